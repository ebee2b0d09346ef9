"""Algorithm 1 as a whole: its order, the changes by act, exact resumption, learning above chance."""

from __future__ import annotations

from collections.abc import Callable
from unittest import mock

import numpy as np
import pytest
import torch
from fake_latents import ACTIONS, CODES, built, frame, live, make_dqn, transition
from imagine_bench.agents.dqn import DQN, epsilon
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination import model_only

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import AgentState, Observation
from imagine_bench.testing.checks import same_state

MAKERS: tuple[Callable[..., DQN], ...] = (
    make_dqn,
    imagination_agents.make,
    imagination_agents.make_uncertainty,
    model_only.make,
    model_only.make_uncertainty,
)


def test_one_seed_acts_alike_until_imagination_begins() -> None:
    agents = [built(make, {"imagination.start_episode": 8}) for make in MAKERS]
    histories = [live(agent, range(8), np.random.default_rng(0)) for agent in agents]
    assert all(history == histories[0] for history in histories)
    for agent in agents:
        counts = {count for name, (_, count) in agent.meters.state().items() if name.startswith("time/")}
        assert counts == {len(histories[0])}, "CPU seconds are those of a real step"

    def weights() -> list[bytes]:  # the last two train a second controller
        return [agent.state().arrays["controller/network.0.weight/weight"].tobytes() for agent in agents[:3]]

    assert len(set(weights())) == 1
    for agent in agents[:2]:
        live(agent, range(8, 10), np.random.default_rng(1))
    assert len(set(weights())) == 3


def watched(**owners: tuple[object, list[str]]) -> mock.Mock:
    """The calls of methods, which still do the same."""
    calls = mock.Mock()
    for of, (owner, names) in owners.items():
        for name in names:
            method = mock.Mock(wraps=getattr(owner, name))
            setattr(owner, name, method)
            calls.attach_mock(method, f"{of}_{name}")
    return calls


def test_algorithm_1_in_its_order() -> None:
    """Only the model's batches are spread and balanced; rollouts begin and explore as the robot does.

    After the last episode that imagines, updates are on real transitions.
    """
    wider = {"spread": 4.0, "balance": 0.5}
    updates = {"model.updates_per_step": 3, "controller.updates_per_step": 2, "imagination.updates_per_step": 4}
    updates |= {f"model.{name}": value for name, value in wider.items()}
    agent = built(imagination_agents.make, {**updates, "imagination.end_episode": 3})
    own = agent.imagination
    calls = watched(
        real=(agent.real, ["add", "sample"]), model=(own.model, ["update"]), imagine=(own, ["rollouts"]),
        imagined=(own.memory, ["sample"]),
    )  # fmt: skip

    def called(state: int, episode: int) -> list[str]:
        calls.reset_mock()
        agent.observe(transition(state, 1, 0.0, 1), episode=episode)
        return [name for name, *_ in calls.mock_calls]

    waking = ["real_add", *["real_sample"] * 3, *["model_update"] * 3]
    assert called(0, episode=1) == waking
    sampled = [(rows, named) for (rows, _), named in calls.real_sample.call_args_list]
    assert sampled == [(8, {})] * 2 + [(24, wider)]
    chances = []
    for state in (3, 0, 5):
        chances.append(epsilon(agent.steps, agent.settings.controller))
        assert called(state, episode=2) == [*waking, "imagine_rollouts", *["imagined_sample"] * 4]
        _, z, _, chance = calls.imagine_rollouts.call_args.args
        assert torch.equal(z, CODES[state])
        assert chance == chances[-1]
    assert chances[0] > chances[-1] > 0.0
    assert called(0, episode=3) == [*waking, *["real_sample"] * 4]


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


