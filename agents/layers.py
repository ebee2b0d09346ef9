"""Dense networks whose weights carry a leading member axis, and dropout whose masks come from a passed generator.

Many small networks of one shape (ensemble members, seeds) are one batched matrix product; a single network is the
case E = 1. Shapes: ``E`` members, ``N`` rows, ``H`` hidden units.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor, nn

Masks = tuple[Tensor, ...]
"""One dropout mask a hidden layer, each (E, N, H), with entries 0 or 1 / (1 - dropout)."""

_INT64_MIN = -(2**63)


def _mask_code(dropout: float) -> tuple[int, int]:
    """The fewest bits b in (1, 2, 4, 8) that express ``dropout``, and how many of their 2**b values mean dropped."""
    bits = next((b for b in (1, 2, 4) if (dropout * 2**b).is_integer()), 8)
    return bits, round(dropout * 2**bits)


@lru_cache(maxsize=32)
def _mask_table(dropout: float, device: torch.device) -> Tensor:
    """What each random byte says about 8 / b units. Shape (256, 8 / b)."""
    bits, dropped = _mask_code(dropout)
    fields = torch.arange(256)[:, None] >> torch.arange(0, 8, bits)[None, :]  # [256, 8 / b]
    kept = (fields % 2**bits) >= dropped
    return (kept.float() * (2**bits / (2**bits - dropped))).to(device)


def dropout_mask(shape: Sequence[int], dropout: float, generator: torch.Generator) -> Tensor:
    """Inverted-dropout mask: 0 with probability ``dropout``, else 1 / (1 - dropout).

    One bit of randomness a unit is enough at 50 %, so a 64-bit draw serves 64 units: an order of magnitude
    cheaper than a Bernoulli draw each. Probabilities that no power of two divides are rounded to 1/256.

    Args:
        shape: Shape of the mask.
        dropout: Probability of dropping a unit, in [0, 1).
        generator: The only source of randomness; its device is the mask's.
    """
    table = _mask_table(dropout, generator.device)
    count = 1
    for size in shape:
        count *= size
    n_bytes = -(-count // table.shape[1])
    words = torch.empty(-(-n_bytes // 8), dtype=torch.int64, device=generator.device)
    random_bytes = words.random_(_INT64_MIN, None, generator=generator).view(torch.uint8)
    return table.index_select(0, random_bytes.int()).view(-1)[:count].view(*shape)


class MemberMLP(nn.Module):
    """E independent ReLU networks of one shape with a linear output, evaluated as one batched computation.

    Args:
        sizes: Units of input, hidden and output layers. Length at least 2.
        members: E, at least 1.
        dropout: Probability of dropping a hidden unit, in [0, 1).
        generator: Draws the initial weights: Glorot uniform, zero biases (the defaults of Keras).
    """

    def __init__(self, sizes: Sequence[int], *, members: int, dropout: float, generator: torch.Generator) -> None:
        super().__init__()
        self.sizes, self.members, self.dropout = tuple(sizes), members, dropout
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for n_in, n_out in pairwise(sizes):
            bound = (6.0 / (n_in + n_out)) ** 0.5
            uniform = torch.rand(members, n_in, n_out, generator=generator, device=generator.device)
            self.weights.append(nn.Parameter((2.0 * uniform - 1.0) * bound))  # [E, in, out]
            self.biases.append(nn.Parameter(torch.zeros(members, 1, n_out, device=generator.device)))  # [E, 1, out]

    def draw_masks(self, rows: int, generator: torch.Generator) -> Masks | None:
        """Fresh dropout masks of every hidden layer for ``rows`` rows, or None where nothing is dropped."""
        if self.dropout == 0.0:
            return None
        return tuple(dropout_mask((self.members, rows, h), self.dropout, generator) for h in self.sizes[1:-1])

    def forward(self, x: Tensor, masks: Masks | None = None) -> Tensor:
        """Map (E, N, in) to (E, N, out); without ``masks`` no unit is dropped and the result is deterministic."""
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)  # [E, N, out]
            if layer < last:
                x = x.relu() if masks is None else x.relu() * masks[layer]
        return x


@torch.no_grad()
def clip_unit_norms(network: MemberMLP, limit: float) -> None:
    """Scale the incoming weights of each unit down to a Euclidean norm of at most ``limit``.

    "The norm of the weights in each layer" (thesis 5.2.3) is read as the max-norm constraint of Keras, per unit:
    a norm of 3 on a whole 512 x 512 matrix would cripple it.
    """
    for weight in network.weights:
        norms = (weight * weight).sum(dim=1, keepdim=True).sqrt()  # [E, 1, out]; several times faster than vector_norm
        if bool((norms > limit).any()):
            weight.mul_((limit / norms).clamp_max(1.0))
