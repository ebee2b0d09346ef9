"""Does a task or an agent keep the contract? For those of this suite and of any other package: ``imagine-bench check``.

Each check is one sentence about what must hold, and raises where it does not.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env

from imagine_bench import registry
from imagine_bench.bench.evaluation import play
from imagine_bench.errors import InvalidValueError, plain
from imagine_bench.interfaces import Agent, AgentContext, AgentState, Observation, TaskSpec
from imagine_bench.rules import facts
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders

_MOST = 200
"""Starts and macro-actions tried."""
_KEYS = {"macrostate", "is_success", "legal", "fault"}

Checks = Mapping[str, Callable[[], None]]


def report(checks: Checks) -> int:
    """Carry all out, print what each found, and count those that failed."""
    failed = 0
    for what, check in checks.items():
        try:
            check()
        except Exception as error:  # whatever a guest does wrong is a finding
            failed += 1
            print(f"wrong  {what}: {' '.join(plain(error).split()) or type(error).__name__}")
        else:
            print(f"ok     {what}")
    return failed


def task_checks(name: str) -> Checks:
    """What must hold of a task. Raises as :func:`.registry.task`."""
    spec = registry.task(name)
    return {
        "its rules are distributions, reach an end and can be won": lambda: _rules(spec),
        "its frames are 64 x 64 RGB bytes and the same for the same generator": lambda: _frames(spec),
        "Gymnasium's checker is content": lambda: _gymnasium(spec),
        "every start is begun in, and told": lambda: _starts(spec),
        "macro-actions end as the rules say": lambda: _steps(spec),
        "the same seed gives the same episode": lambda: _repeats(spec),
    }


def agent_checks(name: str, task: str = "arrow_puzzle") -> Checks:
    """What must hold of an agent, in a task's kinematic execution. Raises as :func:`.registry.agent_entry`."""
    spec, entry = registry.task(task), registry.agent_entry(name)
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=encoders.own(spec, "clean", entry.encoder_kind) if entry.needs_encoder else None,
        seeds=SeedTree(0).child("agent"),
        config_group=spec.config_group,
        hyperparameters="minimal",
        optimal_action=spec.rules.optimal_action if entry.privileged else None,
    )
    checks = {"it is made": lambda: _require(registry.make_agent(name, context) is not None, "nothing is made")}
    if not entry.external_training_loop:
        checks["it acts and learns, greedily without a change"] = lambda: _acts(spec, name, context)
        checks["taken up from its state it goes on to the same bits"] = lambda: _goes_on(spec, name, context)
    return checks


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise InvalidValueError(otherwise)


def _env(spec: TaskSpec) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(spec.env_id, execution="kinematic", appearance="clean", disable_env_checker=True)


def _rules(spec: TaskSpec) -> None:
    found = facts(spec.rules, spec.horizon)
    _require(found.optimum > 0.0, "an optimal agent never succeeds within the horizon")


def _frames(spec: TaskSpec) -> None:
    states = np.array(spec.rules.states[:_MOST])
    one, other = (spec.render_macrostates(states, "clean", np.random.default_rng(0)) for _ in range(2))
    given = f"{one.dtype} of shape {one.shape}"
    _require(one.dtype == np.uint8 and one.shape == (len(states), 64, 64, 3), f"{len(states)} frames are {given}")
    _require(np.array_equal(one, other), "two calls with equal generators differ")


def _gymnasium(spec: TaskSpec) -> None:
    with closing(_env(spec)) as env:
        check_env(env.unwrapped, skip_render_check=True)


def _starts(spec: TaskSpec) -> None:
    with closing(_env(spec)) as env:
        for start in spec.rules.start_states[:_MOST]:
            _, info = env.reset(seed=0, options={"macrostate": start})
            _require(info.keys() >= _KEYS, f"info lacks {sorted(_KEYS - info.keys())}")
            told = tuple(np.asarray(info["macrostate"]).tolist())
            _require(told == start, f"begun in {start}, it tells {told}")


