"""One loop for agents of macro-actions, by planner or by clone: success against seconds of robot time.

It also asks an agent's world model how often a macro-action changes nothing, and counts how often that is true.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, brief, require_integer
from imagine_bench.interfaces import Agent, AgentContext, Observation, TaskSpec, Transition
from imagine_bench.interfaces.capabilities import FrameReader, ModelOnlyTrainer, OutcomePredictor, begin_episode
from imagine_bench.registry.entries import parse_configuration
from imagine_bench.rules import Rules
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders

from .cloned_env import CloneExecutedEnv

Env = gymnasium.Env[Any, Any]
PUZZLE_CUBES = 3
_TEST_SEED = 10**9
_EPISODES = 10**5
"""Seeds of environments that each seed has for training; the first of all tests is behind them."""


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """One point of a learning curve of an agent of macro-actions."""

    episodes: int  #: real training episodes so far
    macro_actions: int  #: of training
    robot_s: float  #: simulated seconds of training
    nothing: int  #: macro-actions of training that changed no object
    faults: int  #: macro-actions of training that ended in a fault
    successes: int  #: of test episodes
    tests: int
    #: mean probability that the agent's model gives to "nothing changes", at the starts of tests; None: it has none
    expects_nothing: float | None
    cpu_s: float  #: of training and tests so far


class Stage(NamedTuple):
    """An environment of macro-actions, and its task."""

    env: Env
    spec: TaskSpec
    rules: Rules
    horizon: int


def environment(execution: str, *, cubes: int, slip: float, clone: Path | None = None) -> Stage:
    """The arrow world whose macro-actions planner or clone carry out, with the rules of a world without slips.

    Args:
        execution: ``"planner"`` or ``"clone"``.
        cubes: How many.
        slip: Probability that a grip slips. Rules and agents do not know of it.
        clone: A file; None is the bundled one.
    """
    spec = registry.task("arrow_puzzle" if cubes == PUZZLE_CUBES else f"arrows:cubes={cubes},horizon=10")
    env: Env
    if execution == "clone":
        env = CloneExecutedEnv(clone=clone, cubes=cubes, slip=slip)
    else:
        env = gymnasium.make("imagine_bench/Arrows-v0", cubes=cubes, horizon=spec.horizon, slip=slip)
    return Stage(env, spec, spec.rules, spec.horizon)


def make_agent(name: str, spec: TaskSpec, seed: int, appearance: str = "clean") -> Agent:
    """An agent of macro-actions by its registered name, with settings of its own if the name has some.

    It sees through the task's own encoder if it needs one.

    Raises:
        UnknownNameError: No such agent or setting.
        SetupError: It is in a package that is not installed or cannot be used.
        InvalidValueError: It sees macrostates, or has a training loop of its own.
    """
    entry = registry.agent_entry(name)
    if entry.privileged or entry.external_training_loop:
        why = "is shown macrostates" if entry.privileged else "has a training loop of its own"
        raise InvalidValueError(f"{name} {why}; give an agent that learns from frames in the loop of this command.")
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=encoders.own(spec, appearance, entry.encoder_kind) if entry.needs_encoder else None,
        seeds=SeedTree(seed).child("agent"),
        config_group=spec.config_group,
        overrides=registry.own_settings(name, {}),
        argument=parse_configuration(name).argument,
    )
    return registry.make_agent(name, context)


def learn(
    env: Env,
    test_env: Env,
    agent: Agent,
    *,
    budgets: Sequence[int],
    tests: int,
    horizon: int,
    seed: int,
    told: Callable[[CurvePoint], None],
) -> list[CurvePoint]:
    """Train an agent, and test it after so many episodes.

    Args:
        env: An environment of macro-actions for training; ``info["sim_time_s"]`` is the time of the latest one.
        test_env: Another one, for tests.
        agent: The learner.
        budgets: Training episodes before each test, ascending.
        tests: Test episodes.
        horizon: Macro-actions before truncation.
        seed: Of the training episodes.
        told: Called with each point of the curve.

    Raises:
        InvalidValueError: No test, a budget below 1, or a seed whose training episodes would be tests.
    """
    if not 0 <= seed < _TEST_SEED // _EPISODES:
        raise InvalidValueError(f"seed is {seed}; give 0 to {_TEST_SEED // _EPISODES - 1:,}.")
    if tests < 1 or not budgets or min(budgets) < 1:
        raise InvalidValueError(f"tests is {tests} and budgets {brief(list(budgets))}; give at least 1 for each.")
    began_s = time.process_time()
    count = _Count()
    curve = []
    for episode in range(1, max(budgets) + 1):
        _train_episode(env, agent, episode, horizon, seed * _EPISODES + episode, count)
        if episode in budgets:
            while isinstance(agent, ModelOnlyTrainer) and agent.train_in_model():
                pass
            successes = sum(test_episode(test_env, agent, horizon, _TEST_SEED + each) for each in range(tests))
            point = CurvePoint(
                episodes=episode,
                macro_actions=count.macro_actions,
                robot_s=round(count.robot_s, 2),
                nothing=count.nothing,
                faults=count.faults,
                successes=successes,
                tests=tests,
                expects_nothing=expects_nothing(test_env, agent, 20),
                cpu_s=round(time.process_time() - began_s, 1),
            )
            told(point)
            curve.append(point)
    return curve


@dataclass
class _Count:
    macro_actions: int = 0
    robot_s: float = 0.0
    nothing: int = 0
    faults: int = 0


def _train_episode(env: Env, agent: Agent, episode: int, horizon: int, seed: int, count: _Count) -> None:
    frame, info = env.reset(seed=seed)
    begin_episode(agent)
    seen = Observation(frame=frame)
    for step in range(1, horizon + 1):
        action = agent.act(seen, explore=True)
        before = info["macrostate"]
        frame, reward, terminated, blew_up, info = env.step(action)
        following = Observation(frame=frame)
        truncated = blew_up or step == horizon
        transition = Transition(
            observation=seen,
            action=action,
            reward=float(reward),
            next_observation=following,
            terminated=bool(terminated),
            truncated=truncated,
        )
        agent.observe(transition, episode=episode)
        count.macro_actions += 1
        count.robot_s += float(info["sim_time_s"])
        count.faults += bool(info["fault"])
        count.nothing += bool(np.array_equal(info["macrostate"], before)) and not info["fault"]
        seen = following
        if terminated or truncated:
            return


def test_episode(env: Env, agent: Agent, horizon: int, seed: int) -> bool:
    """Whether a test episode without exploration succeeds."""
    frame, _ = env.reset(seed=seed)
    begin_episode(agent)
    for _ in range(horizon):
        frame, _, terminated, blew_up, info = env.step(agent.act(Observation(frame=frame), explore=False))
        if terminated or blew_up:
            return bool(info["is_success"])
    return False


def expects_nothing(env: Env, agent: Any, starts: int) -> float | None:
    """Mean probability, over all macro-actions at some starts, that the agent's model gives to no change at all.

    The agent's own probe reads the macrostates of the frames, as it reads those of the model's outcomes. None: its
    model cannot be asked.
    """
    if not isinstance(agent, OutcomePredictor) or not isinstance(agent, FrameReader):
        return None
    begin_episode(agent)
    frames = np.stack([env.reset(seed=_TEST_SEED + each)[0] for each in range(starts)])
    expected = agent.predict_outcomes(frames, np.random.default_rng(0))
    same = (expected.macrostates == agent.read_frames(frames)[:, None, None, :]).all(axis=-1)  # [N, A, B]
    return float((expected.p_continues * same).sum(axis=-1).mean())


def oracle_success(env: Env, rules: Rules, *, tests: int, horizon: int) -> tuple[int, float]:
    """Successes of the rules' optimal policy, and mean seconds of its macro-actions.

    Raises InvalidValueError: no test.
    """
    require_integer("tests", tests, 1)
    successes = 0
    times_s = []
    for episode in range(tests):
        _, info = env.reset(seed=_TEST_SEED + episode)
        for _ in range(horizon):
            action = rules.optimal_action(tuple(info["macrostate"].tolist()))
            _, _, terminated, blew_up, info = env.step(action)
            times_s.append(float(info["sim_time_s"]))
            if terminated or blew_up:
                break
        successes += bool(info["is_success"])
    return successes, float(np.mean(times_s))
