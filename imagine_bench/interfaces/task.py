"""The interface of a task: everything the bench needs to know of it. Numpy and the standard library only.

Shapes: ``A`` macro-actions, ``M`` coordinates of a macrostate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from imagine_bench.appearance import STORED_AS
from imagine_bench.arrays import Frame, Ints, Macrostate, State
from imagine_bench.errors import InvalidValueError, UnknownNameError, brief, require_known
from imagine_bench.rules import RuleFacts, Rules
from imagine_bench.values import Setting

EXECUTIONS = ("physics", "kinematic")
SENSES = ("true", "nominal")
PHYSICS_RANGES: Mapping[str, tuple[float, float]] = {
    "pad_friction": (0.0, 10.0),
    "finger_force_n": (0.0, 100.0),
    "object_mass": (0.01, 100.0),
    "plan_error_mm": (0.0, 100.0),
    "plan_error_deg": (0.0, 90.0),
}
"""Lowest and highest value of each number in :class:`PhysicsSettings`."""


@dataclass(frozen=True, kw_only=True)
class PhysicsSettings:
    """The physics of grasping. The defaults are the scene as it is built, to the bit.

    Errors of the planner are drawn from the environment's generator, anew for each macro-action and only where they
    are not 0. How far each may go is measured by ``imagine-bench check --physics``.

    Raises:
        InvalidValueError: A number out of its range in :data:`PHYSICS_RANGES`.
        UnknownNameError: An unknown ``sense``.
    """

    pad_friction: float = 1.2  #: sliding friction coefficient of the fingertips; that against twisting in proportion
    finger_force_n: float = 30.0  #: the most that each finger's servo exerts, N; a grip asks for 12 to 13 N
    object_mass: float = 1.0  #: times the mass of every loose object
    plan_error_mm: float = 0.0  #: the planner takes the object to be so far aside, mm, in a direction that is drawn
    plan_error_deg: float = 0.0  #: and turned by so much about the vertical, degrees, to a side that is drawn
    #: the planner uses true poses of objects, or ("nominal") where a perfect execution would have left them
    sense: str = SENSES[0]

    def __post_init__(self) -> None:
        for name, (low, high) in PHYSICS_RANGES.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise InvalidValueError(f"Physics setting {name} is {value!r}; give a number from {low:g} to {high:g}.")
            object.__setattr__(self, name, float(value))  # 1 and 1.0 are one setting, with one hash
        require_known("sense", self.sense, SENSES)

    @classmethod
    def of(cls, given: PhysicsSettings | Mapping[str, Any]) -> PhysicsSettings:
        """From settings, or a mapping of some fields' names to values; errors as above, and for an unknown name."""
        if isinstance(given, PhysicsSettings):
            return given
        if not isinstance(given, Mapping):
            raise InvalidValueError(
                f"Physics {brief(given)} is no mapping; give some of {', '.join(cls.__annotations__)}."
            )
        for name in given:
            if name not in cls.__annotations__:
                raise UnknownNameError("physics setting", name, cls.__annotations__)
        return cls(**{name: value.item() if isinstance(value, np.generic) else value for name, value in given.items()})


class ObservationModel(Protocol):
    """The content of frames for the macrostates of a task, exactly."""

    @property
    def lag(self) -> int:
        """Macro-actions that a frame is old, at least 0: after t of them the agent sees that of max(0, t - lag)."""

    def seen(self, macrostate: State, step: int) -> tuple[tuple[float, State], ...]:
        """The content of a frame of ``macrostate``, with probabilities that sum to 1; -1 for a hidden coordinate.

        ``step`` macro-actions of the episode were done when the frame was taken; it is delivered ``lag`` later.
        """


class RenderMacrostates(Protocol):
    """Frames of given macrostates in the kinematic mode, for encoders, probes and comparisons."""

    def __call__(self, macrostates: Ints, appearance: str, rng: np.random.Generator) -> Frame:
        """Render ``macrostates`` (N, M) at an appearance level to frames (N, 64, 64, 3), uint8."""


