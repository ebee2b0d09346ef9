"""The Gymnasium environment of continuous control: commands at 25 Hz, rewards for events that the rules know."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple

import mujoco
import numpy as np

from imagine_bench.appearance import FACTORS
from imagine_bench.arrays import Floats, Info, Ints, Observed, State
from imagine_bench.errors import InvalidValueError, brief, require_known
from imagine_bench.interfaces import PhysicsSettings, TaskSpec
from imagine_bench.values import Json

from ..motion.arm_model import ArmModel
from ..motion.executor import blew_up
from ..observations import Observer
from ..parameters.parameters import delivered, hides
from ..scene_env import BUILT, RENDER_MODES, SceneEnv, Step
from ..scenes.appearance import NUISANCE_FIELDS, Appearance
from ..scenes.appearance import appearance as appearance_level
from ..scenes.arm import ARM_JOINTS, arm_columns
from ..scenes.constants import FAR_CAMERA, FRAME_PX, HUMAN_CAMERA
from ..world import MAX_PLACEMENT_M, World, WorldState
from .controls import HandControl, Motion
from .dense import Potential
from .referee import GRIPPED, Event, Referee

RATE_HZ = 25.0
SLOWEST_HZ = 5.0
"""In a longer period the wrist could turn a cube past a quarter and on to the next one unseen."""
REWARDS = ("sparse", "dense")
SECONDS_PER_MACRO_ACTION = 3.0
"""An episode is truncated after so many seconds for each macro-action of the task's horizon: 1.3 times the time
of planned motions in the arrow puzzle from wherever the hand may be, and twice in pick-and-place (docs: certificates).
"""
_LET_GO_M = 0.003
"""A grip is over when each finger is told to be so much further apart than before, and touches nothing."""


class Period(NamedTuple):
    """The outcome of one control period."""

    reward: float
    terminated: bool
    truncated: bool
    success: bool = False
    reached: State | None = None  #: the macrostate after its event
    fault: str | None = None  #: why a change was no macro-action, or how the simulation ended, in words


@dataclass
class Episode:
    """Where an episode stands, beside its scene."""

    macrostate: State = ()
    periods: int = 0  #: control periods so far
    events: int = 0  #: changes of the macrostate so far
    gripped_m: float | None = None  #: the closest that the fingers of this grip were told to be; None without a grip
    slipping: bool = False  #: whether this grip slips
    latest: Event | None = None  #: the event of the latest period
    potential: float = 0.0  #: with the dense reward, of the latest moment
    limited: str = ""  #: the limit that changed the latest command, or empty
    observations: tuple[Observed, ...] = ()  #: of the latest moment before each of the latest events


@dataclass(frozen=True, kw_only=True)
class MotionState:
    """A snapshot of an environment: scene, looks, randomness and the episode so far. It can be pickled."""

    kind: tuple[object, ...]  #: of which environments it is
    world: WorldState
    generator: Mapping[str, Json]
    begun: bool
    episode: Episode


class MotionEnv(SceneEnv):
    """A task by hand commands: the same scene, rules and truth as its macro-actions, at a finer time scale.

    Action Space: by ``control``, as :class:`.controls.HandControl` says; the names of an action's numbers are
    ``env.unwrapped.control_names``. By default ``Box(-1, 1, (7,), float32)``: the hand's velocity along x, y, z, its
    turning about x, y, z, and the grip (-1 closed, 1 open).

    Observation Space: by ``observation``, a dict of the parts that :class:`.observations.Observer` explains, or one
    part as it is. With ``lag``, all parts, proprioception too, are those of the moment of an earlier event, so many
    events ago, or of the start; they stay the same until the next event.

    Rewards: those of the rules, charged at each event: a change of the macrostate that is read of the scene. A change
    that is no macro-action is a fault, which ends the episode with -5. With ``reward="dense"`` a shaping term is added.

    Starting State: the arm at its observation pose, the objects as one of the rules' start states says.

    Episode End: terminated where the rules say so, or at a fault; truncated after 3 s for each macro-action of the
    task's horizon, or when the simulation blew up, with reward 0 and ``fault_reason``.

    Info: ``macrostate`` (int64, (M,)), ``event`` (whether the macrostate changed in this period, or a fault happened),
    ``macro_action`` (the macro-action that the event amounts to, or -1), ``is_success``, ``success``, ``legal``,
    ``fault``, ``fault_reason``, ``limited`` (the reason that kept the command from the action, or empty),
    ``sim_time_s`` (of this period), ``elapsed_s`` (since the start), ``instruction`` (empty unless ``told``).

    Args:
        spec: The task.
        make_world: Its world, at an appearance level, made for continuous control.
        instruct: The goal of a macrostate in words.
        slip: Probability that a grip slips: the fingers lose their friction and open by themselves, until they are told
            to open. An object held at the start of an episode does not slip.
        control: ``"twist"``, ``"pose"``, ``"joint_delta"`` or ``"joint"``.
        rate_hz: Commands a second; a period is a whole number of the simulation's steps.
        appearance: A name, or factors; drawn at the start and anew after each event.
        reward: ``"sparse"``, the rules' alone; or ``"dense"``, with the growth of :class:`.dense.Potential` added.
        observation: The observation: some of ``hand``, ``front``, ``proprio``, ``objects``, ``state``.
        size: Edge of observed images in pixels, 32 to 256.
        placement: Where an object starts and belongs, drawn at each reset: up to so many metres off its slot along x
            and along y, and turned by up to 5 degrees; 0 to 0.04. Faults, the pointing hand and the directions of
            cubes refer to this place.
        told: Whether ``info["instruction"]`` says the goal in words, and no image shows the pointing hand.
        time_limit_s: Seconds before truncation; None is 3 s for each macro-action of the horizon.
        render_mode: None, ``"rgb_array"``, or ``"human"``, a window.
        width: Pixels of :meth:`render`.
        height: Pixels of :meth:`render`.
        camera: Camera of :meth:`render`: ``"human"`` or ``"far"``.
        physics: The physics of grasping: settings, or a mapping of some of their names to values.

    Raises:
        UnknownNameError: An unknown control, appearance, render mode, camera, physics setting or observation.
        InvalidValueError: A rate, size, factor or physics setting out of range.

    Version History: v0, the first.
    """

    metadata = {"render_modes": RENDER_MODES, "render_fps": round(RATE_HZ)}  # noqa: RUF012  (Gymnasium's own)
    KEYWORDS = (
        "control",
        "rate_hz",
        "appearance",
        "reward",
        "observation",
        "size",
        "placement",
        "told",
        "time_limit_s",
        "render_mode",
        "width",
        "height",
        "camera",
        "physics",
    )
    """The keyword arguments of its constructor."""

    def __init__(
        self,
        spec: TaskSpec,
        make_world: Callable[[Appearance], World],
        *,
        instruct: Callable[[State], str],
        slip: float = 0.0,
        control: str = "twist",
        rate_hz: float = RATE_HZ,
        appearance: str | Mapping[str, float] = "clean",
        reward: str = "sparse",
        observation: str = "hand,front,proprio",
        size: int = FRAME_PX,
        placement: float = 0.0,
        told: bool = False,
        time_limit_s: float | None = None,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        camera: str = HUMAN_CAMERA,
        physics: PhysicsSettings | Mapping[str, float | str] = BUILT,
    ) -> None:
        level = appearance_level(appearance)
        if level.pool is not None:
            raise InvalidValueError(
                "Appearance 'patched' patches images of macrostates; give clean, mild, strong or factors."
            )
        if any(getattr(level, name) for name, _ in NUISANCE_FIELDS.values()):
            raise InvalidValueError(
                f"Appearance {level.name!r} has nuisances, which change frames and rewards of macro-actions; give "
                f"clean, mild, strong or {', '.join(FACTORS)}."
            )
        super().__init__(
            spec,
            make_world,
            level,
            physics=physics,
            motion_hz=0.0,
            render_mode=render_mode,
            image=(camera, width, height),
            cameras=(HUMAN_CAMERA, FAR_CAMERA),
        )
        self._make_world = make_world
        self.draws_quickly = self.render_mode == "human"
        self._instruct = instruct
        self.reward = require_known("reward", reward, REWARDS)
        self._potential = Potential(self.world, spec.rules) if reward == "dense" else None
        self._slip = slip
        if not isinstance(told, (bool, np.bool_)):
            raise InvalidValueError(f"told is {brief(told)}; give True or False.")
        self._told = bool(told)
        is_number = isinstance(placement, Real) and not isinstance(placement, bool)
        if not is_number or not 0.0 <= placement <= MAX_PLACEMENT_M:
            raise InvalidValueError(f"placement is {brief(placement)}; give metres from 0 to {MAX_PLACEMENT_M:g}.")
        self.placement_m = float(placement)
        self._n_steps = steps_in_period(rate_hz, self.model.opt.timestep)
        self.period_s = self._n_steps * self.model.opt.timestep
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.period_s)}
        self.controls = HandControl(control, ArmModel(), self.period_s)
        self.control_names = self.action_names = self.controls.names
        self.action_space = self.controls.space
        self.columns = arm_columns(self.model)
        self._ramp = (np.arange(1, self._n_steps + 1) / self._n_steps)[:, None]
        self.referee = Referee(self.world, spec.rules, spec.macrostate_values)
        self._observer = Observer(observation, size, self.world, spec.macrostate_values, self.camera, control=True)
        self.observation_space = self._observer.space
        self.time_limit_s = SECONDS_PER_MACRO_ACTION * spec.horizon
        if time_limit_s is not None:
            if not isinstance(time_limit_s, Real) or isinstance(time_limit_s, bool) or not time_limit_s > 0:
                raise InvalidValueError(f"time_limit_s is {brief(time_limit_s)}; give seconds above 0, or None.")
            self.time_limit_s = float(time_limit_s)
        own = (slip, told, self.placement_m, reward, *((observation, size) if self._lag else ()))  # which a state holds
        self._kind = (spec.id, "motion", control, self._n_steps, level.name, self.physics, *own)
        self.episode = Episode()

    # --- Gymnasium -----------------------------------------------------------------------------------------------

    def checked(self, action: Motion) -> Floats:
        """As :meth:`.controls.HandControl.checked`."""
        return self.controls.checked(action)

    def _begin(self, start: State) -> Info:
        if self.placement_m:
            self.world.draw_places(self.placement_m, self.np_random)
        self.world.place(start, self.np_random)
        reading = self.world.read()
        self.begun = True
        self.episode = Episode(macrostate=reading.macrostate)
        self.world.set_slipping(False)
        self._vary()
        if self._potential is not None:
            self.episode.potential = self._potential(reading.macrostate)
        return self._info(success=False, fault=reading.problem)

    def act(self, action: Motion) -> Step:
        """Carry out the command of one control period, without an observation.

        Raises:
            InvalidValueError: As :meth:`step`.
        """
        self._require_begun()
        before = self.data.ctrl[self.columns.ctrl]
        change, limited = self._servo_change(self.checked(action), before)
        period = self._advance(before + self._ramp * change, limited)
        self.world.update()
        info = self._info(success=period.success, fault=period.fault)
        return period.reward, period.terminated, period.truncated, info

    def carry_out(self, actions: Motion) -> list[Period]:
        """Carry out actions (N, n) as :meth:`act` does, until they or the episode are over; the periods in turn.

        This is quicker than the same actions one by one. The servos' commands follow from the actions alone, so all are
        computed before the first step. The positions that follow from the joints are brought up to date at the end.

        Raises:
            InvalidValueError: As :meth:`step`; then nothing has moved.
        """
        self._require_begun()
        if self.episode.periods and self._is_at_limit():
            return []
        periods_left = self.time_limit_s / self.period_s - self.episode.periods
        actions = actions[: math.ceil(min(periods_left, len(actions)))]
        before = self.data.ctrl[self.columns.ctrl]
        commands = []
        limits = []
        for action in self.controls.checked(actions, len(actions)):
            change, limited = self._servo_change(action, before)
            commands.append(before + self._ramp * change)
            limits.append(limited)
            before = before + change
        periods: list[Period] = []
        for servos, limited in zip(commands, limits, strict=True):
            periods.append(self._advance(servos, limited))
            if periods[-1].terminated or periods[-1].truncated:
                break
        self.world.update()
        return periods

    def tell_servos(self, action: Motion) -> None:
        """Set the servos' commands to those at the end of a period of an action; nothing is simulated.

        Raises:
            InvalidValueError: As :meth:`step`.
        """
        before = self.data.ctrl[self.columns.ctrl]
        change, self.episode.limited = self._servo_change(self.checked(action), before)
        self.data.ctrl[self.columns.ctrl] = before + change

    def observe(self, envs: Sequence[MotionEnv]) -> list[Observed]:
        """Observations of :meth:`reset` and :meth:`step` of environments like this, by its cameras; once a moment."""
        now = self._observer.observe([(env._observer, env.world.observed(env.episode.macrostate)) for env in envs])
        for env, seen in zip(envs, now, strict=True):
            episode = env.episode
            if episode.latest is not None or not episode.observations:
                episode.observations = delivered(episode.observations, seen, env._lag)
            elif not env._lag:
                episode.observations = (seen,)
        return [copy.deepcopy(env.episode.observations[0]) if env._lag else env.episode.observations[0] for env in envs]

    def _latest_observation(self) -> Observed:
        return self.episode.observations[0]

    def another_world(self) -> World:
        """A scene like this environment's, for a planner or for a goal."""
        return self._make_world(self.world.level)

    # --- states --------------------------------------------------------------------------------------------------

    @property
    def elapsed_s(self) -> float:
        """Simulated seconds since the episode began."""
        return self.episode.periods * self.period_s

    @property
    def instruction(self) -> str:
        """The goal in words, as the pointing hand says it now."""
        return self._instruct(self.episode.macrostate)

    def hand_target_m(self) -> Floats:
        """Where the servos are told to bring the point between the fingers, in the world. Shape (3,)."""
        return self.controls.hand_pose(self.data.ctrl[self.columns.ctrl[: len(ARM_JOINTS)]])[0]

    def servo_targets(self) -> Floats:
        """The servos' present commands: the seven joints (rad), and the opening of each finger (m). Shape (8,)."""
        targets: Floats = self.data.ctrl[self.columns.ctrl[: len(ARM_JOINTS) + 1]].copy()
        return targets

    def servo_forces(self) -> Floats:
        """The present efforts of the servos: torques of the seven joints (N m), forces of both fingers (N). Shape
        (9,).
        """
        return np.asarray(self.data.actuator_force[self.columns.ctrl])

    def get_state(self) -> MotionState:
        """All that decides how the episode goes on, copied; of a wrapper it knows nothing."""
        return MotionState(
            kind=self._kind,
            world=self.world.get_state(),
            generator=copy.deepcopy(self.np_random.bit_generator.state),
            begun=self.begun,
            episode=copy.deepcopy(self.episode),
        )

    def _put_state(self, state: MotionState) -> None:
        episode = copy.deepcopy(state.episode)
        if state.begun:
            self._require_values(episode.macrostate)
        if episode.periods < 0 or not isinstance(episode.observations, tuple):
            raise InvalidValueError(f"it is one of {episode.periods} periods, or has no observations")
        self.world.set_state(state.world)
        self.np_random.bit_generator.state = copy.deepcopy(state.generator)
        self.begun = bool(state.begun)
        self.episode = episode
        self.world.set_slipping(episode.slipping)

    # --- details -------------------------------------------------------------------------------------------------

    def _is_at_limit(self) -> bool:
        """Whether no later end of a period is nearer to the time limit."""
        return self.elapsed_s >= self.time_limit_s - self.period_s / 2

    def _servo_change(self, action: Floats, before: Floats) -> tuple[Floats, str]:
        """The change of the servos' commands in an action's period: joints, then fingers (9,); and the limit met."""
        n_arm = len(ARM_JOINTS)
        command = self.controls.command(action, before[:n_arm], float(before[-1]))
        after = np.empty_like(before)
        after[:n_arm] = command.joints_rad
        after[n_arm:] = command.opening_m
        return after - before, command.limited

    def _advance(self, servos: Floats, limited: str) -> Period:
        """Simulate one control period with the servos' commands at each of its steps (steps, 9), and judge it.

        Positions that follow from the joints are those of before the last step.
        """
        episode = self.episode
        episode.limited = limited
        episode.periods += 1
        self._simulate(servos)
        if blew_up(self.data):
            self.begun = False
            episode.latest = None
            return Period(0.0, terminated=False, truncated=True, fault="the simulation blew up")
        event = self._judge()
        reward = 0.0 if event is None else float(event.outcome.reward)
        terminated = event is not None and event.outcome.terminated
        if self._potential is not None:
            self.world.update()
            before = episode.potential
            episode.potential = 0.0 if terminated else self._potential(episode.macrostate)
            reward += episode.potential - before
        truncated = self._is_at_limit()
        if event is None:
            return Period(reward, terminated, truncated)
        return Period(reward, terminated, truncated, event.outcome.success, episode.macrostate, event.fault)

    def _simulate(self, servos: Floats) -> None:
        """Simulate the steps of a control period, each with its commands to the servos. Shape (steps, 9)."""
        model, data, ctrl = self.model, self.data, self.data.ctrl
        columns = self.columns.ctrl
        step = mujoco.mj_step
        for commands in servos:
            ctrl[columns] = commands
            step(model, data)

    def _judge(self) -> Event | None:
        """The event of the period that is over, with all that it changes in the scene."""
        episode = self.episode
        if self._slip:
            self._slip_or_hold(self.referee.touched())
        event = self.referee.event(episode.macrostate, self.np_random)
        episode.latest = event
        if event is None:
            return None
        before = episode.macrostate
        episode.macrostate = event.outcome.macrostate
        episode.events += 1
        if episode.macrostate[-1] != before[-1]:
            self.world.set_gesture(episode.macrostate[-1])
        self._vary(move_objects=False)
        return event

    def _slip_or_hold(self, touched: Ints) -> None:
        """Draw at the beginning of a grip whether it slips; it is over when the fingers are told to open."""
        episode = self.episode
        told_m = float(self.data.ctrl[self.columns.ctrl[-1]])
        if episode.gripped_m is None and bool((touched & GRIPPED == GRIPPED).any()):
            episode.gripped_m = told_m
            held_at_start = episode.periods == 1
            episode.slipping = not held_at_start and bool(self.np_random.random() < self._slip)
            self.world.set_slipping(episode.slipping)
        elif episode.gripped_m is not None and told_m > episode.gripped_m + _LET_GO_M and not (touched & GRIPPED).any():
            episode.gripped_m = None
            episode.slipping = False
            self.world.set_slipping(False)
        elif episode.gripped_m is not None:
            episode.gripped_m = min(episode.gripped_m, told_m)

    def _vary(self, *, move_objects: bool = True) -> None:
        """Draw how the scene looks, and where that is hidden by chance, whether the gesture is seen."""
        hidden = self._told
        if self._sight is not None:
            hidden |= hides(self._sight, self.episode.macrostate, self.episode.events, self.np_random)
        self.world.hide_gesture(hidden)
        self.world.vary(self.np_random, move_objects=move_objects)

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self.rendered([self])[0], 1.0 / self.period_s)

    def _info(self, *, success: bool, fault: str | None) -> Info:
        episode = self.episode
        event = episode.latest
        return {
            "macrostate": np.array(episode.macrostate, dtype=np.int64),
            "event": np.bool_(event is not None),
            "macro_action": np.int64(-1 if event is None else event.action),
            "is_success": np.bool_(success),
            "success": np.bool_(success),
            "legal": np.bool_(success or event is None or not event.outcome.terminated),
            "fault": np.bool_(fault is not None),
            "fault_reason": fault or "",
            "limited": episode.limited,
            "sim_time_s": np.float64(self.period_s if episode.periods else 0.0),
            "elapsed_s": np.float64(self.elapsed_s),
            "instruction": self.instruction if self._told else "",
        }


def steps_in_period(rate_hz: float, timestep_s: float) -> int:
    """Steps of a simulation in a control period. Raises InvalidValueError: they are no whole number."""
    most_hz = 1.0 / timestep_s
    is_number = isinstance(rate_hz, Real) and not isinstance(rate_hz, bool)
    if is_number and SLOWEST_HZ <= rate_hz <= most_hz + 1e-6:
        steps = 1.0 / (float(rate_hz) * timestep_s)
        if abs(steps - round(steps)) < 1e-6:
            return round(steps)
        near = sorted({max(1, int(steps)), int(steps) + 1}, reverse=True)
        named = " or ".join(f"{1.0 / (each * timestep_s):.6g}" for each in near)
        raise InvalidValueError(
            f"At {rate_hz:g} Hz a period is no whole number of steps of {1e3 * timestep_s:g} ms; give {named} Hz."
        )
    raise InvalidValueError(f"Rate {brief(rate_hz)} must be a number of Hz from {SLOWEST_HZ:g} to {most_hz:g}.")
