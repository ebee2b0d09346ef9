"""The control ``dqn_efficient``: a DQN that uses its real experience as data-efficient agents do, without a model.

Many updates a real step, targets of n steps, a slowly updated target network, and networks that begin anew from time to
time, hidden layers in part (SR-SPR, D'Oro et al. 2023; BBF, Schwarzer et al. 2023). Of SPR and BBF it has no
self-predictive loss, no large network and no schedules.
"""

from __future__ import annotations

import torch
from imagine_bench.agents.dqn import DQN
from imagine_bench.agents.encoders.perception import load_perception, prepare_torch
from imagine_bench.agents.replay import Batch, Posterior, RealMemory, Transitions
from torch import Tensor

from imagine_bench.interfaces import AgentContext, Transition

from .settings import EFFICIENT, EfficientSettings


class EpisodicMemory(RealMemory):
    """Real transitions that know which of them was an episode's last."""

    def __init__(self, capacity: int, latent_size: int, device: torch.device) -> None:
        super().__init__(capacity, latent_size, device)
        self._columns["last"] = torch.zeros(capacity, dtype=torch.bool, device=device)

    def add(
        self, posterior: Posterior, action: int, reward: float, next_posterior: Posterior, terminated: bool
    ) -> None:
        """Store one transition, as yet not its episode's last."""
        self._columns["last"][self.added % self.capacity] = False
        super().add(posterior, action, reward, next_posterior, terminated)

    def end_episode(self) -> None:
        """The newest transition was its episode's last."""
        self._columns["last"][(self.added - 1) % self.capacity] = True

    def sample_returns(self, count: int, generator: torch.Generator, *, steps: int, discount: float) -> Batch:
        """Transitions over up to ``steps`` macro-actions, fewer where an episode or the memory ends before.

        Rewards are discounted sums, next states those after the last macro-action. ``terminated`` is the share that one
        discount of the next value has to lose: 1 where the episode terminated, else ``1 - discount ** (k - 1)`` of k
        macro-actions.
        """
        columns = self._columns
        newest = (self.added - 1) % self.capacity
        first = torch.randint(len(self), (count,), generator=generator, device=generator.device)
        at = first
        reward = columns["reward"][first].clone()
        factor = torch.ones(count, device=first.device)
        for _ in range(steps - 1):
            goes_on = ~columns["last"][at] & (at != newest)
            at = torch.where(goes_on, (at + 1) % self.capacity, at)
            factor = torch.where(goes_on, factor * discount, factor)
            reward += torch.where(goes_on, factor * columns["reward"][at], 0.0)
            if not goes_on.any():
                break
        rows = {name: columns[name][first] for name in ("mu", "sigma", "action")}
        rows |= {name: columns[name][at] for name in ("next_mu", "next_sigma")}
        rows |= {"reward": reward, "terminated": 1.0 - factor * (1.0 - columns["terminated"][at])}
        return self._batch(rows, generator, 1.0)


class EfficientDQN(DQN):
    """A DQN of many updates, n-step targets and resets."""

    settings: EfficientSettings
    real: EpisodicMemory

    def new_memory(self, device: torch.device) -> EpisodicMemory:
        """One that is empty."""
        return EpisodicMemory(self.settings.memory.real, self.perception.latent_size, device)

    def store(self, transition: Transition) -> Tensor:
        """As of the DQN; and where episodes end."""
        z = super().store(transition)
        if transition.terminated or transition.truncated:
            self.real.end_episode()
        return z

    def draw_batch(self, memory: Transitions) -> Batch:
        """Transitions over n macro-actions."""
        settings = self.settings.controller
        steps = self.settings.reuse.steps
        return self.real.sample_returns(settings.batch_size, self._replay, steps=steps, discount=settings.discount)

    def learn_more(self, z: Tensor, episode: int) -> None:
        """Begin anew where it is time to."""
        every = self.settings.reuse.reset_every
        made = self.settings.controller.updates_per_step
        if every and self.updates // every > (self.updates - made) // every:
            self.reset_controller()

    def reset_controller(self) -> None:
        """A new last layer and optimiser, hidden layers moved toward new weights (shrink and perturb)."""
        fresh = self.new_controller(self._replay)
        layers = list(zip(fresh.network.parameters(), self.controller.network.parameters(), strict=True))
        with torch.no_grad():
            for new, old in layers[:-2]:  # the last layer is its weights and biases
                new.lerp_(old, self.settings.reuse.kept)
        fresh.target.load_state_dict(fresh.network.state_dict())
        self.controller = fresh


def make(context: AgentContext) -> EfficientDQN:
    """The ``dqn_efficient`` agent."""
    settings = EFFICIENT.of(context)
    device = prepare_torch(context.device)
    return EfficientDQN(load_perception(context), context.n_actions, settings, context.seeds, device)
