"""A scene for people: as plain shapes and motions, to be drawn elsewhere, and as images."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import InvalidValueError, brief
from imagine_bench.interfaces import ArmMotion, Floats, Frame, Motion, Shape3D

from .motion.executor import MacroResult
from .rendering.cameras import DRAWN_GROUPS, agent_camera, human_camera_view
from .rendering.renderer import Renderer, image_size
from .scenes.arm import ARM_JOINTS, FINGER_JOINTS, TCP_SITE
from .scenes.constants import HUMAN_CAMERA
from .world import World

MAX_MOTION_HZ = 1000
_ANSWER_S = 0.05  # so long after a macro-action people answer it, in a recording
_PLANE_HALF_THICKNESS_M = 0.005
_KINDS = {
    mujoco.mjtGeom.mjGEOM_BOX: ("box", 3),
    mujoco.mjtGeom.mjGEOM_SPHERE: ("sphere", 1),
    mujoco.mjtGeom.mjGEOM_CAPSULE: ("capsule", 2),
    mujoco.mjtGeom.mjGEOM_CYLINDER: ("cylinder", 2),
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: ("ellipsoid", 3),
    mujoco.mjtGeom.mjGEOM_MESH: ("mesh", 0),
}


def body_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Every body, the world included, in the model's order."""
    return tuple(model.body(index).name for index in range(model.nbody))


def shapes_of(model: mujoco.MjModel) -> tuple[Shape3D, ...]:
    """Every geom that some view draws, also people who are hidden now; a plane becomes a thin box under its surface."""
    return tuple(_shape(model, index) for index in range(model.ngeom) if model.geom_group[index] in DRAWN_GROUPS)


def _shape(model: mujoco.MjModel, index: int) -> Shape3D:
    geom = model.geom(index)
    geom_type = mujoco.mjtGeom(model.geom_type[index])
    pose = np.concatenate([model.geom_pos[index], model.geom_quat[index]])
    size = np.zeros(3)
    vertices = None
    faces = None
    if geom_type == mujoco.mjtGeom.mjGEOM_PLANE:
        kind = "box"
        size[:] = (*model.geom_size[index, :2], _PLANE_HALF_THICKNESS_M)
        pose[2] -= _PLANE_HALF_THICKNESS_M
    else:
        kind, n_sizes = _KINDS[geom_type]
        size[:n_sizes] = model.geom_size[index, :n_sizes]
    if kind == "mesh":
        vertices, faces = _mesh(model, int(model.geom_dataid[index]))
    material = int(model.geom_matid[index])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[index]
    return Shape3D(
        name=geom.name,
        body=model.body(int(model.geom_bodyid[index])).name,
        kind=kind,
        size=size,
        pose_in_body=pose,
        rgba=np.array([*rgba[:3], 1.0]),
        vertices=vertices,
        faces=faces,
    )


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    vertex = int(model.mesh_vertadr[mesh])
    face = int(model.mesh_faceadr[mesh])
    vertices = model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[mesh])]
    faces = model.mesh_face[face : face + int(model.mesh_facenum[mesh])]
    return vertices.astype(np.float64), faces.astype(np.int64)


