"""How much the predictive distribution itself changes with the weights: an epistemic score for any mixture.

The thesis (4.3) leaves as future work a measure of the variability of the distributions {p(y | x; w_t)}. Here it is
their Jensen-Shannon divergence with equal weights (Lin 1991, equation 5.1), which is the mutual information of
prediction and weights (Depeweg et al. 2018, equation 4):

    J = (1/T) sum_t KL(p_t || p_mean) = H[p_mean] - (1/T) sum_t H[p_t]   in nats, 0 <= J <= log T.

Unlike the variance of the means it sees samples that put the same mean together from other branches, it does not depend
on the unit of y, and it treats all dimensions of y together.
"""

from __future__ import annotations

import math
from operator import itemgetter

import torch
from torch import Tensor

from ..imagination import mixture as mdn
from ..imagination.mixture import Mixture

_CHUNK = 2_000_000
"""Component densities computed at a time."""


@torch.no_grad()
def jensen_shannon(samples: Mixture, draws: int, generator: torch.Generator) -> Tensor:
    """Monte-Carlo estimate of the divergence between T mixtures, (T, N) to (N,), in nats, cut to [0, log T].

    Every mixture is drawn from equally often (stratified over t), so that only the value within it is chance: the
    standard error falls as 1 / sqrt(T S) with ``draws`` S from each.
    """
    count, rows, components, size = samples.means.shape
    piece = max(1, _CHUNK // (draws * count * count * components * size))
    pieces = (itemgetter((slice(None), slice(start, start + piece))) for start in range(0, rows, piece))
    return torch.cat([_divergence(samples.map(rows_of), draws, generator) for rows_of in pieces])


def _divergence(samples: Mixture, draws: int, generator: torch.Generator) -> Tensor:
    count, rows = samples.means.shape[:2]
    flat = samples.map(lambda part: part.flatten(0, 1).repeat_interleave(draws, dim=0))
    values = mdn.sample(flat, 1.0, generator).view(count, rows, draws, -1).transpose(1, 2)  # [T, S, N, D]
    # every value under every mixture s: [S', T, S, N]
    every = samples.map(lambda part: part[:, None, None])
    log_p = mdn.log_likelihood(every, values.unsqueeze(0))
    log_mean = torch.logsumexp(log_p, dim=0) - math.log(count)  # [T, S, N]
    own = log_p.diagonal(dim1=0, dim2=1).movedim(-1, 0)  # [T, S, N]
    return (own - log_mean).mean(dim=(0, 1)).clamp(0.0, math.log(count))
