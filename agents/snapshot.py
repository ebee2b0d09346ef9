"""Parts of an agent as named numpy arrays, and the check that a snapshot fits before anything is overwritten."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from imagine_bench.arrays import Array, Arrays
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import AgentState
from imagine_bench.values import Json

from .networks.adam import MOMENTS, Adam, TrainedModule
from .replay import Ring

Part = TrainedModule | torch.Generator | Ring
"""The owners of an agent's arrays."""


def prefixed(prefix: str, arrays: Mapping[str, Array]) -> Arrays:
    """The arrays under ``prefix/``."""
    return {f"{prefix}/{name}": array for name, array in arrays.items()}


def below(prefix: str, arrays: Mapping[str, Array]) -> Arrays:
    """The arrays that lie under ``prefix/``, without it."""
    start = f"{prefix}/"
    return {name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)}


def training_arrays(module: nn.Module, optimiser: Adam | torch.optim.Optimizer) -> Arrays:
    """Copies of a module's weights and, of those that learn, of Adam's moments and steps, 0 before the first step."""
    tensors: dict[str, Tensor] = {}
    for name, weight in module.named_parameters():
        tensors[f"{name}/weight"] = weight.detach()
        if weight.requires_grad:
            blank = {**dict.fromkeys(MOMENTS, torch.zeros_like(weight)), "step": torch.zeros(())}
            tensors |= {f"{name}/{kind}": optimiser.state[weight].get(kind, blank[kind]) for kind in blank}
    return {name: tensor.cpu().numpy().copy() for name, tensor in tensors.items()}


@torch.no_grad()
def load_training(module: nn.Module, optimiser: Adam | torch.optim.Optimizer, arrays: Mapping[str, Array]) -> None:
    """Take up the result of :func:`training_arrays`."""
    for name, weight in module.named_parameters():
        weight.copy_(torch.tensor(arrays[f"{name}/weight"]))
        if weight.requires_grad:
            kinds = (*MOMENTS, "step")
            optimiser.state[weight] = {k: torch.tensor(arrays[f"{name}/{k}"], device=weight.device) for k in kinds}


def generator_array(generator: torch.Generator) -> NDArray[np.uint8]:
    """A torch generator's state."""
    return generator.get_state().numpy().copy()


def load_generator(generator: torch.Generator, array: NDArray[np.uint8]) -> None:
    """Take up the result of :func:`generator_array`."""
    generator.set_state(torch.tensor(array))


def jsonable(values: Mapping[str, Any]) -> dict[str, Json]:
    """The values as JSON would give them back."""
    return json.loads(json.dumps(values))


def arrays_of(parts: Mapping[str, Part]) -> Arrays:
    """Copies of weights, moments, rows and generators, below the name of each part."""
    found: Arrays = {}
    for name, part in parts.items():
        if isinstance(part, torch.Generator):
            found[name] = generator_array(part)
        elif isinstance(part, TrainedModule):
            found |= prefixed(name, training_arrays(part, part.optimiser))
        else:
            found |= prefixed(name, part.arrays())
    return found


def load_parts(parts: Mapping[str, Part], arrays: Arrays) -> None:
    """Take up the result of :func:`arrays_of`; how many rows memories ever held is the caller's to say."""
    for name, part in parts.items():
        if isinstance(part, torch.Generator):
            load_generator(part, arrays[name])
        elif isinstance(part, TrainedModule):
            load_training(part, part.optimiser, below(name, arrays))
        else:
            part.load(below(name, arrays), part.added)


_ROWS_VARY = ("real/", "imagination/memory/", "model_only/memory/", "starts/", "replay/", "table/")


def require_fit(given: AgentState, own: AgentState, *, equal: Collection[str] = ("filtered", "settings")) -> None:
    """Check a snapshot against the agent's own: settings, names of values, and names, types and shapes of arrays.

    Values named in ``equal`` must be the same where there are such. ArtefactError names the first difference.
    """
    _require_same_names(given.values, own.values)
    for part in (name for name in equal if name in own.values):
        _require_equal(part, given.values[part], own.values[part])
    _require_same_names(given.arrays, own.arrays)
    for name, ours in own.arrays.items():
        theirs = given.arrays[name]
        start = 1 if name.startswith(_ROWS_VARY) else 0
        if (theirs.dtype, theirs.shape[start:]) != (ours.dtype, ours.shape[start:]):
            raise ArtefactError(
                f"{name!r} in the snapshot is {theirs.dtype} {theirs.shape}, in this agent {ours.dtype} {ours.shape}; "
                "restore it with the settings and the encoder it was made with."
            )


def _require_same_names(given: Collection[str], own: Collection[str]) -> None:
    for name in sorted(set(given) ^ set(own)):
        verb = "lacks" if name in own else "has"
        raise ArtefactError(f"The snapshot {verb} {name!r}, unlike this agent; it is of another agent or damaged.")


def _require_equal(name: str, given: Json, own: Json) -> None:
    if isinstance(own, dict) and isinstance(given, dict):
        _require_same_names(given, own)
        for key in own:
            _require_equal(f"{name}.{key}", given[key], own[key])
    elif given != own:
        raise ArtefactError(
            f"{name!r} is {given!r} in the snapshot and {own!r} in this agent; restore it into its like."
        )