def poses_of(
    model: mujoco.MjModel, qpos: NDArray[np.float64], mocap_pos: NDArray[np.float64], mocap_quat: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Body poses in the world by forward kinematics: positions (m) and quaternions (w, x, y, z). Shape (K, nbody, 7).

    ``qpos`` (K, nq) are positions at each time; mocap bodies, (nmocap, 3) and (nmocap, 4), stand still.
    """
    data = mujoco.MjData(model)
    data.mocap_pos[:] = mocap_pos
    data.mocap_quat[:] = mocap_quat
    poses = np.empty((len(qpos), model.nbody, 7))
    for row, positions in enumerate(qpos):
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        poses[row, :, :3] = data.xpos
        poses[row, :, 3:] = data.xquat
    return poses


def arm_columns(model: mujoco.MjModel) -> tuple[list[int], list[int], list[int]]:
    """Where the seven joints, then the two fingers, are in positions, velocities and controls of a scene."""
    names = (*ARM_JOINTS, *FINGER_JOINTS)
    joints = [model.joint(name) for name in names]
    servos = [f"{name.replace('_slide', '')}_servo" for name in names]
    qpos = [int(joint.qposadr[0]) for joint in joints]
    qvel = [int(joint.dofadr[0]) for joint in joints]
    return qpos, qvel, [int(model.actuator(servo).id) for servo in servos]


def tcp_in_world(data: mujoco.MjData, tcp: int) -> Floats:
    """Position (m) and quaternion (w, x, y, z) of a site, the point between the fingers. Shape (7,).

    Kinematics is up to date.
    """
    pose = np.empty(7)
    pose[:3] = data.site_xpos[tcp]
    mujoco.mju_mat2Quat(pose[3:], data.site_xmat[tcp])
    return pose


def arm_motion_of(model: mujoco.MjModel, time_s: Floats, qpos: Floats, qvel: Floats, ctrl: Floats) -> ArmMotion:
    """The arm's part of a scene's motion: times (K,), positions (K, nq), velocities (K, nv) and commands (K, nu)."""
    data = mujoco.MjData(model)
    poses = np.empty((len(qpos), 7))
    tcp = model.site(TCP_SITE).id
    for row, positions in enumerate(qpos):
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        poses[row] = tcp_in_world(data, tcp)
    at, moving, told = arm_columns(model)
    (joints, fingers), (speeds, _), (commands, grips) = (
        np.split(values, [len(ARM_JOINTS)], axis=1) for values in (qpos[:, at], qvel[:, moving], ctrl[:, told])
    )
    return ArmMotion(
        time_s=time_s,
        joint_rad=joints,
        joint_rad_s=speeds,
        gripper_m=fingers,
        joint_command_rad=commands,
        gripper_command_m=grips,
        tcp_in_world=poses,
    )


class FilmedScene:
    """A world and its latest macro-action, for people: as shapes, as motion, and as images.

    Args:
        world: The scene.
        motion_hz: :attr:`capture_motion_hz`.
    """

    def __init__(self, world: World, motion_hz: float) -> None:
        self.world = world
        self.capture_motion_hz = motion_hz
        self._agent_camera = agent_camera(world.model)
        self._human_camera: Renderer | None = None
        self._latest: MacroResult | None = None
        self._people = self._mocap()

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled scene."""
        return self.world.model

    @property
    def data(self) -> mujoco.MjData:
        """The scene's state; only to be read."""
        return self.world.data

    @property
    def capture_motion_hz(self) -> float:
        """Samples a simulated second that :meth:`step` keeps of a motion, 0 (none) to 1000; nothing else changes."""
        return self._capture_motion_hz

    @capture_motion_hz.setter
    def capture_motion_hz(self, rate_hz: float) -> None:
        if not isinstance(rate_hz, (int, float)) or not 0 <= rate_hz <= MAX_MOTION_HZ:
            raise InvalidValueError(f"Motion cannot be captured at {brief(rate_hz)} Hz; give 0 to {MAX_MOTION_HZ}.")
        self._capture_motion_hz = float(rate_hz)

    def shapes(self) -> tuple[Shape3D, ...]:
        """Every drawable part, arm included."""
        return shapes_of(self.world.model)

    def motion(self) -> Motion:
        """The motion of the latest macro-action as captured, else one sample of the standing scene.

        People stand still meanwhile; what they do when it is over is one sample more.
        """
        model = self.world.model
        standing = poses_of(model, self.world.data.qpos[None], *self._mocap())
        latest = self._captured()
        if latest is None:
            return Motion(body_names=body_names(model), time_s=np.zeros(1), poses_in_world=standing)
        time_s = latest.time_s
        poses = poses_of(model, latest.qpos, *self._people)
        if not all(np.array_equal(*pair) for pair in zip(self._people, self._mocap(), strict=True)):
            time_s = np.append(time_s, time_s[-1] + _ANSWER_S)
            poses = np.concatenate([poses, standing])
        return Motion(body_names=body_names(model), time_s=time_s, poses_in_world=poses)

    def arm_motion(self) -> ArmMotion:
        """The arm during the latest macro-action as captured, else one sample of the standing scene."""
        model = self.world.model
        data = self.world.data
        latest = self._captured()
        if latest is None:
            return arm_motion_of(model, np.zeros(1), data.qpos[None], data.qvel[None], data.ctrl[None].copy())
        return arm_motion_of(model, latest.time_s, latest.qpos, latest.qvel, latest.ctrl)

    def agent_view(self) -> Frame:
        """The frame that agents see, drawn now. Shape (64, 64, 3)."""
        return self.world.develop(self._agent_camera.frame(self.world.data, self.world.model))

    def human_view(self, width: int = 640, height: int = 480) -> Frame:
        """An image of the whole scene with the arm. Shape (height, width, 3)."""
        view = human_camera_view(HUMAN_CAMERA, *image_size(width, height))
        if self._human_camera is None or self._human_camera.view != view:
            if self._human_camera is not None:
                self._human_camera.close()
            self._human_camera = Renderer(self.world.model, view)
        return self._human_camera.frame(self.world.data)

    def film(self, width: int = 640, height: int = 480) -> Frame:
        """Images of the whole scene during the latest macro-action, as captured. Shape (K, height, width, 3)."""
        return np.stack([self.human_view(width, height) for _ in self.replay()])

    def agent_film(self) -> Frame:
        """What the agent's camera sees at each sample that :meth:`arm_motion` gives. Shape (K, 64, 64, 3)."""
        return np.stack([self.agent_view() for _ in self.replay()])

    def replay(self) -> Iterator[float]:
        """Set the scene to each captured sample of the latest macro-action in turn; at the end it stands as before.

        Yields:
            Simulated seconds since the macro-action began. One sample, the standing scene, where none were captured.
        """
        world = self.world
        latest = self._captured()
        if latest is None:
            yield 0.0
            return
        standing = world.data.qpos.copy()
        people = self._mocap()
        try:
            world.data.mocap_pos[:], world.data.mocap_quat[:] = self._people
            for time_s, qpos in zip(latest.time_s.tolist(), latest.qpos, strict=True):
                world.data.qpos[:] = qpos
                world.update()
                yield time_s
        finally:
            world.data.qpos[:] = standing
            world.data.mocap_pos[:], world.data.mocap_quat[:] = people
            world.update()

    def _captured(self) -> MacroResult | None:
        """The latest macro-action, if its motion was captured."""
        latest = self._latest
        return latest if latest is not None and len(latest.time_s) else None

    def _mocap(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where people's hands are now: positions (nmocap, 3) and quaternions (nmocap, 4), copied."""
        return self.world.data.mocap_pos.copy(), self.world.data.mocap_quat.copy()