def test_imagine_follows_its_actions_and_its_generator() -> None:
    trained = built(model_only.make_uncertainty)  # it is tested with another controller than it explores with
    live(trained, range(4), np.random.default_rng(0))
    actions = np.array([0, 2, 1, 1])
    first, other = (
        trained.imagine(frame(1), actions=actions, depth=4, rng=np.random.default_rng(seed)) for seed in (3, 4)
    )
    assert np.array_equal(first.actions, actions)
    assert first.epistemic.tolist() != other.epistemic.tolist()
    assert np.array_equal(first.q_values[0], trained.q_values(Observation(frame=frame(1))))
    for logit, lengths in ((-99.0, [5, 4]), (99.0, [1, 4])):
        with torch.no_grad():
            trained.imagination.model.head.networks[1].biases[-1].fill_(logit)
        greedy, given = (
            trained.imagine(frame(1), actions=these, depth=5, rng=np.random.default_rng(3)) for these in (None, actions)
        )
        assert [len(greedy.actions), len(given.actions)] == lengths, "its own plan ends with the episode"
        assert np.array_equal(greedy.actions, greedy.q_values.argmax(axis=1))


@pytest.mark.parametrize("make", [imagination_agents.make, model_only.make])
def test_the_mean_depth_is_that_of_one_rollout(make: Callable[..., DQN]) -> None:
    agent = built(make, {"imagination.start_episode": 0, "imagination.breadth": 5})
    for logit, depth in ((-99.0, 3.0), (99.0, 1.0)):
        with torch.no_grad():
            agent.imagination.model.head.networks[1].biases[-1].fill_(logit)
        agent.observe(transition(0, 1, 0.0, 1), episode=5)
        if isinstance(agent, model_only.ModelOnlyAgent):
            agent.train_in_model()
        found = agent.diagnostics()
        assert (found["imagination/mean_depth"], found["imagination/acceptance_rate"]) == (depth, 1.0)


def test_expected_outcomes_are_of_each_frame_and_macro_action() -> None:
    certain = {"imagination.temperature": 0.0, "imagination.predicts_with": "network", "model.components": 1}
    agent = built(imagination_agents.make, certain)
    live(agent, range(4), np.random.default_rng(0))
    frames = np.stack([frame(1), frame(4)])
    found = agent.predict_outcomes(frames, np.random.default_rng(0))
    for row, action in np.ndindex(2, ACTIONS):
        one = agent.imagine(frames[row], actions=np.array([action]), depth=1, rng=np.random.default_rng(1))
        assert found.reward[row, action] == pytest.approx(one.rewards[0])
        assert (found.macrostates[row, action] == one.macrostates).all()
        assert found.p_continues[row, action].sum() == (one.p_terminated[0] <= 0.5)


def test_a_snapshot_that_does_not_fit_names_the_first_difference() -> None:
    agent = built(model_only.make_uncertainty)
    live(agent, range(3), np.random.default_rng(0))
    own = agent.state()
    missing = {name: array for name, array in own.arrays.items() if name != "real/mu"}
    wider = {**own.arrays, "real/mu": np.zeros((6, 9), np.float32)}
    unfiltered = built(model_only.make).state()
    for arrays, values, message in (
        (missing, own.values, "The snapshot lacks 'real/mu'"),
        (wider, own.values, r"'real/mu' in the snapshot is float32 \(6, 9\), in this agent float32 \(6, 4\)"),
        (unfiltered.arrays, unfiltered.values, "'filtered' is False in the snapshot and True in this agent"),
    ):
        with pytest.raises(ArtefactError, match=message):
            agent.restore(AgentState(arrays=arrays, values=values))
    assert same_state(own, agent.state()), "a refused snapshot changes nothing"


def test_a_context_that_cannot_work_is_one_clear_error() -> None:
    with pytest.raises(InvalidValueError, match="sees latents; give it the path of an encoder"):
        built(make_dqn, encoder=None)
    with pytest.raises(InvalidValueError, match="reads frames as 'gray_strips', the task declares 'whole_rgb'"):
        built(make_dqn, preprocessing="whole_rgb")