def _steps(spec: TaskSpec) -> None:
    rng, over, state = np.random.default_rng(0), True, spec.rules.start_states[0]
    with closing(_env(spec)) as env:
        for _ in range(_MOST):
            if over:
                state = tuple(np.asarray(env.reset(seed=int(rng.integers(1 << 30)))[1]["macrostate"]).tolist())
            action = int(rng.integers(spec.n_actions))
            _, reward, terminated, truncated, info = env.step(action)
            end = tuple(np.asarray(info["macrostate"]).tolist())
            found = (end, float(reward), terminated, bool(info["is_success"]))
            allowed = [(o.macrostate, o.reward, o.terminated, o.success) for o in spec.rules.outcomes(state, action)]
            words = f"action {action} in {state} gave {found}, the rules allow {allowed}"
            _require(found in allowed or bool(info["fault"]), words)
            state, over = end, terminated or truncated


def _episode(env: gymnasium.Env[Any, Any], seed: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    found: list[Any] = [env.reset(seed=seed)[0]]
    over = False
    while not over:
        frame, reward, terminated, truncated, _ = env.step(int(rng.integers(env.action_space.n)))  # type: ignore[attr-defined]
        found += [frame, reward]
        over = terminated or truncated
    return found


def _repeats(spec: TaskSpec) -> None:
    with closing(_env(spec)) as one, closing(_env(spec)) as other:
        _episode(other, 1)
        for seed in range(3):
            pairs = zip(_episode(one, seed), _episode(other, seed), strict=True)
            _require(all(np.array_equal(a, b) for a, b in pairs), f"two episodes of seed {seed} differ")


def _play(spec: TaskSpec, agent: Agent, privileged: bool, episodes: range) -> list[int]:
    """Train for some episodes; returns the actions."""
    actions = []
    with closing(_env(spec)) as env:
        for episode in episodes:
            for transition, _ in play(env, agent, seed=episode, explore=True, privileged=privileged):
                _require(0 <= transition.action < spec.n_actions, f"it acts {transition.action} of {spec.n_actions}")
                agent.observe(transition, episode=episode)
                actions.append(transition.action)
    return actions


def _acts(spec: TaskSpec, name: str, context: AgentContext) -> None:
    entry, agent = registry.agent_entry(name), registry.make_agent(name, context)
    _play(spec, agent, entry.privileged, range(3))
    states = np.array(spec.rules.start_states[:20])
    frames = spec.render_macrostates(states, "clean", np.random.default_rng(0))
    given = [
        Observation(frame=frame, macrostate=state if entry.privileged else None)
        for frame, state in zip(frames, states, strict=True)
    ]
    before = copy.deepcopy(agent.state())
    once, again = ([agent.act(each, explore=False) for each in given] for _ in range(2))
    if entry.learns:
        _require(once == again, "asked twice with explore=False, it acts otherwise")
        _require(_same(before, agent.state()), "acting with explore=False changes its state")
    _require(all(isinstance(value, (int, float)) for value in agent.diagnostics().values()), "diagnostics: no numbers")


def _goes_on(spec: TaskSpec, name: str, context: AgentContext) -> None:
    privileged, agent = registry.agent_entry(name).privileged, registry.make_agent(name, context)
    _play(spec, agent, privileged, range(3))
    snapshot = agent.state()
    kept = copy.deepcopy(snapshot)
    here = _play(spec, agent, privileged, range(3, 6))
    _require(_same(kept, snapshot), "what it learns later alters a state that it gave before")
    twin = registry.make_agent(name, context)
    twin.restore(kept)
    _require(_play(spec, twin, privileged, range(3, 6)) == here, "it acts otherwise")
    _require(_same(agent.state(), twin.state()), "its later state differs")


def _same(one: AgentState, other: AgentState) -> bool:
    """Whether two states have equal arrays, to the bit."""
    if one.arrays.keys() != other.arrays.keys():
        return False
    return all(value.tobytes() == other.arrays[name].tobytes() for name, value in one.arrays.items())
