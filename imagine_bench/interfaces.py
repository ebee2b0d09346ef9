"""The vocabulary that tasks, agents and the bench share: numpy and the standard library only.

A *task* offers frames, macro-actions and exact rules; an *agent* offers actions; the *bench* knows both by these
interfaces alone. What agents may offer beyond that is in :mod:`.capabilities`. Shapes: ``H = W = 64`` pixels, ``A``
actions, ``M`` coordinates of a macrostate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import InvalidValueError, UnknownNameError, require_known
from imagine_bench.seeding import SeedTree

Frame = NDArray[np.uint8]  #: what the agent sees. Shape (64, 64, 3), upright, RGB.
Macrostate = NDArray[np.int64]  #: the discrete state of a task, one integer a coordinate. Shape (M,).
State = tuple[int, ...]  #: a macrostate that can be a key. Length M.
Floats = NDArray[np.float64]

APPEARANCES = ("clean", "mild", "strong", "photo")
HELD_OUT: Mapping[str, str] = {"photo": "photo_held_out"}
"""By each appearance of finitely many looks, that of the looks kept for tests; training has none of them."""
EXECUTIONS = ("physics", "kinematic")
SENSES = ("true", "nominal")
DEVICES = ("cpu", "cuda")
OBSERVATIONS = ("frame", "human", "state", "proprio")
"""Parts of what an environment of ours can show of one moment."""
PROPRIO_SIZE = 16
"""Joints, fingers, and the tool's position and quaternion."""
FRAME_PX, OBSERVATION_SIZES_PX = 64, (32, 256)
"""Edge of a frame; smallest and largest edge of an image that is observed instead."""


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
    """What decides whether a grasp holds. The defaults are the scene as it is built, to the bit.

    Errors of the planner are drawn from the environment's generator, anew for each macro-action and only where they
    are not 0. How far each may go is measured by ``imagine-bench margins``.

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
        require_known("sense", self.sense, SENSES)

    @classmethod
    def of(cls, given: PhysicsSettings | Mapping[str, Any]) -> PhysicsSettings:
        """From settings, or a mapping of some fields' names to values; errors as above, and for an unknown name."""
        if isinstance(given, PhysicsSettings):
            return given
        if not isinstance(given, Mapping):
            raise InvalidValueError(f"Physics {given!r} is no mapping; give some of {', '.join(cls.__annotations__)}.")
        for name in given:
            if name not in cls.__annotations__:
                raise UnknownNameError("physics setting", name, cls.__annotations__)
        return cls(**given)


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """What an agent is given before it acts."""

    #: the camera image, uint8. Shape (64, 64, 3), or as the protocol says (size, size, 3), or (0, 0, 3) for none
    frame: Frame
    #: the true state, only for agents registered as privileged, as the next; None for every other
    macrostate: Macrostate | None = None
    shown: Macrostate | None = None  #: what ``frame`` shows of the macrostate it was taken of, -1 for what it hides
    #: other parts of :data:`OBSERVATIONS` that the protocol shows, by name; no agent that takes frames alone gets any
    more: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, seen: Any, info: Mapping[str, Any], *, privileged: bool) -> Observation:
        """What an agent may see of a frame, or of parts by name; of ``info`` only if it is privileged."""
        more = {name: part for name, part in seen.items() if name != "frame"} if isinstance(seen, Mapping) else {}
        frame = seen.get("frame", np.zeros((0, 0, 3), dtype=np.uint8)) if isinstance(seen, Mapping) else seen
        if not privileged:
            return cls(frame=frame, more=more)
        macrostate = np.asarray(info["macrostate"])
        return cls(frame=frame, macrostate=macrostate, shown=np.asarray(info.get("shown", macrostate)), more=more)


