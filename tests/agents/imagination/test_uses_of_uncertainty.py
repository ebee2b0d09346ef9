"""Uses of uncertainty beside the thesis' filter: weights by confidence, and what a rollout has gathered so far."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from counting_model import CPU, CountingModel, T, make
from fake_latents import context, frame, live
from imagine_bench.agents.dqn import Controller
from imagine_bench.agents.dqn_settings import ControllerSettings
from imagine_bench.agents.imagination.agent import make as make_agent
from imagine_bench.agents.imagination.agent import make_uncertainty
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.model_only import ModelOnlyTraining
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import ImaginationSettings, Settings, WorldModelSettings
from imagine_bench.agents.imagination.vector_env import ImaginedVectorEnv
from imagine_bench.agents.meters import Meters
from imagine_bench.agents.replay import Batch, RealMemory, StartMemory

from imagine_bench.errors import InvalidValueError
from imagine_bench.seeding import SeedTree

NOTHING_REAL = RealMemory(1, 2, CPU)
UNCERTAINTY = 0.1


class Unsure(CountingModel):
    """As uncertain of every step as of any other."""

    n_actions = 2

    def predict(self, z: torch.Tensor, action: torch.Tensor, weights: None) -> Mixture:
        sound = super().predict(z, action, weights)
        spread = torch.linspace(-1.0, 1.0, T)
        spread *= (UNCERTAINTY / spread.var(correction=0)).sqrt()
        means = sound.means.clone()
        means[..., 1] += spread[:, None, None]
        return dataclasses.replace(sound, means=means)


def depths(imagination: Imagination, controller: Controller) -> np.ndarray:
    """How deep each stored transition lies."""
    imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5)
    return imagination.memory.arrays()["next_z"][:, 1].round()


@pytest.mark.parametrize(("accumulates", "deepest"), [(False, 10), (True, 3)])
def test_gathered_uncertainty_ends_a_rollout_that_no_step_would(accumulates: bool, deepest: int) -> None:
    imagination, controller = make(filtered=True, model=Unsure(), threshold=0.35, accumulates=accumulates)
    assert depths(imagination, controller).max() == deepest


@pytest.mark.parametrize("accumulates", [False, True])
def test_weights_are_the_confidence_by_hand(accumulates: bool) -> None:
    imagination, controller = make(filtered=False, model=Unsure(), confidence_scale=0.2, accumulates=accumulates)
    depth = depths(imagination, controller)
    uncertainty = UNCERTAINTY * (depth if accumulates else 1.0)
    assert depth.max() == 10, "nothing is discarded"
    np.testing.assert_allclose(imagination.memory.arrays()["weight"], 1.0 / (1.0 + uncertainty / 0.2), rtol=1e-4)


def test_filter_and_weights_go_together() -> None:
    imagination, controller = make(filtered=True, model=Unsure(), threshold=0.35, accumulates=True, confidence_scale=1)
    assert sorted(set(depths(imagination, controller))) == [1.0, 2.0, 3.0]
    assert len(imagination.memory.arrays()["weight"]) == 9


def practised(**changes: object) -> ModelOnlyTraining:
    """One imagined episode of a controller that is trained in the model alone."""
    imagination, _ = make(filtered=True, model=Unsure(), threshold=0.35, **changes)
    settings = Settings(imagination=imagination.settings, controller=ControllerSettings(hidden=(8,), batch_size=4))
    training = ModelOnlyTraining(imagination, 2, settings, SeedTree(0), CPU)
    starts = StartMemory(1, 2, CPU)
    starts.add((torch.zeros(2), torch.zeros(2)))
    training.episode(starts, NOTHING_REAL, Meters())
    return training


@pytest.mark.parametrize(("accumulates", "depth"), [(False, 10), (True, 3)])
def test_model_only_training_gathers_and_weighs_uncertainty(accumulates: bool, depth: int) -> None:
    training = practised(accumulates=accumulates, confidence_scale=0.2)
    assert training.steps == depth
    gathered = UNCERTAINTY * (np.arange(1, depth + 1) if accumulates else np.ones(depth))
    np.testing.assert_allclose(training.arrays()["memory/weight"], 1.0 / (1.0 + gathered / 0.2), rtol=1e-4)


@pytest.mark.parametrize(("accumulates", "depth"), [(False, 10), (True, 3)])
def test_an_imagined_environment_gathers_uncertainty(accumulates: bool, depth: int) -> None:
    imagination, _ = make(filtered=True, model=Unsure(), threshold=0.35, accumulates=accumulates)
    env = ImaginedVectorEnv(imagination, np.zeros((1, 2), np.float32), num_envs=2, horizon=10)
    for seed in range(2):  # a new episode has gathered nothing
        env.reset(seed=seed)
        accepted = [env.step(np.zeros(2, np.int64))[4]["accepted"].tolist() for _ in range(10)]
        assert [all(each) for each in accepted[:depth]] == [True] * depth
        assert depth == 10 or accepted[depth] == [False, False]


def test_who_cannot_weigh_by_confidence_refuses_it() -> None:
    imagination, _ = make(filtered=True, model=Unsure(), threshold=0.35, confidence_scale=0.2)
    with pytest.raises(InvalidValueError, match=r"cannot weigh .* leave imagination\.confidence_scale out"):
        ImaginedVectorEnv(imagination, np.zeros((1, 2), np.float32))


def test_the_controller_learns_by_weight() -> None:
    """Twice the weight is twice the gradient, and without weight there is none."""
    generator = torch.Generator().manual_seed(0)
    controller = Controller(2, 2, ControllerSettings(hidden=(8,)), generator)
    z, next_z = torch.randn(2, 6, 2, generator=generator)
    batch = Batch(z, torch.zeros(6, dtype=torch.int64), torch.ones(6), next_z, torch.ones(6))

    def gradient(weight: float) -> torch.Tensor:
        controller.optimiser.zero_grad()
        controller.loss(dataclasses.replace(batch, weight=torch.full((6,), weight))).backward()
        return torch.cat([part.grad.ravel() for part in controller.network.parameters() if part.grad is not None])

    assert gradient(1.0).abs().max() > 0 and torch.equal(gradient(0.0), torch.zeros_like(gradient(0.0)))
    torch.testing.assert_close(gradient(1.0), 2.0 * gradient(0.5))


def test_one_network_knows_no_confidence() -> None:
    settings = Settings(model=WorldModelSettings(dropout=0.0), imagination=ImaginationSettings(confidence_scale=0.3))
    with pytest.raises(InvalidValueError, match=r"imagination\.confidence_scale compares .* or set it to null"):
        Imagination(2, 2, settings, filtered=False, seeds=SeedTree(0), device=CPU)


def test_a_shown_rollout_is_accepted_as_far_as_it_has_gathered_little(monkeypatch: pytest.MonkeyPatch) -> None:
    def imagined(**overrides: object) -> tuple[np.ndarray, np.ndarray]:
        settings = {f"imagination.{name}": value for name, value in overrides.items()}
        agent = make_uncertainty(context(monkeypatch, {"imagination.depth": 8, **settings}))
        rollout = agent.imagine(frame(0), actions=np.zeros(8, dtype=np.int64), depth=8, rng=np.random.default_rng(0))
        return rollout.epistemic, rollout.accepted

    epistemic, _ = imagined(threshold=0.0)
    limit = float(np.cumsum(epistemic)[3]) * 1.001
    _, accepted = imagined(threshold=limit, accumulates=True)
    assert accepted.tolist() == [True] * 4 + [False] * 4
    assert imagined(threshold=max(limit, float(epistemic.max())))[1].all(), "no step alone is too uncertain"


def test_a_weighted_memory_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"imagination.confidence_scale": 0.3}
    agent, other = (make_agent(context(monkeypatch, settings)) for _ in range(2))
    live(agent, range(6), np.random.default_rng(0))
    other.restore(agent.state())
    held, again = (each.imagination.memory.arrays()["weight"] for each in (agent, other))
    assert len(held) > 0 and (held > 0).all() and (held < 1).all() and np.array_equal(held, again)
