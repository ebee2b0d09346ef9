"""Imagination that knows: rollouts of the rules alone, a filter that keeps right transitions, snapshots, privileges."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from fake_latents import ACTIONS, CODES, FakeEncoder, built, frame, transition
from imagine_bench.agents.imagination.rollouts import ImaginedStep
from imagine_bench_controls import exact
from imagine_bench_controls.exact import ExactFilterAgent, ExactImaginationAgent

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, UnableError
from imagine_bench.interfaces import ExactWorld, Outcome, Transition
from imagine_bench.protocols.control import context_of, protocol
from imagine_bench.protocols.data import RunSpec
from imagine_bench.running.bench import plan

STATES = 6
GOAL = 5
HALF = 2
"""Action 2 moves by two with probability 1/2, else by three or not at all; others move by their number."""


def outcomes(state: tuple[int, ...], action: int) -> tuple[Outcome, ...]:
    moves = [(0.5, 2), (0.25, 3), (0.25, 0)] if action == HALF else [(1.0, action)]
    return tuple(
        Outcome(p, ((state[0] + by) % STATES,), 70.0 if (state[0] + by) % STATES == GOAL else -1.0,
                (state[0] + by) % STATES == GOAL, (state[0] + by) % STATES == GOAL)
        for p, by in moves
    )  # fmt: skip


WORLD = ExactWorld(
    rules=SimpleNamespace(outcomes=outcomes),  # type: ignore[arg-type]
    render=lambda states, rng: np.stack([frame(int(state)) for (state,) in states]),
)


def told(moved: Transition) -> Transition:
    """The same, shown to a privileged agent."""
    seen = [replace(o, macrostate=o.frame[0, 0, :1].astype(np.int64))
            for o in (moved.observation, moved.next_observation)]  # fmt: skip
    return replace(moved, observation=seen[0], next_observation=seen[1])


def knowing(**settings: Any) -> ExactImaginationAgent:
    own = {f"imagination.{name}": value for name, value in settings.items()}
    agent = built(exact.make, {"memory.imagined": 2_000, **own}, exact_world=WORLD)
    assert isinstance(agent, ExactImaginationAgent)
    return agent


def live(agent: Any, steps: int, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    state = 0
    for step in range(steps):
        action = int(rng.integers(ACTIONS))
        outcome = outcomes((state,), action)[-1]
        (after,) = outcome.macrostate
        agent.observe(
            told(transition(state, action, outcome.reward, after, terminated=outcome.terminated)), episode=step
        )
        state = 0 if outcome.terminated else after


def test_what_is_imagined_is_of_the_rules_alone() -> None:
    agent = knowing(depth=4, breadth=5, start_states="replayed", exploration=1.0)
    live(agent, 80)
    rows = agent.imagined.arrays()
    before, after = (FakeEncoder().read_macrostate(torch.as_tensor(rows[name]))[:, 0] for name in ("z", "next_z"))
    assert len(before) > 300 and set(before) == set(range(STATES)) - {GOAL}
    for state, action, then, reward, ended in zip(
        before, rows["action"], after, rows["reward"], rows["terminated"], strict=True
    ):
        assert (then, reward, bool(ended)) in {
            (*o.macrostate, o.reward, o.terminated) for o in outcomes((int(state),), int(action))
        }
    by_chance = ((after - before) % STATES)[rows["action"] == HALF]
    shares = np.bincount(by_chance, minlength=4) / len(by_chance)
    error = 4.0 * 0.5 / np.sqrt(len(by_chance))
    assert shares == pytest.approx([0.25, 0.0, 0.5, 0.25], abs=error), "outcomes have their probabilities"


def test_a_rollout_goes_on_from_what_it_reached() -> None:
    agent = knowing(depth=3, breadth=1, start_states="current", start_episode=0, exploration=1.0)
    agent.observe(told(transition(3, 0, -1.0, 3)), episode=0)
    rows = agent.imagined.arrays()
    assert np.array_equal(rows["z"][1:], rows["next_z"][:-1])
    assert np.abs(rows["z"][0] - CODES[3].numpy()).max() < 0.5
    assert len(rows["z"]) == 3 or rows["terminated"][-1] == 1.0


def test_imagining_begins_and_ends_when_settings_say() -> None:
    agent = knowing(start_episode=3, end_episode=6)
    counts = []
    for episode in range(9):
        agent.observe(told(transition(0, 1, -1.0, 1)), episode=episode)
        counts.append(agent.imagined.added)
    assert counts[:3] == [0, 0, 0] and counts[3] < counts[4] < counts[5] == counts[8]
    assert agent.updates == 9 + 6, "one on real transitions a step, and one more from the third episode on"


def test_the_exact_filter_keeps_what_is_right() -> None:
    agent = built(exact.make_filter, exact_world=WORLD)
    assert isinstance(agent, ExactFilterAgent)
    rows = [  # from state 4: action, reached, reward, probability of the end; and whether that is right
        (1, 5, 76.0, 0.9, True),
        (1, 5, 78.0, 0.9, False),
        (1, 5, 70.0, 0.1, False),
        (1, 4, -1.0, 0.1, False),
        (0, 4, -1.9, 0.1, True),
        (HALF, 4, -1.0, 0.1, True),
        (HALF, 0, -1.0, 0.2, True),
        (HALF, 5, 70.0, 0.9, False),
    ]
    action, reached, reward, ends, right = (list(column) for column in zip(*rows, strict=True))
    step = ImaginedStep(CODES[reached] + 0.01, torch.tensor(reward), torch.tensor(ends), None, None)  # type: ignore[arg-type]
    z = CODES[[4] * len(rows)] - 0.01
    assert agent.imagination.admits(z, torch.tensor(action), step, 0.0).tolist() == right


OTHERS: dict[str, Any] = {
    "model.members": 3,
    "imagination.temperature": 0.5,
    "imagination.predicts_with": "network",
    "imagination.curiosity": 0.5,
    "imagination.weight_samples": 9,
    "imagination.reduction": "sum",
    "imagination.accumulates": True,
    "imagination.confidence_scale": 0.2,
    "imagination.threshold": 0.1,
    "imagination.threshold_quantile": 0.5,
    "imagination.reward_threshold": 0.1,
    "imagination.termination_threshold": 0.1,
    "imagination.model_only_episodes": 5,
    "imagination.start_episode": 3,
    "imagination.end_episode": 5,
    "imagination.start_states": "replayed",
    "imagination.breadth": 5,
    "imagination.depth": 2,
    "imagination.updates_per_step": 2,
    "imagination.exploration": 1.0,
    "memory.imagined": 7,
    "memory.priority": 0.5,
}


def learned_with(**settings: Any) -> dict[str, bytes]:
    agent = built(exact.make, settings, exact_world=WORLD)
    live(agent, 8)
    return {name: array.tobytes() for name, array in agent.state().arrays.items()}


@pytest.mark.parametrize("setting", OTHERS)
def test_a_setting_of_a_learned_model_has_no_effect_on_the_exact_one(setting: str) -> None:
    """And a bench refuses it, as each other setting without effect."""
    same = learned_with(**{setting: OTHERS[setting]}) == learned_with()
    assert same == (setting in registry.inert_settings("imagination_exact"))


def test_a_bench_refuses_settings_that_do_nothing_for_a_control() -> None:
    inert = registry.inert_settings
    assert {"imagination.threshold", "imagination.model_only_episodes"} <= inert("imagination_exact_filter")
    assert "imagination.confidence_scale" not in inert("imagination_exact_filter")
    assert "imagination.model_only_episodes" in inert("imagination_memory")
    assert "imagination.threshold" not in inert("imagination_memory")
    assert "model.members" in inert("imagination_exact")


def test_only_who_is_given_the_world_imagines_exactly() -> None:
    with pytest.raises(InvalidValueError, match="given the exact world"):
        built(exact.make)
    with pytest.raises(InvalidValueError, match="was shown none"):
        knowing().observe(transition(0, 1, -1.0, 1), episode=0)
    assert ExactWorld.of(registry.task("arrows:gesture=0.5"), "clean") is None, "its frames hide something"


@pytest.mark.parametrize("agent", ["imagination_exact", "imagination_exact_filter"])
@pytest.mark.parametrize(
    ("option", "sentence"),
    [
        ({"after": ("arrow_puzzle_hard",), "unannounced": True}, "here another comes before"),
        ({"feedback": 2.0}, "a teacher adds to rewards"),
    ],
)
def test_the_rules_are_given_where_all_rewards_of_training_are_theirs(
    agent: str, option: dict[str, Any], sentence: str
) -> None:
    """Earlier tasks have other rules, and a teacher's feedback is in no rule."""
    alone = protocol("arrow_puzzle", "smoke", agents=(agent,))
    given = [context_of(RunSpec(protocol=replace(alone, **more), agent=agent, seed=0)) for more in ({}, option)]
    assert given[0].exact_world is not None
    assert given[1].exact_world is None
    with pytest.raises(UnableError, match=f"^Agent '{agent}' is given the exact rules of one task.*{sentence}"):
        protocol("arrow_puzzle", "smoke", agents=(agent,), **option)
    planner = replace(registry.agent_entry(agent), learns=False)  # of rules, which is trained on nothing
    with mock.patch.dict(registry.AGENTS, {"planner": planner}):
        assert protocol("arrow_puzzle", "smoke", agents=("dqn", "planner"), **option).agents == ("dqn", "planner")


@pytest.mark.parametrize("agent", [name for name, entry in registry.agents().items() if entry.privileged])
@pytest.mark.parametrize("world", ["arrows:cubes=2,gesture=first", "arrows:cubes=2,lag=1"])
def test_a_privileged_agent_is_refused_where_it_cannot_be_made(agent: str, world: str) -> None:
    """Before an encoder is trained; every other one is made in a world that hides something."""
    if not registry.agent_entry(agent).needs_exact_world:
        wanted = protocol(world, "smoke", agents=(agent,))
        registry.make_agent(agent, context_of(RunSpec(protocol=wanted, agent=agent, seed=0)))
        return
    with (
        mock.patch("imagine_bench.store.encoders.own", side_effect=AssertionError("trained")),
        pytest.raises(UnableError, match=f"^Agent '{agent}' imagines from true macrostates, and frames of .* hide"),
    ):
        plan(world, "smoke", agents=(agent,))
