"""Does a task or an agent keep the contract? For those of this suite and of any other package: ``imagine-bench check``.

Each check is one sentence about what must hold, and raises where it does not.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping
from contextlib import closing
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env

from imagine_bench import registry
from imagine_bench.bench.evaluation import play
from imagine_bench.certificates.beliefs import optimal_policy_of
from imagine_bench.errors import ImagineBenchError, InvalidValueError, plain
from imagine_bench.interfaces import Agent, AgentContext, AgentState, Observation, TaskSpec
from imagine_bench.rules import facts, states_of
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders

_MOST = 200
"""Starts and macro-actions tried."""
_KEYS = {"macrostate", "is_success", "legal", "fault"}

Checks = Mapping[str, Callable[[], None]]


class NotOffered(ImagineBenchError):
    """What is checked is something that a guest may do without."""


class CheckedAgent(NamedTuple):
    """An agent that is checked, and where."""

    name: str
    entry: registry.AgentEntry
    spec: TaskSpec
    context: AgentContext

    def make(self) -> Agent:
        """A new one."""
        return registry.make_agent(self.name, self.context)


def report(checks: Checks) -> int:
    """Carry all out, print what each found, and count those that failed."""
    failed = 0
    for what, check in checks.items():
        try:
            check()
        except NotOffered as why:
            print(f"none   {what}: {why}")
        except Exception as error:  # whatever a guest does wrong is a finding
            failed += 1
            print(f"wrong  {what}: {' '.join(plain(error).split()) or type(error).__name__}")
        else:
            print(f"ok     {what}")
    return failed


def task_checks(name: str) -> Checks:
    """What must hold of a task. Raises as :func:`.registry.task`."""
    return {what: functools.partial(check, registry.task(name)) for what, check in TASK_CHECKS.items()}


def agent_checks(name: str, task: str = "arrow_puzzle") -> Checks:
    """What must hold of an agent. Raises as :func:`checked_agent`."""
    agent = checked_agent(name, task)
    return {what: functools.partial(check, agent) for what, check in AGENT_CHECKS.items()}


def checked_agent(name: str, task: str) -> CheckedAgent:
    """An agent as it is checked, in a task's kinematic execution. Raises as :func:`.registry.agent_entry`."""
    spec, entry = registry.task(task), registry.agent_entry(name)
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=encoders.own(spec, "clean", entry.encoder_kind) if entry.needs_encoder else None,
        seeds=SeedTree(0).child("agent"),
        config_group=spec.config_group,
        hyperparameters="minimal",
        overrides=registry.own_settings(name, {}),
        optimal_policy=optimal_policy_of(spec) if entry.privileged else None,
    )
    return CheckedAgent(name, entry, spec, context)


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise InvalidValueError(otherwise)


def _env(spec: TaskSpec) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(spec.env_id, execution="kinematic", appearance="clean", disable_env_checker=True)


def _rules(spec: TaskSpec) -> None:
    found = facts(spec.rules, spec.horizon)
    _require(found.optimum > 0.0, "an optimal agent never succeeds within the horizon")


def _frames(spec: TaskSpec) -> None:
    states = np.array(states_of(spec.rules)[:_MOST])
    one, other = (spec.render_macrostates(states, "clean", np.random.default_rng(0)) for _ in range(2))
    given = f"{one.dtype} of shape {one.shape}"
    _require(one.dtype == np.uint8 and one.shape == (len(states), 64, 64, 3), f"{len(states)} frames are {given}")
    _require(np.array_equal(one, other), "two calls with equal generators differ")


def _gymnasium(spec: TaskSpec) -> None:
    with closing(_env(spec)) as env:
        check_env(env.unwrapped, skip_render_check=True)


