"""The common part of protocols of every task type, their runs, and the parts of a type of task.

A protocol is data, and a hash stands for everything in it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, Self, TypeVar, get_type_hints
from typing import Protocol as Interface

from typeguard import CollectionCheckStrategy, TypeCheckError, check_type

from imagine_bench.errors import InvalidValueError, brief, require_known
from imagine_bench.interfaces import DEVICES
from imagine_bench.registry import package_code
from imagine_bench.registry.entries import FIRST, TODAY, agent_label, edition_of, name_in_edition_1, parse_configuration
from imagine_bench.seeding import SEEDS, TUNING_SEEDS, is_tuning_seed
from imagine_bench.values import Json, Setting, has_switch, kind_in_words

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

OPTIONAL_IN_HASH: Mapping[str, bool] = {"later": True}
"""Metadata of a field that protocols did not always have: at its default it changes no hash."""
MOST = 10_000_000
"""Episodes, budgets and the like; a real robot lives to see a thousandth of it."""


def digest(values: Json) -> str:
    """Twelve hex digits that change when anything in JSON-like values does."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


_FOLDERS = frozenset({"report", "tensorboard", "wandb", "why"})
"""Folders of a bench that are no agent's."""


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
    #: :func:`digest` of every setting of every learner: a hyper-parameter set may be another one tomorrow, and a run
    #: with that one belongs to another bench. Empty in a protocol that no plan made.
    settings_digest: str = ""
    #: Digests of code by name, sorted: of each agent that was registered as a class or a function (:mod:`.by_value`),
    #: and of the package of each agent, regressor and task that is not this suite's (:func:`.registry.package_code`).
    code: tuple[tuple[str, str], ...] = field(default=(), metadata=OPTIONAL_IN_HASH)
    device: str = "cpu"  #: ``"cpu"`` or ``"cuda"``, where the agents compute: the bits of a result depend on it
    #: Edition of agents' names that files and the hash of this protocol have; ``agents`` are today's labels in any.
    #: A file says it only where names would be taken for older ones without it. See :mod:`.registry.entries`.
    agent_names: int = field(default=TODAY, metadata=OPTIONAL_IN_HASH)

    def __post_init__(self) -> None:
        """Lists become tuples, and agents and seeds are written in one way: the same comparison has one hash.

        Raises:
            InvalidValueError: A value of another type than its field's, or out of range.
        """
        require_types(self)
        object.__setattr__(self, "agents", tuple(str(parse_configuration(agent)) for agent in self.agents))
        require_known("device", self.device, DEVICES)
        object.__setattr__(self, "seeds", require_seeds(self.seeds))
        require_different("agents", self.agents)
        for agent in _FOLDERS.intersection(self.agents):
            raise InvalidValueError(f"A bench has a folder {agent!r} of its own; give the agent another name.")

    def as_dict(self) -> dict[str, Json]:
        """A JSON-serialisable copy; fields marked :data:`OPTIONAL_IN_HASH` are in it where they say something."""
        later = {field.name: field.default for field in dataclasses.fields(self) if field.metadata == OPTIONAL_IN_HASH}
        values = {n: value for n, value in dataclasses.asdict(self).items() if n not in later or value != later[n]}
        values.pop("agent_names", None)
        values["agents"] = [self.written_name(agent) for agent in self.agents]
        if self.agent_names == TODAY and edition_of(values["agents"]) == FIRST:
            values["agent_names"] = TODAY
        return json.loads(json.dumps(values))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """The inverse of :meth:`as_dict`; names of an earlier edition become today's labels."""
        names = data["agents"]
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            return cls(**data)  # its errors name the fault
        edition = edition_of(names, data.get("agent_names", FIRST))
        agents = [agent_label(agent, {"agent_names": edition}) for agent in names]
        return cls(**{**data, "agents": agents, "agent_names": edition})

    def written_name(self, agent: str) -> str:
        """The name that files of this protocol have for an agent, which is given by today's label."""
        return name_in_edition_1(agent) if self.agent_names == FIRST else agent

    @property
    def hash(self) -> str:
        """Twelve hex digits that change when anything in the protocol does."""
        return digest(self.as_dict())

    def seeds_of(self, agent: str) -> tuple[int, ...]:
        """The seeds that an agent is run with: all, where a protocol says nothing else."""
        del agent
        return self.seeds

    @property
    def runs(self) -> list[tuple[str, int]]:
        """Agent and seed of every run, seed by seed."""
        return [(agent, seed) for seed in self.seeds for agent in self.agents if seed in self.seeds_of(agent)]

    @abstractmethod
    def code_places(self) -> dict[str, str]:
        """The ``"module:attr"`` of all agents, regressors and tasks that are imported by a name, by names of
        ``code``.
        """

    @abstractmethod
    def work(self, agent: str) -> int:
        """Parts of work of a run of this agent, of whatever the protocol counts."""


