"""The reader recognises fog, noise and blends, and keeps its knowledge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from imagine_bench.agents.world_models.reader import (
    Reader,
    details,
    images_of,
    load_reader,
    train_reader,
)

from imagine_bench import registry
from imagine_bench.judge.reading import reader_errors


def some_frames(count: int) -> tuple[np.ndarray, np.ndarray]:
    spec, rng = registry.task("arrow_puzzle"), np.random.default_rng(9)
    macrostates = np.array(spec.rules.states)[rng.integers(192, size=count)]
    return macrostates, spec.render_macrostates(macrostates, "clean", rng)


@pytest.fixture(scope="module")
def little() -> Reader:
    return train_reader(registry.task("arrow_puzzle"), "clean", frames=300, steps=3)


def test_far_from_every_frame_is_no_picture_even_untrained(little: Reader) -> None:
    _, frames = some_frames(20)
    little.limits[0] = torch.inf  # only the distance decides
    noise = np.random.default_rng(1).integers(0, 256, frames.shape, dtype=np.uint8)
    for nothing in (np.zeros_like(frames), np.full_like(frames, 128), noise):
        assert (little.read(nothing) == -1).all()
    assert (little.read(frames) >= 0).all()


def test_a_kept_reader_reads_the_same(little: Reader, tmp_path: Path) -> None:
    _, frames = some_frames(30)
    (tmp_path / "reader.safetensors").write_bytes(little.content())
    again = load_reader(registry.task("arrow_puzzle"), tmp_path / "reader.safetensors")
    assert np.array_equal(again.read(frames), little.read(frames))
    assert len(little.read(frames[:0])) == 0


def test_pictures_of_any_size_and_color_are_images() -> None:
    _, frames = some_frames(2)
    gray = frames.mean(axis=3).astype(np.float32) / 255.0
    assert images_of(frames).shape == images_of(gray).shape == images_of(gray[:, :50, :40]).shape == (2, 3, 32, 32)
    assert float(images_of(frames).max()) <= 1.0
    likeness = (details(images_of(frames)) * details(images_of(gray))).sum(dim=1)
    assert float(likeness.min()) > 0.99


@pytest.mark.slow
def test_it_reads_what_is_there_and_nothing_else() -> None:
    spec = registry.task("arrow_puzzle")
    errors = reader_errors(train_reader(spec, "clean"), spec, "clean")
    assert errors["misread"] <= 0.002 and errors["refused"] <= 0.005
    assert errors["black_read"] == errors["gray_read"] == errors["noise_read"] == 0.0
    assert errors["blends_read"] <= 0.05
