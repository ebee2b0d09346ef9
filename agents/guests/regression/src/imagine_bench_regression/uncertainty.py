"""How uncertain a sampled value is by itself, and how much a prediction changes with the weights (thesis 4.3, 4.4)."""

from __future__ import annotations

import math

import torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.mixture import Mixture
from torch import Tensor

_CHUNK = 2_000_000
"""Component densities computed at a time."""


def component_variance(samples: Mixture, members: int) -> Tensor:
    """How uncertain each component of the averaged mixture is by itself: its noise, and the effect of weights on its
    mean.

    The law of total variance given the component: ``mean_t sigma_k^2 + var_t mu_k``. Unlike the three parts of
    ``decompose`` it does not count that there are other components, which says nothing about a value that was
    sampled from this one. Samples are (E T, ..., K, Z), member by member; the result is (..., E K, Z), in the order of
    ``mixture.average``.
    """
    means = samples.means.unflatten(0, (members, -1))
    noise = torch.exp(2.0 * samples.log_sigmas).unflatten(0, (members, -1)).mean(dim=1)
    return torch.cat((noise + means.var(dim=1, correction=0)).unbind(0), dim=-2)


def sampled_component_variance(samples: Mixture, predictive: Mixture, values: Tensor, members: int = 1) -> Tensor:
    """:func:`component_variance` of the components that ``values`` (..., Z) came from, summed over dimensions: (...).

    Each component of ``predictive``, the samples' average, counts by its posterior probability of having been the one.
    """
    scaled = (values.unsqueeze(-2) - predictive.means) * torch.exp(-predictive.log_sigmas)  # [..., K, Z]
    log_joint = predictive.log_weights - (0.5 * scaled.square() + predictive.log_sigmas).sum(dim=-1)
    own = component_variance(samples, members).sum(dim=-1)  # [..., K]
    return (log_joint.softmax(dim=-1) * own).sum(dim=-1)


@torch.no_grad()
def jensen_shannon(samples: Mixture, draws: int, generator: torch.Generator) -> Tensor:
    """How much the predictive distribution itself changes with the weights: an epistemic score for any mixture.

    The thesis (4.3) leaves as future work a measure of the variability of the distributions {p(y | x; w_t)}. Here it
    is their Jensen-Shannon divergence with equal weights (Lin 1991, equation 5.1), which is the mutual information of
    prediction and weights (Depeweg et al. 2018, equation 4):

        J = (1/T) sum_t KL(p_t || p_mean) = H[p_mean] - (1/T) sum_t H[p_t]   in nats, 0 <= J <= log T.

    Unlike the variance of the means it sees samples that put the same mean together from other branches, it does not
    depend on the unit of y, and it treats all dimensions of y together. Estimated by Monte Carlo: every mixture is
    drawn from equally often (stratified over t), so that only the value within it is chance: the standard error falls
    as 1 / sqrt(T S) with ``draws`` S from each. Mixtures (T, N) give shape (N,), cut to [0, log T].
    """
    count, _, components, size = samples.means.shape
    piece = max(1, _CHUNK // (draws * count * count * components * size))
    parts = (samples.log_weights, samples.means, samples.log_sigmas)
    found = []
    for rows in zip(*(part.split(piece, dim=1) for part in parts), strict=True):
        some = Mixture(*rows)
        flat = some.map(lambda part: part.flatten(0, 1).repeat_interleave(draws, dim=0))
        values = mdn.sample(flat, 1.0, generator).view(count, -1, draws, size).transpose(1, 2)  # [T, S, N, D]
        every = some.map(lambda part: part[:, None, None])
        log_p = mdn.log_likelihood(every, values.unsqueeze(0))  # every value under every mixture: [T', T, S, N]
        log_mean = torch.logsumexp(log_p, dim=0) - math.log(count)
        own = log_p.diagonal(dim1=0, dim2=1).movedim(-1, 0)
        found.append((own - log_mean).mean(dim=(0, 1)).clamp(0.0, math.log(count)))
    return torch.cat(found)
