"""Studies: variants of one comparison, one factor changed at a time, through the ordinary bench.

A study chooses settings, so it runs on tuning seeds, which are tested on starts of their own; what it finds is then
confirmed by an ordinary bench on seeds that no study may use. The protocol holds the two apart.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.appearance import appearance_name
from imagine_bench.errors import ImagineBenchError, InvalidValueError, brief, require_known
from imagine_bench.interfaces import Rules
from imagine_bench.judge.causes import expected_rightly
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import ProtocolData, require_types
from imagine_bench.protocols.runs import Encoders
from imagine_bench.registry import has_task
from imagine_bench.registry import task as registered
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.launchers.jobs import Launcher
from imagine_bench.running.task_types import task_type
from imagine_bench.seeding import TUNING_SEEDS, is_tuning_seed
from imagine_bench.statistics import Estimate, difference
from imagine_bench.store.results import BenchResult, RunResult

BASE = "base"
"""Name of the factor of what the other variants are compared with."""
_FIXED = {
    "task",
    "preset",
    "agents",
    "seeds",
    "budgets",
    "evaluation_episodes",
    "overrides",
    "settings_digest",
    "codes",
}
_VARIED = sorted({field.name for field in dataclasses.fields(Protocol)} - _FIXED)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One line of a study."""

    name: str  #: Unique within the study
    factor: str  #: What it varies, :data:`BASE` for a reference
    agent: str  #: Registered agent
    against: str | None = None  #: Name of the variant whose success its own is compared with, or None
    settings: Mapping[str, Any] = field(default_factory=dict)  #: Agent settings, by dotted name
    #: What it changes of the study's protocol, by field: appearance, test_appearance, execution, physics, queries, ...
    world: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_types(self)
        for name in self.world:
            require_known("field that a variant may change", name, _VARIED)


@dataclass(frozen=True, kw_only=True)
class Study:
    """What a study runs. Raises InvalidValueError: a name given twice, a comparison with nothing, a reported seed."""

    name: str  #: Its name on the command line
    question: str  #: One sentence for the reader of its page
    budgets: tuple[int, ...]  #: Real training episodes, ascending
    seeds: tuple[int, ...] = (1000, 1001, 1002)  #: Tuning seeds
    evaluation_episodes: int = 300  #: Test episodes at each budget
    appearance: str = "clean"  #: Appearance level
    execution: str = "kinematic"  #: ``"physics"`` or ``"kinematic"``
    variants: tuple[Variant, ...]  #: What is compared
    preset: str = "quick"  #: Preset whose settings the variants change

    def __post_init__(self) -> None:
        require_types(self)
        if not re.fullmatch(r"[\w.-]{1,60}", self.name):
            raise InvalidValueError(f"Study {brief(self.name)}: a name is 1 to 60 letters, digits, '_', '-' or '.'.")
        names = [variant.name for variant in self.variants]
        if not names or len(set(names)) != len(names):
            raise InvalidValueError(f"Study {self.name!r} has the variants {names}; give at least one, each name once.")
        for variant in self.variants:
            if variant.against not in (None, *names):
                raise InvalidValueError(
                    f"Variant {variant.name!r} is compared with {variant.against!r}, which the study lacks: {names}."
                )
        reported = [seed for seed in self.seeds if not is_tuning_seed(seed)]
        if reported or not self.seeds:
            raise InvalidValueError(
                f"Study {self.name!r} chooses settings on seeds {self.seeds}; give seeds from {TUNING_SEEDS} on, which "
                "are tested on starts of their own."
            )

    def only(self, names: tuple[str, ...]) -> Study:
        """The study with the named variants, or all, and those they are compared with. Raises UnknownNameError."""
        known = {variant.name: variant for variant in self.variants}
        wanted = {require_known("variant", name, known) for name in names} or set(known)
        while True:
            more = {str(known[name].against) for name in wanted if known[name].against} - wanted
            if not more:
                break
            wanted |= more
        return replace(self, variants=tuple(variant for variant in self.variants if variant.name in wanted))