def package_digests(places: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """Name and :func:`.registry.package_code` of each ``"module:attr"``, but of this suite's own."""
    return tuple((name, code) for name, place in sorted(places.items()) if (code := package_code(place)))


def require_types(one: DataclassInstance) -> None:
    """Make lists in the fields of a dataclass tuples and whole numbers floats where these are wanted, or raise
    InvalidValueError for a value of another type.
    """
    for name, hint in get_type_hints(type(one)).items():
        if isinstance(value := getattr(one, name), list):
            value = tuple(tuple(item) if isinstance(item, list) else item for item in value)
            object.__setattr__(one, name, value)
        if hint is float and type(value) is int and abs(value) <= MOST:
            object.__setattr__(one, name, float(value))
        try:
            if has_switch(value) and not re.search("bool|Any", str(hint)):
                raise TypeCheckError("true or false is no number")
            check_type(value, hint, collection_check_strategy=CollectionCheckStrategy.ALL_ITEMS)
        except TypeCheckError:
            raise InvalidValueError(f"{name} was given {brief(value)}; it takes {kind_in_words(hint)}.") from None


def require_different(name: str, values: tuple[str, ...]) -> None:
    """Raise InvalidValueError for names that are none or given twice."""
    if not values or len(set(values)) != len(values):
        raise InvalidValueError(f"{name} {brief(values)} must be at least one name, none of them twice.")


def require_seeds(seeds: tuple[int, ...]) -> tuple[int, ...]:
    """Return seeds in ascending order, as results have them.

    Raises:
        InvalidValueError: There are none, equal ones, some out of range, or tuning seeds among reported ones.
    """
    if not seeds or len(set(seeds)) != len(seeds) or not all(0 <= seed < SEEDS for seed in seeds):
        raise InvalidValueError(f"seeds {brief(seeds)} must be one or more different integers from 0 to {SEEDS - 1}.")
    if len({is_tuning_seed(seed) for seed in seeds}) > 1:
        raise InvalidValueError(
            f"seeds {brief(seeds)} mix tuning seeds (from {TUNING_SEEDS} on, tested on starts of their own) with "
            "reported ones; give them to separate benches."
        )
    return tuple(sorted(seeds))


P = TypeVar("P", bound=ProtocolData)
P_co = TypeVar("P_co", bound=ProtocolData, covariant=True)
Phase = Literal["training", "training in the model", "testing", "imagining", "recording", "done", "failed"]


@dataclass(frozen=True, kw_only=True)
class RunSpec(Generic[P_co]):
    """One run."""

    protocol: P_co  #: The comparison it belongs to
    agent: str  #: Registered agent or regressor
    seed: int  #: One of the protocol's seeds
    encoder: Path | None = None  #: The encoder artefact, or None if the agent needs none
    dataset: Path | None = None  #: The folder of the dataset that comes first, or None
    checkpoint_every_s: float = 20.0  #: Seconds of work that a kill may cost
    observers: tuple[str, ...] = ()  #: Its observers, each the ``"module:attr"`` of a :class:`.runner.RunObserver`

    @property
    def work(self) -> int:
        """Parts of work to do, of whatever the protocol counts."""
        return self.protocol.work(self.agent)


RECENT = 50
"""Training episodes whose success is shown while running."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a run is."""

    agent: str  #: Registered agent
    seed: int  #: The run's seed
    bench: str = ""  #: Hash of the run's protocol
    phase: Phase  #: Its phase
    done: int  #: Episodes played, for training and for tests
    work: int  #: Episodes to play
    episode: int = 0  #: Training episodes done
    #: Share of successes among the last :data:`RECENT` training episodes, or in the running test; None before any.
    success: float | None = None
    #: The activity of a run without episodes, or why one failed, in words; None where episodes say it.
    detail: str | None = None


OnProgress = Callable[[Progress], None]

Encoders = Mapping[str, Path]
"""The encoder artefacts of a bench, by kind, none where nothing needs one, and its ``"dataset"``, a folder."""


class FinishedRun(Interface):
    """The results of runs of every type."""

    @property
    def folder(self) -> Path:
        """Where its files lie."""

    @property
    def recording(self) -> Path | None:
        """Its Rerun recording, or None."""


class Result(Interface):
    """The results of benches of every type: one run an agent and seed, in a folder."""

    @property
    def protocol(self) -> ProtocolData:
        """The comparison, as far as it is shown."""

    @property
    def runs(self) -> Sequence[FinishedRun]:
        """One an agent and seed, each with its recording if it has one."""

    @property
    def folder(self) -> Path:
        """Where the bench's files lie."""

    @property
    def missing(self) -> Sequence[str]:
        """The missing runs of an unfinished bench, a sentence each."""


@dataclass(frozen=True, kw_only=True)
class TaskType(Generic[P]):
    """The parts of a type of task."""

    tasks: Callable[[], Mapping[str, object]]  #: Gives its tasks, by name
    learners: Callable[[], Mapping[str, object]]  #: Gives its agents or regressors, by name
    draws: bool  #: Whether its runs need OpenGL
    protocol: type[P]  #: The class of its protocols
    presets: Mapping[str, Mapping[str, Setting]]  #: The changes of each protocol preset, by name
    #: Makes a protocol from a task, a preset and changes to single fields, all checked, and finds its encoders.
    plan: Callable[..., tuple[P, Encoders]]
    run: Callable[[RunSpec[P], Path, OnProgress], object]  #: Carries out a run in a folder
    load_so_far: Callable[[Path], Result]  #: Reads a bench folder, as far as it can be reported


@dataclass(frozen=True, kw_only=True)
class Job:
    """A run and where its files go."""

    spec: RunSpec[ProtocolData]
    folder: Path

    @property
    def log(self) -> Path:
        """Everything the run printed."""
        return self.folder / "log.txt"


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A job that did not finish, and why in one sentence."""

    job: Job
    reason: str

    def __str__(self) -> str:
        spec = self.job.spec
        return f"{spec.agent} seed {spec.seed} in {spec.protocol.task}: {self.reason.rstrip('.')}. Log: {self.job.log}"

    @property
    def progress(self) -> Progress:
        """The progress of it, for an observer."""
        spec = self.job.spec
        return Progress(
            agent=spec.agent, seed=spec.seed, bench=spec.protocol.hash, phase="failed", done=0, work=spec.work,
            detail=self.reason,
        )  # fmt: skip


class Launcher(Interface):
    """Carries out jobs, somewhere."""

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job, whatever becomes of the others, and return those that failed.

        Jobs are independent of one another, and each resumes by itself. ``on_progress`` is told now and then, from this
        process, how far each is, and at once of one that failed.
        """
