"""The common part of agents with memory: they read states, and replay sequences."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from imagine_bench.agents.dqn import DQN
from imagine_bench.agents.encoders.perception import Perception
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.interfaces import AgentState, Frame, Observation, Transition
from imagine_bench.seeding import SeedTree

from .perception import Remembering
from .readout import ReadOut, fit
from .sequences import START, Recurrence, SequenceMemory
from .settings import RecurrentDQNSettings, RecurrentSettings


@dataclass(frozen=True, slots=True)
class Past:
    """The observations of an episode so far, and the macro-action after each frame, the last of which may be still to
    come.
    """

    frames: list[Frame] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)


class RememberingAgent(DQN, ABC):
    """A DQN whose states are the latents of a frame and the memory by :attr:`recurrence` after it.

    Snapshots are taken between two episodes, so an agent's view of one is no part of them.
    """

    perception: Remembering
    real: SequenceMemory
    settings: RecurrentDQNSettings | RecurrentSettings

    def __init__(
        self, perception: Perception, n_actions: int, settings: Any, seeds: SeedTree, device: torch.device, **more: Any
    ) -> None:
        remembering = Remembering(perception, settings.recurrence.units, self.recurrence_now)
        super().__init__(remembering, n_actions, settings, seeds, device, **more)
        self.read_out: tuple[int, ReadOut] | None = None  #: the newest read-out, of so many real steps
        self.begin_episode()

    def begin_episode(self) -> None:
        """Forget the episode so far; see :class:`.capabilities.EpisodeRememberer`."""
        self._seen = Past()
        self._lived = Past()

    def new_memory(self, device: torch.device) -> SequenceMemory:
        """One that is empty, of sequences."""
        settings = self.settings.recurrence
        size = self.perception.plain.latent_size
        return SequenceMemory(
            self.settings.memory.real,
            size,
            device,
            units=settings.units,
            burn_in=settings.burn_in,
            recurrence=self.recurrence_now,
        )

    @property
    @abstractmethod
    def recurrence(self) -> Recurrence:
        """The recurrent network."""

    def recurrence_now(self) -> Recurrence:
        """The recurrent network, for parts that ask anew each time. As a method, it is the copy's own in a copy."""
        return self.recurrence

    def perceive(self, frame: Frame) -> Tensor:
        """The mean latents of a frame and the memory after it. Shape (Z + H,).

        A frame that was not acted on is taken for the next one of the episode, or for the first of another.
        """
        seen = self._seen
        acted_on = bool(seen.frames) and np.shares_memory(seen.frames[-1], frame)  # an observation has a view of it
        frames = seen.frames if acted_on else [*seen.frames, frame]
        return self.perception.recall(frames, seen.actions[: len(frames) - 1])[0]

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Act as the DQN, and remember observations and actions until the episode ends."""
        self._seen.frames.append(observation.frame)
        action = super().act(observation, explore=explore)
        self._seen.actions.append(action)
        return action

    def store(self, transition: Transition) -> Tensor:
        """Add a real transition to the memory, with the memory before it; the state it began in (Z + H,)."""
        lived = self._lived
        frame = transition.observation.frame
        plain = self.perception.plain
        state, before = self.perception.recall([*lived.frames, frame], lived.actions)
        then = plain.posterior(transition.next_observation.frame)
        self.real.add_step(
            plain.posterior(frame),
            transition.action,
            transition.reward,
            then,
            transition.terminated,
            step=len(lived.frames),
            before=lived.actions[-1] if lived.actions else START,
            stored=before,
        )
        lived.frames.append(frame)
        lived.actions.append(transition.action)
        if transition.terminated or transition.truncated:
            self._lived = Past()
        return state

    def read_memory(self, frame: Frame, sizes: Sequence[int]) -> NDArray[np.int64]:
        """The values that a linear read-out finds in the memory; see :class:`.capabilities.MemoryReader`."""
        if self.read_out is None or self.read_out[0] != self.steps:
            self.read_out = self.steps, fit(self.real, self.recurrence, self.perception.plain.encoder, sizes)
        return self.read_out[1](self.perceive(frame)[self.perception.plain.latent_size :])

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot between two episodes; ArtefactError if it does not fit this agent."""
        super().restore(state)
        self.read_out = None
        self.begin_episode()
