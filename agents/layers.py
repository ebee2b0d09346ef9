"""Dense networks whose weights carry a leading member axis, and dropout whose masks come from a passed generator.

Many small networks of one shape (ensemble members, seeds) are one batched matrix product; a single network is the
case E = 1. Shapes: ``E`` members, ``N`` rows, ``H`` hidden units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import accumulate, pairwise

import torch
from torch import Tensor, nn

from .dense import dense_stack

Masks = tuple[Tensor, ...]
"""One dropout mask a hidden layer, each (E, N, H), int16: -1 keeps a unit, 0 drops it."""

_INT64_MIN = -(2**63)
_PROBABILITY_BITS = 8


def dropout_bits(dropout: float) -> int:
    """``dropout`` in units of 1/256, to which masks round it; never 256, which would leave nothing."""
    return min(round(dropout * 2**_PROBABILITY_BITS), 2**_PROBABILITY_BITS - 1)


def kept_scale(dropout: float) -> float:
    """What units that are kept are multiplied by, so that the mean stays: 1 / (1 - dropout), as masks round it."""
    return 1.0 / (1.0 - dropout_bits(dropout) / 2**_PROBABILITY_BITS)


def dropout_mask(shape: Sequence[int], dropout: float, generator: torch.Generator) -> Tensor:
    """A random mask: 0 with probability ``dropout`` (rounded to 1/256), else -1, that is all bits.

    Binary digits of the probability, from the last one that is set to the first, turn fair random bits into biased
    ones (a digit 1 is an OR with a fresh bit, a digit 0 an AND): at 50 % one random bit a unit is enough, so that a
    64-bit draw serves 64 units, an order of magnitude cheaper than a Bernoulli draw each.

    Args:
        shape: Shape of the mask.
        dropout: Probability of dropping a unit, in [0, 1).
        generator: The only source of randomness; its device is the mask's.
    """
    count = math.prod(shape)
    words = torch.empty(-(-count // 64), dtype=torch.int64, device=generator.device)
    digits = f"{dropout_bits(dropout):0{_PROBABILITY_BITS}b}".rstrip("0")
    kept = torch.full_like(words, -1)
    for digit in reversed(digits):
        words.random_(_INT64_MIN, None, generator=generator)
        kept = kept & words if digit == "1" else kept | words
    fields = kept.view(torch.int16)[None, :] << _shifts(generator.device)  # [16, 4 words]: one bit each, at the sign
    return fields.bitwise_right_shift_(15).view(-1)[:count].view(*shape)


@lru_cache(maxsize=8)
def _shifts(device: torch.device) -> Tensor:
    return torch.arange(16, dtype=torch.int16, device=device)[:, None]


class MemberMLP(nn.Module):
    """E independent ReLU networks of one shape with a linear output, evaluated as one batched computation.

    Args:
        sizes: Units of input, hidden and output layers. Length at least 2.
        members: E, at least 1.
        dropout: Probability of dropping a hidden unit, in [0, 1).
        generator: Draws the initial weights: Glorot uniform, zero biases (the defaults of Keras).
        hidden_dtype: In which hidden layers compute while a gradient is wanted, float32 or bfloat16.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        *,
        members: int,
        dropout: float,
        generator: torch.Generator,
        hidden_dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        self.sizes, self.members, self.dropout, self.hidden_dtype = tuple(sizes), members, dropout, hidden_dtype
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

    def forward(self, x: Tensor, masks: Masks | None = None, parameters: Sequence[Tensor] | None = None) -> Tensor:
        """Map (E, N, in) to (E, N, out); without ``masks`` no unit is dropped and the result is deterministic.

        Args:
            x: Shape (E, N, in).
            masks: From :meth:`draw_masks`.
            parameters: Weights, then biases, of as many networks of this shape as ``x`` has, instead of its own.
        """
        layers = len(self.weights)
        weights = self.weights if parameters is None else parameters[:layers]
        biases = self.biases if parameters is None else parameters[layers:]
        exact = weights[0].dtype
        dtype = self.hidden_dtype if torch.is_grad_enabled() and exact == torch.float32 else exact
        return dense_stack(x, list(weights), list(biases), masks, kept_scale(self.dropout), dtype)


def by_network(networks: Iterable[MemberMLP], parameters: Sequence[Tensor]) -> list[Sequence[Tensor]]:
    """Parameters of several networks, one after the other, as one sequence a network."""
    ends = list(accumulate((2 * len(network.weights) for network in networks), initial=0))
    return [parameters[start:end] for start, end in pairwise(ends)]


@torch.no_grad()
def clip_unit_norms(networks: Sequence[MemberMLP], limit: float) -> None:
    """Scale the incoming weights of each unit down to a Euclidean norm of at most ``limit``.

    "The norm of the weights in each layer" (thesis 5.2.2) is read as the max-norm constraint of Keras, per unit:
    a norm of 3 on a whole 512 x 512 matrix would cripple it.
    """
    weights = [weight for network in networks for weight in network.weights]
    squares = [(weight * weight).sum(dim=1, keepdim=True) for weight in weights]  # each [E, 1, out]
    largest = torch.stack([square.amax() for square in squares])
    for weight, square, norm in zip(weights, squares, largest.sqrt().tolist(), strict=True):
        if norm > limit:
            weight.mul_((limit / square.sqrt()).clamp_max(1.0))
