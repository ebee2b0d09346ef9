"""The uncertainty of sampled values, and divergences that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.uncertainty import decompose
from imagine_bench_regression.uncertainty import jensen_shannon, sampled_component_variance
from scipy import integrate, stats


def test_a_sampled_value_is_as_uncertain_as_its_component() -> None:
    """Two components far apart: noise 1 and weights that move the mean by 1, noise 9 and weights that agree."""
    means = torch.tensor([[[[0.0], [100.0]]], [[[2.0], [100.0]]]])  # [T = 2, N = 1, K = 2, Z = 1]
    log_sigmas = torch.tensor([1.0, 3.0]).log().view(1, 1, 2, 1).expand(2, 1, 2, 1)
    both = Mixture(torch.full((2, 1, 2), 0.5).log(), means, log_sigmas)
    for value, variance in ((1.0, 1.0 + 1.0), (100.0, 9.0)):
        found = sampled_component_variance(both, mdn.average(both), torch.tensor([[value]]))
        assert found.item() == pytest.approx(variance, rel=1e-5)
    for value, variance in ((0.0, 1.0), (2.0, 1.0), (100.0, 9.0)):  # two networks, whose components nobody averages
        found = sampled_component_variance(both, mdn.average(both, 2), torch.tensor([[value]]), members=2)
        assert found.item() == pytest.approx(variance, rel=1e-5)


def gaussians(means: list[float], sigma: float) -> Mixture:
    """T mixtures of one component for one row of one dimension."""
    count = len(means)
    values = torch.tensor(means).view(count, 1, 1, 1)
    return Mixture(torch.zeros(count, 1, 1), values, torch.full_like(values, math.log(sigma)))


def divergence(mixtures: Mixture, draws: int) -> float:
    return jensen_shannon(mixtures, draws, torch.Generator().manual_seed(0))[0].item()


def test_equal_distributions_diverge_by_0_disjoint_ones_by_log_t() -> None:
    assert divergence(gaussians([1.0] * 5, 1.0), 50) == pytest.approx(0.0, abs=1e-5)
    apart = gaussians([100.0 * t for t in range(5)], 1.0)
    assert divergence(apart, 4) == pytest.approx(math.log(5), abs=1e-5)


def test_divergence_of_two_gaussians_is_the_integral() -> None:
    def integrand(y: float) -> float:
        p, q = stats.norm.pdf(y, 0, 1), stats.norm.pdf(y, 1.5, 1)
        m = (p + q) / 2
        return 0.5 * (p * np.log(p / m) + q * np.log(q / m))

    exact = integrate.quad(integrand, -10, 12)[0]
    estimate = divergence(gaussians([0.0, 1.5], 1.0), 40_000)
    assert estimate == pytest.approx(exact, abs=0.005)


def test_divergence_sees_what_the_variance_of_means_does_not() -> None:
    """Two samples with the same mean, one of two branches and one between them."""
    weights = torch.tensor([[[0.5, 0.5]], [[0.5, 0.5]]]).log()
    means = torch.tensor([[[[-3.0], [3.0]]], [[[0.0], [0.0]]]])
    two = Mixture(weights, means, torch.full((2, 1, 2, 1), -1.0))
    assert decompose(two).epistemic.item() == 0.0
    assert divergence(two, 100) > 0.6
