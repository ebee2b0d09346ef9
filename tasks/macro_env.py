"""The Gymnasium environment of macro-actions: exact rules, a world that acts, and observations of it."""

from __future__ import annotations

import contextlib
import copy
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import gymnasium
import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Floats, Info, Observed, State
from imagine_bench.errors import DivergedError, InvalidValueError, brief, require_known
from imagine_bench.interfaces import EXECUTIONS, Outcome, PhysicsSettings, TaskSpec
from imagine_bench.values import Json

from .motion.executor import MacroResult
from .observations import Observer
from .parameters.parameters import delivered, hides
from .scene_env import BUILT, RENDER_MODES, WINDOW_HZ, SceneEnv, Step
from .scenes.appearance import Appearance
from .scenes.appearance import appearance as appearance_level
from .scenes.constants import AGENT_CAMERA, FAR_CAMERA, FRAME_PX, HUMAN_CAMERA
from .world import World, WorldState

_MOST_KEPT = 20_000
"""Macro-actions whose outcomes a process keeps, some 3 KB each; the oldest go first."""
_outcomes: OrderedDict[tuple[Hashable, ...], tuple[MacroResult, Floats]] = OrderedDict()


@dataclass(frozen=True, kw_only=True)
class EnvState:
    """A snapshot of an environment: scene, looks, randomness and the episode so far. It can be pickled."""

    #: Where it may be set: task, execution, appearance, physics, and where frames are late, the kind of observation
    kind: tuple[object, ...]
    world: WorldState
    generator: Mapping[str, Json]  #: state of the generator that everything random is drawn from
    macrostate: State
    episode: Mapping[str, object] = field(repr=False)  #: its other parts of :data:`_EPISODE`


_EPISODE = ("begun", "latest", "_people", "_steps", "_observations", "_observed")
"""Attributes that say where an episode stands: latest macro-action, and the observations that lag keeps back."""


