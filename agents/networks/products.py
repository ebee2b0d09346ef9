"""Batched matrix products by the fastest library at hand.

On CPUs that MKL does not know well, torch's own float32 products reach half of what oneDNN, which torch has on board
too, does with the same operands: 98 against 222 GFLOP/s on a core of a Zen 5 at 512 x 512 x 512.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

_ONEDNN_FROM = 2**20
"""Multiplications of one product from which oneDNN is ahead of the lower overhead of the other calls."""
_ONEDNN: Any = getattr(torch.ops.mkldnn, "_linear_pointwise", None) if torch.backends.mkldnn.is_available() else None
_FORMATS = (
    (torch.float32, torch.bfloat16)
    if _ONEDNN is not None and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    else (torch.float32,)
)
"""What oneDNN multiplies; bfloat16 not on processors without AVX-512, where torch's own calls emulate it."""


def product(a: Tensor, b: Tensor) -> Tensor:
    """``a @ b`` for each member: (E, N, I) and (E, I, O) give (E, N, O). Any strides; without a gradient of its own."""
    if a.dtype == torch.float32 and _by_onednn(a, b):  # of bfloat16, bmm is oneDNN's already
        return stacked([_ONEDNN(x, y.t(), None, "none", [], "") for x, y in zip(a.unbind(), b.unbind(), strict=True)])
    return torch.bmm(a, b)


def affine(x: Tensor, weight: Tensor, bias: Tensor, *, relu: bool = False) -> Tensor:
    """``x @ weight + bias`` for each member: (E, N, I), (E, I, O) and (E, 1, O). Without a gradient of its own.

    With ``relu``, what is below 0 becomes 0, by oneDNN in the same pass over memory, as the bias is added.
    """
    if _by_onednn(x, weight):
        parts, then = zip(x.unbind(), weight.unbind(), bias.unbind(), strict=True), "relu" if relu else "none"
        return stacked([_ONEDNN(rows, w.t(), b[0], then, [], "") for rows, w, b in parts])
    if weight.shape[2] == 1 < len(weight):
        # Of several members with one output each, MKL sums in another order; no member may change another's bits.
        parts = zip(bias.split(1), x.split(1), weight.split(1), strict=True)
        result = torch.cat([torch.baddbmm(*part) for part in parts])
    else:
        result = torch.baddbmm(bias, x, weight)
    return _relu_(result) if relu else result


def joined(parts: Sequence[Tensor]) -> Tensor:
    """Tensors one behind another along their first axis; a single one is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


def stacked(parts: Sequence[Tensor]) -> Tensor:
    """Tensors of one shape along a new first axis; a single one is not copied."""
    return parts[0].unsqueeze(0) if len(parts) == 1 else torch.stack(list(parts))


def _by_onednn(a: Tensor, b: Tensor) -> bool:
    size = a.shape[1] * a.shape[2] * b.shape[2]
    return _ONEDNN is not None and a.dtype in _FORMATS and a.device.type == "cpu" and size >= _ONEDNN_FROM


def _relu_(x: Tensor) -> Tensor:
    """``x.relu_()``; a bfloat16 below 0 is an integer below 0, for which torch is six times faster.

    So is a NaN with the sign bit set, which becomes 0: gradients are where NaN must be looked for.
    """
    if x.dtype == torch.bfloat16:
        x.view(torch.int16).clamp_min_(0)
        return x
    return x.relu_()
