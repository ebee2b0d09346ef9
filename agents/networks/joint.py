"""One gradient for the models of several seeds: their weights lie side by side, and seeds are a leading axis.

Small networks leave a processor waiting for calls rather than for arithmetic, so one pass through S of them costs less
than S passes. What is done with a gradient (clipping, Adam's moments, norms) stays each model's own. A model that
learns alone is the case S = 1 of the same code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from ..replay import Batch
from .flat_adam import FlatAdam
from .mlp import MemberMLP, Parameters
from .products import joined, stacked

Losses = Callable[[Parameters], Tensor]
"""From the parameters of S models of E members, each (S E, ...), to their losses (terms, S)."""


def gradients(optimisers: Sequence[FlatAdam], losses: Losses) -> tuple[Tensor, Tensor]:
    """Losses of S models, and the gradient of the sum of each one's terms by its own parameters.

    Args:
        optimisers: Those of the models, which must be of one shape.
        losses: What to differentiate; the parameters come in the order of ``optimisers[0].parameters``.

    Returns:
        Losses, shape (terms, S), and gradients, shape (S, P).
    """
    # Every greenlet has this flag for itself, and in a cohort the one that is here did not prepare torch.
    torch.set_flush_denormal(True)
    vectors = _side_by_side(optimisers).detach()
    gradient = torch.empty_like(vectors)  # each layer writes its own where it belongs
    sizes = [parameter.numel() for parameter in optimisers[0].parameters]
    homes = gradient.split(sizes, dim=1)
    shapes = [(-1, *parameter.shape[1:]) for parameter in optimisers[0].parameters]
    values, written = (
        [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
        for parts in (vectors.split(sizes, dim=1), homes)
    )
    terms = losses(Parameters([value.requires_grad_() for value in values], written))
    for home, found in zip(homes, torch.autograd.grad(terms.sum(), values), strict=True):
        if found.data_ptr() != home.data_ptr():  # several members of several models: reshaping was a copy
            home.copy_(found.view(home.shape))
    return terms.detach(), gradient


def _side_by_side(optimisers: Sequence[FlatAdam]) -> Tensor:
    """The parameters of S models as rows of one tensor (S, P), where they stay until the company changes."""
    if len(optimisers) == 1:
        return optimisers[0].vector.unsqueeze(0)
    home = optimisers[0].home
    if len(home) != len(optimisers) or any(o.home is not home or o.row != row for row, o in enumerate(optimisers)):
        home = torch.stack([optimiser.vector for optimiser in optimisers])
        for row, optimiser in enumerate(optimisers):
            optimiser.settle(home, row)
    return home


def batches(parts: Sequence[Batch]) -> Batch:
    """The batches of S models as one, every shape with a leading S."""
    names = Batch.__slots__
    return Batch(**{name: stacked([getattr(part, name) for part in parts]) for name in names})


def masks(network: MemberMLP, rows: int, generators: Sequence[torch.Generator]) -> Iterator[Tensor] | None:
    """The dropout masks of S models' E members as those of S E members, or None where nothing is dropped.

    Each is drawn when it is asked for, that is when its layer has been computed: so it is read from a near cache.
    """
    if network.dropout == 0.0:
        return None
    layers = network.sizes[1:-1]
    return (joined([network.draw_mask(hidden, rows, generator) for generator in generators]) for hidden in layers)
