"""World models whose every transition is known: one that counts, one that is a task's rules."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import torch
from imagine_bench.agents.dqn import Controller
from imagine_bench.agents.dqn_settings import ControllerSettings
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.model_only import ModelOnlyAgent
from imagine_bench.agents.imagination.rollouts import Counts, Imagination
from imagine_bench.agents.imagination.settings import ImaginationSettings, Settings
from imagine_bench.agents.replay import RealMemory

from imagine_bench.interfaces import Outcome, State, TaskSpec
from imagine_bench.seeding import SeedTree

CPU = torch.device("cpu")
T = 4
Change = Callable[[Mixture, torch.Tensor], Mixture]


class CountingModel:
    """An identifiable world model: latent (i, c) goes to (i, c + 1), and uncertainty and end come at chosen counts.

    The first latent dimension tells the rollouts apart by the action taken first. ``change`` gets the mixtures of
    latents, and these, and returns the prediction instead.
    """

    members = 1
    latent_size = 2
    n_actions = 2

    def __init__(
        self,
        *,
        uncertain_at: int = -1,
        end_at: int = -1,
        reward_uncertain_at: int = -1,
        torn_at: int = -1,
        change: Change | None = None,
    ) -> None:
        self.uncertain_at = uncertain_at
        self.end_at = end_at
        self.reward_uncertain_at = reward_uncertain_at
        self.torn_at = torn_at
        self.change = change

    def draw_weights(self, count: int, dropout: torch.Generator) -> None:
        return None

    def draw_reward_weights(self, count: int, dropout: torch.Generator) -> tuple[torch.Tensor, ...]:
        return ()

    def reward_std(
        self, z: torch.Tensor, action: torch.Tensor, next_z: torch.Tensor, weights: tuple[torch.Tensor, ...]
    ) -> torch.Tensor:
        return 2.0 * (next_z[:, 1] == self.reward_uncertain_at)

    def predict(self, z: torch.Tensor, action: torch.Tensor, weights: None) -> Mixture:
        following = z + torch.tensor([0.0, 1.0])
        uncertain = (following[:, 1] == self.uncertain_at).float()  # [N]
        spread = torch.linspace(-1.0, 1.0, T)[:, None] * uncertain * 3.0  # [T, N]; zero mean over weight samples
        means = following.expand(T, *following.shape).clone()
        means[..., 0] += spread
        sound = Mixture(torch.zeros(T, len(z), 1), means.unsqueeze(2), torch.full((T, len(z), 1, 2), -9.0))
        return self.change(sound, z) if self.change else sound

    def predict_outcome(
        self, z: torch.Tensor, action: torch.Tensor, next_z: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ends = (next_z[:, 1] == self.end_at).float() + 0.3 * (next_z[:, 1] == self.torn_at)
        return 10.0 * next_z[:, 1], ends


def chosen(changes: Mapping[str, Any]) -> ImaginationSettings:
    values = {"breadth": 3, "depth": 10, "temperature": 0.0, "threshold": 0.3, "weight_samples": T}
    return ImaginationSettings(**{**values, **changes})


def make(*, filtered: bool, model: CountingModel, **changes: object) -> tuple[Imagination, Controller]:
    settings = Settings(imagination=chosen(changes))
    imagination = Imagination(2, 2, settings, filtered=filtered, seeds=SeedTree(0), device=CPU)
    imagination.model = model  # type: ignore[assignment]
    return imagination, Controller(2, 2, settings.controller, torch.Generator().manual_seed(0))


def imagined(
    model: CountingModel, *, filtered: bool = False, epsilon: float = 0.5, states: int = 1, **changes: object
) -> tuple[Imagination, Counts]:
    """The imagination of such a model from (0, 0), with so many real states remembered."""
    imagination, controller = make(filtered=filtered, model=model, **changes)
    counts = imagination.rollouts(controller, torch.zeros(2), remembering(states), epsilon)
    return imagination, counts


def practising(model: CountingModel, *, filtered: bool = False, **changes: object) -> ModelOnlyAgent:
    """An agent that trains in such a model alone, in episodes from (0, 0)."""
    controller = ControllerSettings(hidden=(8,), batch_size=4, epsilon_decay=0.1)
    settings = Settings(imagination=chosen(changes), controller=controller)
    sees: Any = SimpleNamespace(latent_size=2)
    agent = ModelOnlyAgent(sees, 2, settings, SeedTree(0), CPU, filtered=filtered)
    agent.imagination.model = model  # type: ignore[assignment]
    agent.starts.add((torch.zeros(2), torch.zeros(2)))
    agent.real = remembering(4)
    agent.steps = 1
    return agent


def remembering(count: int) -> RealMemory:
    """Real states (i, 5) for i below ``count``, known exactly."""
    real = RealMemory(count, 2, CPU)
    for index in range(count):
        z = torch.tensor([float(index), 5.0])
        sigma = torch.zeros(2)
        real.add((z, sigma), 0, 0.0, (z, sigma), False)
    return real


class RuledModel:
    """A world model equal to a task's rules: a latent is the one-hot code of each coordinate of a macrostate.

    ``uncertain`` pairs of macrostate and action are predicted rightly on average, by weight samples that disagree.
    """

    members = 1

    def __init__(self, task: TaskSpec, uncertain: Collection[tuple[State, int]] = ()) -> None:
        self.rules = task.rules
        self.n_actions = task.n_actions
        self.uncertain = frozenset(uncertain)
        self._outcome = functools.cache(lambda state, action: task.rules.outcomes(state, action)[0])
        self.sizes = [len(values) for values in task.macrostate_values]
        self.latent_size = sum(self.sizes)

    def encode(self, macrostates: Iterable[State]) -> torch.Tensor:
        parts = torch.tensor(list(macrostates)).unbind(dim=1)
        hot = [torch.nn.functional.one_hot(part, size) for part, size in zip(parts, self.sizes, strict=True)]
        return torch.cat(hot, dim=1).float()

    def decode(self, z: torch.Tensor) -> list[State]:
        parts = [part.argmax(dim=1) for part in z.split(self.sizes, dim=1)]
        return [tuple(row) for row in torch.stack(parts, dim=1).tolist()]

    def draw_weights(self, count: int, dropout: torch.Generator) -> None:
        return None

    def _outcomes(self, z: torch.Tensor, action: torch.Tensor) -> list[Outcome]:
        pairs = zip(self.decode(z), action.tolist(), strict=True)
        return [self._outcome(*pair) for pair in pairs]

    def predict(self, z: torch.Tensor, action: torch.Tensor, weights: None) -> Mixture:
        following = self.encode(outcome.macrostate for outcome in self._outcomes(z, action))
        pairs = zip(self.decode(z), action.tolist(), strict=True)
        torn = torch.tensor([pair in self.uncertain for pair in pairs]).float()  # [N]
        means = following.expand(T, *following.shape).clone()
        means[..., 0] += torch.linspace(-1.0, 1.0, T)[:, None] * torn * 3.0
        shape = (T, len(z), 1, self.latent_size)
        return Mixture(torch.zeros(T, len(z), 1), means.unsqueeze(2), torch.full(shape, -9.0))

    def predict_outcome(
        self, z: torch.Tensor, action: torch.Tensor, next_z: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        outcomes = self._outcomes(z, action)
        rewards = torch.tensor([outcome.reward for outcome in outcomes])
        return rewards, torch.tensor([float(outcome.terminated) for outcome in outcomes])


def ruled(task: TaskSpec, *, filtered: bool = True, uncertain: Collection[tuple[State, int]] = ()) -> Imagination:
    """The imagination of :class:`RuledModel`."""
    model = RuledModel(task, uncertain)
    settings = Settings(imagination=ImaginationSettings(temperature=0.0, threshold=0.3, weight_samples=T))
    size, n = model.latent_size, task.n_actions
    imagination = Imagination(size, n, settings, filtered=filtered, seeds=SeedTree(0), device=CPU)
    imagination.model = model  # type: ignore[assignment]
    return imagination
