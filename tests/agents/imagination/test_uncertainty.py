"""The split of the predictive variance against brute force, and divergences that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.uncertainty import decompose, jensen_shannon, nll, sampled_component_variance
from scipy import integrate, stats

T, N, K, Z = 6, 5, 3, 2


def samples(dtype: torch.dtype) -> Mixture:
    generator = torch.Generator().manual_seed(0)
    outputs = torch.randn(T, N, mdn.output_size(K, Z), generator=generator, dtype=torch.float64)
    return mdn.from_outputs(outputs.to(dtype), K, Z, log_sigma_floor=-3.0)


def moments(mixtures: Mixture) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Weights (T, N, K, 1), means and variances (T, N, K, Z) of the components."""
    return mixtures.log_weights.exp().unsqueeze(-1), mixtures.means, (2.0 * mixtures.log_sigmas).exp()


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_the_three_causes_sum_to_the_total_predictive_variance(dtype: torch.dtype, relative: float) -> None:
    """That of the uniform mixture over all T K components, by second moments."""
    parts = decompose(samples(dtype))
    weights, means, variances = (each.double() for each in moments(samples(dtype)))
    first = (weights * means).sum(2).mean(0)
    second = (weights * (variances + means.square())).sum(2).mean(0)
    total = (parts.epistemic + parts.aleatoric + parts.modal).double()
    torch.testing.assert_close(total, second - first.square(), rtol=relative, atol=0.0)


def test_each_cause_is_its_equation() -> None:
    mixtures = samples(torch.float64)
    alpha, mu, var = moments(mixtures)
    inner = (alpha * mu).sum(2)  # [T, N, Z]
    parts = decompose(mixtures)
    torch.testing.assert_close(parts.epistemic, inner.square().mean(0) - inner.mean(0).square())  # 4.25
    torch.testing.assert_close(parts.aleatoric, (alpha * var).sum(2).mean(0))  # 4.26
    torch.testing.assert_close(parts.modal, ((alpha * mu.square()).sum(2) - inner.square()).mean(0))  # 4.27


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


VALUES = torch.linspace(-2.0, 2.0, N * Z, dtype=torch.float64).view(N, Z)


def test_nll_is_that_of_all_weight_samples_together() -> None:
    mixtures = samples(torch.float64)
    densities = [mdn.log_likelihood(mixtures.map(lambda part, t=t: part[t]), VALUES).exp() for t in range(T)]
    torch.testing.assert_close(nll(mixtures, VALUES), -torch.stack(densities).mean(dim=0).log())


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
