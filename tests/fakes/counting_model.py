"""A world model that counts, so that every imagined transition is known."""

from __future__ import annotations

import torch
from imagine_bench.agents.dqn import Controller
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import ImaginationSettings, Settings
from imagine_bench.agents.replay import RealMemory

from imagine_bench.seeding import SeedTree

CPU = torch.device("cpu")
T = 4


class CountingModel:
    """An identifiable world model: latent (i, c) goes to (i, c + 1), and uncertainty and end come at chosen counts.

    The first latent dimension tells the rollouts apart by the action taken first.
    """

    members, latent_size = 1, 2

    def __init__(
        self, *, uncertain_at: int = -1, end_at: int = -1, reward_uncertain_at: int = -1, torn_at: int = -1
    ) -> None:
        self.uncertain_at, self.end_at = uncertain_at, end_at
        self.reward_uncertain_at, self.torn_at = reward_uncertain_at, torn_at

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
        return Mixture(torch.zeros(T, len(z), 1), means.unsqueeze(2), torch.full((T, len(z), 1, 2), -9.0))

    def predict_outcome(
        self, z: torch.Tensor, action: torch.Tensor, next_z: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ends = (next_z[:, 1] == self.end_at).float() + 0.3 * (next_z[:, 1] == self.torn_at)
        return 10.0 * next_z[:, 1], ends


def make(*, filtered: bool, model: CountingModel, **changes: object) -> tuple[Imagination, Controller]:
    values = {"breadth": 3, "depth": 10, "temperature": 0.0, "threshold": 0.3, "weight_samples": T}
    settings = Settings(imagination=ImaginationSettings(**(values | changes)))
    imagination = Imagination(2, 2, settings, filtered=filtered, seeds=SeedTree(0), device=CPU)
    imagination.model = model  # type: ignore[assignment]
    return imagination, Controller(2, 2, settings.controller, torch.Generator().manual_seed(0))


def remembering(count: int) -> RealMemory:
    """Real states (i, 5) for i below ``count``, known exactly."""
    real = RealMemory(count, 2, CPU)
    for index in range(count):
        z, sigma = torch.tensor([float(index), 5.0]), torch.zeros(2)
        real.add((z, sigma), 0, 0.0, (z, sigma), False)
    return real