class MacroEnv(SceneEnv):
    """Macro-actions on a real scene, seen by the wrist camera.

    Action Space: ``Discrete(A)``, the macro-actions. Their names, in this order, are ``env.unwrapped.action_names``.

    Observation Space: ``Box(0, 255, (64, 64, 3), uint8)``, one upright RGB frame with the human at the top, unless
    ``observation`` says otherwise.

    Rewards: those of the task's rules, for the macrostate that was read back from the scene, and noise where the
    appearance has it.

    Starting State: one of the rules' start states, equally likely, or ``reset(options={"macrostate": ...})``.

    Episode End: terminated where the rules say so; truncation is the registered time limit, or a simulation that blew
    up: then the reward is 0, observation and macrostate are those before, and ``fault_reason`` names the cause.

    Info: ``macrostate`` and the part of it in the observation, ``shown``, late, or -1 where hidden (int64, (M,)),
    ``is_success``, ``success``, ``legal``, ``fault`` and ``fault_reason`` (empty where there is none), ``sim_time_s``
    and ``ik_error_m`` of the latest macro-action, ``action_mask`` (int8, (A,)). All are there at every reset and step,
    as numpy scalars or arrays but the reason.

    Args:
        spec: The task.
        make_world: Its world, at an appearance level.
        execution: ``"physics"`` moves the arm in contact physics, ``"kinematic"`` sets the outcome.
        appearance: A name, or factors, as :func:`imagine_bench.appearance.appearance_name` takes them.
        render_mode: None, ``"rgb_array"``, which :meth:`render` returns, or ``"human"``: a window that shows each
            motion as long as it took.
        width: Pixels of :meth:`render`.
        height: Pixels of :meth:`render`.
        camera: Camera of :meth:`render` and of the window: ``"human"`` looks at the table from nearby, ``"far"`` at the
            whole arm, and ``"wrist"`` is the agent's.
        physics: The physics of grasping: settings, or a mapping of some of their names to values.
        motion_hz: :attr:`capture_motion_hz`.
        observation: The observation of one moment: ``"frame"``, or others and several, as :class:`.Observer` says.
        size: Edge of observed images in pixels, 32 to 256.

    Raises:
        UnknownNameError: An unknown execution, appearance, render mode, camera, physics setting or observation.
        InvalidValueError: An image size, a factor, a physics setting or a rate out of range.

    Version History: v0, the first.
    """

    metadata = {"render_modes": RENDER_MODES, "render_fps": 1}  # noqa: RUF012  (Gymnasium's own declaration)
    KEYWORDS = (
        "execution",
        "appearance",
        "render_mode",
        "width",
        "height",
        "camera",
        "physics",
        "motion_hz",
        "observation",
        "size",
    )
    """The keyword arguments of its constructor."""

    def __init__(
        self,
        spec: TaskSpec,
        make_world: Callable[[Appearance], World],
        *,
        execution: str = "physics",
        appearance: str | Mapping[str, float] = "clean",
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        camera: str = HUMAN_CAMERA,
        physics: PhysicsSettings | Mapping[str, float | str] = BUILT,
        motion_hz: float = 0.0,
        observation: str = "frame",
        size: int = FRAME_PX,
    ) -> None:
        self.execution = require_known("execution", execution, EXECUTIONS)
        level = appearance_level(appearance)
        super().__init__(
            spec,
            make_world,
            level,
            physics=physics,
            motion_hz=motion_hz,
            render_mode=render_mode,
            image=(camera, width, height),
            cameras=(HUMAN_CAMERA, FAR_CAMERA, AGENT_CAMERA),
        )
        self.preprocessing = spec.preprocessing
        self.action_names = spec.action_names
        self.horizon = spec.horizon
        self._steps = 0
        self._observations: tuple[Observed, ...] = ()
        late = (observation, size) if self._lag else ()  # a state holds the observations under way
        self._kind = (spec.id, self.execution, level.name, self.physics, *late)
        self.action_space = gymnasium.spaces.Discrete(spec.n_actions)
        self._n_actions = spec.n_actions
        self.takes_long = self.execution == "physics"
        self._observer = Observer(observation, size, self.world, spec.macrostate_values, self.camera)
        self.observation_space = self._observer.space
        self._macrostate = spec.rules.start_states[0]
        self._observed: tuple[State, ...] = ()
        self._reuses = False

    # --- Gymnasium -----------------------------------------------------------------------------------------------

    def _begin(self, start: State) -> Info:
        self.begun = True
        self.latest = None
        self._steps = 0
        self._observations = ()
        self._observed = ()
        self.world.place(start, self.np_random)
        self._vary()
        reading = self.world.read()
        self._reach(reading.macrostate)
        return self._info(success=False, legal=self._rules.is_legal(reading.macrostate), fault=reading.problem)

    def _latest_observation(self) -> Observed:
        return self._observations[0]

    def act(self, action: np.int64 | int) -> Step:
        """Carry out one macro-action, without an observation; also out of a terminal macrostate, as the rules go on.

        Raises:
            InvalidValueError: As :meth:`step`.
        """
        self._require_begun()
        chosen = self.checked(action)
        self._steps += 1
        self.begun = False  # until the scene is a macrostate again: a simulation that blows up ends the episode
        start = self._macrostate
        outcome = intended = self._intended(start, chosen)
        self.world.sensing.draw(self.np_random)
        if self._sight is not None:
            self.world.draw_placement_noise(self.np_random)
        fault = None
        if self.execution == "physics":
            standing = self.world.get_state()
            self._people = self._mocap()
            self.prepare()
            try:
                self.latest = self._execute(chosen, intended.macrostate)
            except DivergedError as error:
                return self._blown_up(standing, str(error))
            fault = self.latest.fault
        else:
            self.world.set_outcome(chosen, intended.macrostate)
        self._vary(move_objects=self.execution == "kinematic")
        reading = self.world.read()
        self._reach(reading.macrostate)
        self.begun = True
        fault = fault or reading.problem
        if reading.macrostate != intended.macrostate:
            outcome = self._rules.judge(start, chosen, reading.macrostate)
            fault = fault or f"the scene reads {reading.macrostate}, the rules say {intended.macrostate}"
        info = self._info(success=outcome.success, legal=outcome.success or not outcome.terminated, fault=fault)
        return self.world.reward(outcome.reward, self.np_random), outcome.terminated, False, info

    def prepare(self) -> None:
        """Compile the executor of macro-actions, if it is not yet."""
        self.world.executor.capture_motion_hz = self.capture_motion_hz

    def reuse_outcomes(self) -> None:
        """From now on, simulate no macro-action twice in this process; results stay the same to the bit.

        A macro-action is a pure function of the scene's state, so one that was carried out before from the same bits
        only has its outcome set again. Tests of a bench begin alike for all agents, seeds and budgets: most of their
        motions are repeated. A motion that is captured for a recording is simulated.
        """
        self._reuses = True

    def observe(self, envs: Sequence[MacroEnv]) -> list[Observed]:
        """The observations of :meth:`reset` and :meth:`step` for environments like this, by its cameras; once a
        moment.
        """
        now = self._observer.observe([(env._observer, env.world.observed(env._macrostate)) for env in envs])
        due = []
        for env, observation in zip(envs, now, strict=True):
            env._observations = delivered(env._observations, observation, env._lag)
            due.append(copy.deepcopy(env._observations[0]) if env._lag else observation)
        return due

    def action_masks(self) -> NDArray[np.bool_]:
        """Which macro-actions can be carried out: all; the agent has to learn which ones the rules punish. Shape
        (A,).
        """
        return np.ones(self._n_actions, dtype=np.bool_)

    def get_state(self) -> EnvState:
        """All that decides how the episode goes on, copied; of a wrapper, such as a time limit, it knows nothing."""
        return EnvState(
            kind=self._kind,
            world=self.world.get_state(),
            generator=copy.deepcopy(self.np_random.bit_generator.state),
            macrostate=self._macrostate,
            episode={name: getattr(self, name) for name in _EPISODE},
        )

    def _put_state(self, state: EnvState) -> None:
        self._require_values(state.macrostate)
        if state.episode.keys() != set(_EPISODE):
            raise InvalidValueError(f"its episode has the parts {', '.join(state.episode)}")
        self.world.set_state(state.world)
        self.np_random.bit_generator.state = copy.deepcopy(state.generator)
        self._macrostate = state.macrostate
        for name, value in state.episode.items():
            setattr(self, name, value)

    # --- details -------------------------------------------------------------------------------------------------

    def _show(self) -> None:
        """In a window, if there is one: the latest motion, and how the scene stands."""
        if self._window is None:
            return
        for _ in self.replay():
            self._window.show(self.rendered([self])[0], self.capture_motion_hz or WINDOW_HZ)
        self._window.show(self.rendered([self])[0], WINDOW_HZ)

    def _vary(self, *, move_objects: bool = True) -> None:
        """Draw how this moment looks, and where that is hidden by chance, whether the gesture is seen."""
        if self._sight is not None:
            self.world.hide_gesture(hides(self._sight, self.world.read().macrostate, self._steps, self.np_random))
        self.world.vary(self.np_random, move_objects=move_objects)

    def _reach(self, macrostate: State) -> None:
        """Be in a macrostate, once a moment, of which the frame that is due may show less, or another."""
        self._macrostate = macrostate
        self._observed = delivered(self._observed, self.world.observed(macrostate), self._lag)

    def checked(self, action: np.int64 | int) -> int:
        """A macro-action as a number. Raises InvalidValueError: no such action."""
        if isinstance(action, (int, np.integer)) and 0 <= action < self._n_actions:
            return int(action)
        with contextlib.suppress(Exception):  # as of a macrostate
            (chosen,) = np.asanyarray(action).ravel().tolist()
            if chosen in range(self._n_actions):
                return int(chosen)
        raise InvalidValueError(
            f"Action {brief(action)} does not exist; give an integer from 0 to {self._n_actions - 1}."
        )

    def _execute(self, action: int, intended: State) -> MacroResult:
        """Carry out a macro-action in physics, or set its earlier outcome again; see :meth:`reuse_outcomes`."""
        if not self._reuses or self.capture_motion_hz > 0.0:
            return self.world.execute(action, intended)
        before = (self._kind, action, intended, *self.world.decisive())
        known = _outcomes.get(before)
        if known is None:
            known = _outcomes[before] = self.world.execute(action, intended), self.world.physics()
            if len(_outcomes) > _MOST_KEPT:
                _outcomes.popitem(last=False)
        else:
            self.world.set_physics_state(known[1])
        return known[0]

    def _blown_up(self, standing: WorldState, why: str) -> Step:
        """The result of :meth:`act` if the simulation blew up: the scene stands as before, the episode is over."""
        self.world.set_state(standing)
        self.latest = None
        return 0.0, False, True, self._info(success=False, legal=self._rules.is_legal(self._macrostate), fault=why)

    def _intended(self, start: State, action: int) -> Outcome:
        """The rules' outcome, drawn where they leave a choice."""
        outcomes = self._rules.outcomes(start, action)
        if len(outcomes) == 1:
            return outcomes[0]
        chances = np.array([outcome.probability for outcome in outcomes])
        return outcomes[int(self.np_random.choice(len(outcomes), p=chances / chances.sum()))]

    def _info(self, *, success: bool, legal: bool, fault: str | None) -> Info:
        latest = self.latest
        return {
            "macrostate": np.array(self._macrostate, dtype=np.int64),
            "shown": np.array(self._observed[0], dtype=np.int64),
            "is_success": np.bool_(success),
            "success": np.bool_(success),
            "legal": np.bool_(legal),
            "fault": np.bool_(fault is not None),
            "fault_reason": fault or "",
            "sim_time_s": np.float64(0.0 if latest is None else latest.sim_time_s),
            "ik_error_m": np.float64(0.0 if latest is None else latest.ik_error_m),
            "action_mask": self.action_masks().view(np.int8),
        }