@dataclass(frozen=True, kw_only=True)
class PerformanceTargets:
    """The targets of ``imagine-bench check TASK --physics`` for a task in contact physics."""

    objects: tuple[str, ...]  #: bodies of the loose objects; coordinate i of a macrostate is object i's
    as_ruled: float  #: least share of random macro-actions that end exactly as the rules say, at clean
    as_ruled_varied: float = 0.995  #: the same at every other appearance
    other_objects_mm: float  #: an object that an action leaves where it stands moves by less
    #: the object acted on ends nearer to where a perfect execution leaves it, 99 times of 100; None asks for nothing
    error_mm: float | None = None
    error_deg: float | None = None  #: the same for its yaw
    physics_per_cpu_s: float  #: least macro-actions with planning, physics and frame
    kinematic_per_cpu_s: float  #: least macro-actions in the kinematic mode, with frame
    #: least share of fresh frames whose macrostate the bundled encoder's probe reads right, by appearance
    encoders: Mapping[str, float]
    goes_on: bool = False  #: whether a walk is measured through ends without a reset, so that errors could add up


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """Everything the bench needs to know of a task. Building one is cheap: MuJoCo loads on the first frame."""

    id: str  #: registry name, such as ``"arrow_puzzle"``
    title: str  #: a few words for headings
    description: str  #: two sentences for a reader of the report
    env_id: str  #: Gymnasium id
    horizon: int  #: macro-actions before truncation
    action_names: tuple[str, ...]  #: one a action, in order. Length A.
    macrostate_names: tuple[str, ...]  #: one a coordinate. Length M.
    #: the names of each coordinate's values; their counts give its cardinality
    macrostate_values: tuple[tuple[str, ...], ...]
    preprocessing: str  #: a name of :mod:`imagine_bench.preprocessing`
    encoder: str  #: base name of the bundled encoders, one an appearance level (``"<encoder>-<appearance>"``)
    rules: Rules  #: the macrostate machine
    facts: Callable[[], RuleFacts]  #: the facts of the rules, as a function (enumerating costs a moment)
    render_macrostates: RenderMacrostates  #: frames of macrostates, kinematic mode
    reference: str | None = None  #: name of the thesis' table in :mod:`imagine_bench.reference`, or None
    config_group: str = "chapter_5"  #: config group of learners' settings: the thesis' chapter that the task is from
    #: the changes of each protocol preset for this task: fields of the protocol by preset
    presets: Mapping[str, Mapping[str, Setting]] = field(default_factory=dict)
    success_threshold: float = 0.95  #: success rate, in (0, 1], at which the task counts as learned
    #: the limits that ``check --physics`` compares it with; None for a task whose scene another one measures
    targets: PerformanceTargets | None = None
    sight: ObservationModel | None = None  #: the content of frames; None: each the whole macrostate of its own moment
    executions: tuple[str, ...] = EXECUTIONS  #: how macro-actions can happen, the usual way first

    def execution(self, asked: str | None) -> str:
        """How macro-actions are to happen: as asked for, or the usual way. UnknownNameError: not in this world."""
        return self.executions[0] if asked is None else require_known("execution", asked, self.executions)

    @property
    def n_actions(self) -> int:
        """Number of macro-actions A."""
        return len(self.action_names)

    def value_names(self, macrostate: Sequence[int] | Macrostate) -> tuple[str, ...]:
        """The names of a macrostate's values, one a coordinate, "not seen" for any other. Length M."""
        pairs = zip(self.macrostate_values, macrostate, strict=True)
        return tuple(names[int(value)] if 0 <= value < len(names) else "not seen" for names, value in pairs)

    def as_observed(self, shown: Sequence[int] | Macrostate) -> State:
        """The values that a probe reads in a frame that shows this, -1 for a hidden coordinate. Length M.

        A hidden coordinate is read as one more than its last value.
        """
        pairs = zip(self.macrostate_values, shown, strict=True)
        return tuple(len(values) if value < 0 else int(value) for values, value in pairs)


def bundled_name(encoder: str, appearance: str, kind: str) -> str:
    """Name of a bundled encoder: ``"arrow_puzzle-clean"`` gives latents, ``"arrow_puzzle-clean-codes"`` codes."""
    name = f"{encoder}-{STORED_AS.get(appearance, appearance)}"
    return name if kind == "latents" else f"{name}-{kind}"