@dataclass(frozen=True, kw_only=True)
class Line:
    """What a variant reached."""

    variant: Variant  #: Which
    success: NDArray[np.float64]  #: Success shares. Shape (seeds, budgets).
    #: What the model holds rightly of one macro-action, :func:`.judge.causes.expected_rightly`; NaN where it cannot be
    #: asked. Shape (seeds, budgets).
    imagined_right: NDArray[np.float64]
    train_cpu_s: float  #: Mean CPU seconds of training a run
    #: Against the variant it is compared with, one a budget; None where it is compared with nothing.
    difference: tuple[Estimate, ...] | None
    folder: Path  #: Where its runs lie
    environment: Mapping[str, Any]  #: Command, commit, versions and machine of its first session; JSON-like


def load_study(path: Path) -> Study:
    """A study from a TOML or JSON file, whose keys are the fields of :class:`Study` and :class:`Variant`.

    It is called as its file, and a variant's factor is :data:`BASE`, where the file does not say otherwise. Nested
    settings have dotted names.

    Raises:
        InvalidValueError: It cannot be read, or a field is missing, unknown or of another type.
    """
    try:
        text = path.read_text()
        data = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
        variants = tuple(Variant(**{"factor": BASE, **each, "settings": _dotted(each)}) for each in data["variants"])
        return Study(**{"name": path.stem, **data, "variants": variants})
    except ImagineBenchError as error:
        raise InvalidValueError(f"{path}: {error}") from error
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InvalidValueError(
            f"{path} is not a study: {type(error).__name__}: {error}. Give {', '.join(Study.__annotations__)} and "
            f"[[variants]] with {', '.join(Variant.__annotations__)}, as TOML or JSON."
        ) from error


def _dotted(variant: Mapping[str, Any]) -> dict[str, Any]:
    """A variant's settings, nested or not, by dotted name."""
    found: dict[str, Any] = {}
    left = list(variant.get("settings", {}).items())
    while left:
        name, value = left.pop()
        if isinstance(value, Mapping):
            left += [(f"{name}.{inner}", each) for inner, each in value.items()]
        else:
            found[name] = value
    return found


def run_study(study: Study, task: str, *, root: Path, launcher: Launcher) -> tuple[Line, ...]:
    """Run what is missing of every variant and compare; errors as of :func:`imagine_bench.running.bench.bench`."""
    if not has_task(task):
        task_type(task)  # knows every name
        raise InvalidValueError(f"{task} is learned from data; a study compares agents that act. Give a control task.")
    planned = [(variant, *_plan(study, task, variant)) for variant in study.variants]  # all checked before any is run
    results: dict[str, BenchResult] = {}
    for variant, protocol, paths in planned:
        result = bench(protocol, paths, root=root, launcher=launcher)
        assert isinstance(result, BenchResult), "of a control task"
        results[variant.name] = result
    success = {variant.name: results[variant.name].success_rates(variant.agent) for variant in study.variants}
    return tuple(
        Line(
            variant=variant,
            success=success[variant.name],
            imagined_right=_imagined_right(registered(task).rules, results[variant.name].of(variant.agent)),
            train_cpu_s=float(np.mean([run.checkpoints[-1].train_cpu_s for run in results[variant.name].runs])),
            difference=None if variant.against is None else _differences(study, variant, success),
            folder=results[variant.name].folder,
            environment=results[variant.name].environment,
        )
        for variant in study.variants
    )


def _imagined_right(rules: Rules, runs: Sequence[RunResult]) -> NDArray[np.float64]:
    return np.array([
        [math.nan if row.beliefs is None else expected_rightly(rules, row.beliefs) for row in run.checkpoints]
        for run in runs
    ])  # fmt: skip


def _plan(study: Study, task: str, variant: Variant) -> tuple[ProtocolData, Encoders]:
    world = {"execution": study.execution, "appearance": study.appearance, **variant.world}
    world["appearance"] = appearance_name(world["appearance"])
    world |= {name: tuple(sorted(value.items())) for name, value in world.items() if isinstance(value, Mapping)}
    return plan(
        task, study.preset, agents=(variant.agent,), seeds=study.seeds, budgets=study.budgets,
        evaluation_episodes=study.evaluation_episodes, overrides=tuple(sorted(variant.settings.items())),
        **{"open_loop_starts": 0, "recorded_episodes": 0, **world},
    )  # fmt: skip


def _differences(study: Study, variant: Variant, success: Mapping[str, NDArray[np.float64]]) -> tuple[Estimate, ...]:
    ours, theirs = success[variant.name], success[str(variant.against)]
    return tuple(
        difference(ours[:, index], theirs[:, index], trials=study.evaluation_episodes)
        for index, budget in enumerate(study.budgets)
    )
