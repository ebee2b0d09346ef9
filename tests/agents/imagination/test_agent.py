"""Algorithm 1 as a whole: its order, what act may change, exact resumption, learning above chance."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch
from agent_states import same
from fake_latents import ACTIONS, CODES, context, frame, live, make_dqn, transition
from imagine_bench.agents.dqn import DQN, Controller, epsilon
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination import model_only
from imagine_bench.agents.imagination.rollouts import Counts
from imagine_bench.agents.replay import RealMemory

from imagine_bench.errors import ArtefactError, DivergedError, InvalidValueError, SetupError, UnknownNameError
from imagine_bench.interfaces import AgentState, Observation
from imagine_bench.interfaces.capabilities import Imaginer, ValueReader
from imagine_bench.seeding import SeedTree

MAKERS: dict[str, Callable[..., DQN]] = {
    "dqn": make_dqn,
    "imagination": imagination_agents.make,
    "imagination_uncertainty": imagination_agents.make_uncertainty,
    "imagination_only": model_only.make,
    "imagination_only_uncertainty": model_only.make_uncertainty,
}
everyone = pytest.mark.parametrize("kind", MAKERS)
imaginers = pytest.mark.parametrize("kind", ["imagination", "imagination_uncertainty"])


@everyone
def test_acting_greedily_is_constant_and_changes_nothing(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = MAKERS[kind](context(monkeypatch))
    live(agent, range(3), np.random.default_rng(0))
    before = agent.state()
    chosen = [agent.act(Observation(frame=frame(state)), explore=False) for state in (0, 1, 2, 3) * 5]
    assert chosen[:4] * 5 == chosen
    assert same(before, agent.state())
    agent.act(Observation(frame=frame(0)), explore=True)
    assert not same(before, agent.state()), "exploring draws from the agent's generator"


@everyone
def test_a_resumed_agent_equals_an_uninterrupted_one_to_the_bit(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    agent, resumed = MAKERS[kind](context(monkeypatch)), MAKERS[kind](context(monkeypatch, seeds=SeedTree(99)))
    first, second = np.random.default_rng(0), np.random.default_rng(0)
    live(agent, range(6), first)
    second.bit_generator.state = first.bit_generator.state
    saved = agent.state()
    kept = copy.deepcopy(saved)
    onward = live(agent, range(6, 30), first)
    assert same(saved, kept), "a snapshot must not follow later learning"
    assert not same(saved, agent.state())
    resumed.restore(saved)
    assert live(resumed, range(6, 30), second) == onward
    assert same(agent.state(), resumed.state())


def weights(agent: DQN) -> np.ndarray:
    return agent.state().arrays["controller/network.0.weight/weight"]


def test_one_seed_acts_alike_until_imagination_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    agents = [make(context(monkeypatch, {"imagination.start_episode": 8})) for make in MAKERS.values()]
    histories = [live(agent, range(8), np.random.default_rng(0)) for agent in agents]
    assert all(history == histories[0] for history in histories)
    values = [weights(agent) for agent in agents[:3]]  # the other two train a second one
    assert np.array_equal(values[0], values[1]) and np.array_equal(values[0], values[2])
    for agent in agents:
        live(agent, range(8, 10), np.random.default_rng(1))
    assert not np.array_equal(*map(weights, agents[:2]))


def test_algorithm_1_in_its_order(monkeypatch: pytest.MonkeyPatch) -> None:
    overrides = {"model.updates_per_step": 3, "controller.updates_per_step": 2, "imagination.updates_per_step": 4}
    agent = imagination_agents.make(context(monkeypatch, overrides))
    calls: list[str] = []

    def note(owner: object, name: str, label: Callable[..., str]) -> None:
        original = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *args, **how: (calls.append(label(*args)), original(*args, **how))[1])

    note(agent.real, "add", lambda *_: "store")
    note(agent.imagination.model, "update", lambda *_: "model")
    note(agent.imagination, "rollouts", lambda *_: "imagine")
    note(agent.real, "sample", lambda count, _: f"real {count}")
    note(agent.imagination.memory, "sample", lambda count, _: f"imagined {count}")
    agent.observe(transition(0, 1, 0.0, 1), episode=1)
    waking = ["store", "real 8", "real 8", "real 24", "model", "model", "model"]
    assert calls == waking
    calls.clear()
    agent.observe(transition(0, 1, 0.0, 1), episode=2)
    assert calls == [*waking, "imagine", *["imagined 8"] * 4]


def test_rollouts_begin_and_explore_as_the_robot_acts(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = imagination_agents.make(context(monkeypatch))
    given: list[tuple[list[float], float]] = []
    rollouts = agent.imagination.rollouts

    def noted(controller: Controller, z: torch.Tensor, real: RealMemory, chance: float) -> Counts:
        given.append((z.tolist(), chance))
        return rollouts(controller, z, real, chance)

    monkeypatch.setattr(agent.imagination, "rollouts", noted)
    chances = []
    for state in (3, 0, 5):
        chances.append(epsilon(agent.steps, agent.settings.controller))
        agent.observe(transition(state, 1, 0.0, 1), episode=2)
    assert given == [(CODES[state].tolist(), chance) for state, chance in zip((3, 0, 5), chances, strict=True)]
    assert chances[0] > chances[-1] > 0.0


def test_only_the_model_s_batches_are_spread_and_balanced(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wanted = {"spread": 4.0, "balance": 0.5}
    agent = imagination_agents.make(context(monkeypatch, {f"model.{name}": value for name, value in wanted.items()}))
    sample, how = agent.real.sample, list[dict[str, float]]()
    monkeypatch.setattr(agent.real, "sample", lambda *args, **names: (how.append(names), sample(*args, **names))[1])
    agent.observe(transition(0, 1, 0.0, 1), episode=0)
    assert how == [*[{}] * agent.settings.controller.updates_per_step, wanted]


def test_after_imagination_updates_are_on_real_transitions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two agents are one until the last episode that imagines; then one's imagined memory stays as it is."""
    forever, ending = (
        imagination_agents.make_uncertainty(context(monkeypatch, {"imagination.end_episode": end})) for end in (None, 5)
    )
    histories = [live(agent, range(5), np.random.default_rng(0)) for agent in (forever, ending)]
    assert histories[0] == histories[1]
    imagined = ending.imagination.memory.added
    assert imagined == forever.imagination.memory.added > 0
    sampled: list[int] = []
    sample = ending.real.sample
    monkeypatch.setattr(
        ending.real, "sample", lambda count, *args, **how: (sampled.append(count), sample(count, *args, **how))[1]
    )
    ending.observe(transition(0, 1, 0.0, 1), episode=5)
    forever.observe(transition(0, 1, 0.0, 1), episode=5)
    rows, settings = ending.settings.controller.batch_size, ending.settings
    model = settings.model.batch_size * settings.model.updates_per_step
    real, instead = settings.controller.updates_per_step, settings.imagination.updates_per_step
    assert sampled == [*[rows] * real, model, *[rows] * instead]
    assert ending.imagination.memory.added == imagined < forever.imagination.memory.added


