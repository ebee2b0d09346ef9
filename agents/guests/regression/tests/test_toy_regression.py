"""The toy data and its closed-form truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imagine_bench_regression import toy_regression as toy
from imagine_bench_regression.recordings import record_toy
from recordings import logged
from scipy import stats

from imagine_bench.interfaces.regression import Prediction
from imagine_bench.seeding import SeedTree


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_branches_by_hand() -> None:
    expected = [7 * np.sin(1.5) + 1, 3 * np.sin(1.0) + 1, 2 * np.sin(0.6) + 19.6]
    np.testing.assert_allclose(toy.branches(np.array(2.0)), expected)


@pytest.mark.parametrize("variant", toy.VARIANTS)
def test_data_has_the_counts_and_the_noise_of_its_variant(variant: str) -> None:
    data = toy.training(variant, rng())
    inside = abs(data.inputs) <= toy.REGION
    assert (inside.sum(), (~inside).sum()) == ((13 if variant == "low_data" else 667), 1333)
    assert abs(data.inputs).max() <= 30
    many = toy.testing(variant, rng(), 60_000)
    nearest = toy.errors(variant, many.inputs, many.targets)  # in standard deviations of the noise
    far = np.abs(np.diff(np.sort(toy.branches(many.inputs[:, 0]), axis=1), axis=1)).min(axis=1) > 20
    assert far.sum() > 500
    assert stats.kstest(nearest[far], "halfnorm").pvalue > 1e-4  # where branches are far apart, the nearest is the own


def test_noise_is_three_times_as_large_in_the_noisy_region_only() -> None:
    x = np.array([-10.1, -10.0, 0.0, 10.0, 10.1])
    np.testing.assert_array_equal(toy.noise_sigma("high_noise", x), [1, 3, 3, 3, 1])
    np.testing.assert_array_equal(toy.noise_sigma("base", x), np.ones(5))


def test_the_true_uncertainties_are_of_the_curves_and_the_noise() -> None:
    """Beside networks of which each value drawn is 5: the error is the bias, the distance of the curves, the noise."""

    def predict(inputs: np.ndarray, purpose: str) -> Prediction:
        shape = (*inputs.shape[:2], 1)
        said: dict[str, Any] = {field.name: np.full(shape, 5.0) for field in dataclasses.fields(Prediction)}
        return Prediction(**{**said, "epistemic": np.full(shape, 2.0), "drawn": np.full((*shape[:2], 300, 1), 5.0)})

    found = toy.evaluate("high_noise", predict, (SeedTree(0), SeedTree(1)))
    branches = toy.branches(found["x"])
    mean = branches.mean(axis=1)
    noise = np.where(np.abs(found["x"]) <= 10.0, 9.0, 1.0)
    np.testing.assert_array_equal(found["true_aleatoric"], noise)
    np.testing.assert_allclose(found["true_modal"], ((branches - mean[:, None]) ** 2).mean(axis=1))
    np.testing.assert_allclose(found["true_epistemic"], np.tile((mean - 5.0) ** 2 + 2.0, (2, 1)))
    expected = found["true_epistemic"][0] - 2.0 + found["true_modal"] + noise
    assert (found["squared_error"] / expected).mean() == pytest.approx(1.0, abs=0.005)


def test_a_recording_shows_standard_deviations_beside_the_true_ones(tmp_path: Path) -> None:
    """Of the first network, over 100 x; the training data in the order of x."""
    x = np.array([-1.0, 0.0, 2.5])
    data = {"x": x, "training_x": x[::-1], "training_y": x[::-1] ** 2, "prediction": np.stack([x + 1.0, x])}
    curves = {"y/training": x**2, "y/prediction": x + 1.0}
    for place, kind in enumerate(("epistemic", "modal", "aleatoric"), start=1):
        data |= {kind: np.full((2, 3), 4.0 * place), f"true_{kind}": np.full(3, 9.0 * place)}
        curves |= {f"{kind}/{name}": np.full(3, std * place**0.5) for name, std in (("estimated", 2.0), ("true", 3.0))}
    path = record_toy({"base": data}, task=toy.SPEC, name="mdn", path=tmp_path / "toy.rrd")
    for name, values in curves.items():
        places, shown = zip(*logged(path, f"/base/{name}", "Scalars:scalars", "x_hundredths"), strict=True)
        assert places == (-100, 0, 250)
        np.testing.assert_allclose(np.ravel(shown), values)
