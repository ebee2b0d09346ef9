"""Stacks of dense ReLU layers with dropout, forward and backward written out for speed.

The mathematics is that of ``baddbmm``, ``relu`` and a multiplication by an inverted-dropout mask, differentiated by
autograd; the tests hold it to that. What is saved: masks and the gate of ReLU act on the bits of a number as one
integer operation, their factor rides on the weights, and hidden layers may compute in bfloat16. The output layer
always computes in float32: a reward of 50 has no decimals in bfloat16.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .products import affine, product

_BITS = {2: torch.int16, 4: torch.int32, 8: torch.int64}
"""The integers as wide as a floating-point number of so many bytes."""


def dense_stack(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], keep: Sequence[Tensor] | None, dropout: float,
    dtype: torch.dtype,
) -> Tensor:  # fmt: skip
    """A differentiable stack: ``relu(x W + b) * mask`` at each hidden layer, linear at the last.

    Args:
        x: Shape (E, N, in).
        weights: One a layer, (E, in, out).
        biases: One a layer, (E, 1, out).
        keep: One a hidden layer, (E, N, out), int16: -1 keeps a unit, 0 drops it. None drops nothing.
        dropout: The probability of 0 in ``keep``; what is kept is scaled by 1 / (1 - dropout).
        dtype: In which the hidden layers compute; the output layer computes in that of the weights.

    Returns:
        Shape (E, N, out).
    """
    scale = 1.0 if keep is None else 1.0 / (1.0 - dropout)
    output: Tensor = _Stack.apply(x, None if keep is None else tuple(keep), scale, dtype, *weights, *biases)
    return output


class _Stack(torch.autograd.Function):
    """``p = scale (x W + b)`` and ``h = relu(p) & keep``: as scale > 0, ``h`` is the inverted-dropout activation."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, keep: tuple[Tensor, ...] | None, scale: float, dtype: torch.dtype, *parameters: Tensor
    ) -> Tensor:
        layers = len(parameters) // 2
        weights, biases = parameters[:layers], parameters[layers:]
        h, hidden, scaled = x.to(dtype), [], []
        for layer, (weight, bias) in enumerate(zip(weights[:-1], biases[:-1], strict=True)):
            hidden.append(h)
            scaled.append(_times(weight, scale).to(dtype))
            h = _relu_(affine(h, scaled[-1], _times(bias, scale).to(dtype)))
            if keep is not None:
                _and_(h, keep[layer])
        exact = h.to(weights[-1].dtype)
        ctx.save_for_backward(*hidden, *scaled, h, exact, weights[-1])
        ctx.scale = scale
        return affine(exact, weights[-1], biases[-1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        *pairs, h, exact, last = ctx.saved_tensors
        inputs, scaled = pairs[: len(pairs) // 2], pairs[len(pairs) // 2 :]
        by_weight = [product(exact.transpose(1, 2), gradient)]
        by_bias = [gradient.sum(dim=1, keepdim=True)]
        g = _times(gradient, ctx.scale)  # of every p, times scale: so it is what the weights want, layer after layer
        g, by_x = product(g, last.transpose(1, 2)).to(h.dtype), None
        for x, weight in zip(reversed(inputs), reversed(scaled), strict=True):
            _gate_(g, h)
            by_weight.append(product(x.transpose(1, 2), g).to(last.dtype))
            by_bias.append(g.sum(dim=1, keepdim=True).to(last.dtype))
            if x is not inputs[0] or ctx.needs_input_grad[0]:
                g, h = product(g, weight.transpose(1, 2)), x
        if ctx.needs_input_grad[0]:
            by_x = (g / ctx.scale).to(last.dtype) if inputs else product(gradient, last.transpose(1, 2))
        return by_x, None, None, None, *reversed(by_weight), *reversed(by_bias)


def _times(x: Tensor, scale: float) -> Tensor:
    return x if scale == 1.0 else x * scale


def _bits(x: Tensor) -> Tensor:
    return x.view(_BITS[x.itemsize])


def _relu_(x: Tensor) -> Tensor:
    """``x.relu_()``; a bfloat16 below 0 is an integer below 0, for which torch is six times faster.

    So is a NaN with the sign bit set, which becomes 0: gradients are where NaN must be looked for.
    """
    if x.itemsize == 2:
        _bits(x).clamp_min_(0)
        return x
    return x.relu_()


def _and_(x: Tensor, keep: Tensor) -> None:
    bits = _bits(x)
    bits.bitwise_and_(keep.to(bits.dtype))


def _gate_(gradient: Tensor, h: Tensor) -> None:
    """Clear the gradient wherever ``h``, which is never negative, is 0."""
    bits = _bits(h)
    _bits(gradient).bitwise_and_(bits.neg().bitwise_right_shift_(8 * h.itemsize - 1))