def test_real_and_imagined_transitions_never_mix(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = imagination_agents.make(context(monkeypatch))
    live(agent, range(20), np.random.default_rng(0))
    real, imagined = agent.real.arrays(), agent.imagination.memory.arrays()
    assert len(real["mu"]) == 40
    assert len(imagined["z"]) == 20, "the short memory must be full here"
    codes = {tuple(row) for row in CODES.tolist()}
    assert all(tuple(row) in codes for row in real["next_mu"].tolist())
    assert not any(tuple(row) in codes for row in imagined["next_z"].tolist())


def test_truncation_is_stored_as_alive_and_termination_as_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_dqn(context(monkeypatch))
    agent.observe(transition(0, 1, 0.0, 1, truncated=True), episode=0)
    agent.observe(transition(0, 1, 0.0, 1, terminated=True), episode=1)
    assert agent.real.arrays()["terminated"].tolist() == [0.0, 1.0]


@imaginers
def test_imagine_changes_nothing_and_follows_its_generator(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = MAKERS[kind](context(monkeypatch))
    live(agent, range(4), np.random.default_rng(0))
    assert isinstance(agent, Imaginer)
    assert isinstance(agent, ValueReader)
    before, actions = agent.state(), np.array([0, 2, 1, 1])
    first, again = (agent.imagine(frame(1), actions=actions, depth=4, rng=np.random.default_rng(3)) for _ in range(2))
    assert same(before, agent.state())
    assert np.array_equal(first.actions, actions)
    assert np.array_equal(first.epistemic, again.epistemic)
    other = agent.imagine(frame(1), actions=actions, depth=4, rng=np.random.default_rng(4))
    assert not np.array_equal(first.epistemic, other.epistemic)
    shapes = {name: getattr(first, name).shape for name in first.__dataclass_fields__}
    assert shapes == {
        **dict.fromkeys(("actions", "rewards", "p_terminated", "epistemic", "aleatoric", "modal", "accepted"), (4,)),
        "frames": (4, 64, 64),
        "start_frame": (64, 64),
        "q_values": (4, ACTIONS),
        "macrostates": (4, 1),
    }
    assert np.array_equal(first.q_values[0], agent.q_values(Observation(frame=frame(1))))
    greedy = agent.imagine(frame(1), actions=None, depth=5, rng=np.random.default_rng(3))
    assert np.array_equal(greedy.actions, greedy.q_values.argmax(axis=1))
    assert len(greedy.actions) <= 5
    assert (greedy.p_terminated[:-1] <= 0.5).all()


def test_shown_rollouts_stay_rejected_after_the_first_rejection(monkeypatch: pytest.MonkeyPatch) -> None:
    overrides = {"imagination.threshold": 0.0}
    actions, rng = np.array([0, 1, 2]), np.random.default_rng(0)
    strict = imagination_agents.make_uncertainty(context(monkeypatch, overrides))
    assert not strict.imagine(frame(0), actions=actions, depth=3, rng=rng).accepted.any()
    free = imagination_agents.make(context(monkeypatch, overrides))
    assert free.imagine(frame(0), actions=actions, depth=3, rng=rng).accepted.all()
    once = iter([True, False, True])
    monkeypatch.setattr(strict.imagination, "keeps", lambda step, gathered: torch.tensor([next(once)]))
    shown = strict.imagine(frame(0), actions=actions, depth=3, rng=rng)
    assert shown.accepted.tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("actions", "depth", "message"), [(None, 0, "give at least one"), ([3], 1, r"must lie in \[0, 3\)")]
)
def test_nothing_to_imagine_is_an_error(
    actions: list[int] | None, depth: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = imagination_agents.make(context(monkeypatch))
    given = None if actions is None else np.array(actions)
    with pytest.raises(InvalidValueError, match=message):
        agent.imagine(frame(0), actions=given, depth=depth, rng=np.random.default_rng(0))


def test_diagnostics_are_means_since_the_last_call(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = imagination_agents.make_uncertainty(context(monkeypatch, {"imagination.threshold": 1e6}))
    live(agent, range(4), np.random.default_rng(0))
    read = agent.diagnostics()
    names = {f"loss/{name}" for name in ("dynamics", "reward", "termination", "bellman")}
    names |= {f"time/{name}_s" for name in ("model", "controller", "imagination")}
    names |= {"imagination/acceptance_rate", "imagination/mean_depth", "epsilon"}
    assert set(read) == names | {"real_transitions", "gradient_updates", "imagined_transitions"}
    assert read["real_transitions"] == 8.0
    assert read["imagination/acceptance_rate"] == 1.0
    steps, rollouts, depth = 4, 3, 3
    every = agent.settings.controller.updates_per_step + agent.settings.model.updates_per_step
    assert read["gradient_updates"] == 8 * every + steps * agent.settings.imagination.updates_per_step
    assert rollouts <= read["imagined_transitions"] / steps <= rollouts * depth
    assert read["imagination/mean_depth"] == pytest.approx(read["imagined_transitions"] / (steps * rollouts))
    assert set(agent.diagnostics()) == {"epsilon", "real_transitions", "gradient_updates", "imagined_transitions"}


def test_a_dqn_beats_chance_on_a_small_contextual_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six contexts, three actions, one of them right: a random agent succeeds one time in three."""
    agent = make_dqn(context(monkeypatch, {"controller.hidden": (64, 64), "controller.batch_size": 32}))
    rng = np.random.default_rng(0)
    for episode in range(250):
        state = int(rng.integers(6))
        action = agent.act(Observation(frame=frame(state)), explore=True)
        reward = 1.0 if action == state % 3 else -1.0
        agent.observe(transition(state, action, reward, 10, terminated=True), episode=episode)
    right = [agent.act(Observation(frame=frame(state)), explore=False) == state % 3 for state in range(6)]
    assert np.mean(right) >= 5 / 6  # chance 1 / 3; all six by luck: 1 in 729


@everyone
def test_a_snapshot_that_does_not_fit_names_the_first_difference(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = MAKERS[kind](context(monkeypatch))
    live(agent, range(3), np.random.default_rng(0))
    own = agent.state()
    missing = AgentState(arrays={k: v for k, v in own.arrays.items() if k != "real/mu"}, values=own.values)
    wider = AgentState(arrays={**own.arrays, "real/mu": np.zeros((6, 9), np.float32)}, values=own.values)
    other = AgentState(arrays=own.arrays, values=MAKERS[kind](context(monkeypatch, {"memory.real": 9})).state().values)
    for wrong, message in (
        (missing, "The snapshot lacks 'real/mu'"),
        (wider, r"'real/mu' in the snapshot is float32 \(6, 9\), in this agent float32 \(6, 4\)"),
        (other, "'settings.memory.real' is 9 in the snapshot and 64 in this agent"),
    ):
        with pytest.raises(ArtefactError, match=message):
            agent.restore(wrong)
    assert same(own, agent.state()), "a refused snapshot changes nothing"


def test_snapshots_of_other_agents_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    states = {kind: make(context(monkeypatch)).state() for kind, make in MAKERS.items()}
    with pytest.raises(ArtefactError, match="has 'filtered'"):
        make_dqn(context(monkeypatch)).restore(states["imagination"])
    with pytest.raises(ArtefactError, match="'filtered' is True in the snapshot and False in this agent"):
        imagination_agents.make(context(monkeypatch)).restore(states["imagination_uncertainty"])


def test_a_context_that_cannot_work_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for changes, error, message in (
        ({"encoder": None}, InvalidValueError, "sees latents; give it the path of an encoder"),
        (
            {"preprocessing": "whole_rgb"},
            InvalidValueError,
            "reads frames as 'gray_strips', the task declares 'whole_rgb'",
        ),
        ({"device": "tpu"}, UnknownNameError, "No device 'tpu'.* Known: cpu, cuda"),
    ):
        with pytest.raises(error, match=message):
            make_dqn(context(monkeypatch, **changes))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SetupError, match="finds no NVIDIA GPU"):
        make_dqn(context(monkeypatch, device="cuda"))


def test_a_reward_that_is_no_number_stops_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = imagination_agents.make(context(monkeypatch))
    with pytest.raises(DivergedError, match="controller's loss is nan"):
        agent.observe(transition(0, 0, float("nan"), 1), episode=0)
