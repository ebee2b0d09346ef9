"""Algorithm 1 as a whole: its order, the changes by act, exact resumption, learning above chance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from agent_states import same
from fake_latents import CODES, built, frame, live, make_dqn, transition
from imagine_bench.agents.dqn import DQN, epsilon
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination import model_only
from imagine_bench.agents.imagination.agent import ImaginingAgent

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import AgentState, Observation

MAKERS: dict[str, Callable[..., DQN]] = {
    "dqn": make_dqn,
    "imagination": imagination_agents.make,
    "imagination_uncertainty": imagination_agents.make_uncertainty,
    "imagination_only": model_only.make,
    "imagination_only_uncertainty": model_only.make_uncertainty,
}


def weights(agent: DQN) -> np.ndarray:
    return agent.state().arrays["controller/network.0.weight/weight"]


def test_one_seed_acts_alike_until_imagination_begins() -> None:
    agents = [built(make, {"imagination.start_episode": 8}) for make in MAKERS.values()]
    histories = [live(agent, range(8), np.random.default_rng(0)) for agent in agents]
    assert all(history == histories[0] for history in histories)
    dqn, imagining, filtered = agents[:3]  # the other two train a second controller
    assert np.array_equal(weights(dqn), weights(imagining))
    assert np.array_equal(weights(dqn), weights(filtered))
    live(dqn, range(8, 10), np.random.default_rng(1))
    live(imagining, range(8, 10), np.random.default_rng(1))
    assert not np.array_equal(weights(dqn), weights(imagining))


class Calls(list[tuple[str, tuple[Any, ...], dict[str, Any]]]):
    """The calls of methods that are watched, with their arguments; they still do the same."""

    def watch(self, owner: object, of: str, *names: str) -> None:
        for name in names:
            setattr(owner, name, self._noted(f"{of}.{name}", getattr(owner, name)))

    def _noted(self, name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def noted(*given: Any, **named: Any) -> Any:
            self.append((name, given, named))
            return method(*given, **named)

        return noted


def test_algorithm_1_in_its_order() -> None:
    """Only the model's batches are spread and balanced; rollouts begin and explore as the robot does.

    After the last episode that imagines, updates are on real transitions.
    """
    wider = {"spread": 4.0, "balance": 0.5}
    updates = {"model.updates_per_step": 3, "controller.updates_per_step": 2, "imagination.updates_per_step": 4}
    updates |= {f"model.{name}": value for name, value in wider.items()}
    agent = built(imagination_agents.make, {**updates, "imagination.end_episode": 3})
    calls = Calls()
    calls.watch(agent.real, "real", "add", "sample")
    calls.watch(agent.imagination.model, "model", "update")
    calls.watch(agent.imagination, "imagined", "rollouts")
    calls.watch(agent.imagination.memory, "imagined", "sample")
    agent.observe(transition(0, 1, 0.0, 1), episode=1)
    waking = ["real.add", *["real.sample"] * 3, *["model.update"] * 3]
    assert [name for name, *_ in calls] == waking
    assert [(given[0], named) for name, given, named in calls if name == "real.sample"] == [(8, {})] * 2 + [(24, wider)]
    chances = []
    for state in (3, 0, 5):
        calls.clear()
        chances.append(epsilon(agent.steps, agent.settings.controller))
        agent.observe(transition(state, 1, 0.0, 1), episode=2)
        assert [name for name, *_ in calls] == [*waking, "imagined.rollouts", *["imagined.sample"] * 4]
        _, z, _, chance = calls[7][1]
        assert torch.equal(z, CODES[state])
        assert chance == chances[-1]
    assert chances[0] > chances[-1] > 0.0
    calls.clear()
    agent.observe(transition(0, 1, 0.0, 1), episode=3)
    assert [name for name, *_ in calls] == [*waking, *["real.sample"] * 4]


def test_real_and_imagined_transitions_never_mix() -> None:
    agent = built(imagination_agents.make)
    live(agent, range(20), np.random.default_rng(0))
    real = agent.real.arrays()
    imagined = agent.imagination.memory.arrays()
    assert len(real["mu"]) == 40
    assert len(imagined["z"]) == 20, "the short memory must be full here"
    codes = {tuple(row) for row in CODES.tolist()}
    assert {tuple(row) for row in real["next_mu"].tolist()} <= codes
    assert codes.isdisjoint(tuple(row) for row in imagined["next_z"].tolist())


def test_truncation_is_stored_as_alive_and_termination_as_ended() -> None:
    agent = built(make_dqn)
    agent.observe(transition(0, 1, 0.0, 1, truncated=True), episode=0)
    agent.observe(transition(0, 1, 0.0, 1, terminated=True), episode=1)
    assert agent.real.arrays()["terminated"].tolist() == [0.0, 1.0]


@pytest.fixture(scope="module")
def trained() -> ImaginingAgent:
    agent = built(imagination_agents.make_uncertainty)
    live(agent, range(4), np.random.default_rng(0))
    return agent


def test_imagine_changes_nothing_and_follows_its_generator(trained: ImaginingAgent) -> None:
    before = trained.state()
    actions = np.array([0, 2, 1, 1])
    first, again, other = (
        trained.imagine(frame(1), actions=actions, depth=4, rng=np.random.default_rng(seed)) for seed in (3, 3, 4)
    )
    assert same(before, trained.state())
    assert np.array_equal(first.actions, actions)
    assert np.array_equal(first.epistemic, again.epistemic)
    assert not np.array_equal(first.epistemic, other.epistemic)
    assert np.array_equal(first.q_values[0], trained.q_values(Observation(frame=frame(1))))
    greedy = trained.imagine(frame(1), actions=None, depth=5, rng=np.random.default_rng(3))
    assert np.array_equal(greedy.actions, greedy.q_values.argmax(axis=1))
    assert (greedy.p_terminated[:-1] <= 0.5).all()


def test_diagnostics_are_means_since_the_last_call() -> None:
    agent = built(imagination_agents.make_uncertainty, {"imagination.threshold": 1e6})
    live(agent, range(4), np.random.default_rng(0))
    read = agent.diagnostics()
    assert (read["real_transitions"], read["imagination/acceptance_rate"]) == (8.0, 1.0)
    settings = agent.settings
    waking = settings.controller.updates_per_step + settings.model.updates_per_step
    assert read["gradient_updates"] == 8 * waking + 4 * settings.imagination.updates_per_step
    assert read["imagination/mean_depth"] == pytest.approx(read["imagined_transitions"] / (4 * 3))
    counters = {"epsilon", "real_transitions", "gradient_updates", "imagined_transitions"}
    assert set(agent.diagnostics()) == counters < set(read)


def test_a_dqn_beats_chance_on_a_small_contextual_task() -> None:
    """Six contexts, three actions, one of them right: a random agent succeeds one time in three."""
    agent = built(make_dqn, {"controller.hidden": (64, 64), "controller.batch_size": 32})
    rng = np.random.default_rng(0)
    for episode in range(250):
        state = int(rng.integers(6))
        action = agent.act(Observation(frame=frame(state)), explore=True)
        reward = 1.0 if action == state % 3 else -1.0
        agent.observe(transition(state, action, reward, 10, terminated=True), episode=episode)
    right = [agent.act(Observation(frame=frame(state)), explore=False) == state % 3 for state in range(6)]
    assert np.mean(right) >= 5 / 6  # chance 1 / 3; all six by luck: 1 in 729


def test_a_snapshot_that_does_not_fit_names_the_first_difference() -> None:
    agent = built(model_only.make_uncertainty)
    live(agent, range(3), np.random.default_rng(0))
    own = agent.state()
    missing = {name: array for name, array in own.arrays.items() if name != "real/mu"}
    wider = {**own.arrays, "real/mu": np.zeros((6, 9), np.float32)}
    for arrays, values, message in (
        (missing, own.values, "The snapshot lacks 'real/mu'"),
        (wider, own.values, r"'real/mu' in the snapshot is float32 \(6, 9\), in this agent float32 \(6, 4\)"),
    ):
        with pytest.raises(ArtefactError, match=message):
            agent.restore(AgentState(arrays=arrays, values=values))
    assert same(own, agent.state()), "a refused snapshot changes nothing"
    with pytest.raises(ArtefactError, match="'filtered' is False in the snapshot and True in this agent"):
        built(imagination_agents.make_uncertainty).restore(built(imagination_agents.make).state())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"encoder": None}, "sees latents; give it the path of an encoder"),
        ({"preprocessing": "whole_rgb"}, "reads frames as 'gray_strips', the task declares 'whole_rgb'"),
    ],
)
def test_a_context_that_cannot_work_is_one_clear_error(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        built(make_dqn, **change)
