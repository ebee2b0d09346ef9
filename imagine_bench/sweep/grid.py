"""The two kinds of grid, how they are read from TOML or JSON files, and those that have a name.

A study compares variants of agents on one task. It chooses settings, so it runs on tuning seeds, which are tested on
starts of their own; an ordinary bench on other seeds then confirms its findings. A suite scores agents in experiments,
each of which changes one world parameter over a few levels (after bsuite, Osband et al. 2020).
"""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, InvalidValueError, brief, require_known, why
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import digest, require_seeds, require_types
from imagine_bench.registry.entries import each_once
from imagine_bench.seeding import TUNING_SEEDS, is_tuning_seed
from imagine_bench.values import Setting, dotted

Member = TypeVar("Member", "Variant", "Experiment")
BASE = "base"
"""Name of the factor of a variant that others are compared with."""
MEASURES = ("success", "auroc")
"""``"success"`` of test episodes, between a level's exact chance and optimum; or ``"auroc"``, with which epistemic
uncertainty tells wrong imagined transitions from right ones, between 0.5 and 1."""
_OF_GRID = {
    "task",
    "preset",
    "agents",
    "seeds",
    "few_seeds",
    "evaluation_episodes",
    "settings_digest",
    "codes",
    "code",
    "agent_names",
}
"""Fields of a protocol that a grid sets alike for all its members."""
_OF_LEVEL = sorted({each.name for each in dataclasses.fields(Protocol)} - _OF_GRID)
_VARIED = sorted({*_OF_LEVEL} - {"budgets", "overrides"})


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One line of a study."""

    name: str  #: Unique within the study
    factor: str = BASE  #: The factor that it varies, :data:`BASE` for a reference
    agent: str  #: Registered agent
    against: str | None = None  #: Name of the variant whose success its own is compared with, or None
    settings: Mapping[str, Setting] = field(default_factory=dict)  #: Agent settings, by dotted name
    #: Fields of the protocol that differ from the study's: appearance, execution, physics, queries, ...
    world: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_types(self)
        for name in self.world:
            require_known("field that a variant may change", name, _VARIED)


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study.

    Raises InvalidValueError: a name or a seed given twice, a comparison with nothing, or a seed of reported runs.
    """

    name: str  #: Its name on the command line
    question: str  #: One sentence for the reader of its page
    budgets: tuple[int, ...]  #: Real training episodes, ascending
    seeds: tuple[int, ...] = (1000, 1001, 1002)  #: Tuning seeds
    evaluation_episodes: int = 300  #: Test episodes at each budget
    appearance: str = "clean"  #: Appearance level
    execution: str = "kinematic"  #: ``"physics"`` or ``"kinematic"``
    variants: tuple[Variant, ...]  #: The lines that are compared
    preset: str = "quick"  #: Preset whose settings the variants change

    def __post_init__(self) -> None:
        require_types(self)
        names = _require_names(self.name, "variants", self.variants)
        for variant in self.variants:
            if variant.against not in (None, *names):
                raise InvalidValueError(
                    f"Variant {variant.name!r} is compared with {variant.against!r}, which the study lacks: {names}."
                )
        if not self.seeds or not all(map(is_tuning_seed, self.seeds)):
            raise InvalidValueError(
                f"Study {self.name!r} chooses settings on seeds {self.seeds}; give seeds from {TUNING_SEEDS} on, which "
                "are tested on starts of their own."
            )
        object.__setattr__(self, "seeds", require_seeds(self.seeds))

    def only(self, names: Sequence[str]) -> Study:
        """The study with the named variants, or all, and those they are compared with. Raises UnknownNameError."""
        chosen = _chosen("variant", names, self.variants)
        for _ in self.variants:  # the variants that these are compared with may be compared with others
            against = {variant.against for variant in chosen}
            chosen = tuple(each for each in self.variants if each in chosen or each.name in against)
        return replace(self, variants=chosen)


@dataclass(frozen=True, kw_only=True)
class Level:
    """One value of an experiment's world parameter."""

    name: str  #: The value, for axes and tables
    task: str  #: Canonical name of the world
    episodes: int = 250  #: Real training episodes, on this task
    #: More fields of the protocol that differ; ``budgets`` may have others before ``episodes``.
    protocol: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_types(self)
        for name in self.protocol:
            require_known("field that a level may change", name, _OF_LEVEL)
        budgets = self.protocol.get("budgets", [self.episodes])
        if not isinstance(budgets, list | tuple) or [*budgets][-1:] != [self.episodes]:
            raise InvalidValueError(f"Level {self.name!r} has {self.episodes} episodes; give budgets that end there.")
        if "@" in self.task:  # a file of options may change
            object.__setattr__(self, "task", registry.task_name(self.task))


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One capability, and the world parameter that asks for more and more of it."""

    name: str
    parameter: str  #: The world parameter, in words
    question: str  #: For a reader of the report
    levels: tuple[Level, ...]
    measure: str = "success"  #: One of :data:`MEASURES`

    def __post_init__(self) -> None:
        require_types(self)
        require_known("measure", self.measure, MEASURES)
        silent = [level.name for level in self.levels if not level.protocol.get("open_loop_starts")]
        if self.measure == "auroc" and silent:
            raise InvalidValueError(
                f"Experiment {self.name!r} measures auroc, and its levels {silent} have no rollouts to measure; give "
                "open_loop_starts in the protocol of each, such as 100."
            )


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Experiments, and the protocol fields that all of them share.

    Raises InvalidValueError: a name given twice, or seeds that no bench takes.
    """

    name: str
    experiments: tuple[Experiment, ...]
    seeds: tuple[int, ...] = (0, 1)
    evaluation_episodes: int = 100
    execution: str = "kinematic"
    hyperparameters: str = "fast"
    #: Those that are compared unless others are named
    agents: tuple[str, ...] = ("dqn", "imagination_uncertainty", "factored:given")

    def __post_init__(self) -> None:
        require_types(self)
        object.__setattr__(self, "seeds", require_seeds(self.seeds))
        _require_names(self.name, "experiments", self.experiments)
        for each in self.experiments:
            _require_names(self.name, f"levels of {each.name}", each.levels)

    @property
    def hash(self) -> str:
        """12 hex digits that change when anything in any level does; seeds and tests count, too, but not agents."""
        fields = dataclasses.asdict(self)
        del fields["agents"]
        for each in fields["experiments"]:
            each["dial"] = each.pop("parameter")  # the name that it had, so that hashes stay
        return digest(fields)

    def only(self, names: Sequence[str]) -> Suite:
        """The suite with some of its experiments, or all if none are named. Raises UnknownNameError."""
        return replace(self, experiments=_chosen("experiment", names, self.experiments))


