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

from imagine_bench.seeding import SeedTree

Frame = NDArray[np.uint8]
"""What the agent sees. Shape (64, 64, 3), upright, RGB."""
Macrostate = NDArray[np.int64]
"""The discrete state of a task, one integer a coordinate. Shape (M,)."""
State = tuple[int, ...]
"""A macrostate that can be a key. Length M."""
Floats = NDArray[np.float64]

APPEARANCES = ("clean", "mild", "strong")
EXECUTIONS = ("physics", "kinematic")
DEVICES = ("cpu", "cuda")


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """What an agent is given before it acts.

    Attributes:
        frame: The camera image. Shape (64, 64, 3), uint8.
        macrostate: The true state, only for agents registered as privileged; None for every other.
    """

    frame: Frame
    macrostate: Macrostate | None = None


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
    """One possible result of a macro-action according to the rules.

    Attributes:
        probability: In (0, 1]; those of one (macrostate, action) sum to 1.
        macrostate: The next macrostate, a tuple of M integers.
        reward: The reward of this transition.
        terminated: Whether the episode ends here.
        success: Whether it ends as a success.
    """

    probability: float
    macrostate: State
    reward: float
    terminated: bool
    success: bool


class Rules(Protocol):
    """The macrostate machine of a task: no physics, no pixels, exact."""

    @property
    def n_actions(self) -> int:
        """Number of macro-actions A."""

    @property
    def states(self) -> tuple[State, ...]:
        """Every macrostate the machine knows, terminal ones included."""

    @property
    def start_states(self) -> tuple[State, ...]:
        """The macrostates an episode may start in, equally likely."""

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        """Every possible result of ``action`` in ``macrostate``, also out of a terminal one: the scene goes on obeying
        its dynamics there, though no episode does.
        """

    def judge(self, macrostate: State, action: int, reached: State) -> Outcome:
        """What the rules give for ``reached`` as it was read back, also where a fault led somewhere unexpected."""

    def is_legal(self, macrostate: State) -> bool:
        """Whether ``macrostate`` breaks no rule."""

    def is_terminal(self, macrostate: State) -> bool:
        """Whether no episode goes on from ``macrostate``."""

    def optimal_action(self, macrostate: State) -> int:
        """An action of an optimal policy (the lowest index among equals)."""


@dataclass(frozen=True, kw_only=True)
class RuleFacts:
    """What the rules alone say about a task, computed by enumeration.

    Attributes:
        chance_level: Success probability of a uniformly random agent within the horizon.
        optimum: Success probability of an optimal agent within the horizon.
        optimal_return: Mean undiscounted return of an optimal agent over the start states.
        mean_plan_length: Mean number of actions of an optimal agent over the start states.
    """

    chance_level: float
    optimum: float
    optimal_return: float
    mean_plan_length: float


class RenderMacrostates(Protocol):
    """Frames of given macrostates in the kinematic mode, for encoders, probes and comparisons."""

    def __call__(self, macrostates: NDArray[np.int64], appearance: str, rng: np.random.Generator) -> Frame:
        """Render ``macrostates`` (N, M) at an appearance level to frames (N, 64, 64, 3), uint8."""


@dataclass(frozen=True, kw_only=True)
class PerformanceTargets:
    """What ``make speed`` holds a task in contact physics to.

    Attributes:
        objects: Bodies of the loose objects; coordinate i of a macrostate is object i's.
        as_ruled: Least share of random macro-actions that end exactly as the rules say.
        other_objects_mm: An object that an action leaves where it stands moves by less.
        error_mm: The object acted on ends nearer to where a perfect execution leaves it, 99 times of 100; None asks
            for nothing.
        error_deg: The same for its yaw.
        physics_per_cpu_s: Least macro-actions with planning, physics and frame.
        kinematic_per_cpu_s: Least macro-actions in the kinematic mode, with frame.
        encoders: Least share of fresh frames whose macrostate the bundled encoder's probe reads right, by appearance.
        goes_on: Whether a walk is measured through ends without a reset, so that errors could add up.
    """

    objects: tuple[str, ...]
    as_ruled: float
    other_objects_mm: float
    error_mm: float | None = None
    error_deg: float | None = None
    physics_per_cpu_s: float
    kinematic_per_cpu_s: float
    encoders: Mapping[str, float]
    goes_on: bool = False


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """Everything the bench needs to know of a task. Building one is cheap: MuJoCo loads on the first frame.

    Attributes:
        id: Registry name, such as ``"arrow_puzzle"``.
        title: A few words for headings.
        description: Two sentences for a reader of the report.
        env_id: Gymnasium id.
        horizon: Macro-actions before truncation.
        action_names: One a action, in order. Length A.
        macrostate_names: One a coordinate. Length M.
        macrostate_values: The names of each coordinate's values; their counts give its cardinality.
        preprocessing: A name of :mod:`imagine_bench.preprocessing`.
        encoder: Base name of the bundled encoders, one an appearance level (``"<encoder>-<appearance>"``).
        rules: The macrostate machine.
        facts: What the rules say, as a function (enumerating costs a moment).
        render_macrostates: Frames of macrostates, kinematic mode.
        reference: Name of the thesis' table in :mod:`imagine_bench.reference`, or None.
        settings: Family of settings that learners take: the thesis' chapter that the task is from.
        presets: What each protocol preset changes for this task: fields of the protocol by preset.
        success_threshold: Success rate, in (0, 1], at which the task counts as learned.
        targets: What ``make speed`` measures it against; None for a task whose scene another one measures.
    """

    id: str
    title: str
    description: str
    env_id: str
    horizon: int
    action_names: tuple[str, ...]
    macrostate_names: tuple[str, ...]
    macrostate_values: tuple[tuple[str, ...], ...]
    preprocessing: str
    encoder: str
    rules: Rules
    facts: Callable[[], RuleFacts]
    render_macrostates: RenderMacrostates
    reference: str | None = None
    settings: str = "chapter_5"
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    success_threshold: float = 0.95
    targets: PerformanceTargets | None = None

    @property
    def n_actions(self) -> int:
        """Number of macro-actions A."""
        return len(self.action_names)

    def value_names(self, macrostate: Sequence[int] | Macrostate) -> tuple[str, ...]:
        """The names of a macrostate's values, one a coordinate. Length M."""
        return tuple(names[int(value)] for names, value in zip(self.macrostate_values, macrostate, strict=True))


