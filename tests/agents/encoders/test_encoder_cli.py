"""The command that trains an encoder anew: its files, and its refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from encoder_frames import CHAPTER_5, QUICK, arrow_spec
from imagine_bench.agents.encoders import training
from imagine_bench.agents.encoders.cli import retrain
from imagine_bench.agents.encoders.encoder import Encoder
from PIL import Image

from imagine_bench.errors import ArtefactError, InvalidValueError, UnknownNameError


def made(out: Path, recipe: Any = QUICK, appearance: str = "mild", **how: Any) -> str:
    return retrain(arrow_spec(), recipe=recipe, appearance=appearance, seed=1, out=out, **how)


def test_retrain_leaves_three_files_and_never_overwrites(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "SAVE_EVERY_S", 0.0)
    monkeypatch.setitem(CHAPTER_5, "quick", QUICK)
    text = made(tmp_path, "quick", batch=9, latents=11)
    path = tmp_path / "drawn_arrows-mild.safetensors"
    card = Encoder.load(path).card
    assert f"Wrote {path}" in text
    assert f"mlp {card.probe['mlp']:.2%}" in text
    assert (card.recipe.steps, card.recipe.batch, card.recipe.latents) == (QUICK.steps, 9, 11)
    command = "imagine-bench encoder --task drawn_arrows --appearance mild --recipe quick --seed 1"
    assert card.command == f"{command} --batch 9 --latents 11"
    with Image.open(path.with_suffix(".png")) as sheet:
        assert np.asarray(sheet).std() > 20
        assert sheet.width > 1000
    written = {file: file.read_bytes() for file in tmp_path.iterdir()}
    assert len(written) == 3
    with pytest.raises(ArtefactError, match="exists already and is never overwritten"):
        made(tmp_path)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == written


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"recipe": "defualt"}, r"No encoder recipe 'defualt'. Did you mean 'default'"),
        ({"appearance": "x"}, "Known: clean, mild, strong"),
        ({"latents": 0}, "needs latents, frames"),
        ({"recipe": "codes", "steps": 1, "latents": 11}, r"gradient steps; leave out --steps 1 --latents 11\."),
        ({"recipe": "codes", "device": "cuda"}, "leave out --device cuda"),
    ],
)
def test_wrong_choices_are_named_before_anything_is_made(tmp_path: Path, how: dict[str, Any], message: str) -> None:
    with pytest.raises((InvalidValueError, UnknownNameError), match=message):
        made(tmp_path / "new", **how)
    assert not (tmp_path / "new").exists()