def _chosen(what: str, names: Sequence[str], members: tuple[Member, ...]) -> tuple[Member, ...]:
    """The members of these names, in their order; all if none are named. Raises UnknownNameError."""
    known = [each.name for each in members]
    wanted = [require_known(what, name, known) for name in names or known]
    return tuple(each for each in members if each.name in wanted)


def _require_names(grid: str, what: str, members: Sequence[Variant | Experiment | Level]) -> list[str]:
    """The names of members. Raises InvalidValueError: one is given twice, there is none, or the grid's is no name."""
    if not re.fullmatch(r"[\w.-]{1,60}", grid):
        raise InvalidValueError(f"Study {brief(grid)}: a name is 1 to 60 letters, digits, '_', '-' or '.'.")
    names = [each.name for each in members]
    if not names or len(set(names)) < len(names):
        raise InvalidValueError(f"{grid} has the {what} {names}; give at least one, each name once.")
    return names


def read_grid(path: Path) -> Study | Suite:
    """A suite if the TOML or JSON file has ``experiments``, else a study; keys are the fields of the classes above.

    The name of the file is the default of ``name``. Settings may be nested; ``"none"`` as a setting is None, which
    TOML cannot say.

    Raises:
        InvalidValueError: It cannot be read, or a field is missing, unknown or of another type.
    """
    if not path.is_file():
        raise InvalidValueError(
            f"There is no file {path}; give one of a study or suite, or a name: {', '.join(GRIDS)}."
        )
    try:
        text = path.read_text()
        found = json.loads(text, object_pairs_hook=each_once) if path.suffix == ".json" else tomllib.loads(text)
        data = {"name": path.stem, **found}
        if "experiments" not in data:
            variants = [Variant(**{**each, "settings": _settings(each)}) for each in data["variants"]]
            return Study(**{**data, "variants": variants})
        experiments = []
        for each in data["experiments"]:
            if "dial" in each:  # the name that it had
                each["parameter"] = each.pop("dial")
            levels = [Level(**level) for level in each["levels"]]
            experiments.append(Experiment(**{**each, "levels": levels}))
        return Suite(**{**data, "experiments": experiments})
    except ImagineBenchError as error:
        raise InvalidValueError(f"{path}: {error}") from error
    except Exception as error:  # a file can be wrong in any way
        raise InvalidValueError(
            f"{path} is no study: {why(error)}. Give {', '.join(Study.__annotations__)} and "
            f"[[variants]] with {', '.join(Variant.__annotations__)}, as TOML or JSON; a suite has [[experiments]]."
        ) from error


def _settings(variant: Mapping[str, Any]) -> dict[str, Setting]:
    """The settings of a variant by dotted name; the word ``none`` is None, and a list a tuple."""
    found: dict[str, Setting] = {}
    for name, value in dotted(variant.get("settings", {})).items():
        found[name] = tuple(value) if isinstance(value, list) else None if value == "none" else value
    return found


SUITE = "suite"
"""Name of the suite of ``make suite``, which two cores are meant to finish within the hour."""
GRIDS = {path.stem: read_grid(path) for path in sorted((Path(__file__).parent / "grids").glob("*.toml"))}
"""The grids in ``sweep/grids``, by name."""
LADDER = GRIDS[SUITE]
registry.describe_group(registry.STUDY_GROUP, what="study", kind=Study, own=GRIDS)


def grid_named(name: str) -> Study | Suite:
    """The grid of a name, or of a file if the name ends in ``.toml`` or ``.json``.

    Raises:
        UnknownNameError: No such grid.
        InvalidValueError: The file is no grid.
        SetupError: A package offers it, and it cannot be loaded.
    """
    if name.endswith((".toml", ".json")):
        return read_grid(Path(name))
    grid: Study | Suite = registry.offered(name, GRIDS, registry.STUDY_GROUP)
    return grid


def all_grids() -> dict[str, Study | Suite]:
    """All grids by name, also those of installed packages, without those that cannot be loaded."""
    return {**GRIDS, **registry.usable(registry.STUDY_GROUP)}
