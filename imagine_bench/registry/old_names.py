"""The one table of the names that agents had earlier: kept files are read through it, command lines are refused by it.

A protocol's ``agent_names`` says with which edition of the names it was written. Files of edition 1 do not say so; they
are read with today's labels, and written back, hashed and compared with the names that stand in them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from imagine_bench.registry.entries import Entrant, entrant

FIRST = 1
TODAY = 2
"""Editions of agents' names: that of files that name none, and that of every new protocol."""
LABEL_OF_OLD_AGENT = {"factored_own": "factored", "factored": "factored:given"}
"""Today's label of each agent that had another name in edition 1 (until 2026-11-28)."""


def label_today(name: str) -> str:
    """Today's label of an agent that edition 1 called ``name``; settings in the name stay."""
    return _renamed(name, LABEL_OF_OLD_AGENT)


def name_in_edition_1(label: str) -> str:
    """The inverse of :func:`label_today`."""
    return _renamed(label, {now: then for then, now in LABEL_OF_OLD_AGENT.items()})


def edition_of(names: Iterable[str], edition: int = FIRST) -> int:
    """The edition that names from a file are of: the first where it says none and holds one that was renamed."""
    return FIRST if edition == FIRST and any(label_today(name) != name for name in names) else TODAY


def agent_label(name: str, protocol: Mapping[str, object]) -> str:
    """Today's label of an agent in a file, beside the protocol, a JSON mapping, that the file was written with."""
    return name if protocol.get("agent_names", FIRST) == TODAY else label_today(name)


def _renamed(name: str, table: Mapping[str, str]) -> str:
    one = entrant(name)
    return str(Entrant(table.get(one.agent, one.agent), one.settings))
