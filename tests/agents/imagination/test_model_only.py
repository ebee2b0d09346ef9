"""Model-only training: the tested controller was trained in the model alone, and training resumes to the bit."""

from __future__ import annotations

import copy
from typing import Any
from unittest import mock

import numpy as np
import pytest
from counting_model import CountingModel, practising
from fake_latents import CODES, built, frame, live, make_dqn, transition
from imagine_bench.agents.dqn import epsilon
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination import model_only
from imagine_bench.agents.imagination.model_only import ModelOnlyAgent

from imagine_bench.interfaces import Observation
from imagine_bench.testing.checks import same_state


def made(**changes: Any) -> ModelOnlyAgent:
    return built(model_only.make, {"imagination.model_only_episodes": 8, **changes})


def train_in_model(agent: ModelOnlyAgent) -> int:
    """Train until nothing is left; returns the number of episodes."""
    return sum(1 for _ in iter(agent.train_in_model, False))


def solved(agent: ModelOnlyAgent) -> float:
    right = [agent.act(Observation(frame=frame(state)), explore=False) == state % 3 for state in range(6)]
    return float(np.mean(right))


def test_a_controller_trained_in_the_model_alone_beats_chance() -> None:
    """One action in three is right; it earns 1, the others cost 1, and all of them end the episode."""
    controller = {"controller.hidden": (64, 64), "controller.batch_size": 32, "controller.epsilon_decay": 0.003}
    model = {"model.dynamics_hidden": (32,), "model.dropout": 0.0, "model.batch_size": 32, "model.learning_rate": 5e-3}
    agent = made(**controller, **model, **{"imagination.model_only_episodes": 300, "memory.imagined": 400})
    rng = np.random.default_rng(0)
    for episode in range(200):
        state = int(rng.integers(6))
        action = agent.act(Observation(frame=frame(state)), explore=True)
        right = action == state % 3
        reward = 1.0 if right else -1.0
        agent.observe(transition(state, action, reward, 10 if right else 11, terminated=True), episode=episode)
    untrained = solved(agent)
    assert train_in_model(agent) == 300
    assert solved(agent) >= 5 / 6 > untrained  # chance 1 / 3; five of six by luck: 1 in 56


def training(agent: ModelOnlyAgent, part: str = "") -> dict[str, bytes]:
    arrays = agent.state().arrays
    return {name: array.tobytes() for name, array in arrays.items() if name.startswith(f"model_only/{part}")}


def test_the_tested_controller_sees_no_real_transition() -> None:
    """Only new experience asks for new training."""
    plain, agent = built(make_dqn), made()
    assert not agent.train_in_model(), "nothing was learned yet"
    for start in (0, 3):
        before = training(agent, "controller")
        first, second = (live(each, range(start, start + 3), np.random.default_rng(start)) for each in (plain, agent))
        assert first == second
        assert training(agent, "controller") == before
        assert train_in_model(agent) == 8
        after = training(agent)
        assert training(agent, "controller") != before and not agent.train_in_model()
        assert training(agent) == after
    weights = (each.state().arrays["controller/network.0.weight/weight"] for each in (plain, agent))
    assert np.array_equal(*weights)


def test_training_twice_from_equal_experience_gives_equal_bits() -> None:
    """Earlier training, at another budget, leaves no trace in later training; interrupted training goes on."""

    def trained(often: bool) -> ModelOnlyAgent:
        agent = made(**{"controller.target_rate": 0.1})
        rng = np.random.default_rng(0)
        live(agent, range(3), rng)
        if often:
            train_in_model(agent)
        live(agent, range(3, 5), rng)
        return agent

    once, twice = trained(often=False), trained(often=True)
    assert all(once.train_in_model() for _ in range(3))
    resumed = made(**{"controller.target_rate": 0.1})
    resumed.restore(copy.deepcopy(once.state()))
    assert [train_in_model(each) for each in (once, resumed, twice)] == [5, 5, 8]
    assert same_state(once.state(), resumed.state())
    assert training(once) == training(twice)


def test_imagined_episodes_begin_where_real_ones_did() -> None:
    agent = made(**{"imagination.depth": 1, "controller.updates_per_step": 3})
    for episode in range(3):
        agent.observe(transition(episode, 0, 0.0, 4), episode=episode)
        agent.observe(transition(4, 0, 0.0, 5), episode=episode)
    train_in_model(agent)
    assert agent.updates == 6 * (3 + 2) + 8 * 3, "as many a step of an imagined episode as of a real one"
    begun = agent.state().arrays["model_only/memory/z"]
    distance = np.linalg.norm(begun[:, None] - CODES[:3].numpy()[None], axis=-1).min(axis=1)
    assert distance.shape == (8,) and distance.max() < 0.5, "drawn from the posteriors of starts, whose sigma is 0.05"


@pytest.mark.parametrize(("quantile", "least", "most"), [(None, 1.0, 1.0), (0.0, 0.0, 0.3)])
def test_its_filter_follows_a_quantile_of_real_transitions(quantile: float | None, least: float, most: float) -> None:
    moving = {"imagination.threshold": 99.0, "imagination.threshold_quantile": quantile}
    agent = built(model_only.make_uncertainty, {"imagination.model_only_episodes": 60, **moving})
    live(agent, range(8), np.random.default_rng(0))
    train_in_model(agent)
    assert least <= agent.diagnostics()["imagination/acceptance_rate"] <= most


def test_exploration_falls_to_that_of_the_settings() -> None:
    agent = practising(CountingModel(), depth=30, exploration=0.2)
    with mock.patch.object(agent.imagination, "act", wraps=agent.imagination.act) as act:
        agent.train_in_model()
    chances = [call.args[2] for call in act.call_args_list]
    assert chances == [max(epsilon(step, agent.settings.controller), 0.2) for step in range(30)]


@pytest.mark.parametrize("make", [imagination_agents.make_uncertainty, model_only.make_uncertainty])
def test_a_learner_keeps_its_dynamics_network_and_nothing_else(make) -> None:  # type: ignore[no-untyped-def]
    moving = {"imagination.threshold": 99.0, "imagination.threshold_quantile": 0.5}
    learner, resumed = (built(make, moving) for _ in range(2))
    live(learner, range(8), np.random.default_rng(0))
    before = learner.state().arrays
    resumed.restore(learner.state())
    moved = learner.imagination.filter.threshold
    assert resumed.imagination.filter.threshold == moved
    assert (moved == 99.0) == (make is model_only.make_uncertainty), "only imagination at real steps moves it here"
    for each in (learner, resumed):
        each.reset_for_new_task()
    after = learner.state().arrays
    parts = ("imagination/model", "controller")
    weights = {name for name in before if name.startswith(parts) and ".weight" in name and name.endswith("/weight")}
    kept = {name for name in weights if np.array_equal(before[name], after[name])}
    assert kept == {name for name in weights if name.startswith("imagination/model/dynamics.")} < weights
    assert len(learner.real) == len(learner.imagination.memory) == learner.steps == learner.updates == 0
    assert not any(name.startswith("loss/") for name in learner.diagnostics()), "of a task that is over"
    assert learner.imagination.filter.threshold == 99.0
    first, second = (live(each, range(5), np.random.default_rng(1)) for each in (learner, resumed))
    assert first == second and same_state(learner.state(), resumed.state())
    assert not any(np.array_equal(before[name], learner.state().arrays[name]) for name in kept), "it goes on learning"
