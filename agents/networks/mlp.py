"""Dense networks whose weights carry a leading member axis, and dropout whose masks come from a passed generator.

Many small networks of one shape (ensemble members, seeds) are one batched matrix product; a single network is the
case E = 1. Shapes: ``E`` members, ``N`` rows, ``H`` hidden units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise

import torch
from torch import Tensor, nn

from .dense import dense_stack

Masks = tuple[Tensor, ...]
"""One dropout mask a hidden layer, each (E, N, H), int16: -1 keeps a unit, 0 drops it."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Weights and biases of networks of one shape, other than those that a module holds.

    Attributes:
        values: Network by network its weights, then its biases, each with a leading axis of as many as there are.
        gradients: Where the gradients of these are written, of the same shapes; empty: in new memory.
    """

    values: Sequence[Tensor]
    gradients: Sequence[Tensor] = ()


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
    last, *digits = _digits(dropout)
    kept = words.random_(_INT64_MIN, None, generator=generator) if last else words.fill_(-1)
    for digit in digits:
        fresh = torch.empty_like(words).random_(_INT64_MIN, None, generator=generator)
        kept = kept & fresh if digit else kept | fresh
    fields = kept.view(torch.int16)[None, :] << _shifts(generator.device)  # [16, 4 words]: one bit each, at the sign
    return fields.bitwise_right_shift_(15).view(-1)[:count].view(*shape)


@lru_cache(maxsize=64)
def _digits(dropout: float) -> tuple[bool, ...]:
    """The binary digits of the probability, the last one that is set first; (False,) if none is."""
    digits = f"{dropout_bits(dropout):0{_PROBABILITY_BITS}b}".rstrip("0")
    return tuple(digit == "1" for digit in reversed(digits)) or (False,)


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
        return tuple(self.draw_mask(hidden, rows, generator) for hidden in self.sizes[1:-1])

    def draw_mask(self, hidden: int, rows: int, generator: torch.Generator) -> Tensor:
        """A fresh dropout mask of a layer of so many hidden units: (E, N, H)."""
        return dropout_mask((self.members, rows, hidden), self.dropout, generator)

    def forward(self, x: Tensor, masks: Iterable[Tensor] | None = None, parameters: Parameters | None = None) -> Tensor:
        """Map (E, N, in) to (E, N, out); without ``masks`` no unit is dropped and the result is deterministic.

        Args:
            x: Shape (E, N, in).
            masks: From :meth:`draw_masks`, or one a hidden layer that is drawn when it is asked for.
            parameters: Those of as many networks of this shape as ``x`` has, instead of its own.
        """
        chosen = Parameters([*self.weights, *self.biases]) if parameters is None else parameters
        weights, biases = chosen.values[: len(self.weights)], chosen.values[len(self.weights) :]
        exact = weights[0].dtype
        dtype = self.hidden_dtype if torch.is_grad_enabled() and exact == torch.float32 else exact
        return dense_stack(x, weights, biases, masks, kept_scale(self.dropout), dtype, chosen.gradients)


def by_network(networks: Iterable[MemberMLP], parameters: Parameters) -> list[Parameters]:
    """Those of several networks, one after the other, network by network."""
    ends = list(accumulate((2 * len(network.weights) for network in networks), initial=0))
    return [Parameters(parameters.values[a:b], parameters.gradients[a:b]) for a, b in pairwise(ends)]


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
