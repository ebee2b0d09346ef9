"""``imagine-bench check TASK --physics``: does physics do what the rules say, and how nearly does it fail?"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench import registry
from imagine_bench.appearance import appearance_name
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import APPEARANCES, PerformanceTargets, TaskSpec
from imagine_bench.registry.machine import describe_environment, gl_renderer
from imagine_bench.store.files import require_writable, write_json
from imagine_bench.testing.fidelity import Fidelity, measure_fidelity
from imagine_bench.testing.margins import measure_margins

_SLIPPED_MM = 5
"""An object whose macro-action slips is only squared in the fingers, and moves less than a pushed one."""
_SIGNS = {"<": operator.lt, "<=": operator.le, ">=": operator.ge}


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One measured figure: its name with the unit, its target and value as text, and whether the target is met."""

    what: str
    required: str  #: An en dash if there is no target
    measured: str
    met: bool

    @property
    def row(self) -> str:
        """Its row of a Markdown table."""
        verdict = "" if self.required == "–" else "met" if self.met else "NOT MET"
        return f"| {self.what} | {self.required} | {self.measured} | {verdict} |"


HEAD = "| what | required | measured | |\n|---|---|---|---|"
"""Head of a table of figures."""


def figure_of(
    what: str, value: float, form: str, sign: str = "", target: float | None = None, more: str = ""
) -> Figure:
    """A figure whose value must stand to its target as ``sign`` says (``"<"``, ``"<="`` or ``">="``), if it has one.

    ``form`` formats the value, and ``more`` follows it.
    """
    measured = f"{value:{form}}{more}"
    if target is None:
        return Figure(what=what, required="–", measured=measured, met=True)
    required = f"{target:.1%}" if form.endswith("%") else f"{target:,g}"
    return Figure(what=what, required=f"{sign} {required}", measured=measured, met=bool(_SIGNS[sign](value, target)))


def check_physics(
    task: str,
    out: Path,
    *,
    turns: int = 2_000,
    trials: int = 200,
    appearances: Sequence[str] = APPEARANCES[:1],
    show: Callable[[str], None] = print,
) -> bool:
    """Measure fidelity and margins of a task, show Markdown tables, and keep the figures and the machine's description.

    Args:
        task: Registered task, this suite's or an installed package's.
        out: The JSON file to write.
        turns: Macro-actions of the fidelity measurement at each appearance; 0 for none.
        trials: Macro-actions of each value of each physics setting; 0 for none.
        appearances: Appearance levels at which fidelity is measured.
        show: Takes one line of text.

    Returns:
        Whether every target of the task was met; a task without targets is only measured.

    Raises:
        InvalidValueError: Negative or no numbers of macro-actions, or a folder to write to.
        UnknownNameError: An unknown task or appearance.
        SetupError: The file cannot be written, or there is no GL.
    """
    if min(turns, trials) < 0 or turns == trials == 0:
        raise InvalidValueError(f"turns is {turns} and trials is {trials}; give at least 1 macro-action of either.")
    if out.is_dir():
        raise InvalidValueError(f"{out} is a folder; give the JSON file to write.")
    spec = registry.task(task)
    if {"physics", "kinematic"} - set(spec.executions):
        raise InvalidValueError(f"{task} has the executions {spec.executions}; physics is compared with kinematic.")
    levels = [appearance_name(each) for each in appearances]
    require_writable(out.parent)
    gl_renderer()  # fails here, in one sentence, rather than in a macro-action
    kept: dict[str, Any] = {"task": task, "seed": 0}
    figures = []
    if turns:
        show(HEAD)
        for level in levels:
            for figure in fidelity_figures(spec, turns, level):
                figures.append(figure)
                show(figure.row)
        kept["figures"] = [asdict(figure) for figure in figures]
    if trials:
        kept |= measure_margins(spec, trials, show)
    write_json(out, {**kept, "environment": describe_environment()})
    return all(figure.met for figure in figures)


def fidelity_figures(spec: TaskSpec, turns: int, appearance: str = APPEARANCES[0]) -> Iterator[Figure]:
    """Fidelity of random macro-actions, beside the task's targets if it has any."""
    targets = spec.targets
    found = measure_fidelity(spec, turns, appearance)
    clean = appearance == APPEARANCES[0]
    world = spec.id if clean else f"{spec.id} at {appearance}"
    least = None if targets is None else targets.as_ruled if clean else targets.as_ruled_varied
    what = f"{world}: macro-actions exactly as the rules say, of {turns:,}"
    yield figure_of(what, found.as_ruled / found.actions, ".2%", ">=", least)
    if targets is not None:
        yield from _of_poses(world, found, targets)
    if found.slips:
        yield from slips(world, found)


def _of_poses(world: str, found: Fidelity, targets: PerformanceTargets) -> Iterator[Figure]:
    what = f"{world}: other objects moved, worst, mm"
    yield figure_of(what, found.other_objects_mm, ".3f", "<", targets.other_objects_mm)
    for what, values, most in (
        ("position error, p99, mm", found.error_mm, targets.error_mm),
        ("yaw error, p99, degrees", found.error_deg, targets.error_deg),
    ):
        if most is not None:
            yield figure_of(f"{world}: {what}", float(np.percentile(values, 99)), ".2f", "<", most)


def slips(world: str, found: Fidelity) -> Iterator[Figure]:
    """The rate of slips, within the 99 % interval of the rules' probability, and how far objects that slip move."""
    n = len(found.slips)
    rate = float(np.mean([slipped for slipped, _ in found.slips]))
    expected = float(np.mean([probability for _, probability in found.slips]))
    low, high = scipy.stats.binom.interval(0.99, n, expected) / np.float64(n)
    yield Figure(
        what=f"{world}: macro-actions that slip, of {n:,}",
        required=f"{low:.1%} to {high:.1%}",
        measured=f"{rate:.1%}",
        met=bool(low <= rate <= high),
    )
    yield figure_of(f"{world}: objects that slip move, worst, mm", found.slipped_mm, ".2f", "<", _SLIPPED_MM)