def _starts(spec: TaskSpec) -> None:
    with closing(_env(spec)) as env:
        states = states_of(spec.rules)
        for start in (*spec.rules.start_states[:_MOST], *states[:: 1 + len(states) // _MOST]):
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


def _kept(spec: TaskSpec) -> None:
    with closing(_env(spec)) as one, closing(_env(spec)) as other:
        env, twin = one.unwrapped, other.unwrapped
        if not (hasattr(env, "get_state") and hasattr(env, "set_state")):
            raise NotOffered("the environment has no get_state and set_state")
        env.reset(seed=1)
        twin.reset(seed=2)
        env.step(0)
        state = env.get_state()
        walked = _walk(env, spec)
        for again, where in ((env, "in the same environment"), (twin, "in another")):
            again.set_state(state)
            _require(_walk(again, spec) == walked, f"put back {where}, it goes on otherwise")


def _walk(env: Any, spec: TaskSpec) -> list[Any]:
    """What follows on some random macro-actions, to the end of the episode at most."""
    rng, found, over = np.random.default_rng(0), list[Any](), False
    while not over and len(found) < spec.horizon:
        frame, reward, over, _, info = env.step(int(rng.integers(spec.n_actions)))
        found.append((np.asarray(frame).tobytes(), reward, over, np.asarray(info["macrostate"]).tolist()))
    return found


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


def _made(one: CheckedAgent) -> None:
    _require(one.make() is not None, "nothing is made")


def _acts(one: CheckedAgent) -> None:
    spec, privileged, agent = one.spec, one.entry.privileged, _trainee(one)
    _play(spec, agent, privileged, range(3))
    states = np.array(spec.rules.start_states[:20])
    frames = spec.render_macrostates(states, "clean", np.random.default_rng(0))
    given = [
        Observation(frame=frame, macrostate=state if privileged else None)
        for frame, state in zip(frames, states, strict=True)
    ]
    before = copy.deepcopy(agent.state())
    once, again = ([agent.act(each, explore=False) for each in given] for _ in range(2))
    if one.entry.learns:
        _require(once == again, "asked twice with explore=False, it acts otherwise")
        _require(_same(before, agent.state()), "acting with explore=False changes its state")
    _require(all(isinstance(value, (int, float)) for value in agent.diagnostics().values()), "diagnostics: no numbers")


def _goes_on(one: CheckedAgent) -> None:
    spec, privileged, agent = one.spec, one.entry.privileged, _trainee(one)
    _play(spec, agent, privileged, range(3))
    snapshot = agent.state()
    kept = copy.deepcopy(snapshot)
    here = _play(spec, agent, privileged, range(3, 6))
    _require(_same(kept, snapshot), "what it learns later alters a state that it gave before")
    twin = one.make()
    twin.restore(kept)
    _require(_play(spec, twin, privileged, range(3, 6)) == here, "it acts otherwise")
    _require(_same(agent.state(), twin.state()), "its later state differs")


def _trainee(one: CheckedAgent) -> Agent:
    if one.entry.external_training_loop:
        raise NotOffered("it trains in a loop of its own, and its run cannot pause")
    return one.make()


def _same(one: AgentState, other: AgentState) -> bool:
    """Whether two states have equal arrays, to the bit."""
    if one.arrays.keys() != other.arrays.keys():
        return False
    return all(value.tobytes() == other.arrays[name].tobytes() for name, value in one.arrays.items())


TASK_CHECKS: Mapping[str, Callable[[TaskSpec], None]] = {
    "its rules are distributions, reach an end and can be won": _rules,
    "its frames are 64 x 64 RGB bytes and the same for the same generator": _frames,
    "Gymnasium's checker is content": _gymnasium,
    "every macrostate is begun in, and told": _starts,
    "macro-actions end as the rules say": _steps,
    "the same seed gives the same episode": _repeats,
    "in the middle of an episode its state is kept and put back, to the bit": _kept,
}
"""What must hold of a task, a sentence each."""
AGENT_CHECKS: Mapping[str, Callable[[CheckedAgent], None]] = {
    "it is made": _made,
    "it acts and learns, greedily without a change": _acts,
    "taken up from its state it goes on to the same bits": _goes_on,
}
"""What must hold of an agent, a sentence each."""
