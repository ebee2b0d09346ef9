"""A task's scene at run time: loose objects and people's hands, put as a macrostate says and read back."""

from __future__ import annotations

import abc
import copy
import math
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np

from imagine_bench.arrays import Floats, Frame, Ints, State
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import PhysicsSettings

from .motion import orientation
from .motion.executor import MacroExecutor, MacroResult, at_rest
from .motion.orientation import Sensing
from .parameters.distractors import Distraction
from .parameters.parameters import HIDDEN
from .scenes.appearance import Appearance, AppearanceSampler, appearance_arrays
from .scenes.arm import FINGER_JOINTS, TIP_IN_NAME
from .scenes.constants import Point
from .scenes.control_views import varied_by_appearance
from .scenes.fragments import Composite, draw_composite
from .scenes.nuisances import Nuisance, draw_nuisance

MAX_TILT_RAD = math.radians(10.0)
MAX_SKEW_RAD = math.radians(20.0)
"""An object that is tipped, or turned off where it may stand, by more is a problem."""
MAX_OTHER_SHIFT_M = 0.005
MAX_PLACEMENT_M = 0.04
PLACEMENT_YAW_RAD = math.radians(5.0)
"""How far off their slots places may be drawn, and how far turned."""
_DRAWS = 10_000
Place = tuple[float, float, float]
"""x and y (m) and yaw (rad)."""
_APART_M = 0.085
"""Places drawn off the slots are so far apart, along x or along y: fingers fit between any two objects."""
SLIP_FRICTION = 0.02
SLIP_FORCE_N = 2.0
"""Friction of fingertips whose grip slips, and the force (N) by which such fingers open, in continuous control."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """The state of a world, as it is read."""

    macrostate: State  #: the nearest macrostate
    problem: str | None  #: the reason why the scene is no proper macrostate, in words, or None


_STATE = mujoco.mjtState.mjSTATE_INTEGRATION.value
_SLEEP = (
    *("body_awake", "body_awake_ind", "dof_awake_ind", "parent_awake_ind", "tree_asleep", "tree_awake"),
    *("nbody_awake", "nparent_awake", "ntree_awake", "nv_awake"),
)
"""Arrays and numbers of ``mjData`` that say which bodies sleep: they decide the next steps, and no state has them."""
Sleep = Mapping[str, Ints | int]


@dataclass(frozen=True, kw_only=True)
class WorldState:
    """A scene's dynamic state, MuJoCo's with the start of its solvers, its looks, and the planner's latest error."""

    physics: Floats
    looks: tuple[Floats, ...]
    composite: Composite | None  #: where frames are patched, the fragments of the latest
    sensing: Sensing
    places: tuple[Place, ...] = ()  #: as :attr:`World.places`
    nuisance: Nuisance | None = None  #: the nuisances of the latest frame, where there are any
    sleep: Sleep = field(default_factory=dict)  #: the sleeping bodies, by the names in ``mjData``


