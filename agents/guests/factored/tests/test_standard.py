"""Frames without nuisances: each correction is made where it is needed, undoes its nuisance, and changes no more."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from fake_pictures import picture, shape
from imagine_bench_factored.seeing import appearance
from imagine_bench_factored.seeing.standard import Standard, standard_of
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame

COUNT = 60
VALUES = 3
PLACES = ((10, 8), (10, 40), (40, 24))


def scene(codes: NDArray[np.int64]) -> Frame:
    """Three marks in frames that stand still, and a striped border: no nuisance."""
    images = np.full((len(codes), 64, 64, 3), 110.0)
    images[:, 27:30, 4:60] = (60.0, 80.0, 90.0)
    images[:, 56:58, 10:50] = (190.0, 160.0, 120.0)
    for row, code in enumerate(codes):
        for value, (top, left) in zip(code, PLACES, strict=True):
            images[row, top - 2 : top + 14, left - 2 : left + 14] = (200.0, 190.0, 180.0)
            images[row, top : top + 12, left : left + 12] -= 150.0 * shape(value)[..., None]
    return images.round().astype(np.uint8)


def drawn(seed: int = 0) -> tuple[NDArray[np.int64], Frame]:
    codes = np.random.default_rng(seed).integers(VALUES, size=(COUNT, len(PLACES)))
    return codes, scene(codes)


def shifted(frames: Frame, by_px: NDArray[np.int64]) -> Frame:
    pairs = zip(frames, by_px.tolist(), strict=True)
    padded = [(np.pad(frame, ((6, 6), (6, 6), (0, 0)), mode="edge"), by) for frame, by in pairs]
    return np.stack([each[6 - down : 70 - down, 6 - right : 70 - right] for each, (down, right) in padded])


def shadowed(frames: Frame, rng: np.random.Generator) -> Frame:
    rows, columns = np.mgrid[:64, :64]
    places = rng.uniform(0.0, 64.0, (len(frames), 2, 1, 1))
    away = ((rows - places[:, 0]) ** 2 + (columns - places[:, 1]) ** 2) / (2 * 13.0**2)
    return np.asarray(frames * (1.0 - 0.5 * np.exp(-away))[..., None]).astype(np.uint8)


def noisy(frames: Frame, rng: np.random.Generator, levels: float = 20.0) -> Frame:
    return np.clip(frames + levels * rng.standard_normal(frames.shape), 0, 255).astype(np.uint8)


def occluded(frames: Frame, rng: np.random.Generator) -> tuple[Frame, NDArray[np.bool_]]:
    hidden = np.zeros(frames.shape[:3], dtype=bool)
    seen = frames.copy()
    for row in range(len(frames)):
        top, left = rng.integers(0, 56, size=2)
        hidden[row, top : top + 8, left : left + 8] = True
        seen[row, top : top + 8, left : left + 8] = rng.integers(256)
    return seen, hidden


def corrections(standard: Standard) -> set[str]:
    made = {"moved": standard.spectrum, "noise": standard.components, "hidden": standard.usual}
    return {name for name, each in made.items() if each is not None} | ({"light"} if standard.is_uneven else set())


def pairs(found: list[appearance.SeenFactor], frames: object, codes: NDArray[np.int64]) -> list[int]:
    """How many pairs of a found and a true value there are, of the true factor that each found one is."""
    read, _, _ = appearance.read(found, np.asarray(frames))
    return sorted(
        min(len(set(zip(values.tolist(), truth.tolist(), strict=True))) for values in read.T) for truth in codes.T
    )


def test_frames_without_nuisances_stay_as_they_are() -> None:
    for count in (5, 12, 30, COUNT):
        frames = drawn()[1][:count]
        standard = standard_of(frames)
        assert not corrections(standard)
        assert standard.of(frames) is frames


def test_things_that_move_by_themselves_are_no_moving_camera() -> None:
    rng = np.random.default_rng(0)
    frames = np.stack([picture(code, rng) for code in rng.integers(2, size=(COUNT, 3)).tolist()])
    assert not corrections(standard_of(frames))


def test_a_shift_is_undone_to_the_pixel() -> None:
    _, frames = drawn()
    by_px = np.random.default_rng(1).integers(-5, 6, size=(COUNT, 2))
    standard = standard_of(shifted(frames, by_px))
    assert corrections(standard) == {"moved"}
    upright = standard.of(shifted(frames, by_px))
    inner = np.s_[:, 8:-8, 8:-8]
    moves = itertools.product(range(-6, 7), repeat=2)
    apart = [np.abs(np.roll(upright, move, axis=(1, 2))[inner] - frames[inner]).max() for move in moves]
    assert min(apart) == 0.0, "all frames lie alike, by whatever all of them are off"


def test_nearly_all_half_hidden_values_are_read() -> None:
    codes, frames = drawn(2)
    seen, _ = occluded(frames, np.random.default_rng(2))
    standard = standard_of(seen)
    assert corrections(standard) == {"hidden"}
    whole = standard.of(seen)
    read, _, _ = appearance.read(appearance.find(whole), np.asarray(whole))
    for truth in codes.T:
        assert max(share_right(values, truth) for values in read.T) >= 0.95


def test_what_is_hidden_is_not_clear_and_all_that_is_clear_is_right() -> None:
    codes, frames = drawn(2)
    found = appearance.find(frames)
    assert appearance.read(found, frames).clear.all(), "nothing is hidden"
    hidden = frames.astype(np.float32)
    top, left = np.random.default_rng(3).integers(0, 12, size=(2, COUNT))
    for frame, row, column in zip(hidden, top, left, strict=True):
        frame[row : row + 14, column : column + 14] = np.nan  # over the first mark, or a part of it
    values, _, clear = appearance.read(found, hidden)
    first = [column for column in range(len(PLACES)) if not clear[:, column].all()]
    assert len(first) == 1 and 0.2 < clear[:, first].mean() < 0.9
    told = {
        code: value for code, value in zip(codes[:, 0], appearance.read(found, frames).values[:, first[0]], strict=True)
    }
    right = values[:, first[0]] == [told[code] for code in codes[:, 0].tolist()]
    assert right[clear[:, first[0]]].all() and not right.all()


def share_right(values: NDArray[np.int64], truth: NDArray[np.int64]) -> float:
    """The share of frames in which a found value stands for the true value that it stands for most often."""
    usual = sum(np.bincount(truth[values == value]).max() for value in np.unique(values))
    return float(usual / len(truth))


@pytest.mark.parametrize("nuisance", ["moved", "light", "noise"])
def test_values_are_found_and_read_behind_a_nuisance(nuisance: str) -> None:
    rng = np.random.default_rng(2)
    codes, frames = drawn(2)
    if nuisance == "moved":
        seen = shifted(frames, rng.integers(-4, 5, size=(COUNT, 2)))
    else:
        seen = {"light": shadowed, "noise": noisy}[nuisance](frames, rng)
    standard = standard_of(seen)
    assert corrections(standard) == {nuisance}
    whole = standard.of(seen)
    assert pairs(appearance.find(whole), whole, codes) == [VALUES] * len(PLACES)


@pytest.mark.parametrize(
    ("brightness", "lit", "where", "least"),
    [*((each, True, np.s_[31:39, 16:60], 140) for each in (0.5, 0.7, 1.0, 1.3)), (1.0, False, np.s_[5:25], 165)],
)
def test_noise_is_taken_away_in_dark_and_in_bright_frames(
    brightness: float, lit: bool, where: tuple[slice, ...], least: float
) -> None:
    """Dividing a frame by its light changes its noise by as much; a new thing stays where that is less."""
    rng = np.random.default_rng(5)
    _, frames = drawn(5)
    standard = standard_of(noisy(shadowed(frames, rng) if lit else frames, rng))
    assert corrections(standard) == ({"light", "noise"} if lit else {"noise"})
    strange = frames[:5].copy()
    strange[:, 40:52, 2:14] = 190
    clean = standard.of(noisy(brightness * strange, rng))
    assert np.array([each[where] for each in clean - strange]).std() < 0.35 * 20.0 / brightness
    if brightness >= 1.0:
        assert clean[:, 43:49, 5:11].mean(axis=(1, 2)).min() > least, "the background is 110"


def test_most_hidden_pixels_are_no_numbers_and_few_others() -> None:
    rng = np.random.default_rng(4)
    _, frames = drawn(4)
    seen, hidden = occluded(frames, rng)
    found = np.isnan(standard_of(seen).of(seen)).any(axis=-1)
    different = hidden & (np.abs(seen.astype(int) - frames).max(axis=-1) > 40)
    assert found[different].mean() > 0.8
    assert found[~hidden].mean() < 0.02


def test_crops_that_are_all_hidden_in_part_are_compared_by_the_rest() -> None:
    mask = np.zeros((64, 64), dtype=bool)
    mask[10:14, 10:14] = True
    draws = np.random.default_rng(3)
    whole = appearance.crops(draws.normal(size=(3, 64, 64, 2)), mask)
    hidden = whole.copy()
    hidden[:, 0] = np.nan
    apart = appearance.distances(hidden, whole, mask, 1e-6)
    assert (apart.argmin(axis=1) == np.arange(3)).all()
    half = whole.shape[1] // 2
    hidden[:, :half] = np.nan
    whole[:, :half] *= 20.0
    apart = appearance.distances(hidden, whole, mask, 1e-6)
    assert apart.diagonal() == pytest.approx([0.0] * 3, abs=1e-5) and (apart + np.eye(3)).min() > 0.05
