"""What must hold of an agent, in a task's kinematic execution."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import NamedTuple

import numpy as np

from imagine_bench import registry
from imagine_bench.exact.beliefs import optimal_policy_of
from imagine_bench.interfaces import Agent, AgentContext, AgentState, ExactWorld, Observation, TaskSpec
from imagine_bench.interfaces.capabilities import begin_episode
from imagine_bench.running.evaluation import play
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders
from imagine_bench.testing.common import NotOffered, make_env, require


class CheckedAgent(NamedTuple):
    """An agent that is checked, and where."""

    name: str
    entry: registry.AgentEntry
    spec: TaskSpec
    context: AgentContext

    def make(self) -> Agent:
        """A new one."""
        return registry.make_agent(self.name, self.context)


def checked_agent(name: str, task: str) -> CheckedAgent:
    """An agent as it is checked, in a task's kinematic execution. Raises as :func:`.registry.agent_entry`."""
    spec = registry.task(task)
    entry = registry.agent_entry(name)
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=encoders.own(spec, "clean", entry.encoder_kind) if entry.needs_encoder else None,
        seeds=SeedTree(0).child("agent"),
        config_group=spec.config_group,
        hyperparameters="minimal",
        overrides=registry.own_settings(name, {}),
        optimal_policy=optimal_policy_of(spec) if entry.privileged else None,
        exact_world=ExactWorld.of(spec, "clean") if entry.privileged else None,
    )
    return CheckedAgent(name, entry, spec, context)


def _play(spec: TaskSpec, agent: Agent, privileged: bool, episodes: range) -> list[int]:
    """Train for some episodes; returns the actions."""
    actions = []
    with closing(make_env(spec)) as env:
        for episode in episodes:
            for transition, _ in play(env, agent, seed=episode, explore=True, privileged=privileged):
                require(0 <= transition.action < spec.n_actions, f"it acts {transition.action} of {spec.n_actions}")
                agent.observe(transition, episode=episode)
                actions.append(transition.action)
    return actions


def _made(one: CheckedAgent) -> None:
    require(one.make() is not None, "nothing is made")


def _acts(one: CheckedAgent) -> None:
    spec = one.spec
    privileged = one.entry.privileged
    agent = _trainee(one)
    _play(spec, agent, privileged, range(3))
    states = np.array(spec.rules.start_states[:20])
    frames = spec.render_macrostates(states, "clean", np.random.default_rng(0))
    given = [
        Observation(frame=frame, macrostate=state if privileged else None)
        for frame, state in zip(frames, states, strict=True)
    ]
    before = copy.deepcopy(agent.state())
    once, again = (greedy(agent, given) for _ in range(2))
    if one.entry.learns:
        require(once == again, "asked twice with explore=False, it acts otherwise")
        require(same_arrays(before, agent.state()), "acting with explore=False changes its state")
    require(all(isinstance(value, (int, float)) for value in agent.diagnostics().values()), "diagnostics: no numbers")


def greedy(agent: Agent, given: Sequence[Observation]) -> list[int]:
    """The greedy action in each observation, as the first of an episode."""
    actions = []
    for each in given:
        begin_episode(agent)
        actions.append(agent.act(each, explore=False))
    return actions


def _goes_on(one: CheckedAgent) -> None:
    spec = one.spec
    privileged = one.entry.privileged
    agent = _trainee(one)
    _play(spec, agent, privileged, range(3))
    snapshot = agent.state()
    kept = copy.deepcopy(snapshot)
    here = _play(spec, agent, privileged, range(3, 6))
    require(same_arrays(kept, snapshot), "what it learns later alters a state that it gave before")
    twin = one.make()
    twin.restore(kept)
    require(_play(spec, twin, privileged, range(3, 6)) == here, "it acts otherwise")
    require(same_arrays(agent.state(), twin.state()), "its later state differs")


def _trainee(one: CheckedAgent) -> Agent:
    if one.entry.external_training_loop:
        raise NotOffered("it trains in a loop of its own, and its run cannot pause")
    return one.make()


def same_arrays(one: AgentState, other: AgentState) -> bool:
    """Whether two states have equal arrays, to the bit."""
    if one.arrays.keys() != other.arrays.keys():
        return False
    return all(value.tobytes() == other.arrays[name].tobytes() for name, value in one.arrays.items())


AGENT_CHECKS: Mapping[str, Callable[[CheckedAgent], None]] = {
    "it is made": _made,
    "it acts and learns, greedily without a change": _acts,
    "taken up from its state it goes on to the same bits": _goes_on,
}
"""What must hold of an agent, a sentence each."""
