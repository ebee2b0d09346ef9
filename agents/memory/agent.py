"""What agents with memory share: they read states, and replay sequences."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from imagine_bench.interfaces import Observation, Transition
from imagine_bench.seeding import SeedTree

from ..dqn import DQN
from ..encoders.perception import Perception
from .perception import Remembering
from .recurrence import START, Recurrence
from .sequences import SequenceMemory
from .settings import RecurrentDQNSettings, RecurrentSettings


class RememberingAgent(DQN):
    """A DQN whose states are the latents of a frame and what :attr:`recurrence` remembers of the episode after it.

    What is remembered follows from the observation, which has the episode's past; between two calls nothing is kept.
    """

    perception: Remembering
    real: SequenceMemory
    settings: RecurrentDQNSettings | RecurrentSettings

    def __init__(
        self, perception: Perception, n_actions: int, settings: Any, seeds: SeedTree, device: torch.device, **more: Any
    ) -> None:
        remembering = Remembering(perception, settings.recurrence.units, lambda: self.recurrence)
        super().__init__(remembering, n_actions, settings, seeds, device, **more)

    def new_memory(self, device: torch.device) -> SequenceMemory:
        """One that is empty, of sequences."""
        settings, size = self.settings.recurrence, self.perception.plain.latent_size
        return SequenceMemory(
            self.settings.memory.real, size, device,
            units=settings.units, burn_in=settings.burn_in, recurrence=lambda: self.recurrence,
        )  # fmt: skip

    @property
    def recurrence(self) -> Recurrence:
        """What remembers."""
        raise NotImplementedError

    def perceive(self, observation: Observation) -> Tensor:
        """The mean latents of the frame and what is remembered after it. Shape (Z + H,)."""
        return self.perception.recall(observation)[0]

    def store(self, transition: Transition) -> None:
        """Add a real transition to the memory, with what was remembered before its frame."""
        seen, plain = transition.observation, self.perception.plain
        self.real.add_step(
            plain.posterior(seen.frame), transition.action, transition.reward,
            plain.posterior(transition.next_observation.frame), transition.terminated,
            step=len(seen.past), before=seen.past[-1][1] if seen.past else START,
            stored=self.perception.recall(seen)[1],
        )  # fmt: skip