@dataclass(frozen=True, slots=True, kw_only=True)
class Transition:
    """One real macro-action and what it led to. ``terminated`` stops bootstrapping, ``truncated`` does not."""

    observation: Observation
    action: int
    reward: float
    next_observation: Observation
    terminated: bool
    truncated: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """One possible result of a macro-action according to the rules."""

    probability: float  #: in (0, 1]; those of one (macrostate, action) sum to 1
    macrostate: State  #: the next macrostate, a tuple of M integers
    reward: float  #: the reward of this transition
    terminated: bool  #: whether the episode ends here
    success: bool  #: whether it ends as a success


class Rules(Protocol):
    """The macrostate machine of a task: no physics, no pixels, exact."""

    @property
    def n_actions(self) -> int:
        """Number of macro-actions A."""

    @property
    def states(self) -> tuple[State, ...] | None:
        """Every macrostate the machine knows, terminal ones included; None: those that are reached from the starts."""

    @property
    def start_states(self) -> tuple[State, ...]:
        """The macrostates an episode may start in, equally likely."""

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        """Every possible result of ``action``, also out of a terminal macrostate: there its dynamics hold too."""

    def judge(self, macrostate: State, action: int, reached: State) -> Outcome:
        """What the rules give for ``reached`` as it was read back, also where a fault led somewhere unexpected."""

    def is_legal(self, macrostate: State) -> bool:
        """Whether ``macrostate`` breaks no rule."""

    def is_terminal(self, macrostate: State) -> bool:
        """Whether no episode goes on from ``macrostate``."""

    def optimal_action(self, macrostate: State) -> int:
        """An action of an optimal policy (the lowest index among equals)."""


class Sight(Protocol):
    """What frames show of the macrostates of a task, exactly."""

    @property
    def lag(self) -> int:
        """Macro-actions that a frame is old, at least 0: after t of them the agent sees that of max(0, t - lag)."""

    def seen(self, macrostate: State, step: int) -> tuple[tuple[float, State], ...]:
        """What a frame of ``macrostate`` may show, with probabilities that sum to 1; -1 for a hidden coordinate.

        ``step`` macro-actions of the episode were done when the frame was taken; it is delivered ``lag`` later.
        """


@dataclass(frozen=True, kw_only=True)
class RuleFacts:
    """What the rules alone say about a task, computed by enumeration."""

    chance_level: float  #: success probability of a uniformly random agent within the horizon
    optimum: float  #: largest success probability of any policy within the horizon
    optimal_return: float  #: mean undiscounted return of an optimal agent over the start states
    mean_plan_length: float  #: mean number of actions of an optimal agent over the start states


class RenderMacrostates(Protocol):
    """Frames of given macrostates in the kinematic mode, for encoders, probes and comparisons."""

    def __call__(self, macrostates: NDArray[np.int64], appearance: str, rng: np.random.Generator) -> Frame:
        """Render ``macrostates`` (N, M) at an appearance level to frames (N, 64, 64, 3), uint8."""


@dataclass(frozen=True, kw_only=True)
class PerformanceTargets:
    """What ``make speed`` holds a task in contact physics to."""

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
    facts: Callable[[], RuleFacts]  #: what the rules say, as a function (enumerating costs a moment)
    render_macrostates: RenderMacrostates  #: frames of macrostates, kinematic mode
    reference: str | None = None  #: name of the thesis' table in :mod:`imagine_bench.reference`, or None
    config_group: str = "chapter_5"  #: config group of learners' settings: the thesis' chapter that the task is from
    #: what each protocol preset changes for this task: fields of the protocol by preset
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    success_threshold: float = 0.95  #: success rate, in (0, 1], at which the task counts as learned
    #: what ``make speed`` measures it against; None for a task whose scene another one measures
    targets: PerformanceTargets | None = None
    sight: Sight | None = None  #: what frames show; None: each the whole macrostate of its own moment
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
        """What a probe reads in a frame that shows this, -1 for what it hides. Length M.

        A hidden coordinate is read as one more than its last value.
        """
        pairs = zip(self.macrostate_values, shown, strict=True)
        return tuple(len(values) if value < 0 else int(value) for values, value in pairs)


