"""The interface of an agent: its construction, its methods, and its state in a checkpoint.

Optional abilities of agents are in :mod:`.interfaces.capabilities`. Shapes: ``A`` macro-actions, ``Z`` latents.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Arrays, Frame, Ints, State
from imagine_bench.interfaces.observation import FRAME_PX, Observation, Transition
from imagine_bench.interfaces.task import TaskSpec
from imagine_bench.rules import Rules
from imagine_bench.seeding import SeedTree
from imagine_bench.values import Setting

DEVICES = ("cpu", "cuda")
"""Devices that learners compute on, by torch's names."""


@dataclass(frozen=True, kw_only=True)
class ExactWorld:
    """The knowledge of a perfect world model, for privileged controls."""

    rules: Rules  #: the macrostate machine
    #: frames (N, 64, 64, 3) of macrostates (N, M), as training shows them
    render: Callable[[Ints, np.random.Generator], Frame]

    @classmethod
    def of(cls, spec: TaskSpec, appearance: str) -> ExactWorld | None:
        """That of a task at an appearance; None where frames hide something, so that no frame is a state."""
        if spec.sight is not None:
            return None
        return cls(rules=spec.rules, render=partial(_rendered, spec, appearance))


def _rendered(spec: TaskSpec, appearance: str, states: Ints, rng: np.random.Generator) -> Frame:
    return spec.render_macrostates(states, appearance, rng)


@dataclass(frozen=True, kw_only=True)
class AgentContext:
    """The arguments of an agent's factory; it learns nothing else about its task."""

    n_actions: int  #: number of macro-actions A
    preprocessing: str  #: name of the task's declared observation preprocessing
    encoder: Path | None  #: the encoder artefact (``.safetensors``), or None for agents that need none
    seeds: SeedTree  #: the agent's node of the seed tree
    config_group: str = "chapter_5"  #: name of the config group of settings, as the task names it
    hyperparameters: str = "fast"  #: name of the group's set of values (``"minimal"``, ``"fast"`` or ``"published"``)
    #: single settings that replace the set's, by dotted name
    overrides: Mapping[str, Setting] = field(default_factory=dict)
    device: str = "cpu"  #: a torch device name, ``"cpu"`` or ``"cuda"``
    #: makes an optimal policy, from the observation and so many macro-actions of an episode; only
    #: for agents registered as privileged, None for every other
    optimal_policy: Callable[[], Callable[[State, int], int]] | None = None
    #: only for agents registered as privileged, where frames hide nothing, no other task is trained on before, and no
    #: teacher adds to rewards
    exact_world: ExactWorld | None = None
    argument: str = ""  #: the text after the colon of the name that it was asked for by
    #: shape of each part of an observation, by its name in :data:`OBSERVATIONS`
    observation: Mapping[str, tuple[int, ...]] = field(default_factory=lambda: {"frame": (FRAME_PX, FRAME_PX, 3)})


@dataclass(frozen=True, kw_only=True)
class AgentState:
    """All that an agent needs to go on as if never interrupted: weights, optimisers, memories, generators, counters."""

    arrays: Arrays  #: named numpy arrays; they become one safetensors file
    #: JSON-serialisable values; a resumed run has them as JSON does: lists in place of tuples, texts for all keys
    values: dict[str, Any]


class FrameEncoder(Protocol):
    """A representation of frames that another package offers, such as the features of a frozen network.

    It may also have ``decode``, from latents (N, Z) to pictures (N, H, W, 3) or (N, H, W) in [0, 1]; and
    ``code_sizes``, the numbers of values of factors whose one-hot codes, one behind the other, its latents are.
    """

    def encode(self, frames: Frame) -> NDArray[np.floating]:
        """Latents (N, Z), finite, of frames (N, 64, 64, 3); equal frames have equal latents, and Z never changes."""


class Agent(Protocol):
    """A learner, or a fixed policy, seen by the runner. One agent lives through one run."""

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Choose a macro-action in [0, A); ``explore=False`` changes nothing and is random only in random agents."""

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Take in one real transition of training episode ``episode`` (from 0) and learn from it."""

    def diagnostics(self) -> dict[str, float]:
        """Means since the last call, by slashed name: ``imagination/acceptance_rate``, ``time/model_s``, ..."""

    def state(self) -> AgentState:
        """A snapshot for a checkpoint; later learning does not alter it."""

    def restore(self, state: AgentState) -> None:
        """Continue from ``state``, bit for bit; ArtefactError names the first difference of one that does not fit."""
