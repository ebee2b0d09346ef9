"""The mixture's mathematics against the formula, with scipy's densities."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.mixture import Mixture
from scipy import special, stats

N, K, Z = 7, 4, 3


def random_mixture(*leading: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Mixture:
    generator = torch.Generator().manual_seed(seed)
    outputs = torch.randn(*leading, mdn.output_size(K, Z), generator=generator, dtype=dtype) * 2.0
    return mdn.from_outputs(outputs, K, Z, log_sigma_floor=-4.0)


def log_density(mixture: Mixture, values: torch.Tensor) -> np.ndarray:
    """``log sum_k w_k prod_d N(values_d; mu_kd, sigma_kd)``. Shape (N,)."""
    normal = stats.norm.logpdf(values.numpy()[:, None], mixture.means.numpy(), mixture.log_sigmas.exp().numpy())
    return np.asarray(special.logsumexp(mixture.log_weights.numpy() + normal.sum(axis=-1), axis=-1))


def test_log_likelihood_and_mean_are_those_of_the_density() -> None:
    mixture = random_mixture(N)
    targets = torch.randn(N, Z, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 3.0
    assert mdn.log_likelihood(mixture, targets).numpy() == pytest.approx(log_density(mixture, targets), rel=1e-10)
    weights = mixture.log_weights.exp()
    torch.testing.assert_close(weights.sum(-1), torch.ones(N, dtype=torch.float64))
    torch.testing.assert_close(mdn.mean(mixture), torch.einsum("nk,nkz->nz", weights, mixture.means))


def test_log_likelihood_stays_finite_where_densities_underflow() -> None:
    mixture = random_mixture(N, dtype=torch.float32)
    far = torch.full((N, Z), 300.0)
    assert np.exp(log_density(mixture, far)).max() == 0.0, "the density itself must underflow here"
    assert torch.isfinite(mdn.log_likelihood(mixture, far)).all()


def test_sigma_stays_within_its_bounds_and_keeps_a_gradient() -> None:
    log_variances = torch.tensor([[-1e3, -2.0, 0.0, 2.0, 1e3]], dtype=torch.float64)
    outputs = torch.cat([torch.zeros(1, 10, dtype=torch.float64), log_variances], dim=1)  # K = 5, Z = 1
    bounded = mdn.from_outputs(outputs, 5, 1, log_sigma_floor=-30.0, log_sigma_ceiling=40.0).log_sigmas.flatten()
    assert bounded.tolist() == pytest.approx([-30.0, -1.0, 0.0, 1.0, 40.0], abs=1e-9)
    assert mdn.from_outputs(outputs, 5, 1, -30.0).log_sigmas.max() == 500.0, "there need not be a ceiling"
    below = torch.full((1, mdn.output_size(K, Z)), -8.0, requires_grad=True)
    mdn.from_outputs(below, K, Z, log_sigma_floor=-4.0).log_sigmas.sum().backward()
    assert below.grad is not None
    assert (below.grad[:, -K * Z :] > 0.1).all()


def test_samples_have_the_mean_and_variance_of_the_mixture() -> None:
    one = random_mixture(1)
    count = 50_000
    many = one.map(lambda values: values.expand(count, *values.shape[1:]))
    weights = one.log_weights.exp().unsqueeze(-1)  # [1, K, 1]
    squares = (weights * (one.means.square() + (2.0 * one.log_sigmas).exp())).sum(dim=1)
    variance = (squares - mdn.mean(one).square())[0]
    drawn = mdn.sample(many, 1.0, torch.Generator().manual_seed(4))
    error = drawn.mean(0) - mdn.mean(one)[0]
    assert (error.abs() < 4.0 * (variance / count).sqrt()).all()
    torch.testing.assert_close(drawn.var(0), variance, rtol=0.05, atol=0.0)


def test_temperature_scales_the_noise_around_a_component() -> None:
    mixture = random_mixture(N)
    cold, half, warm = (mdn.sample(mixture, t, torch.Generator().manual_seed(5)) for t in (0.0, 0.5, 1.0))
    distance = (mixture.means - cold.unsqueeze(1)).abs().sum(-1)  # [N, K]
    assert (distance.min(dim=1).values == 0.0).all()
    torch.testing.assert_close(half - cold, 0.5 * (warm - cold))
    assert (warm != cold).all()


@pytest.mark.parametrize("members", [1, 3])
def test_average_is_over_weight_samples_and_side_by_side_over_members(members: int) -> None:
    """Networks may order their components in other ways: averaging those one by one would invent places."""
    samples = random_mixture(2 * members, N)
    averaged = mdn.average(samples, members)
    pairs = [samples.map(lambda part, at=at: part[2 * at : 2 * at + 2]) for at in range(members)]  # two of each
    weights = torch.cat([each.log_weights.exp().mean(0) for each in pairs], dim=1) / members
    torch.testing.assert_close(averaged.log_weights.exp(), weights)
    torch.testing.assert_close(averaged.means, torch.cat([each.means.mean(0) for each in pairs], dim=1))
    variances = torch.cat([(2.0 * each.log_sigmas).exp().mean(0) for each in pairs], dim=1)
    torch.testing.assert_close((2.0 * averaged.log_sigmas).exp(), variances)


@pytest.mark.parametrize(("components", "least", "most"), [(6, 0.0, 0.25), (1, 0.5, 1.0)])
def test_a_mixture_holds_several_outcomes_and_one_gaussian_does_not(components: int, least: float, most: float) -> None:
    """A coin of three sides, at -2, 0 and 3: a fit by its likelihood is off by this total variation."""
    sides = torch.tensor([-2.0, 0.0, 3.0])
    shares = torch.tensor([0.5, 0.3, 0.2])
    draws = torch.Generator().manual_seed(0)
    outputs = torch.randn(mdn.output_size(components, 1), generator=draws).requires_grad_()
    optimizer = torch.optim.SGD([outputs], lr=0.2)
    for _ in range(600):
        optimizer.zero_grad()
        fitted = mdn.from_outputs(outputs, components, 1, log_sigma_floor=-2.0)
        loss = -shares @ mdn.log_likelihood(fitted, sides[:, None])
        loss.backward()
        optimizer.step()
    many = fitted.map(lambda part: part.detach().expand(2_000, *part.shape))
    near = (mdn.sample(many, 1.0, draws) - sides).abs() < 0.6  # [samples, sides]
    read = near.double().mean(dim=0)
    away = 0.5 * float((read - shares).abs().sum() + 1.0 - read.sum())
    assert least <= away <= most
