"""What a report can say of tasks and agents whose package is not installed here: their names, and what was measured."""

from __future__ import annotations

import math
from typing import Any, cast

from imagine_bench import registry
from imagine_bench.errors import SetupError, UnknownNameError
from imagine_bench.interfaces import RuleFacts, TaskSpec
from imagine_bench.protocols.data import ProtocolData

_ABSENT = (UnknownNameError, SetupError)


def known_agent(name: str) -> registry.AgentEntry:
    """The registry line of an agent, or one for a learner of which only the name is known."""
    try:
        return registry.agent_entry(name)
    except _ABSENT:
        return registry.AgentEntry(make="", description="Its package is not installed here.")


def known_task(name: str) -> TaskSpec:
    """A task's spec, or one without macro-actions, rules and facts, of which only the name is known."""
    try:
        return registry.task(name)
    except _ABSENT:
        return TaskSpec(
            id=name, title=name.replace("_", " "), description="Its package is not installed here.", env_id="",
            horizon=0, action_names=(), macrostate_names=(), macrostate_values=(), preprocessing="", encoder="",
            rules=cast("Any", None), facts=_no_facts, render_macrostates=cast("Any", None),
        )  # fmt: skip


def missing(protocol: ProtocolData, *, certified: bool) -> str:
    """One sentence on what is not installed here and therefore not shown; empty where everything is.

    Where the bench keeps the certificate of its world (``certified``), chance level and optimum are shown.
    """
    agents = [agent for agent in protocol.agents if not known_agent(agent).make]
    unshown = ["what they are"] if agents else []
    names = [f"agent {name}" for name in agents]
    if not known_task(protocol.task).action_names:
        names = [f"task {protocol.task}", *names]
        unshown = [
            *([] if certified else ["chance level", "optimum"]),
            "areas",
            "imagined futures and rollouts",
            *unshown,
        ]
    return f"Not installed here: {', '.join(names)}. Not shown therefore: {', '.join(unshown)}." if names else ""


def _no_facts() -> RuleFacts:
    return RuleFacts(chance_level=math.nan, optimum=math.nan, optimal_return=math.nan, mean_plan_length=math.nan)
