"""Real episodes as arrays: the content of a dataset in any format, and its identity.

Shapes: ``E`` episodes of ``N`` transitions in all, so ``N + E`` frames, each episode's last one included; ``A``
actions, ``M`` coordinates of a macrostate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imagine_bench.arrays import Array, Arrays, Bools, Floats, Frame, Ints, content_hash, read_only
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.observation import Observation, Transition

_TYPES = {
    "lengths": np.int64,
    "frames": np.uint8,
    "action_masks": np.int8,
    "actions": np.int64,
    "rewards": np.float64,
    "terminated": np.bool_,
    "truncated": np.bool_,
    "success": np.bool_,
}
FRAME_SHAPE = (64, 64, 3)


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Episodes one behind another, all that a learner may be given. Their arrays cannot be written to.

    Raises:
        InvalidValueError: Arrays that do not fit together, a reward that is not finite, an action that does not exist,
            or an episode that ends too early or not at all.
    """

    lengths: Ints  #: macro-actions of each episode, at least 1. Shape (E,).
    frames: Frame  #: before each macro-action, and after the last of an episode. Shape (N + E, 64, 64, 3).
    action_masks: NDArray[np.int8]  #: 1 where a macro-action can be carried out there. Shape (N + E, A).
    actions: Ints  #: macro-actions, in [0, A). Shape (N,).
    rewards: Floats  #: rewards. Shape (N,).
    terminated: Bools  #: whether the episode ended there in a terminal macrostate. Shape (N,).
    truncated: Bools  #: whether it was cut off there. Shape (N,).
    success: Bools  #: whether each episode ended in success. Shape (E,).

    def __post_init__(self) -> None:
        for name, dtype in _TYPES.items():
            found = getattr(self, name)
            if not isinstance(found, np.ndarray) or found.dtype != dtype:
                given = getattr(found, "dtype", type(found).__name__)
                raise InvalidValueError(f"{name} holds {given}, not {dtype.__name__}")
            object.__setattr__(self, name, read_only(found))
        if self.lengths.ndim != 1 or not len(self.lengths) or self.lengths.min() < 1:
            raise InvalidValueError("lengths must be those of one or more episodes, each of at least 1")
        episodes = len(self.lengths)
        steps = int(self.lengths.sum())
        masks = self.action_masks.shape[-1] if self.action_masks.ndim == 2 else 0
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("actions", "rewards", "terminated", "truncated"), (steps,))
        shapes |= {"frames": (steps + episodes, *FRAME_SHAPE), "action_masks": (steps + episodes, masks)}
        shapes["success"] = (episodes,)
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InvalidValueError(f"{name} has shape {getattr(self, name).shape}, not {shape}")
        if not np.isfinite(self.rewards).all():
            raise InvalidValueError(f"reward {int(np.argmin(np.isfinite(self.rewards)))} is not finite")
        if not ((self.actions >= 0) & (self.actions < masks)).all():
            raise InvalidValueError(f"actions must lie from 0 to {masks - 1}")
        if not np.isin(self.action_masks, (0, 1)).all():
            raise InvalidValueError("an action mask is neither 0 nor 1")
        if not np.array_equal(np.flatnonzero(self.terminated | self.truncated), np.cumsum(self.lengths) - 1):
            raise InvalidValueError("an episode goes on after its end, or has none")

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def n_actions(self) -> int:
        """Number of macro-actions A."""
        return self.action_masks.shape[1]

    @property
    def rows(self) -> tuple[Ints, Ints]:
        """Rows of the frames before each transition (N,), and of those that episodes end with (E,)."""
        last = np.cumsum(self.lengths + 1) - 1
        return np.delete(np.arange(len(self.frames)), last), last

    def arrays(self) -> Arrays:
        """Every array by its name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def steps(self, episode: int) -> tuple[slice, slice]:
        """Where an episode's transitions lie, and where its frames."""
        begin = int(self.lengths[:episode].sum())
        length = int(self.lengths[episode])
        return slice(begin, begin + length), slice(begin + episode, begin + episode + length + 1)

    def transitions(self, episode: int) -> Iterator[Transition]:
        """The real transitions of an episode as a learner sees them, without macrostates."""
        steps, rows = self.steps(episode)
        frames = [Observation(frame=frame) for frame in self.frames[rows]]
        for index, step in enumerate(range(steps.start, steps.stop)):
            yield Transition(
                observation=frames[index],
                action=int(self.actions[step]),
                reward=float(self.rewards[step]),
                next_observation=frames[index + 1],
                terminated=bool(self.terminated[step]),
                truncated=bool(self.truncated[step]),
            )

    def first(self, transitions: int) -> Episodes:
        """The first so many transitions, the last episode cut off there where it is longer.

        Raises:
            InvalidValueError: There are fewer, or none is asked for.
        """
        if not 1 <= transitions <= len(self.actions):
            raise InvalidValueError(f"{transitions} transitions of {len(self.actions)}: give 1 to that many")
        ends = np.cumsum(self.lengths)
        count = int(np.searchsorted(ends, transitions)) + 1
        truncated = self.truncated[:transitions].copy()
        truncated[-1] |= not self.terminated[transitions - 1]
        lengths = self.lengths[:count].copy()
        success = self.success[:count].copy()
        lengths[-1] -= ends[count - 1] - transitions
        success[-1] &= ends[count - 1] == transitions
        frames = slice(transitions + count)
        return Episodes(
            lengths=lengths,
            frames=self.frames[frames],
            action_masks=self.action_masks[frames],
            actions=self.actions[:transitions],
            rewards=self.rewards[:transitions],
            terminated=self.terminated[:transitions],
            truncated=truncated,
            success=success,
        )

    @cached_property
    def hash(self) -> str:
        """64 hex digits that change when anything in any array does, and with nothing else."""
        return content_hash(self.arrays())


def joined(parts: Sequence[Mapping[str, ArrayLike]]) -> Episodes:
    """Episodes from one mapping each: ``frames``, ``action_masks``, ``actions``, ... and one ``success``."""
    if not parts:
        raise InvalidValueError("there is no episode")
    arrays: Arrays = {"success": np.array([part["success"] for part in parts], dtype=bool)}
    arrays["lengths"] = np.array([len(np.asarray(part["actions"])) for part in parts], dtype=np.int64)
    for name in set(_TYPES) - set(arrays):
        arrays[name] = np.concatenate([np.asarray(part[name]) for part in parts])
    exact: Arrays = {name: _exactly(name, array) for name, array in arrays.items()}
    return Episodes(**exact)


def _exactly(name: str, array: Array) -> Array:
    """An array in the type that episodes have it in, if that changes no value."""
    cast = array.astype(_TYPES[name]) if array.dtype.kind in "biuf" else array
    return cast if np.array_equal(cast, array, equal_nan=array.dtype.kind == "f") else array
