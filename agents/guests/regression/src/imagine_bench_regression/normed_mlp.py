"""Dense networks that standardise the input of every layer (thesis 4.5.1), many members trained as one computation.

While training, activations are kept as units x rows: standardising a unit over its batch is then layer normalisation
over the last axis, which torch has as one fused operation. For prediction the standardisation is folded into the
weights, so the predictor is an ordinary ``MemberMLP``. Shapes: ``E`` members, ``H`` units, ``N`` rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from imagine_bench.agents.networks.mlp import MemberMLP, dropout_mask
from torch import Tensor, nn

EPSILON = 1e-5
"""Added to every variance (the default of PyTorch): little, as decay makes units small."""
MOMENTUM = 0.99
"""Share of the running statistics that one batch leaves (the default of Keras), once there have been 100 batches."""
_REACH = 3.0**0.5
"""Half the width of a uniform distribution, in standard deviations: how far first units' bends are spread."""


class NormedMLP(nn.Module):
    """E independent ReLU networks with a linear output, the input of every layer standardised over its batch.

    The learned scale and shift of batch normalisation (Ioffe & Szegedy 2015) are left out: a dense layer follows each,
    whose weights and bias can express them.

    Args:
        sizes: Units of input, hidden and output layers. Length at least 2.
        generators: One a member; each draws its member's initial weights (Glorot uniform; biases of the first layer
            uniform too, so that its units bend all over the data and not all at its centre; other biases 0), so that a
            member is the same network alone and among others.
        dropout: Probability of dropping a unit of a hidden layer that another one follows, in [0, 1). Units right
            before the output stay: their noise is noise of the outputs, which a mixture would take for the data's.
        precision: Type of the products between hidden layers while training, and on a CPU that in which each batch's
            statistics come. Parameters, the values of first and last layer and all predictions are always float32.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        *,
        generators: Sequence[torch.Generator],
        dropout: float,
        precision: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        self.sizes = tuple(sizes)
        self.members = len(generators)
        self.dropout = dropout
        self.precision = precision
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        self.batches = 0
        self._statistics: list[tuple[Tensor, Tensor]] = []
        device = generators[0].device
        for layer, (n_in, n_out) in enumerate(pairwise(sizes)):
            bound = (6.0 / (n_in + n_out)) ** 0.5
            uniform = torch.stack([torch.rand(n_out, n_in, generator=g, device=g.device) for g in generators])
            self.weights.append(nn.Parameter((2.0 * uniform - 1.0) * bound))  # [E, out, in]
            reach = 0.0 if layer else _REACH * bound
            uniform = torch.stack([torch.rand(n_out, 1, generator=g, device=g.device) for g in generators])
            self.biases.append(nn.Parameter((2.0 * uniform - 1.0) * reach))  # [E, out, 1]
            self.register_buffer(f"mean_{layer}", torch.zeros(self.members, n_in, 1, device=device))
            self.register_buffer(f"variance_{layer}", torch.ones(self.members, n_in, 1, device=device))

    def draw_masks(self, rows: int, generators: Sequence[torch.Generator]) -> tuple[Tensor, ...] | None:
        """Factors of the hidden layers but the last, each (E, H, N), from its member's generator; None for none."""
        hidden = self.sizes[1:-2]
        if self.dropout == 0.0 or not hidden:
            return None
        shape = sum(hidden), rows
        masks = torch.stack([dropout_mask(shape, self.dropout, draws, self.precision) for draws in generators])
        return masks.split(hidden, dim=1)

    def forward(self, x: Tensor, masks: Sequence[Tensor] | None) -> Tensor:
        """Map a training batch (E, in, N) to (E, out, N), and keep its statistics for :meth:`update_running_stats`."""
        last = len(self.weights) - 1
        self._statistics = []
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x, mean, rstd = torch.native_layer_norm(x, x.shape[-1:], None, None, EPSILON)
            self._statistics.append((mean.detach(), rstd.detach()))
            if layer == 0:
                x = torch.baddbmm(bias, weight, x)  # [E, out, N]
            elif layer < last:
                x = torch.baddbmm(bias.to(self.precision), weight.to(self.precision), x)
            else:
                x = self._outputs(weight, bias, x)
            if layer < last:
                x = x.to(self.precision).relu()
                x = x if masks is None or layer >= len(masks) else x * masks[layer]
        return x

    def _outputs(self, weight: Tensor, bias: Tensor, x: Tensor) -> Tensor:
        """The last layer: its values in float32, its gradient in the precision of the hidden products."""
        if x.dtype == torch.float32:
            return torch.baddbmm(bias, weight, x)
        rounded = torch.bmm(weight.to(x.dtype), x).float()
        with torch.no_grad():
            rounding = torch.bmm(weight, x.float()) - rounded
        return bias + rounded + rounding

    @torch.no_grad()
    def update_running_stats(self) -> None:
        """Move the running means and variances toward those of the last batch; the first batches count equally."""
        self.batches += 1
        share = max(1.0 - MOMENTUM, 1.0 / self.batches)
        for layer, (mean, rstd) in enumerate(self._statistics):
            self.get_buffer(f"mean_{layer}").lerp_(mean.float(), share)
            variance = (rstd.float().pow(-2) - EPSILON).clamp_min_(0.0)
            self.get_buffer(f"variance_{layer}").lerp_(variance, share)

    @torch.no_grad()
    def folded(self, members: slice = slice(None)) -> MemberMLP:
        """The same networks, or some, with the running statistics folded into the weights: ``W (x - m) / s + b``."""
        blank = torch.Generator(device=self.weights[0].device)
        count = len(self.weights[0][members])
        network = MemberMLP(self.sizes, members=count, dropout=self.dropout, generator=blank)
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            mean = self.get_buffer(f"mean_{layer}")
            variance = self.get_buffer(f"variance_{layer}")
            scaled = weight * (variance + EPSILON).rsqrt().mT  # [E, out, in]
            network.weights[layer].copy_(scaled.mT[members])
            network.biases[layer].copy_((bias - scaled @ mean).mT[members])
        return network


@torch.no_grad()
def clip_member_gradients(network: nn.Module, limit: float) -> Tensor:
    """Scale the gradient of each member down to a norm of at most ``limit``; parameters begin with the member axis.

    Returns the norms before. Shape (E,).
    """
    gradients = [parameter.grad.flatten(1) for parameter in network.parameters() if parameter.grad is not None]
    norms = torch.stack([gradient.square().sum(dim=1) for gradient in gradients]).sum(dim=0).sqrt()
    scale = (limit / norms.clamp_min(1e-30)).clamp_max(1.0).unsqueeze(1)
    for gradient in gradients:
        gradient.mul_(scale)
    return norms