def appearance_of_tests(appearance: str) -> str:
    """The appearance that tests have where training has ``appearance``."""
    return HELD_OUT.get(appearance, appearance)


def bundled_name(encoder: str, appearance: str, kind: str) -> str:
    """Name of a bundled encoder: ``"arrow_puzzle-clean"`` gives latents, ``"arrow_puzzle-clean-codes"`` codes."""
    return f"{encoder}-{appearance}" if kind == "latents" else f"{encoder}-{appearance}-{kind}"


@dataclass(frozen=True, kw_only=True)
class ExactWorld:
    """What a perfect world model would know: for privileged controls."""

    rules: Rules  #: the macrostate machine
    #: frames (N, 64, 64, 3) of macrostates (N, M), as training shows them
    render: Callable[[NDArray[np.int64], np.random.Generator], Frame]

    @classmethod
    def of(cls, spec: TaskSpec, appearance: str) -> ExactWorld | None:
        """That of a task at an appearance; None where frames hide something, so that no frame is a state."""
        if spec.sight is not None:
            return None
        return cls(rules=spec.rules, render=lambda states, rng: spec.render_macrostates(states, appearance, rng))


@dataclass(frozen=True, kw_only=True)
class AgentContext:
    """What an agent is built from; it learns nothing else about its task."""

    n_actions: int  #: number of macro-actions A
    preprocessing: str  #: name of the task's declared observation preprocessing
    encoder: Path | None  #: the encoder artefact (``.safetensors``), or None for agents that need none
    seeds: SeedTree  #: the agent's node of the seed tree
    config_group: str = "chapter_5"  #: name of the config group of settings, as the task names it
    hyperparameters: str = "fast"  #: name of the group's set of values (``"minimal"``, ``"fast"`` or ``"published"``)
    #: single settings that replace the set's, by dotted name
    overrides: Mapping[str, Any] = field(default_factory=dict)
    device: str = "cpu"  #: a torch device name, ``"cpu"`` or ``"cuda"``
    #: makes an optimal policy, which says what to do after what is shown and so many macro-actions of an episode; only
    #: for agents registered as privileged, None for every other
    optimal_policy: Callable[[], Callable[[State, int], int]] | None = None
    exact_world: ExactWorld | None = None  #: only for agents registered as privileged, and where frames hide nothing
    #: shape of each part of an observation, by its name in :data:`OBSERVATIONS`
    observation: Mapping[str, tuple[int, ...]] = field(default_factory=lambda: {"frame": (FRAME_PX, FRAME_PX, 3)})


@dataclass(frozen=True, kw_only=True)
class AgentState:
    """All that an agent needs to go on as if never interrupted: weights, optimisers, memories, generators, counters."""

    arrays: dict[str, NDArray[Any]]  #: named numpy arrays; they become one safetensors file
    values: dict[str, Any]  #: JSON-serialisable values


class FrameEncoder(Protocol):
    """A representation of frames that another package offers, such as the features of a frozen network.

    It may also have ``decode``, from latents (N, Z) to pictures (N, H, W, 3) or (N, H, W) in [0, 1]; and
    ``code_sizes``, the numbers of values of factors whose one-hot codes, one behind the other, its latents are.
    """

    def encode(self, frames: Frame) -> NDArray[np.floating[Any]]:
        """Latents (N, Z), finite, of frames (N, 64, 64, 3); equal frames have equal latents, and Z never changes."""


class Agent(Protocol):
    """A learner, or a fixed policy, seen by the runner. One agent lives through one run."""

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Choose a macro-action in [0, A); ``explore=False`` changes nothing and is random only in random agents."""

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Take in one real transition of training episode ``episode`` (from 0) and learn from it."""

    def diagnostics(self) -> dict[str, float]:
        """Means since the last call, by slashed name: ``imagination/acceptance_rate``, ``time/model_s``, ..."""

    def state(self) -> AgentState:
        """A snapshot for a checkpoint; later learning does not alter it."""

    def restore(self, state: AgentState) -> None:
        """Continue from ``state``, bit for bit; ArtefactError names the first difference of one that does not fit."""


