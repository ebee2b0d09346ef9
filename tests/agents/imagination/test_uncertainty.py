"""The split of the predictive variance against brute force."""

from __future__ import annotations

import pytest
import torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.uncertainty import REDUCTIONS, decompose, nll

T, N, K, Z = 6, 5, 3, 2


def samples(dtype: torch.dtype) -> Mixture:
    generator = torch.Generator().manual_seed(0)
    outputs = torch.randn(T, N, mdn.output_size(K, Z), generator=generator, dtype=torch.float64)
    return mdn.from_outputs(outputs.to(dtype), K, Z, log_sigma_floor=-3.0)


def moments(mixtures: Mixture) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Weights (T, N, K, 1), means and variances (T, N, K, Z) of the components."""
    return mixtures.log_weights.exp().unsqueeze(-1), mixtures.means, (2.0 * mixtures.log_sigmas).exp()


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_each_cause_is_its_equation(dtype: torch.dtype, relative: float) -> None:
    """And so they sum to the variance of the uniform mixture over all T K components."""
    parts = decompose(samples(dtype))
    alpha, mu, var = (each.double() for each in moments(samples(dtype)))
    inner = (alpha * mu).sum(2)  # [T, N, Z]
    epistemic = inner.square().mean(0) - inner.mean(0).square()  # 4.25
    aleatoric = (alpha * var).sum(2).mean(0)  # 4.26
    modal = ((alpha * mu.square()).sum(2) - inner.square()).mean(0)  # 4.27
    for found, expected in zip(
        (parts.epistemic, parts.aleatoric, parts.modal), (epistemic, aleatoric, modal), strict=True
    ):
        torch.testing.assert_close(found.double(), expected, rtol=relative, atol=0.0)


VALUES = torch.linspace(-2.0, 2.0, N * Z, dtype=torch.float64).view(N, Z)


def test_nll_is_that_of_all_weight_samples_together() -> None:
    mixtures = samples(torch.float64)
    densities = [mdn.log_likelihood(mixtures.map(lambda part, t=t: part[t]), VALUES).exp() for t in range(T)]
    torch.testing.assert_close(nll(mixtures, VALUES), -torch.stack(densities).mean(dim=0).log())


def test_the_variances_of_one_vector_become_one_number() -> None:
    values = torch.tensor([[1.0, 2.0, 6.0], [0.0, 0.0, 3.0]])  # [N, Z]
    found = {name: reduce(values).tolist() for name, reduce in REDUCTIONS.items()}
    assert found == {"sum": [9.0, 3.0], "mean": [3.0, 1.0], "max": [6.0, 3.0]}
