"""The command that trains an encoder anew: what it leaves, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from encoder_frames import CHAPTER_5, TINY, TINY_CONV, arrow_spec
from imagine_bench.agents.encoders import unfinished
from imagine_bench.agents.encoders.cli import compare, retrain
from imagine_bench.agents.encoders.encoder import Encoder
from imagine_bench.agents.encoders.training import train_encoder
from PIL import Image

from imagine_bench.errors import ArtefactError, InvalidValueError, UnknownNameError


def test_retrain_leaves_three_files_and_never_overwrites(tmp_path: Path) -> None:
    text = retrain(arrow_spec(), recipe=TINY, appearance="mild", seed=1, out=tmp_path / "new")
    path = tmp_path / "new" / "drawn_arrows-mild.safetensors"
    card = Encoder.load(path).card
    assert f"Wrote {path}" in text and f"{card.probe['mlp']:.2%}" in text
    assert card.command == "imagine-bench encoder --task drawn_arrows --appearance mild --recipe tiny --seed 1"
    assert card.cpu_s["total"] == pytest.approx(sum(card.cpu_s[k] for k in ("frames", "training", "probe")), abs=0.2)
    with Image.open(path.with_suffix(".png")) as sheet:
        colors = np.asarray(sheet)
    assert colors.std() > 20 and colors.shape[1] > 1000
    written = {file: file.read_bytes() for file in path.parent.iterdir()}
    assert len(written) == 3
    with pytest.raises(ArtefactError, match="exists already and is never overwritten"):
        retrain(arrow_spec(), recipe=TINY, appearance="mild", seed=2, out=tmp_path / "new")
    assert {file: file.read_bytes() for file in path.parent.iterdir()} == written


def test_retrain_names_wrong_choices_before_working(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"No encoder recipe 'defualt'. Did you mean 'default'"):
        retrain(arrow_spec(), recipe="defualt", appearance="mild", seed=0, out=tmp_path / "new")
    with pytest.raises(UnknownNameError, match="Known: clean, mild, strong"):
        retrain(arrow_spec(), recipe=TINY, appearance="x", seed=0, out=tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_retrain_with_fewer_steps_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unfinished, "_SAVE_EVERY_S", 0.0)
    monkeypatch.setitem(CHAPTER_5, "tiny_conv", TINY_CONV)
    retrain(arrow_spec(), recipe="tiny_conv", appearance="mild", seed=1, out=tmp_path, steps=1)
    card = Encoder.load(tmp_path / "drawn_arrows-mild.safetensors").card
    assert card.recipe.steps == 1 and card.command.endswith("--recipe tiny_conv --seed 1 --steps 1")
    assert len(list(tmp_path.iterdir())) == 3


def test_retrain_with_other_numbers_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CHAPTER_5, "tiny_conv", TINY_CONV)
    retrain(arrow_spec(), recipe="tiny_conv", appearance="mild", seed=1, out=tmp_path, steps=1, batch=9, latents=11)
    card = Encoder.load(tmp_path / "drawn_arrows-mild.safetensors").card
    assert card.latent_size == 11 and card.recipe.batch == 9
    assert card.command.endswith(" --steps 1 --batch 9 --latents 11")
    for nothing in ({"steps": 0}, {"batch": 0}, {"latents": 0}):
        with pytest.raises(InvalidValueError, match="has a count below 1"):
            retrain(arrow_spec(), recipe="tiny_conv", appearance="mild", seed=1, out=tmp_path / "none", **nothing)
    with pytest.raises(InvalidValueError, match=r"without gradient steps; leave out --steps 1 --latents 11\."):
        retrain(arrow_spec(), recipe="codes", appearance="mild", seed=1, out=tmp_path, steps=1, latents=11)
    with pytest.raises(InvalidValueError, match="leave out --device cuda"):
        retrain(arrow_spec(), recipe="codes", appearance="mild", seed=1, out=tmp_path, device="cuda")


def test_comparison_shows_both_cards() -> None:
    tiny = train_encoder(arrow_spec(), recipe=TINY, appearance="mild", seed=3)
    better = replace(tiny.card, probe={"linear": 0.5, "mlp": 0.9987, "mlp_sampled": 0.75}, seed=77)
    text = compare(better, tiny.card)
    assert "new" in text and "bundled" in text and "99.87%" in text and "77" in text
    assert f"{tiny.card.probe['mlp']:.2%}" in text
