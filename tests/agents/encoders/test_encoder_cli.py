"""The command that trains an encoder anew: what it leaves, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from encoder_frames import CHAPTER_5, QUICK, arrow_spec
from imagine_bench.agents.encoders import unfinished
from imagine_bench.agents.encoders.cli import compare, retrain
from imagine_bench.agents.encoders.encoder import Encoder
from PIL import Image

from imagine_bench.errors import ArtefactError, InvalidValueError, UnknownNameError


def made(out: Path, recipe: Any = QUICK, appearance: str = "mild", **how: Any) -> str:
    return retrain(arrow_spec(), recipe=recipe, appearance=appearance, seed=1, out=out, **how)


def test_retrain_leaves_three_files_and_never_overwrites(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unfinished, "_SAVE_EVERY_S", 0.0)
    text = made(tmp_path)
    path = tmp_path / "drawn_arrows-mild.safetensors"
    card = Encoder.load(path).card
    assert f"Wrote {path}" in text
    assert f"{card.probe['mlp']:.2%}" in text
    assert card.command == "imagine-bench encoder --task drawn_arrows --appearance mild --recipe quick --seed 1"
    assert card.cpu_s["total"] == pytest.approx(sum(card.cpu_s[k] for k in ("frames", "training", "probe")), abs=0.2)
    with Image.open(path.with_suffix(".png")) as sheet:
        colors = np.asarray(sheet)
    assert colors.std() > 20
    assert colors.shape[1] > 1000
    written = {file: file.read_bytes() for file in tmp_path.iterdir()}
    assert len(written) == 3
    with pytest.raises(ArtefactError, match="exists already and is never overwritten"):
        made(tmp_path)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == written
    better = replace(card, probe={"linear": 0.5, "mlp": 0.9987, "mlp_sampled": 0.75}, seed=77)
    both = compare(better, card)
    assert all(word in both for word in ("new", "bundled", "99.87%", "77", f"{card.probe['mlp']:.2%}"))


def test_changed_numbers_of_a_named_recipe_are_part_of_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(CHAPTER_5, "quick", QUICK)
    made(tmp_path, "quick", steps=1, batch=9, latents=11)
    card = Encoder.load(tmp_path / "drawn_arrows-mild.safetensors").card
    assert (card.recipe.steps, card.recipe.batch, card.recipe.latents) == (1, 9, 11)
    assert card.command.endswith("--recipe quick --seed 1 --steps 1 --batch 9 --latents 11")


@pytest.mark.parametrize(
    ("how", "error", "message"),
    [
        ({"recipe": "defualt"}, UnknownNameError, r"No encoder recipe 'defualt'. Did you mean 'default'"),
        ({"appearance": "x"}, UnknownNameError, "Known: clean, mild, strong"),
        ({"steps": 0}, InvalidValueError, "has a count below 1"),
        ({"batch": 0}, InvalidValueError, "has a count below 1"),
        ({"latents": 0}, InvalidValueError, "has a count below 1"),
        (
            {"recipe": "codes", "steps": 1, "latents": 11},
            InvalidValueError,
            r"without gradient steps; leave out --steps 1 --latents 11\.",
        ),
        ({"recipe": "codes", "device": "cuda"}, InvalidValueError, "leave out --device cuda"),
    ],
)
def test_wrong_choices_are_named_before_anything_is_made(
    tmp_path: Path, how: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        made(tmp_path / "new", **how)
    assert not (tmp_path / "new").exists()
