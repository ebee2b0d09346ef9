"""LeWM of torch-world: where it plans to, its memory, its random numbers, its learning."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_runs import context

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Observation, Transition

pytest.importorskip("torch_world")
import torch
from imagine_bench_peers import lewm
from imagine_bench_peers.lewm import LeWMPlanner, make

PLACES = 4  # a white quarter of the frame, at one of four places on a ring
GOAL = 2


def learner(seed: int = 0, **overrides: Any) -> LeWMPlanner:
    return make(replace(context(seed), n_actions=3, hyperparameters="minimal", overrides=overrides))


def seen(place: int) -> Observation:
    frame = np.zeros((64, 64, 3), dtype=np.uint8)
    y, x = ((0, 0), (0, 32), (32, 32), (32, 0))[place]
    frame[y : y + 32, x : x + 32] = 255
    return Observation(frame=frame)


def moved(place: int, action: int) -> int:
    """One back, stay, one on."""
    return (place + action - 1) % PLACES


def ended(place: int, action: int, reward: float, then: int) -> Transition:
    """An episode of one transition."""
    return Transition(
        observation=seen(place), action=action, reward=reward, next_observation=seen(then), terminated=True,
        truncated=False,
    )  # fmt: skip


def trained(agent: LeWMPlanner, steps: int) -> list[int]:
    """Episodes from each place in turn, paid where they end at the goal."""
    actions = []
    for step in range(steps):
        place = step % PLACES
        actions.append(agent.act(seen(place), explore=True))
        then = moved(place, actions[-1])
        agent.observe(ended(place, actions[-1], float(then == GOAL), then), episode=step)
    return actions


class Exact(torch.nn.Module):
    """The ring as it is: places are angles."""

    def encode(self, pixels: torch.Tensor) -> torch.Tensor:
        quarters = pixels[:, 0, 0, ::32, ::32].flatten(1)[:, [0, 1, 3, 2]]
        return self._points(quarters.argmax(dim=1, keepdim=True) * torch.pi / 2)

    def rollout(self, z: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        start = torch.atan2(z[:, :1, 1], z[:, :1, 0])
        turned = (actions.argmax(dim=2) - 1).cumsum(dim=1) * torch.pi / 2
        return self._points(torch.cat([start, start + turned], dim=1))

    def _points(self, angles: torch.Tensor) -> torch.Tensor:
        return torch.stack([angles.cos(), angles.sin()], dim=-1)


def test_a_full_memory_forgets_the_oldest() -> None:
    agent = learner(buffer_size=3, learning_starts=1000)
    actions = trained(agent, 5)
    assert agent.rows["action"] == actions[-3:] and {len(kept) for kept in agent.rows.values()} == {3}


def test_goals_are_the_frames_that_earned_most() -> None:
    agent = learner(goals=2)
    for reward, place in ((-1.0, 0), (3.0, 1), (2.0, 0), (3.0, 2), (3.0, 3)):
        agent.observe(ended(0, 0, reward, place), episode=0)
    goals = agent.state().arrays["replay/goals"]
    assert np.array_equal(goals, [seen(2).frame, seen(3).frame]), "the latest two of those that earned 3"


def test_goals_are_read_again_after_an_update(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = learner(learning_starts=2)
    trained(agent, 12)
    read: list[int] = []
    encode = agent.network.encode
    monkeypatch.setattr(agent.network, "encode", lambda pixels: read.append(len(pixels)) or encode(pixels))
    agent.act(seen(0), explore=False)
    before = agent.updates
    agent.observe(ended(0, 1, -1.0, 0), episode=12)
    assert agent.updates > before
    read.clear()
    agent.act(seen(0), explore=False)
    goals = len(agent.state().arrays["replay/goals"])
    assert read == [goals, 1], "the goals, then the frame"
    agent.act(seen(1), explore=False)
    assert read == [goals, 1, 1], "the network is the same"


def planner(model: torch.nn.Module, horizon: int, **overrides: Any) -> LeWMPlanner:
    agent = learner(horizon=horizon, learning_starts=100, **overrides)
    agent.network = model
    agent.goals = [seen(GOAL).frame]
    return agent


def test_plans_lead_to_the_nearest_goal_at_whichever_step() -> None:
    agent = planner(Exact(), 3)
    assert agent.act(seen(GOAL - 1), explore=False) == 2
    assert agent.act(seen(GOAL + 1), explore=False) == 0
    two_away = agent.act(seen(0), explore=False)
    assert two_away in {0, 2} and agent.act(seen(moved(0, two_away)), explore=False) == two_away
    agent.goals = [seen(0).frame, seen(3).frame]
    agent.goal_latents = None
    assert moved(2, agent.act(seen(2), explore=False)) in {1, 3}, "the one that is one away, or on the way to the other"


def test_exploration_falls_in_a_line_to_its_final_share() -> None:
    agent = planner(Exact(), 1, exploration_steps=10, exploration_final_eps=0.5)
    agent.updates = 1
    for agent.steps, epsilon in ((0, 1.0), (5, 0.75), (10, 0.5)):
        best = [agent.act(seen(GOAL - 1), explore=True) == 2 for _ in range(300)]
        assert np.mean(best) == pytest.approx(1.0 - epsilon * 2 / 3, abs=0.09)


class Detour(torch.nn.Module):
    """From 3 the first macro-action leads to 1; the last one leads to 1.5, and taken twice to the goal, at 0."""

    def encode(self, pixels: torch.Tensor) -> torch.Tensor:
        return 3.0 * pixels[:, :, 0, 0, :1]

    def rollout(self, z: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        first, second = actions.argmax(dim=2).unbind(1)
        one = torch.tensor([1.0, 3.0, 1.5])[first]
        two = torch.where((first == 2) & (second == 2), 0.0, one)
        return torch.stack([z[:, 0, 0], one, two], dim=1).unsqueeze(2)


def test_a_plan_costs_the_squared_distances_of_all_its_steps() -> None:
    """To stay at 1 costs 1 + 1, the way over 1.5 costs 2.25."""
    assert planner(Detour(), 2).act(seen(0), explore=False) == 0


def test_updates_follow_the_ratio_without_the_global_generator() -> None:
    before = torch.get_rng_state()
    agent = learner(replay_ratio=0.7)
    assert [agent.act(seen(place), explore=False) for place in range(PLACES)] == [0] * PLACES, "without a goal, 0"
    trained(agent, 8)
    assert torch.equal(before, torch.get_rng_state()) and agent.updates == 3, "0.7 a step, from the fourth of eight"


def test_freed_memory_goes_back_every_fifty_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    released = []
    monkeypatch.setattr(lewm, "release_freed_memory", lambda: released.append(agent.updates))
    agent = learner(replay_ratio=20.0)
    trained(agent, 9)
    assert agent.updates == 120 and released == [50, 100]


@pytest.mark.parametrize("wrong", [{"model.patch": 7}, {"model.embedding": 22}])
def test_sizes_that_do_not_fit_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidValueError, match=r"patch is .* must divide 64.* multiple of 4 times .*, 12"):
        learner(**wrong)
