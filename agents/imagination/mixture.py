"""The mathematics of Gaussian mixtures with diagonal components, in log space (thesis 2.1.5; Bishop 1994).

Shapes: ``...`` any leading axes, ``K`` components, ``Z`` dimensions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, distributions
from torch.nn import functional


@dataclass(frozen=True, slots=True)
class Mixture:
    """Gaussian mixtures, one a leading index."""

    log_weights: Tensor  #: logarithms of the mixture coefficients, normalised. Shape (..., K).
    means: Tensor  #: shape (..., K, Z)
    log_sigmas: Tensor  #: logarithms of the standard deviations. Shape (..., K, Z).

    def map(self, change: Callable[[Tensor], Tensor]) -> Mixture:
        """The mixtures whose three tensors are changed alike, in their leading axes."""
        return Mixture(change(self.log_weights), change(self.means), change(self.log_sigmas))


def output_size(components: int, dimensions: int) -> int:
    """Network outputs that one mixture needs: K coefficients, K Z means, K Z log variances."""
    return components * (1 + 2 * dimensions)


def from_outputs(
    outputs: Tensor, components: int, dimensions: int, log_sigma_floor: float, log_sigma_ceiling: float = math.inf
) -> Mixture:
    """Read network outputs (..., output_size(K, Z)): softmax coefficients, linear means, linear log variances.

    The smallest log sigma is approached smoothly: a hard clamp would leave no gradient below it. So is the largest: far
    from all data a linear output has no bound, and a variance that overflows spoils every sum it is in.
    """
    logits, means, log_variances = outputs.split((components, *2 * (components * dimensions,)), dim=-1)
    shape = (*outputs.shape[:-1], components, dimensions)
    log_sigmas = log_sigma_floor + functional.softplus(0.5 * log_variances - log_sigma_floor)
    if log_sigma_ceiling < math.inf:
        log_sigmas = log_sigma_ceiling - functional.softplus(log_sigma_ceiling - log_sigmas)
    return Mixture(logits.log_softmax(dim=-1), means.reshape(shape), log_sigmas.reshape(shape))


def log_likelihood(mixture: Mixture, targets: Tensor) -> Tensor:
    """``log p(targets)``. Targets (..., Z), result (...). Leading axes broadcast.

    The distributions of torch cost 2 % of a model update more than the formula written out.
    """
    normal = distributions.Normal(mixture.means, mixture.log_sigmas.exp(), validate_args=False)
    components = distributions.Independent(normal, 1, validate_args=False)
    weights = distributions.Categorical(logits=mixture.log_weights, validate_args=False)
    return distributions.MixtureSameFamily(weights, components, validate_args=False).log_prob(targets)


def mean(mixture: Mixture) -> Tensor:
    """Mean of each mixture. Shape (..., Z)."""
    return (mixture.log_weights.exp().unsqueeze(-1) * mixture.means).sum(dim=-2)


def sample(mixture: Mixture, temperature: float, generator: torch.Generator) -> Tensor:
    """Sample a component of each of N mixtures by its coefficient, then a value of it. Shape (N, Z).

    ``temperature`` scales the component's standard deviation: 0 gives its mean, 1 the thesis' sample.
    """
    chosen = torch.multinomial(mixture.log_weights.exp(), 1, generator=generator)  # [N, 1]
    index = chosen.unsqueeze(-1).expand(-1, 1, mixture.means.shape[-1])  # [N, 1, Z]
    means = mixture.means.gather(1, index).squeeze(1)
    if temperature == 0.0:
        return means
    noise = torch.empty_like(means).normal_(generator=generator)
    return means + temperature * mixture.log_sigmas.gather(1, index).squeeze(1).exp() * noise


def average(mixtures: Mixture, members: int = 1) -> Mixture:
    """Average coefficients, means and variances over weight samples (thesis 4.4), for each member of an ensemble.

    Weight samples of one network describe the same components and are averaged one by one; those of different networks
    do not, so an ensemble's prediction is all their components side by side, each member with the same share. The
    leading axis of E T samples, member by member, goes; the result has E K components.
    """

    def mean_by_member(values: Tensor) -> tuple[Tensor, ...]:
        return values.unflatten(0, (members, -1)).mean(dim=1).unbind(0)

    weights = torch.cat(mean_by_member(mixtures.log_weights.exp()), dim=-1) / members  # [..., E K]
    variances = torch.cat(mean_by_member(torch.exp(2.0 * mixtures.log_sigmas)), dim=-2)  # [..., E K, Z]
    return Mixture(weights.log(), torch.cat(mean_by_member(mixtures.means), dim=-2), 0.5 * variances.log())
