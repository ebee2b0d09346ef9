"""The uncertainty of sampled values, divergences that are known, and the causes of the expected squared error."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.uncertainty import decompose
from imagine_bench_regression import toy_regression as toy
from imagine_bench_regression.uncertainty import jensen_shannon, sampled_component_variance
from scipy import integrate, stats

Rows = list[list[float]]
PAIRS = 400_000
SURE = 4.5
"""Standard errors beyond which chance is no explanation."""
X = 12.5
"""Where all of the causes are worth mentioning: the branches are 13 apart (standard deviation)."""


def mixtures(weights: Rows, means: Rows, sigmas: Rows) -> Mixture:
    """T mixtures of K components for one row of one dimension, from T rows of K numbers."""
    of_weights, of_means, of_sigmas = (
        torch.tensor(rows, dtype=torch.float64).unsqueeze(1) for rows in (weights, means, sigmas)
    )
    return Mixture(of_weights.log(), of_means.unsqueeze(-1), of_sigmas.log().unsqueeze(-1))


def test_a_sampled_value_is_as_uncertain_as_its_component() -> None:
    """Two components far apart: noise 1 and weights that move the mean by 1, noise 9 and weights that agree."""
    both = mixtures([[0.5, 0.5]] * 2, [[0.0, 100.0], [2.0, 100.0]], [[1.0, 3.0]] * 2)
    for members, variances in (
        (1, {1.0: 1.0 + 1.0, 100.0: 9.0}),
        (2, {0.0: 1.0, 2.0: 1.0, 100.0: 9.0}),  # two networks, whose components nobody averages
    ):
        for value, variance in variances.items():
            sampled = torch.tensor([[value]], dtype=torch.float64)
            found = sampled_component_variance(both, mdn.average(both, members), sampled, members=members)
            assert found.item() == pytest.approx(variance, rel=1e-5)


def test_a_value_between_two_components_is_of_each_by_its_density() -> None:
    """Components N(0, 1) and N(4, 3) at the value 2: densities of exp(-2) / 1 and exp(-2 / 9) / 3."""
    both = mixtures([[0.5, 0.5]] * 2, [[0.0, 4.0]] * 2, [[1.0, 3.0]] * 2)
    narrow, wide = math.exp(-2.0), math.exp(-2.0 / 9.0) / 3.0
    expected = (narrow * 1.0 + wide * 9.0) / (narrow + wide)
    sampled = torch.tensor([[2.0]], dtype=torch.float64)
    assert sampled_component_variance(both, mdn.average(both), sampled).item() == pytest.approx(expected, rel=1e-6)


def divergence(found: Mixture, draws: int) -> list[float]:
    return jensen_shannon(found, draws, torch.Generator().manual_seed(0)).tolist()


def gaussians(means: list[float]) -> Mixture:
    """Mixtures of one component of deviation 1."""
    return mixtures([[1.0]] * len(means), [[mean] for mean in means], [[1.0]] * len(means))


def test_equal_distributions_diverge_by_0_disjoint_ones_by_log_t() -> None:
    """Each row for itself."""
    means = torch.stack([torch.ones(5), 100.0 * torch.arange(5)], dim=1)[..., None, None]
    both = Mixture(torch.zeros_like(means[..., 0]), means, torch.zeros_like(means))
    assert divergence(both, 50) == pytest.approx([0.0, math.log(5)], abs=1e-5)


def test_divergence_of_two_gaussians_is_the_integral() -> None:
    def integrand(y: float) -> float:
        p, q = stats.norm.pdf(y, 0, 1), stats.norm.pdf(y, 1.5, 1)
        m = (p + q) / 2
        return 0.5 * (p * np.log(p / m) + q * np.log(q / m))

    exact = integrate.quad(integrand, -10, 12)[0]
    assert divergence(gaussians([0.0, 1.5]), 40_000) == pytest.approx([exact], abs=0.005)


def test_divergence_sees_what_the_variance_of_means_does_not() -> None:
    """Two samples with the same mean, one of two branches and one between them."""
    two = mixtures([[0.5, 0.5]] * 2, [[-3.0, 3.0], [0.0, 0.0]], [[math.exp(-1.0)] * 2] * 2)
    assert decompose(two).epistemic.item() == 0.0
    assert divergence(two, 100)[0] > 0.6


# Equation 4.8 (appendix A of the thesis) -----------------------------------------------------------------------------

WEIGHTS = [[0.5, 0.5], [0.9, 0.1], [0.2, 0.8], [0.4, 0.6]]
MEANS = [[20.0, 45.0], [30.0, 10.0], [35.0, 40.0], [22.0, 50.0]]
SIGMAS = [[4.0, 6.0], [5.0, 5.0], [7.0, 3.0], [9.0, 2.0]]
"""Four weight samples, mixtures of two components that lie beside the truth at X."""


def causes(sigma: float) -> dict[str, float]:
    parts = decompose(mixtures(WEIGHTS, MEANS, SIGMAS))
    mean = float(np.sum(np.multiply(WEIGHTS, MEANS), axis=1).mean())
    branches = toy.branches(np.array(X))
    return {
        "bias²": (branches.mean() - mean) ** 2, "epistemic": float(parts.epistemic), "aleatoric": sigma**2,
        "modal": float(branches.var()), "spread": float(parts.aleatoric + parts.modal),
    }  # fmt: skip


def drawn(rng: np.random.Generator) -> np.ndarray:
    """Values of the mixtures of drawn weight samples. Shape (PAIRS,)."""
    weights, means, sigmas = map(np.array, (WEIGHTS, MEANS, SIGMAS))
    t = rng.integers(len(weights), size=PAIRS)
    k = (rng.random(PAIRS) > weights[t, 0]).astype(int)
    return means[t, k] + sigmas[t, k] * rng.standard_normal(PAIRS)


def targets(sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Of the process of thesis 4.5.1 at X, by its definition. Shape (PAIRS,)."""
    f = np.array([7 * np.sin(0.75 * X) + 0.5 * X, 3 * np.sin(0.5 * X) + 3 * X - 5, 2 * np.sin(0.3 * X) - 0.2 * X + 20])
    return f[rng.integers(3, size=PAIRS)] + sigma * rng.standard_normal(PAIRS)


def test_the_error_is_the_sum_of_its_causes_and_of_no_fewer() -> None:
    rng = np.random.default_rng(0)
    squared = (targets(3.0, rng) - drawn(rng)) ** 2
    error = squared.std() / np.sqrt(PAIRS)
    terms = causes(3.0)
    left = squared.mean() - sum(terms.values())
    assert abs(left) < SURE * error
    for name, value in terms.items():
        assert left + value > SURE * error, f"{name} could be left out"
