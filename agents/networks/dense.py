"""Stacks of dense ReLU layers with dropout, forward and backward written out for speed.

The mathematics is that of ``baddbmm``, ``relu`` and a multiplication by an inverted-dropout mask, differentiated by
autograd; the tests hold it to that. What is saved: masks and the gate of ReLU act on the bits of a number as one
integer operation, their factor is applied once, and hidden layers may compute in bfloat16. What the output layer says
is always computed in float32: a reward of 50 has no decimals in bfloat16. Its gradients are of the hidden layers' type.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from .products import affine, product

_BITS = {2: torch.int16, 4: torch.int32, 8: torch.int64}
"""The integers as wide as a floating-point number of so many bytes."""


def dense_stack(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], keep: Iterable[Tensor] | None, scale: float,
    dtype: torch.dtype, gradients: Sequence[Tensor] = (),
) -> Tensor:  # fmt: skip
    """A differentiable stack: ``relu(x W + b) * mask`` at each hidden layer, linear at the last.

    Args:
        x: Shape (E, N, in).
        weights: One a layer, (E, in, out).
        biases: One a layer, (E, 1, out).
        keep: One a hidden layer, (E, N, out), int16: -1 keeps a unit, 0 drops it; each is asked for when its layer is
            done. None drops nothing.
        scale: What a unit that is kept is multiplied by; not read without ``keep``.
        dtype: In which the hidden layers compute forward, and all layers backward; the values of the output layer are
            computed in the type of the weights.
        gradients: Where those of weights, then biases, are written; empty: in new memory.

    Returns:
        Shape (E, N, out).
    """
    masks, scale = (None, 1.0) if keep is None else (iter(keep), scale)
    output: Tensor = _Stack.apply(x, masks, scale, dtype, gradients, *weights, *biases)
    return output


class _Stack(torch.autograd.Function):
    """``g = relu(g_before W + b / scale^l) & keep`` at hidden layer l, from 0: the activation over ``scale^(l + 1)``.

    As ReLU lets a positive factor pass, those of all L layers meet in one, ``scale^L``, which is applied to the last
    weights and to the gradient that comes back: no other weight and no unit is ever multiplied by it.
    """

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, keep: Iterator[Tensor] | None, scale: float, dtype: torch.dtype,
        gradients: Sequence[Tensor], *parameters: Tensor,
    ) -> Tensor:  # fmt: skip
        layers = len(parameters) // 2
        weights, biases = parameters[:layers], parameters[layers:]
        g, inputs, rounded = x.to(dtype), [], []
        for layer, (weight, bias) in enumerate(zip(weights[:-1], biases[:-1], strict=True)):
            inputs.append(g)
            rounded.append(weight.to(dtype))
            g = affine(g, rounded[-1], _times(bias, scale**-layer).to(dtype), relu=True)
            if keep is not None:
                _and_(g, next(keep))
        ctx.save_for_backward(*inputs, *rounded, g, weights[-1])
        ctx.scale, ctx.gradients, ctx.shapes = scale, gradients, [parameter.shape for parameter in parameters]
        return affine(g.to(weights[-1].dtype), _times(weights[-1], scale ** (layers - 1)), biases[-1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        *pairs, g, last = ctx.saved_tensors
        inputs, rounded = pairs[: len(pairs) // 2], pairs[len(pairs) // 2 :]
        gradients = ctx.gradients or [last.new_empty(shape) for shape in ctx.shapes]
        by_weight, by_bias = gradients[: len(inputs) + 1], gradients[len(inputs) + 1 :]
        back = _times(gradient, ctx.scale ** len(inputs)).to(g.dtype)
        by_weight[-1].copy_(product(g.transpose(1, 2), back))
        torch.sum(gradient, dim=1, keepdim=True, out=by_bias[-1])
        back = product(back, last.to(g.dtype).transpose(1, 2))
        for layer in reversed(range(len(inputs))):
            x, weight = inputs[layer], rounded[layer]
            _gate_(back, g)
            by_weight[layer].copy_(product(x.transpose(1, 2), back))
            by_bias[layer].copy_(back.sum(dim=1, keepdim=True)).mul_(ctx.scale**-layer)
            if layer > 0 or ctx.needs_input_grad[0]:
                back, g = product(back, weight.transpose(1, 2)), x
        by_x = back.to(last.dtype) if ctx.needs_input_grad[0] else None
        return by_x, None, None, None, None, *gradients


def _times(x: Tensor, scale: float) -> Tensor:
    return x if scale == 1.0 else x * scale


def _bits(x: Tensor) -> Tensor:
    return x.view(_BITS[x.itemsize])


def _and_(x: Tensor, keep: Tensor) -> None:
    bits = _bits(x)
    bits.bitwise_and_(keep.to(bits.dtype))


def _gate_(gradient: Tensor, h: Tensor) -> None:
    """Clear the gradient wherever ``h``, which is never negative, is 0; as integers, for which torch is faster."""
    bits = _bits(gradient)
    torch.ops.aten.threshold_backward.grad_input(bits, _bits(h), 0, grad_input=bits)