def bundled_name(encoder: str, appearance: str, kind: str) -> str:
    """Name of a bundled encoder: ``"arrow_puzzle-clean"`` gives latents, ``"arrow_puzzle-clean-codes"`` codes."""
    return f"{encoder}-{appearance}" if kind == "latents" else f"{encoder}-{appearance}-{kind}"


@dataclass(frozen=True, kw_only=True)
class AgentContext:
    """What an agent is built from; it learns nothing else about its task.

    Attributes:
        n_actions: Number of macro-actions A.
        preprocessing: Name of the task's declared observation preprocessing.
        encoder: The encoder artefact (``.safetensors``), or None for agents that need none.
        seeds: The agent's node of the seed tree.
        config_group: Name of the config group of settings, as the task names it.
        hyperparameters: Name of the group's set of values (``"minimal"``, ``"fast"`` or ``"published"``).
        overrides: Single settings that replace the set's, by dotted name.
        device: A torch device name, ``"cpu"`` or ``"cuda"``.
        optimal_action: The rules' optimal action, only for agents registered as privileged; None for every other.
    """

    n_actions: int
    preprocessing: str
    encoder: Path | None
    seeds: SeedTree
    config_group: str = "chapter_5"
    hyperparameters: str = "fast"
    overrides: Mapping[str, Any] = field(default_factory=dict)
    device: str = "cpu"
    optimal_action: Callable[[State], int] | None = None


@dataclass(frozen=True, kw_only=True)
class AgentState:
    """All that an agent needs to go on as if never interrupted: weights, optimisers, memories, generators, counters.

    Attributes:
        arrays: Named numpy arrays; they become one safetensors file.
        values: JSON-serialisable values.
    """

    arrays: dict[str, NDArray[Any]]
    values: dict[str, Any]


class Agent(Protocol):
    """A learner, or a fixed policy, seen by the runner. One agent lives through one run."""

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Choose a macro-action in [0, A). With ``explore=False`` it changes nothing and is deterministic,
        but for agents whose policy is random by definition.
        """

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Take in one real transition of training episode ``episode`` (from 0) and learn from it."""

    def diagnostics(self) -> dict[str, float]:
        """Means since the last call, by slashed name (``loss/dynamics``, ``imagination/acceptance_rate``,
        ``time/model_s``, ...).
        """

    def state(self) -> AgentState:
        """A snapshot for a checkpoint; later learning does not alter it."""

    def restore(self, state: AgentState) -> None:
        """Continue from ``state``, bit for bit.

        Raises:
            ArtefactError: The snapshot does not fit this agent; the message names the first difference.
        """


@dataclass(frozen=True, kw_only=True)
class Shape3D:
    """One drawable part of a scene, fixed to a body.

    Attributes:
        name: Unique element name.
        body: Name of the body it moves with.
        kind: ``"box"`` (half sizes), ``"sphere"`` (radius), ``"capsule"`` / ``"cylinder"`` (radius, half length),
            ``"ellipsoid"`` (radii) or ``"mesh"``.
        size: As ``kind`` says, in metres. Shape (3,), unused entries 0.
        pose_in_body: Position (m) and quaternion (w, x, y, z). Shape (7,).
        rgba: In [0, 1]. Shape (4,).
        vertices: For meshes, (V, 3) in metres; else None.
        faces: For meshes, (F, 3) vertex indices; else None.
    """

    name: str
    body: str
    kind: str
    size: NDArray[np.float64]
    pose_in_body: NDArray[np.float64]
    rgba: NDArray[np.float64]
    vertices: NDArray[np.float64] | None = None
    faces: NDArray[np.int64] | None = None


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How the bodies of a scene moved during one macro-action.

    Attributes:
        body_names: One a body. Length B.
        time_s: Seconds since the macro-action began, ascending. Shape (K,).
        poses_in_world: Position (m) and quaternion (w, x, y, z). Shape (K, B, 7).
    """

    body_names: tuple[str, ...]
    time_s: NDArray[np.float64]
    poses_in_world: NDArray[np.float64]


@runtime_checkable
class SceneReader(Protocol):
    """An environment (``env.unwrapped``) whose scene can be drawn elsewhere, such as in Rerun."""

    capture_motion_hz: float
    """Samples of the motion a second kept during :meth:`step`; 0 keeps none."""

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
