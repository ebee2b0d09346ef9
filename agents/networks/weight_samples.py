"""T weight samples of one network in one batched pass: what a Bayesian prediction is made of.

Under Monte-Carlo dropout (Gal & Ghahramani 2016) a weight sample is a dropout mask that all inputs share; in a deep
ensemble (Lakshminarayanan et al. 2017) it is a member. Shapes: ``T`` samples, ``N`` rows, ``H`` hidden units.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .mlp import MemberMLP, kept_scale
from .products import affine

_CHUNK = 2048
"""Rows times samples of one product: 2 MB of activations of 256 units stay in cache, beside neighbours' too."""
_MANY = 256
"""Rows from which it pays to gather the units that each sample drops."""
_TILE = 10
"""Samples of one product where rows are many."""


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
    if masks is not None:
        return _masked(network, x, masks)
    rows = max(1, _CHUNK // network.members)
    outputs = x.new_empty((network.members, len(x), network.sizes[-1]))
    for start in range(0, len(x), rows):
        outputs[:, start : start + rows] = network(x[start : start + rows].expand(network.members, -1, -1))
    return outputs


def _masked(network: MemberMLP, x: Tensor, masks: Sequence[Tensor]) -> Tensor:
    """One member under T masks a layer: (N, in) to (T, N, out)."""
    samples, last = len(masks[0]), len(network.weights) - 1
    scale = -kept_scale(network.dropout)  # in a mask -1 keeps a unit and 0 drops it
    factors = [mask.to(x.dtype).mul_(scale).unsqueeze(1) for mask in masks]  # [T, 1, H] each
    second = _Second(
        affine(x.unsqueeze(0), network.weights[0], network.biases[0], relu=True)[0],
        factors[0], network.weights[1], network.biases[1], relu=last > 1,
    )  # fmt: skip
    tile = min(samples, _TILE) if len(x) >= _MANY else samples
    rows = max(1, _CHUNK // tile)
    outputs = x.new_empty((samples, len(x), network.sizes[-1]))
    for t in range(0, samples, tile):
        some = slice(t, t + tile)
        for start in range(0, len(x), rows):
            h = second(some, slice(start, start + rows))  # [T, N, H]
            count = len(h)
            for layer in range(2, last + 1):
                if layer <= len(factors):
                    h = h.mul_(factors[layer - 1][some])
                weight, bias = network.weights[layer], network.biases[layer]
                h = affine(h.view(1, -1, h.shape[-1]), weight, bias, relu=layer < last).view(count, -1, bias.shape[-1])
            outputs[some, start : start + rows] = h
    return outputs


class _Second:
    """The second layer, the first one whose inputs differ between samples: ``(h * m_t) W + b``.

    Where rows are many, it is the layer without dropout, once, less what each sample drops of it: at a dropout of a
    fifth, a quarter of the multiplications.

    Args:
        hidden: Activations of the first layer, which all samples share. Shape (N, H).
        factors: What each sample multiplies them by. Shape (T, 1, H).
        weight: Shape (1, H, out).
        bias: Shape (1, 1, out).
        relu: Whether what is below 0 becomes 0.
    """

    def __init__(self, hidden: Tensor, factors: Tensor, weight: Tensor, bias: Tensor, *, relu: bool) -> None:
        self._hidden, self._factors, self._weight, self._bias, self._relu = hidden, factors, weight, bias, relu
        dropped = factors[:, 0] == 0  # [T, H]
        self._widest = int(dropped.sum(dim=1).amax()) if len(hidden) >= _MANY else 0
        self._gathers = 0 < 2 * self._widest < hidden.shape[1]
        if self._gathers:
            scale = factors.amax()
            self._whole = affine(hidden.unsqueeze(0), weight * scale, bias)  # [1, N, out]
            strength, self._units = dropped.to(hidden.dtype).topk(self._widest, dim=1)  # [T, D]; 0 pads
            self._lost = weight[0][self._units] * (-scale * strength).unsqueeze(-1)  # [T, D, out]
            self._by_unit = hidden.t().contiguous()  # [H, N]

    def __call__(self, samples: slice, rows: slice) -> Tensor:
        """Its outputs for some samples and some rows. Shape (T, N, out)."""
        if not self._gathers:
            inputs = self._hidden[rows] * self._factors[samples]  # [T, N, H]
            flat = inputs.view(1, -1, inputs.shape[-1])
            return affine(flat, self._weight, self._bias, relu=self._relu).view(*inputs.shape[:2], -1)
        units, lost = self._units[samples], self._lost[samples]
        inputs = self._by_unit[:, rows].index_select(0, units.flatten()).view(*units.shape, -1)  # [T, D, N]
        outputs = torch.baddbmm(self._whole[:, rows].expand(len(units), -1, -1), inputs.mT, lost)
        return outputs.relu_() if self._relu else outputs
