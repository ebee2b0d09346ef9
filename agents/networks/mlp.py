"""Dense ReLU networks: one, or several of one shape whose weights have a leading member axis, and dropout.

Members (of an ensemble) are one batched matrix product. Shapes: ``E`` members, ``N`` rows, ``H`` hidden units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

Masks = tuple[Tensor, ...]
"""One dropout mask a hidden layer, each (E, N, H): the factor of each unit, 0 or 1 / (1 - dropout)."""


class ReluLayers(nn.Sequential):
    """Linear layers with ReLU between them, whose gradients are computed here where autograd is not needed."""

    @torch.no_grad()
    def outputs(self, x: Tensor) -> list[Tensor]:
        """The inputs (N, in), then the outputs of each layer, ReLU included."""
        *hidden, last = [*self][::2]
        values = [x]
        for layer in hidden:
            values.append(torch.addmm(layer.bias, values[-1], layer.weight.t()).relu_())
        return [*values, torch.addmm(last.bias, values[-1], last.weight.t())]

    @torch.no_grad()
    def backpropagate(self, values: Sequence[Tensor], gradient: Tensor) -> None:
        """Set the gradients of all weights, given :meth:`outputs` and the gradient of the last of them, (N, out)."""
        for layer, entered in zip([*self][-1::-2], values[-2::-1], strict=True):
            layer.weight.grad = gradient.t() @ entered
            layer.bias.grad = gradient.sum(dim=0)
            if entered is not values[0]:
                gradient = (gradient @ layer.weight).mul_(entered.sign())  # a mask of booleans takes five times as long


def relu_layers(sizes: Sequence[int], device: torch.device | str = "cpu") -> ReluLayers:
    """Linear layers with ReLU between them; their weights are undefined, so that nothing is drawn.

    ``sizes`` are units of input, hidden and output layers, at least 2.
    """
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes):
        layers += [nn.utils.skip_init(nn.Linear, n_in, n_out, device=device), nn.ReLU()]
    return ReluLayers(*layers[:-1])


@torch.no_grad()
def initialise(network: nn.Module, generator: torch.Generator) -> None:
    """Draw every linear and convolutional weight and bias from U(-1/sqrt(fan_in), 1/sqrt(fan_in)), torch's default law.

    torch's own constructors draw from the global generator. Other modules are left alone. The generator must be on the
    network's device.
    """
    for module in network.modules():
        if isinstance(module, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
            bound = 1.0 / math.sqrt(module.weight[0].numel())
            for weight in module.parameters():
                weight.uniform_(-bound, bound, generator=generator)


def mlp(sizes: Sequence[int], generator: torch.Generator) -> ReluLayers:
    """One network: ReLU hidden layers and a linear output; Glorot uniform weights, biases 0 (the defaults of Keras).

    ``sizes`` are units of input, hidden and output layers, at least 2; the generator's device is the network's.
    """
    network = relu_layers(sizes, generator.device)
    for layer in network:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)
    return network


def dropout_mask(
    shape: Sequence[int], dropout: float, generator: torch.Generator, dtype: torch.dtype = torch.float32
) -> Tensor:
    """A dropout mask: 0 with probability ``dropout`` in [0, 1), rounded to 1/256, else 1 / (1 - dropout).

    A random 64-bit integer serves 64 units, where ``bernoulli_`` draws a number for each. Every binary digit of the
    probability, from the last to the first, costs one fair random bit a unit: a digit 1 keeps a unit if it was kept so
    far *and* the bit is set, a digit 0 if it was kept so far *or* the bit is set. At the thesis' settings (50 %, one
    digit) this takes a third of a model update away: 54 to 37 CPU ms. The generator's device is the mask's.
    """
    count = math.prod(shape)
    share = min(round(256 * dropout), 255)
    kept = torch.full((-(-count // 64),), -1, dtype=torch.int64, device=generator.device)  # all bits are set
    for digit in reversed(f"{share:08b}".rstrip("0")):
        bits = torch.empty_like(kept).random_(-(2**63), None, generator=generator)
        kept = kept & bits if digit == "1" else kept | bits
    shifts = torch.arange(16, dtype=torch.int16, device=kept.device).unsqueeze(1)
    fields = kept.view(torch.int16) << shifts  # [16, 4 words]: each bit once where the sign is
    keep = (fields >> 15).view(-1)[:count].view(*shape)  # -1 or 0
    return keep.to(dtype).mul_(-1.0 / (1.0 - share / 256))


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
        self.sizes = tuple(sizes)
        self.members = members
        self.dropout = dropout
        self.hidden_dtype = hidden_dtype
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for n_in, n_out in pairwise(sizes):
            bound = (6.0 / (n_in + n_out)) ** 0.5
            uniform = torch.rand(members, n_in, n_out, generator=generator, device=generator.device)
            self.weights.append(nn.Parameter((2.0 * uniform - 1.0) * bound))  # [E, in, out]
            self.biases.append(nn.Parameter(torch.zeros(members, 1, n_out, device=generator.device)))  # [E, 1, out]

    def draw_masks(self, rows: int, generator: torch.Generator) -> Masks | None:
        """New dropout masks of every hidden layer for ``rows`` rows, or None where nothing is dropped."""
        if self.dropout == 0.0:
            return None
        shapes = [(self.members, rows, hidden) for hidden in self.sizes[1:-1]]
        dtype = self._dtype()
        return tuple(dropout_mask(shape, self.dropout, generator, dtype) for shape in shapes)

    def forward(self, x: Tensor, masks: Sequence[Tensor] | None = None) -> Tensor:
        """Map (E, N, in) to (E, N, out); without ``masks`` no unit is dropped and the result is deterministic."""
        dtype = self._dtype()
        *hidden, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for layer, (inner, shift) in enumerate(hidden):
            x = torch.baddbmm(shift.to(dtype), x.to(dtype), inner.to(dtype)).relu()
            if masks is not None:
                x = x * masks[layer]
        return torch.baddbmm(bias, x.to(weight.dtype), weight)

    def _dtype(self) -> torch.dtype:
        """In which hidden layers compute now: predictions are float32, and so are output layers always.

        Training in bfloat16 where the processor multiplies it quickly takes a model update at the thesis' settings from
        37 to 24 CPU ms; at those of ``fast`` it gains nothing.
        """
        exact = self.weights[0].dtype
        return self.hidden_dtype if torch.is_grad_enabled() and exact == torch.float32 else exact


@torch.no_grad()
def clip_unit_norms(network: MemberMLP, limit: float) -> None:
    """Scale the incoming weights of each unit down to a Euclidean norm of at most ``limit``.

    "The norm of the weights in each layer" (thesis 5.2.2) is read as the max-norm constraint of Keras, per unit:
    a norm of 3 on a whole 512 x 512 matrix would cripple it.
    """
    for weight in network.weights:
        squares = weight.square().sum(dim=1, keepdim=True)  # [E, 1, out]; ``norm`` takes four times as long
        weight.mul_((limit * squares.clamp_min(1e-24).rsqrt()).clamp_max(1.0))


def clip_gradient_norm(weights: Sequence[nn.Parameter], limit: float) -> None:
    """Scale all gradients down to a common norm of at most ``limit``, to the bit ``torch.nn.utils.clip_grad_norm_``.

    That function sorts gradients by device and type first, which costs as much as its arithmetic.
    """
    gradients = [weight.grad for weight in weights if weight.grad is not None]
    norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))
    torch._foreach_mul_(gradients, (limit / (norm + 1e-6)).clamp_max(1.0))
