"""Factors and their values: found where they are, as many as there are, under jitter, and decoded again."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from imagine_bench.agents.encoders.discrete_encoder import DiscreteEncoder, clouds, dependence, discover

from imagine_bench.errors import InvalidValueError

HEIGHT, WIDTH = 22, 24


def box(top: float, left: float, height: float, width: float) -> np.ndarray:
    """How much of each pixel a rectangle covers."""
    sides = []
    for begin, length, pixel in ((top, height, np.arange(HEIGHT)), (left, width, np.arange(WIDTH))):
        sides.append(np.clip(np.minimum(pixel + 1, begin + length) - np.maximum(pixel, begin), 0.0, 1.0))
    return np.outer(*sides)


def images(n: int, rng: np.random.Generator, jitter: float = 0.3) -> tuple[torch.Tensor, np.ndarray]:
    """Two independent objects that jitter: a bar that lies in 3 ways at the top, a dot in 2 places at the bottom.

    A second channel shows them mirrored.
    """
    values = np.stack([rng.integers(3, size=n), rng.integers(2, size=n)], axis=1)
    frames = np.full((n, 1, HEIGHT, WIDTH), 0.5, dtype=np.float32)
    for index, (bar, dot) in enumerate(values.tolist()):
        top, left, height, width = [(2, 2, 2, 8), (2, 13, 2, 8), (0, 10, 10, 2)][bar]
        frames[index] += 0.3 * box(top + jitter * rng.normal(), left + jitter * rng.normal(), height, width)
        frames[index] -= 0.3 * box(17 + jitter * rng.normal(), 4 + 12 * dot + jitter * rng.normal(), 4, 4)
    light = rng.uniform(0.9, 1.1, size=(n, 1, 1, 1)).astype(np.float32)
    lit = np.clip(frames * light, 0.0, 1.0)
    return torch.from_numpy(np.concatenate([lit, lit[..., ::-1]], axis=1)), values


@pytest.fixture(scope="module")
def found() -> DiscreteEncoder:
    return discover(images(3000, np.random.default_rng(0))[0], torch.Generator().manual_seed(0))


def test_factors_and_values_are_found_without_being_told(found: DiscreteEncoder) -> None:
    assert sorted(found.code_sizes) == [2, 3]
    fresh, values = images(400, np.random.default_rng(1))
    codes = found.codes(fresh).numpy()
    order = [found.code_sizes.index(3), found.code_sizes.index(2)]
    for factor, truth in zip(order, values.T, strict=True):
        pairs = set(zip(codes[:, factor].tolist(), truth.tolist(), strict=True))
        assert len(pairs) == len(set(truth.tolist())), "each value is one code and each code one value"


def test_a_code_is_decoded_to_how_its_values_look(found: DiscreteEncoder) -> None:
    fresh, _ = images(200, np.random.default_rng(2), jitter=0.0)
    mu, log_variance = found.posterior(fresh)
    assert (mu.sum(dim=1) == 2.0).all() and (log_variance < -10).all()
    assert (found.mean(mu) - fresh).square().mean() < 0.5 * (fresh.mean(dim=0) - fresh).square().mean()


def test_still_images_have_no_factors() -> None:
    with pytest.raises(InvalidValueError, match="No factor with two values"):
        discover(torch.full((50, 1, HEIGHT, WIDTH), 0.5), torch.Generator().manual_seed(0))


def test_dependence_sees_what_correlation_does_not() -> None:
    x, other = np.random.default_rng(0).normal(size=(2, 4000))
    table = dependence(np.stack([x, x**2, other], axis=1))
    assert abs(np.corrcoef(x, x**2)[0, 1]) < 0.1
    assert table[0, 1] > 0.9 and table[0, 2] < 0.1
    assert np.array_equal(table, table.T)


@pytest.mark.parametrize("flushed", [False, True])
def test_clouds_of_any_shape_are_counted_and_equal_points_joined(flushed: bool) -> None:
    torch.set_flush_denormal(flushed)  # as every learner of the suite runs; the tree of neighbours must not mind
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, size=2000)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) + 0.02 * rng.normal(size=(2000, 2))
    label = clouds(np.concatenate([ring, np.zeros((300, 2))]))
    assert label.max() == 1
    assert (label[2000:] == label[2000]).all() and (label[:2000] != label[2000]).all()


def torn(gap: float) -> np.ndarray:
    """Four clouds of 400 points: two of them ``gap`` apart, the other two 2.4 to 3.4 away from every other."""
    rng = np.random.default_rng(0)
    corners = [(-0.2, 0.0), (gap, 0.0), (0.0, 2.8), (2.8, 2.8)]
    return np.concatenate([np.array(corner) + rng.uniform(0.0, 0.2, size=(400, 2)) for corner in corners])


@pytest.mark.parametrize(("gap", "values"), [(0.15, 3), (0.9, 4)])
def test_a_value_that_is_torn_by_a_narrow_gap_is_one(gap: float, values: int) -> None:
    label = clouds(torn(gap)).reshape(4, 400)
    assert label.max() + 1 == values
    owners = [set(row.tolist()) - {-1} for row in label]
    assert all(len(owner) == 1 for owner in owners)
    assert (owners[0] == owners[1]) == (values == 3)
    assert owners[2] != owners[3]
    assert values == 4 or owners[0] == {0}, "the largest comes first, counted whole"
