"""Imagination that remembers: a mixture density network on a recurrent state (MDN-RNN, Ha and Schmidhuber 2018).

The memory of the recurrence is learned from the predictions of the world model: the next latents, reward and end. The
controller reads the latents and the memory, as in that paper, and learns nothing of the recurrence. Imagined
rollouts begin in real states and remember their imagined steps; filter and members are those of the imagining agents.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import cast

import torch
from imagine_bench.agents.imagination.agent import ImaginingAgent, build
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import Settings, WorldModelSettings
from imagine_bench.agents.imagination.world_model import EnvironmentModel
from imagine_bench.agents.networks.adam import Adam
from imagine_bench.agents.replay import Batch
from torch import Tensor

from .agent import RememberingAgent
from .sequences import Recurrence
from .settings import IMAGINATION_MEMORY, RecurrentSettings


class RecurrentEnvironmentModel(EnvironmentModel):
    """A world model of states (Z + H): the memory (H) decides with the latents (Z) its predictions."""

    def __init__(
        self, state_size: int, n_actions: int, settings: WorldModelSettings, units: int, generator: torch.Generator
    ) -> None:
        super().__init__(state_size, n_actions, settings, generator, predicted=state_size - units)
        self.recurrence = Recurrence(self.predicted, n_actions, units, generator)
        self.clipped = (*self.networks, self.recurrence)
        self.optimiser = Adam([(self.parameters(), 0.0)], settings.learning_rate)

    def keep_dynamics_of(self, other: EnvironmentModel) -> None:
        """Take over the dynamics and the recurrence of another model of the same shape."""
        super().keep_dynamics_of(other)
        self.recurrence.load_state_dict(cast(RecurrentEnvironmentModel, other).recurrence.state_dict())


class RecurrentImagination(Imagination):
    """Imagination whose rollouts carry the memory."""

    model: RecurrentEnvironmentModel

    def new_model(self, state_size: int, n_actions: int, settings: Settings) -> RecurrentEnvironmentModel:
        """A world model that has learned nothing, of states of so many numbers."""
        units = cast(RecurrentSettings, settings).recurrence.units
        return RecurrentEnvironmentModel(state_size, n_actions, settings.model, units, self.generators["weights"])

    @torch.no_grad()
    def state_after(self, z: Tensor, action: Tensor, predicted: Tensor) -> Tensor:
        """States (N, Z + H) after others ``z`` and actions (N,), given the predicted latents (N, Z)."""
        memory = z[:, self.model.predicted :]
        after = self.model.recurrence(predicted.unsqueeze(1), action.unsqueeze(1), memory)[:, 0]
        return torch.cat([predicted, after], dim=-1)


class ImaginingMemoryAgent(RememberingAgent, ImaginingAgent):
    """Algorithm 1 on states: a DQN on the memory of the world model, fed by recurrent imagination."""

    settings: RecurrentSettings
    imagination: RecurrentImagination
    imagination_kind = RecurrentImagination

    @property
    def recurrence(self) -> Recurrence:
        """That of the world model."""
        return self.imagination.model.recurrence

    def reset_for_new_task(self) -> None:
        """As without memory, and what is remembered is read anew."""
        super().reset_for_new_task()
        self.read_out = None

    @torch.no_grad()
    def remembered_states(self) -> Tensor:
        """With the memory after each frame, from that which was stored before it. Shape (N, Z + H)."""
        rows = self.real.arrays()
        device = self.perception.encoder.device
        mu, before, stored = (torch.as_tensor(rows[name], device=device) for name in ("mu", "before", "stored"))
        return torch.cat([mu, self.recurrence(mu.unsqueeze(1), before.unsqueeze(1), stored)[:, 0]], dim=-1)

    def draw_model_batches(self, generator: torch.Generator) -> Iterator[Batch]:
        """Replayed sequences as transitions between states, through which losses reach the recurrent network."""
        settings = self.settings.model
        length = self.settings.recurrence.sequence
        for _ in range(settings.updates_per_step):
            sequences = self.real.draw(
                settings.batch_size, length, generator, spread=settings.spread, balance=settings.balance
            )
            states = sequences.states(self.recurrence)
            yield sequences.transitions(states, states)


make = partial(build, ImaginingMemoryAgent, filtered=True, hyperparameters=IMAGINATION_MEMORY)
"""The ``imagination_memory`` agent."""
