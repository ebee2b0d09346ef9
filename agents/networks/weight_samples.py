"""T weight samples of one network in one batched pass: the parts of a Bayesian prediction.

Under Monte-Carlo dropout (Gal & Ghahramani 2016) a weight sample is a dropout mask that all inputs share; in a deep
ensemble (Lakshminarayanan et al. 2017) it is a member. Shapes: ``T`` samples, ``N`` rows, ``H`` hidden units.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .mlp import MemberMLP

_CHUNK = 2048
"""Rows times samples of one product: 2 MB of activations of 256 units stay in cache, beside neighbours' too."""


@torch.no_grad()
def sample_outputs(network: MemberMLP, x: Tensor, masks: Sequence[Tensor] | None) -> Tensor:
    """Outputs (T, N, out) of every weight sample for every row (N, in), without a Python loop over samples.

    Args:
        network: One member, with masks, or the T members of an ensemble, without.
        x: Shape (N, in).
        masks: One a hidden layer, from the first on, each (T, H), as :func:`~.mlp.dropout_mask` draws them; layers
            beyond drop nothing. None makes every member a sample.
    """
    samples = network.members if masks is None else len(masks[0])
    outputs = x.new_empty((samples, len(x), network.sizes[-1]))
    rows = max(1, _CHUNK // samples)
    for start in range(0, len(x), rows):
        some = slice(start, start + rows)
        if masks is None:
            outputs[:, some] = network(x[some].expand(samples, -1, -1))
        else:
            outputs[:, some] = _masked(network, x[some], masks)
    return outputs


def _masked(network: MemberMLP, x: Tensor, masks: Sequence[Tensor]) -> Tensor:
    """One member under T masks a layer: (N, in) to (T, N, out). The first layer comes before any mask, so once."""
    h = x.unsqueeze(0)  # [1, N, in]
    last = len(network.weights) - 1
    for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        flat = torch.addmm(bias[0], h.reshape(-1, h.shape[-1]), weight[0])
        h = flat.view(len(h), len(x), -1)
        if layer < last:
            h = h.relu_()
        if layer < len(masks):
            mask = masks[layer].unsqueeze(1)  # [T, 1, H]
            h = h * mask if layer == 0 else h.mul_(mask)  # [T, N, H]
    return h
