"""What protocols of every task type have in common: they are data, and a hash stands for everything in them."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self, get_type_hints

from typeguard import CollectionCheckStrategy, TypeCheckError, check_type

from imagine_bench.errors import InvalidValueError, brief, require_known
from imagine_bench.interfaces import DEVICES
from imagine_bench.registry.entries import FIRST, TODAY, agent_label, edition_of, entrant, name_in_edition_1
from imagine_bench.seeding import SEEDS, TUNING_SEEDS, is_tuning_seed
from imagine_bench.values import Json, Setting

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

LATER: Mapping[str, bool] = {"later": True}
"""Metadata of a field that protocols did not always have: at its default it changes no hash."""
MOST = 10_000_000
"""Episodes, budgets and the like; a real robot lives to see a thousandth of it."""


def digest(values: Json) -> str:
    """Twelve hex digits that change when anything in JSON-like values does."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


@dataclass(frozen=True, kw_only=True)
class ProtocolData(ABC):
    """A comparison, completely specified by JSON-like values."""

    task: str  #: Registered task
    preset: str  #: Name of this protocol
    agents: tuple[str, ...]  #: Registered agents or regressors, in the order of the report
    #: One training run a seed and agent; each in [0, 2**24). Seeds from TUNING_SEEDS on are for choosing settings and
    #: are tested on starts that no reported run meets; the two kinds never mix.
    seeds: tuple[int, ...]
    #: Settings that replace those of the hyper-parameter set, as sorted (dotted name, value) pairs.
    overrides: tuple[tuple[str, Setting], ...] = ()
    #: :func:`digest` of every setting of every learner: a hyper-parameter set may be another one tomorrow, and what was
    #: run with it is then another bench. Empty in a protocol that no plan made.
    settings_digest: str = ""
    device: str = "cpu"  #: ``"cpu"`` or ``"cuda"``, where the agents compute: the bits of a result depend on it
    #: Edition of agents' names that files and the hash of this protocol have; ``agents`` are today's labels in any.
    #: A file says it only where names would be taken for older ones without it. See :mod:`.registry.entries`.
    agent_names: int = field(default=TODAY, metadata=LATER)

    def __post_init__(self) -> None:
        """Lists become tuples, and agents and seeds are written in one way: the same comparison has one hash.

        Raises:
            InvalidValueError: A value of another type than its field's, or out of range.
        """
        require_types(self)
        object.__setattr__(self, "agents", tuple(str(entrant(agent)) for agent in self.agents))
        require_known("device", self.device, DEVICES)
        require_seeds(self.seeds)
        object.__setattr__(self, "seeds", tuple(sorted(self.seeds)))
        require_different("agents", self.agents)

    def as_dict(self) -> dict[str, Any]:
        """A JSON-serialisable copy; fields marked :data:`LATER` are in it where they say something."""
        later = {field.name: field.default for field in dataclasses.fields(self) if field.metadata == LATER}
        values = {n: value for n, value in dataclasses.asdict(self).items() if n not in later or value != later[n]}
        values.pop("agent_names", None)
        values["agents"] = [self.written_name(agent) for agent in self.agents]
        if self.agent_names == TODAY and edition_of(values["agents"]) == FIRST:
            values["agent_names"] = TODAY
        return json.loads(json.dumps(values))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """The inverse of :meth:`as_dict`; names of an earlier edition become today's labels."""
        edition = edition_of(data["agents"], data.get("agent_names", FIRST))
        agents = [agent_label(agent, {"agent_names": edition}) for agent in data["agents"]]
        return cls(**{**data, "agents": agents, "agent_names": edition})

    def written_name(self, agent: str) -> str:
        """The name that files of this protocol have for an agent, which is given by today's label."""
        return name_in_edition_1(agent) if self.agent_names == FIRST else agent

    @property
    def hash(self) -> str:
        """Twelve hex digits that change when anything in the protocol does."""
        return digest(self.as_dict())

    @property
    def stages(self) -> tuple[int | None, ...]:
        """The order of work: all runs come to each of these budgets before any goes on; None is the end.

        A long bench that is stopped early is then a whole bench of fewer episodes.
        """
        return (None,)

    @abstractmethod
    def work(self, agent: str, until: int | None = None) -> int:
        """Parts of work of a run of this agent as far as the budget ``until``, of whatever the protocol counts."""


def require_types(one: DataclassInstance) -> None:
    """Make lists in the fields of a dataclass tuples, or raise InvalidValueError for a value of another type."""
    for name, hint in get_type_hints(type(one)).items():
        if isinstance(value := getattr(one, name), list):
            value = tuple(tuple(item) if isinstance(item, list) else item for item in value)
            object.__setattr__(one, name, value)
        try:
            check_type(value, hint, collection_check_strategy=CollectionCheckStrategy.ALL_ITEMS)
        except TypeCheckError:
            wanted = next(field.type for field in dataclasses.fields(one) if field.name == name)
            raise InvalidValueError(f"{name} was given {brief(value)}; it takes {wanted}.") from None


def require_ascending(name: str, values: tuple[int, ...], *, at_least: int) -> None:
    """Raise InvalidValueError unless values are different integers, ascending, of at least ``at_least``."""
    ascending = all(a < b for a, b in itertools.pairwise(values))
    if not values or not ascending or values[0] < at_least or values[-1] > MOST:
        most = f" and at most {MOST:,}" if values and values[-1] > MOST else ""
        raise InvalidValueError(
            f"{name} {brief(values)} must be one or more different integers of at least {at_least}{most}, ascending."
        )


def require_between(name: str, value: int, *, at_least: int) -> None:
    """Raise InvalidValueError unless a number is at least ``at_least`` and at most :data:`MOST`."""
    if not at_least <= value <= MOST:
        allowed = f"at least {at_least}" if value < at_least else f"at most {MOST:,}"
        raise InvalidValueError(f"{name} is {brief(value)}; give {allowed}.")


def require_different(name: str, values: tuple[str, ...]) -> None:
    """Raise InvalidValueError for names that are none or given twice."""
    if not values or len(set(values)) != len(values):
        raise InvalidValueError(f"{name} {brief(values)} must be at least one name, none of them twice.")


def require_seeds(seeds: tuple[int, ...]) -> None:
    """Raise InvalidValueError for seeds that are none, equal or out of range, and for tuning among reported ones."""
    if not seeds or len(set(seeds)) != len(seeds) or not all(0 <= seed < SEEDS for seed in seeds):
        raise InvalidValueError(f"seeds {brief(seeds)} must be one or more different integers from 0 to {SEEDS - 1}.")
    if len({is_tuning_seed(seed) for seed in seeds}) > 1:
        raise InvalidValueError(
            f"seeds {seeds} mix tuning seeds (from {TUNING_SEEDS} on, tested on starts of their own) with "
            "reported ones; give them to separate benches."
        )
