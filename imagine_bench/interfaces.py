"""The vocabulary that tasks, agents and the bench share: numpy and the standard library only.

A *task* offers frames, macro-actions and exact rules; an *agent* offers actions and, if it imagines, imagined
rollouts; the *bench* knows both by these interfaces alone. Shapes: ``H = W = 64`` pixels, ``A`` actions,
``M`` coordinates of a macrostate, ``D`` imagined depth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
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

APPEARANCES = ("clean", "mild", "strong")
EXECUTIONS = ("physics", "kinematic")
ENCODER_KINDS = ("latents", "codes")
"""What an encoder gives: continuous latents, or one-hot codes of discrete parts."""
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
    macrostate: tuple[int, ...]
    reward: float
    terminated: bool
    success: bool


class Rules(Protocol):
    """The macrostate machine of a task: no physics, no pixels, exact."""

    @property
    def n_actions(self) -> int:
        """Number of macro-actions A."""

    @property
    def states(self) -> tuple[tuple[int, ...], ...]:
        """Every macrostate the machine knows, terminal ones included."""

    @property
    def start_states(self) -> tuple[tuple[int, ...], ...]:
        """The macrostates an episode may start in, equally likely."""

    def outcomes(self, macrostate: tuple[int, ...], action: int) -> tuple[Outcome, ...]:
        """Every possible result of ``action`` in ``macrostate``, also out of a terminal one: the scene goes on obeying
        its dynamics there, though no episode does.
        """

    def judge(self, macrostate: tuple[int, ...], action: int, reached: tuple[int, ...]) -> Outcome:
        """What the rules give for ``reached`` as it was read back, also where a fault led somewhere unexpected."""

    def is_legal(self, macrostate: tuple[int, ...]) -> bool:
        """Whether ``macrostate`` breaks no rule."""

    def is_terminal(self, macrostate: tuple[int, ...]) -> bool:
        """Whether no episode goes on from ``macrostate``."""

    def optimal_action(self, macrostate: tuple[int, ...]) -> int:
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
class Promises:
    """What ``make speed`` holds a task in contact physics to.

    Attributes:
        objects: Bodies of the loose objects; coordinate i of a macrostate is object i's.
        as_ruled: Least share of random macro-actions that end exactly as the rules say.
        bystander_mm: An object that an action leaves where it stands moves by less.
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
    bystander_mm: float
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
        mastery: Success rate, in (0, 1], at which the task counts as learned.
        promises: What ``make speed`` measures it against; None for a task whose scene another one measures.
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
    mastery: float = 0.95
    promises: Promises | None = None

    @property
    def n_actions(self) -> int:
        """Number of macro-actions A."""
        return len(self.action_names)


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
        settings: Name of the settings family, as the task names it.
        preset: Name of the family's preset (``"smoke"``, ``"quick"``, ``"thesis"``, ``"full"``).
        overrides: Single settings that replace the preset's, by dotted name.
        device: A torch device name, ``"cpu"`` or ``"cuda"``.
        optimal_action: The rules' optimal action, only for agents registered as privileged; None for every other.
    """

    n_actions: int
    preprocessing: str
    encoder: Path | None
    seeds: SeedTree
    settings: str = "chapter_5"
    preset: str = "quick"
    overrides: Mapping[str, Any] = field(default_factory=dict)
    device: str = "cpu"
    optimal_action: Callable[[tuple[int, ...]], int] | None = None


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
class ImaginedRollout:
    """An imagined rollout from one real frame; index d is the imagined result of ``actions[d]``.

    Attributes:
        actions: Macro-actions imagined. Shape (D,), int64.
        frames: Decoded latents as pictures of the whole view in [0, 1], grey (D, H', W') or RGB (D, H', W', 3).
        start_frame: The decoded encoding of the real frame it started from. Shape (H', W') or (H', W', 3).
        rewards: Predicted rewards. Shape (D,).
        p_terminated: Predicted probability that the episode ended there. Shape (D,).
        q_values: The controller's values in the state *before* each action. Shape (D, A).
        epistemic: Epistemic uncertainty of each imagined transition, reduced as the filter does. Shape (D,).
        aleatoric: The same for aleatoric. Shape (D,).
        modal: The same for modal. Shape (D,).
        accepted: Whether the filter keeps the transition (False from the first rejected one on). Shape (D,).
        macrostates: The macrostate an evaluation-only probe reads from each imagined latent. Shape (D, M).
    """

    actions: NDArray[np.int64]
    frames: NDArray[np.float32]
    start_frame: NDArray[np.float32]
    rewards: NDArray[np.float32]
    p_terminated: NDArray[np.float32]
    q_values: NDArray[np.float32]
    epistemic: NDArray[np.float32]
    aleatoric: NDArray[np.float32]
    modal: NDArray[np.float32]
    accepted: NDArray[np.bool_]
    macrostates: NDArray[np.int64]


@runtime_checkable
class ValueReader(Protocol):
    """An agent that can say what it expects of each action."""

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        """Values of every macro-action. Shape (A,)."""


@runtime_checkable
class Rehearser(Protocol):
    """An agent that practises by itself, without the world, before it is tested."""

    def rehearse(self) -> bool:
        """Practise a little on what has been learned so far, or say that there is nothing left to practise.

        The bench calls it before each test until it returns False. What it did is in :meth:`Agent.state`, so that an
        interrupted rehearsal goes on bit for bit.

        Returns:
            Whether anything was done; False changes nothing.
        """


OnEpisode = Callable[[bool, int], bool]
"""Told whether a training episode succeeded and its macro-actions; answers whether training goes on."""


@runtime_checkable
class SelfTrainer(Protocol):
    """An agent whose training loop is its own, as a library's is; the bench only watches and tests it.

    It cannot be stopped and taken up again: an interrupted run of it starts anew.
    """

    def train(self, env: Any, *, episodes: int, horizon: int, on_episode: OnEpisode) -> None:
        """Train in ``env``, from nothing.

        Args:
            env: The task's Gymnasium environment; every reset is the next training episode of the run.
            episodes: Real training episodes there will be.
            horizon: Most macro-actions of one.
            on_episode: To be told of each episode as it ends, before the next macro-action; it may ask the agent to
                act. Training ends when it answers False.
        """


@runtime_checkable
class Transferable(Protocol):
    """An agent that can take what it knows of a world into another task in the same world."""

    def carry_over(self) -> None:
        """Keep what was learned of how the world moves; what was rewarded and what ended episodes is a hint at most.

        The bench calls it between two tasks of one dynamics; training episodes are counted from 0 again after it.
        """


@dataclass(frozen=True, slots=True)
class Answer:
    """What a teacher says of an action that was only imagined: the reward it would bring, and whether it would end
    the episode.
    """

    reward: float
    terminated: bool


@runtime_checkable
class Questioner(Protocol):
    """An agent that can ask a teacher what actions which it only imagines would bring."""

    def question(self, observation: Observation) -> NDArray[np.int64] | None:
        """Before it acts: the macro-actions whose last one is asked about, from the frame seen, or None to ask nothing.

        It changes nothing but the agent's measurements.

        Returns:
            Macro-actions (D,) with D of at least 1. The scene is imagined to go on through ends of episodes, so the
            answer concerns the last one alone.
        """

    def learn_answer(self, observation: Observation, actions: NDArray[np.int64], answer: Answer | None) -> None:
        """Take in the answer to :meth:`question`; None says that it is a matter of chance, so that there is none."""


@runtime_checkable
class Imaginer(Protocol):
    """An agent that can show what it imagines; it changes nothing in the agent."""

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        """Imagine up to ``depth`` transitions from ``frame``.

        Args:
            frame: A real camera image. Shape (64, 64, 3).
            actions: The macro-actions to imagine, (D,) with D <= depth, never stopped early; None lets the greedy
                controller choose and stops where the model says the episode has ended.
            depth: Longest rollout.
            rng: Draws components, noise and dropout masks.
        """


Follow = Callable[[NDArray[np.int64]], NDArray[np.int64]]
"""Macrostates (N, M) that a probe read from imagined latents to macro-actions (N,); a negative one ends there."""


@dataclass(frozen=True, kw_only=True)
class SampledFutures:
    """What may happen, as sampled by a model in closed loop. Once a future has ended, its last macrostate is held.

    Attributes:
        macrostates: What the evaluation-only probe reads. Shape (D, R, S, M).
        rewards: Predicted rewards, 0 once a future has ended. Shape (D, R, S).
        ended: Whether the model has said, here or before, that the episode is over. Shape (D, R, S).
    """

    macrostates: NDArray[np.int64]
    rewards: NDArray[np.float32]
    ended: NDArray[np.bool_]


@runtime_checkable
class FutureSampler(Protocol):
    """An agent that can be asked for many futures of the same beginning; it changes nothing in the agent."""

    def sample_futures(
        self,
        frames: Frame,
        actions: NDArray[np.int64],
        *,
        follow: Follow,
        samples: int,
        depth: int,
        rng: np.random.Generator,
    ) -> SampledFutures:
        """Imagine S = ``samples`` futures of D = ``depth`` macro-actions from each of R frames.

        Args:
            frames: Real camera images. Shape (R, 64, 64, 3).
            actions: The first macro-action from each. Shape (R,).
            follow: Chooses the later ones.
            samples: Futures of each row.
            depth: Macro-actions of each future.
            rng: Draws components, noise and dropout masks.
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
        """A picture of the whole scene with the arm. Shape (height, width, 3)."""

    def film(self, width: int = 640, height: int = 480) -> Frame:
        """Pictures of the whole scene during the latest macro-action, as captured. Shape (K, height, width, 3)."""