@dataclass(frozen=True, kw_only=True)
class Shape3D:
    """One drawable part of a scene, fixed to a body."""

    name: str  #: unique element name
    body: str  #: name of the body it moves with
    #: ``"box"`` (half sizes), ``"sphere"`` (radius), ``"capsule"`` / ``"cylinder"`` (radius, half length),
    #: ``"ellipsoid"`` (radii) or ``"mesh"``
    kind: str
    size: NDArray[np.float64]  #: as ``kind`` says, in metres. Shape (3,), unused entries 0.
    pose_in_body: NDArray[np.float64]  #: position (m) and quaternion (w, x, y, z). Shape (7,).
    rgba: NDArray[np.float64]  #: in [0, 1]. Shape (4,).
    vertices: NDArray[np.float64] | None = None  #: for meshes, (V, 3) in metres; else None
    faces: NDArray[np.int64] | None = None  #: for meshes, (F, 3) vertex indices; else None


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How the bodies of a scene moved during one macro-action."""

    body_names: tuple[str, ...]  #: one a body. Length B.
    time_s: NDArray[np.float64]  #: seconds since the macro-action began, ascending. Shape (K,).
    poses_in_world: NDArray[np.float64]  #: position (m) and quaternion (w, x, y, z). Shape (K, B, 7).


@dataclass(frozen=True, kw_only=True)
class ArmMotion:
    """How the arm moved during one macro-action; joints from the base to the wrist, what is commanded holds from then.

    Rows are the samples of :class:`Motion`: ``capture_motion_hz`` a second, and the last moment.
    """

    time_s: NDArray[np.float64]  #: seconds since the macro-action began, ascending. Shape (K,).
    joint_rad: NDArray[np.float64]  #: Shape (K, 7).
    joint_rad_s: NDArray[np.float64]  #: Shape (K, 7).
    gripper_m: NDArray[np.float64]  #: each finger's distance from the grip's middle. Shape (K, 2).
    joint_command_rad: NDArray[np.float64]  #: what the servos are told, feed-forward included. Shape (K, 7).
    gripper_command_m: NDArray[np.float64]  #: the same of the fingers. Shape (K, 2).
    #: the point between the fingers: position (m) and quaternion (w, x, y, z). Shape (K, 7).
    tcp_in_world: NDArray[np.float64]


@runtime_checkable
class ArmReader(Protocol):
    """An environment (``env.unwrapped``) with an arm whose motion can be read."""

    capture_motion_hz: float  #: samples of the motion a second kept during :meth:`step`; 0 keeps none

    def arm_motion(self) -> ArmMotion:
        """The latest macro-action's as captured; where nothing was, one sample of the standing scene (K = 1)."""

    def agent_film(self) -> Frame:
        """What the agent's camera sees at each sample. Shape (K, 64, 64, 3)."""


@runtime_checkable
class SceneReader(Protocol):
    """An environment (``env.unwrapped``) whose scene can be drawn elsewhere, such as in Rerun."""

    capture_motion_hz: float  #: samples of the motion a second kept during :meth:`step`; 0 keeps none

    def shapes(self) -> tuple[Shape3D, ...]:
        """Every drawable part, arm included."""

    def motion(self) -> Motion:
        """The motion of the latest macro-action; after ``reset`` one sample of the standing scene."""

    def agent_view(self) -> Frame:
        """The frame that agents see, drawn now. Shape (64, 64, 3)."""

    def human_view(self, width: int = 640, height: int = 480) -> Frame:
        """An image of the whole scene with the arm. Shape (height, width, 3)."""

    def film(self, width: int = 640, height: int = 480) -> Frame:
        """Images of the whole scene during the latest macro-action, as captured. Shape (K, height, width, 3)."""
