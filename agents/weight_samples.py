"""T weight samples of one network in one batched pass: what a Bayesian prediction is made of.

Under Monte-Carlo dropout (Gal & Ghahramani 2016) a weight sample is a dropout mask that all inputs share; in a deep
ensemble (Lakshminarayanan et al. 2017) it is a member. Shapes: ``T`` samples, ``N`` rows, ``H`` hidden units.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .layers import MemberMLP, kept_scale
from .products import affine

_CHUNK = 4096
"""Rows times samples of one product: activations of 256 units then stay in a core's cache."""


@torch.no_grad()
def sample_outputs(network: MemberMLP, x: Tensor, masks: Sequence[Tensor] | None) -> Tensor:
    """Outputs of every weight sample for every row.

    The first layer comes before any mask and is computed once; from there on samples and rows are one product a layer,
    cut into pieces that fit the cache. No sample is a turn of a Python loop.

    Args:
        network: One member, with masks, or the T members of an ensemble, without.
        x: Shape (N, in).
        masks: One a hidden layer, from the first on, each (T, H), as :func:`~.layers.dropout_mask` draws them; layers
            beyond drop nothing. None makes every member a sample.

    Returns:
        Shape (T, N, out).
    """
    samples = network.members if masks is None else len(masks[0])
    scale = -kept_scale(network.dropout)  # in a mask -1 keeps a unit and 0 drops it
    factors = [mask.to(x.dtype).mul_(scale).unsqueeze(1) for mask in masks or ()]  # [T, 1, H] each
    rows = max(1, _CHUNK // samples)
    outputs = x.new_empty((samples, len(x), network.sizes[-1]))
    for start in range(0, len(x), rows):
        piece = x[start : start + rows]
        if masks is None:
            outputs[:, start : start + rows] = network(piece.expand(samples, -1, -1))
        else:
            outputs[:, start : start + rows] = _masked(network, piece, factors)
    return outputs


def _masked(network: MemberMLP, x: Tensor, factors: Sequence[Tensor]) -> Tensor:
    """One member under T masks: (N, in) to (T, N, out)."""
    samples, last = len(factors[0]), len(network.weights) - 1
    for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        x = affine(x.unsqueeze(0), weight, bias).squeeze(0)  # [N, H], from the second layer on [T N, H]
        if layer < last:
            x = x.relu_().view(samples if layer else 1, -1, x.shape[-1])
            if layer < len(factors):
                x = x.mul_(factors[layer]) if layer else x * factors[layer]
            x = x.view(-1, x.shape[-1])  # [T N, H]
    return x.view(samples, -1, x.shape[-1])
