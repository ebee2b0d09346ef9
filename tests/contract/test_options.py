"""Every agent with every option of a protocol: the option has an effect or is refused; watching teaches as living."""

from __future__ import annotations

import functools
from collections.abc import Iterable

import imagine_bench.agents.dqn  # noqa: F401 - loads torch, which no test's time holds
import pytest
from guest_packages import Guests

from imagine_bench import registry
from imagine_bench.registry.builtin import guests as guests_of_ours
from imagine_bench.testing.checks import NotOffered, checked_agent
from imagine_bench.testing.options import OPTION_ROWS, CheckedOptions, require_every_field, watching_teaches_as_living

TASK = "arrow_puzzle:horizon=3"
_HEAVY = ("dqn_", "dreamer_", "drqn", "imagination_exact", "lewm", "sb3_")
"""Guests that train networks or load a library for longer than a fast test may last; those with tables are fast."""
_DO_LESS = ("imagination", "imagination_only", "dqn_more_updates")
"""Agents that do as much as another of the same class or less, which the fast tests check."""
_GUESTS = {name for guest in guests_of_ours() for name in guest.names.get(registry.AGENT_GROUP, ())}
AGENTS = [
    *(
        pytest.param(name, marks=[pytest.mark.slow] * (name in _DO_LESS))
        for name, entry in sorted(registry.AGENTS.items())
        if entry.make.startswith("imagine_bench.agents.")
    ),
    *(
        pytest.param(name, marks=[pytest.mark.slow] * name.startswith(_HEAVY))
        for name in sorted(_GUESTS & registry.agents().keys())
    ),
]
"""All of the suite and of its guests; fakes of other tests are registered, too."""


@pytest.fixture(scope="module", autouse=True)
def what_runs_share() -> None:
    """The dataset, the environments and the encoders are made once, in no test's time."""
    CheckedOptions("dqn", TASK).check("dataset")


def test_every_field_of_a_protocol_has_a_row_or_a_reason() -> None:
    require_every_field()


def test_two_runs_of_a_row_differ_in_its_option_alone() -> None:
    for name, row in OPTION_ROWS.items():
        keys = row.changes.keys() | row.without.keys()
        differ = {key for key in keys if row.changes.get(key) != row.without.get(key)}
        assert differ == set(row.fields) - {"execution"}, name
        assert bool(row.world) != bool(differ), "a field of the protocol, or an option of the world"


@functools.cache
def checked_options(agent: str) -> CheckedOptions:
    """The options of an agent, whose run without any is carried out once."""
    return CheckedOptions(agent, TASK)


def refusals(agent: str, options: Iterable[str]) -> set[str]:
    """The options that are refused; InvalidValueError for one that is not, and changes nothing."""
    checked, refused = checked_options(agent), set[str]()
    for option in options:
        try:
            checked.check(option)
        except NotOffered:
            refused.add(option)
    return refused


@pytest.mark.parametrize("agent", AGENTS)
def test_every_option_of_training_has_an_effect_or_is_refused(agent: str) -> None:
    refusals(agent, [name for name, row in OPTION_ROWS.items() if not row.shown])


@pytest.mark.parametrize("agent", ["dqn", "factored"])
def test_a_change_without_notice_has_an_effect(agent: str) -> None:
    assert not refusals(agent, ["unannounced"])


@pytest.mark.parametrize("agent", AGENTS)
def test_every_option_of_the_world_has_an_effect_or_is_refused(agent: str) -> None:
    refused = refusals(agent, [name for name, row in OPTION_ROWS.items() if row.shown])
    if registry.agent_entry(agent).privileged:  # one that renders its world needs an encoder of that very world
        refused -= {"gesture", "lag"}
    assert not refused & {"split", "physics", "appearance", "gesture", "lag"}, "the world is the same for all"


@pytest.mark.parametrize("agent", AGENTS)
def test_watching_episodes_teaches_as_living_them(agent: str) -> None:
    entry = registry.agent_entry(agent)
    try:
        watching_teaches_as_living(checked_agent(agent, TASK))
    except NotOffered:
        assert not entry.learns or entry.external_training_loop, "only those learn from no episodes that are shown"


def test_a_task_that_always_looks_the_same_is_no_fault_of_an_agent(guests: Guests) -> None:
    guests.new("task", "their_task")
    guests.new("agent", "their_agent")
    checked = CheckedOptions("their_agent", "their_task")
    checked.check("split")
    with pytest.raises(NotOffered, match="with it task their_task shows nothing else"):
        checked.check("appearance")
