"""A recurrent DQN (Hausknecht and Stone 2015) with replayed sequences, stored memory and burn-in (R2D2)."""

from __future__ import annotations

import torch
from imagine_bench.agents.dqn import Controller
from imagine_bench.agents.dqn_settings import ControllerSettings
from imagine_bench.agents.encoders.perception import load_perception, prepare_torch
from imagine_bench.agents.networks.mlp import mlp
from imagine_bench.agents.replay import Batch, Transitions
from torch import Tensor, nn

from imagine_bench.interfaces import AgentContext

from .agent import RememberingAgent
from .sequences import Recurrence
from .settings import DRQN as HYPERPARAMETERS
from .settings import RecurrentDQNSettings


class RecurrentValues(nn.Module):
    """A recurrence and, of the states that it makes, the values of actions; both are learned from Bellman errors."""

    def __init__(
        self, latent_size: int, n_actions: int, units: int, settings: ControllerSettings, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.recurrence = Recurrence(latent_size, n_actions, units, generator)
        self.head = mlp((latent_size + units, *settings.hidden, n_actions), generator)

    def forward(self, states: Tensor) -> Tensor:
        """Action values (N, A) of states (N, Z + H)."""
        return self.head(states)


class DRQN(RememberingAgent):
    """Acts and learns as the DQN, on the memory of its controller; a slowly updated target network has its own."""

    settings: RecurrentDQNSettings

    def new_controller(self, generator: torch.Generator) -> Controller:
        """Values with a memory of their own."""
        size = self.perception.latent_size
        units = self.settings.recurrence.units
        settings = self.settings.controller
        network = RecurrentValues(size - units, self.n_actions, units, settings, generator)
        return Controller(size, self.n_actions, settings, generator, network)

    @property
    def recurrence(self) -> Recurrence:
        """That of the controller."""
        return self.controller.network.recurrence  # type: ignore[return-value]

    def draw_batch(self, memory: Transitions) -> Batch:
        """Replayed sequences as transitions between states, through which the loss reaches the recurrent network."""
        del memory
        count = self.settings.controller.batch_size
        length = self.settings.recurrence.sequence
        sequences = self.real.draw(count, length, self._replay)
        with torch.no_grad():
            then = sequences.states(self.controller.target.recurrence)  # type: ignore[arg-type]
        return sequences.transitions(sequences.states(self.recurrence), then)


def make(context: AgentContext) -> DRQN:
    """The ``drqn`` agent."""
    settings = HYPERPARAMETERS.of(context)
    device = prepare_torch(context.device)
    return DRQN(load_perception(context), context.n_actions, settings, context.seeds, device)