class World(abc.ABC):
    """A scene; its macrostates are a value for each loose object, and last one for the human's gesture.

    From the start and after each method all derived positions of ``data`` are up to date.

    Args:
        model: Compiled scene, this world's own.
        level: How much the appearance varies.
        objects: Bodies of the loose objects, and their names in sentences; ``<body>_joint`` is a free joint.
        materials: Those whose colors vary.
        distractors: How many the model has.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        level: Appearance,
        *,
        objects: Mapping[str, str],
        materials: tuple[str, ...],
        distractors: int = 0,
    ) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self.sensing = Sensing()
        self.object_bodies = [model.body(body).id for body in objects]
        self.level = level
        self.object_names = tuple(objects.values())
        self._varies = level.varies_every_frame
        cameras, varied = varied_by_appearance(model, materials)
        self._appearance = AppearanceSampler(model, level, cameras=cameras, materials=varied)
        self._composite: Composite | None = None
        self._nuisance: Nuisance | None = None
        self._distraction = Distraction(model, distractors) if distractors else None
        starts = [int(model.joint(f"{body}_joint").qposadr[0]) for body in objects]
        self.object_qpos = np.array(starts)[:, None] + np.arange(7)  # [N, 7]
        moves = [int(model.joint(f"{body}_joint").dofadr[0]) for body in objects]
        self.object_qvel = np.array(moves)[:, None] + np.arange(6)  # [N, 6]
        self._tips = [index for index in range(model.ngeom) if TIP_IN_NAME in model.geom(index).name]
        self._tip_friction = model.geom_friction[self._tips, :1].copy()
        self._people = [model.material(name).id for name in ("skin", "cloth")]
        self.places: tuple[Place, ...] = ((0.0, 0.0, 0.0),) * len(starts)  #: of each object, off its slot
        self._placement_noise = [[0.0, 0.0, 0.0] for _ in starts]
        self._read_at: tuple[bytes, bytes] | None = None
        self._latest_objects: tuple[State, str | None] = ((), None)
        self._rest_qpos, self._rest_ctrl = at_rest(model)
        self.data.qpos[:] = self._rest_qpos
        self.update()

    def set_physics(self, settings: PhysicsSettings) -> None:
        """Change the physics of grasping; once, before the first macro-action."""
        self.sensing.settings = settings
        model = self.model
        built = PhysicsSettings()
        model.geom_friction[self._tips, :2] *= settings.pad_friction / built.pad_friction
        self._set_finger_force(-settings.finger_force_n, settings.finger_force_n)
        if settings.object_mass != built.object_mass:
            model.body_mass[self.object_bodies] *= settings.object_mass
            model.body_inertia[self.object_bodies] *= settings.object_mass
            mujoco.mj_setConst(model, mujoco.MjData(model))

    def set_slipping(self, slipping: bool) -> None:
        """Let the fingers hold a gripped object, or let it slip: without friction, they open whatever they are told."""
        settings = self.sensing.settings
        built = PhysicsSettings()
        friction = settings.pad_friction / built.pad_friction * self._tip_friction
        self.model.geom_friction[self._tips, :1] = np.minimum(friction, SLIP_FRICTION) if slipping else friction
        force_n = settings.finger_force_n
        self._set_finger_force(*((SLIP_FORCE_N, SLIP_FORCE_N) if slipping else (-force_n, force_n)))

    def _set_finger_force(self, least_n: float, most_n: float) -> None:
        for name in FINGER_JOINTS:
            servo = self.model.actuator(name.replace("_slide", "_servo")).id
            self.model.actuator_forcerange[servo] = (least_n, most_n)

    def get_state(self) -> WorldState:
        """Everything in the scene that may change, copied."""
        looks = tuple(np.array(each) for each in appearance_arrays(self.model))
        return WorldState(
            physics=self.physics(),
            looks=looks,
            composite=self._composite,
            sensing=replace(self.sensing),
            places=self.places,
            nuisance=self._nuisance,
            sleep=self._sleep(),
        )

    def set_state(self, state: WorldState) -> None:
        """Put the scene as it was, to the bit. Raises InvalidValueError: it has values that are not finite."""
        if not all(np.isfinite(each).all() for each in (state.physics, *state.looks)):
            raise InvalidValueError("the scene has values that are not finite")
        for mine, then in zip(appearance_arrays(self.model), state.looks, strict=True):
            mine[:] = then
        self._composite = state.composite
        self._nuisance = state.nuisance
        self.places = state.places
        self.sensing.aside_m = state.sensing.aside_m
        self.sensing.turned_rad = state.sensing.turned_rad
        mujoco.mj_resetData(self.model, self.data)  # nothing sleeps
        self.set_physics_state(state.physics)
        mujoco.mj_forward(self.model, self.data)  # else a body that sleeps wakes without its inertia
        self.set_physics_state(state.physics)
        self._set_sleep(state.sleep)

    def _sleep(self) -> Sleep:
        return {name: copy.copy(getattr(self.data, name)) for name in _SLEEP}

    def _set_sleep(self, sleep: Sleep) -> None:
        for name, value in sleep.items():
            setattr(self.data, name, value)

    def __getstate__(self) -> dict[str, Any]:
        """The attributes of a copy or a pickle, and the sleeping bodies: a pickled ``mjData`` forgets a part of
        that.
        """
        return {**self.__dict__, "sleep": self._sleep()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """See :meth:`__getstate__`."""
        sleep = state.pop("sleep")
        self.__dict__.update(state)
        self._set_sleep(sleep)

    def physics(self) -> Floats:
        """MuJoCo's state of the scene, with the start values of its solvers, copied."""
        physics = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, physics, _STATE)
        return physics

    def set_physics_state(self, physics: Floats) -> None:
        """Put the moving bodies of the scene as :meth:`physics` found it, to the bit."""
        mujoco.mj_setState(self.model, self.data, physics, _STATE)
        self.update()

    def decisive(self) -> tuple[Hashable, ...]:
        """All values that decide, with the model and the arguments, the result of :meth:`execute`."""
        noise = tuple(each for index, share in enumerate(self._placement_noise) for each in self._off(index, share))
        return self.physics().tobytes(), noise, self.sensing.aside_m, self.sensing.turned_rad

    def place(self, macrostate: State, rng: np.random.Generator) -> None:
        """Start anew, every object a little off its place as the appearance says; nothing from before remains."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self._rest_qpos
        self.data.ctrl[:] = self._rest_ctrl
        *objects, gesture = macrostate
        for index, offset in enumerate(rng.uniform(-1.0, 1.0, (len(objects), 3)).tolist()):
            self._put(index, objects[index], offset)
        self.set_gesture(gesture)
        if self._distraction is not None:
            self._distraction.place(self.data, rng)
        self._nuisance = draw_nuisance(self.level, rng)
        self.update()

    def draw_places(self, most_m: float, rng: np.random.Generator) -> None:
        """Draw each object's place of an episode off its slot: up to so many metres along x and y, and turned.

        Raises:
            InvalidValueError: There are no such places apart from each other.
        """
        slots_m = np.array([self._slot_m(index) for index in range(len(self.places))])
        later, earlier = np.tril_indices(len(slots_m), -1)
        for _ in range(_DRAWS):
            drawn = rng.uniform(-1.0, 1.0, (len(slots_m), 3)) * (most_m, most_m, PLACEMENT_YAW_RAD)
            places_m = slots_m + drawn[:, :2]
            if (np.abs(places_m[later] - places_m[earlier]).max(axis=1) >= _APART_M).all():
                self.places = tuple((x_m, y_m, yaw_rad) for x_m, y_m, yaw_rad in drawn.tolist())
                return
        raise InvalidValueError(f"No places {most_m:g} m off their slots keep objects apart; give a smaller placement.")

    def draw_placement_noise(self, rng: np.random.Generator) -> None:
        """Draw where the next macro-action puts objects down: as far off their places as at a start.

        Then no frame tells which object was moved before. Without it, objects come down exactly on their places.
        """
        self._placement_noise = rng.uniform(-1.0, 1.0, (len(self._placement_noise), 3)).tolist()

    def hide_gesture(self, hidden: bool) -> None:
        """Let no camera see people's hands and arms, or let all; where they are stays as it is."""
        self.model.mat_rgba[self._people, 3] = 0.0 if hidden else 1.0

    def observed(self, macrostate: State) -> State:
        """The view of cameras of a macrostate: its gesture is -1 where it is hidden."""
        return (*macrostate[:-1], HIDDEN) if self.model.mat_rgba[self._people[0], 3] == 0.0 else macrostate

    def vary(self, rng: np.random.Generator, *, move_objects: bool = True) -> None:
        """Draw this frame's nuisances, light, colors, camera and hands as the appearance says, then its distractors.

        Where frames are patched of fragments, a fragment's pose holds too unless objects must not move: an object that
        physics moved stays there.
        """
        if self._nuisance is not None:
            self._nuisance = self._nuisance.following(rng)
        if self.level.pool is not None:
            self._patch(rng, move_objects=move_objects)
        elif self._varies:
            self._appearance.vary(rng)
            self._vary_hands(self._read_gesture(), rng.uniform(-1.0, 1.0, 4).tolist())
        elif self._distraction is None:
            return
        if self._distraction is not None:
            self._distraction.vary(self.data, rng)
        self.update()

    def _patch(self, rng: np.random.Generator, *, move_objects: bool) -> None:
        objects, _ = self._objects()
        gesture = self._read_gesture()
        hidden = self.observed((*objects, gesture))[-1]  # light would show the hidden gesture
        self._composite = draw_composite(self.level, objects, hidden, rng)
        for index, (value, fragment) in enumerate(zip(objects, self._composite.objects, strict=True)):
            if move_objects:
                x, y, _, yaw = fragment.offset
                self._put(index, value, (x, y, yaw))
        self._vary_hands(gesture, self._composite.hand.offset)

    def _vary_hands(self, gesture: int, offset: Sequence[float]) -> None:
        """Put hands off their places by shares of the ranges of the appearance in x, y, z and yaw, if they may vary."""
        if self._hands_vary():
            *shift, turn = offset
            offset_m = [self.level.hand_offset_m * each for each in shift]
            self.set_gesture(gesture, offset_m, self.level.hand_yaw_rad * turn)

    def composite(self, frame: Frame) -> Frame:
        """The agent's frame from a rendered one (H, W, 3): itself, unless frames are patched or have nuisances."""
        patched = frame if self._composite is None else self._composite.of(frame)
        return patched if self._nuisance is None else self._nuisance.of(patched)

    def reward(self, ruled: float, rng: np.random.Generator) -> float:
        """The reward that the agent gets for that of the rules: on average the same, and the same where it is exact."""
        reward = float(ruled)
        if self.level.reward_std:
            reward += self.level.reward_std * float(rng.standard_normal())
        if self.level.reward_step:
            reward += self.level.reward_step * int(rng.integers(-1, 2))
        return reward

    @abc.abstractmethod
    def set_outcome(self, action: int, intended: State) -> None:
        """Kinematic execution: put the scene where a perfect ``action`` leads."""

    @property
    @abc.abstractmethod
    def executor(self) -> MacroExecutor:
        """The executor of macro-actions in contact physics, made when it is first needed."""

    @abc.abstractmethod
    def execute(self, action: int, intended: State) -> MacroResult:
        """Physical execution: plan, simulate, and let people react.

        ``intended`` says how people in the scene act, never how far the robot succeeds.

        Raises:
            DivergedError: The simulation blew up.
        """

    @abc.abstractmethod
    def rest(self) -> None:
        """Bring the scene to where macro-actions begin: the arm at its observation pose, with a held object."""

    def read(self) -> Reading:
        """Read the macrostate back from where objects, gripper and hands are."""
        objects, problem = self._objects()
        return Reading(macrostate=(*objects, self._read_gesture()), problem=problem)

    # --- for each task -------------------------------------------------------------------------------------------

    @abc.abstractmethod
    def _slot_m(self, index: int) -> tuple[float, float]:
        """The nominal place of an object on the table, in x and y."""

    @abc.abstractmethod
    def _put(self, index: int, value: int, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Put an object where ``value`` says, off by shares of the ranges of the appearance in x, y and yaw."""

    @abc.abstractmethod
    def read_object(self, index: int, pose: list[float]) -> tuple[int, str | None]:
        """The value nearest to an object's pose (7), and the fault of that pose."""

    @abc.abstractmethod
    def value_in_hand(self, index: int, pose: list[float], value: int, *, gripped: bool) -> int:
        """The value that an object which is touched or moves has come to, from ``value``, by its pose (7).

        ``gripped``: both fingers touch it.
        """

    @abc.abstractmethod
    def progress(self, index: int, pose: list[float], before: int, after: int) -> float:
        """How much of the way an object has made from one value to another, by its pose (7): 0 to 1, or beyond."""

    @abc.abstractmethod
    def _hands_m(self, gesture: int) -> dict[int, Point]:
        """Where people's hands are, by the number of their mocap body."""

    @abc.abstractmethod
    def _read_gesture(self) -> int:
        """The gesture of the hands."""

    def _hands_vary(self) -> bool:
        return True

    # --- for all tasks -------------------------------------------------------------------------------------------

    def _scaled(self, offset: Sequence[float]) -> tuple[float, float, float]:
        """Shares of the ranges of the appearance, in x, y and yaw, as metres and radians."""
        x, y, yaw = offset
        return self.level.object_offset_m * x, self.level.object_offset_m * y, self.level.object_yaw_rad * yaw

    def _off(self, index: int, offset: Sequence[float]) -> Place:
        """How far an object is off its slot, in metres and radians, that is off its place by such shares."""
        x_m, y_m, yaw_rad = self._scaled(offset)
        place_x_m, place_y_m, place_yaw_rad = self.places[index]
        return place_x_m + x_m, place_y_m + y_m, place_yaw_rad + yaw_rad

    def _place_m(self, index: int) -> tuple[float, float]:
        """An object's place of this episode on the table, in x and y."""
        x_m, y_m = self._slot_m(index)
        return x_m + self.places[index][0], y_m + self.places[index][1]

    def set_gesture(self, gesture: int, offset_m: Sequence[float] = (0.0, 0.0, 0.0), yaw_rad: float = 0.0) -> None:
        """Put people's hands where they say ``gesture``, off that by an offset (3,) in m and a yaw in rad."""
        x_m, y_m, z_m = offset_m
        turned = orientation.about_vertical(yaw_rad)
        for mocap, place_m in self._hands_m(gesture).items():
            self.data.mocap_pos[mocap] = place_m[0] + x_m, place_m[1] + y_m, place_m[2] + z_m
            self.data.mocap_quat[mocap] = turned

    def update(self) -> None:
        """Bring geoms, sites, cameras and lights up to date with positions."""
        mujoco.mj_kinematics(self.model, self.data)
        option = self.model.opt
        flags = option.enableflags
        option.enableflags = 0  # where bodies may sleep, MuJoCo moves cameras in the room at mj_resetData alone
        mujoco.mj_camlight(self.model, self.data)
        option.enableflags = flags

    def object_poses(self) -> Floats:
        """Positions and quaternions of the objects, copied. Shape (N, 7)."""
        return np.asarray(self.data.qpos[self.object_qpos])

    def _objects(self) -> tuple[State, str | None]:
        """The value of each object, and the fault of the first that is not as it should be."""
        place = self.data.qpos.tobytes(), self.data.mocap_pos.tobytes()
        if place != self._read_at:  # asked several times of one moment
            read = [self.read_object(index, pose) for index, pose in enumerate(self.object_poses().tolist())]
            problem = next((problem for _, problem in read if problem), None)
            self._read_at = place
            self._latest_objects = (tuple([value for value, _ in read]), problem)
        return self._latest_objects

    def _tipped(self, index: int, pose: list[float]) -> str | None:
        tilt_rad = orientation.tilt_rad(*pose[4:6])
        if tilt_rad <= MAX_TILT_RAD:
            return None
        return f"{self.object_names[index]} is tipped by {math.degrees(tilt_rad):.0f} degrees"

    def _pushed(self, moving: Collection[int], before: Floats, how: str) -> str | None:
        """Which object but the moving ones is elsewhere than in the poses before (N, 7)."""
        shift_m = np.linalg.norm(self.object_poses()[:, :3] - before[:, :3], axis=1)
        for index, name in enumerate(self.object_names):
            if index not in moving and shift_m[index] > MAX_OTHER_SHIFT_M:
                return f"{name} was pushed {1e3 * shift_m[index]:.0f} mm {how}"
        return None
