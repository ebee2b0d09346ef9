"""A scene for people: as plain shapes and motions, to be drawn elsewhere, and as images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from numbers import Real

import mujoco
import numpy as np

from imagine_bench.errors import InvalidValueError, brief
from imagine_bench.interfaces import ArmMotion, Floats, Frame, Motion, Shape3D

from .motion.executor import MacroResult, Samples
from .rendering.cameras import DRAWN_GROUPS, agent_camera_view, human_camera_view
from .rendering.renderer import Renderer, View
from .scenes.arm import ARM_JOINTS, TCP_SITE, arm_columns, tcp_in_world
from .scenes.constants import HUMAN_CAMERA
from .world import World

MAX_MOTION_HZ = 1000
_ANSWER_S = 0.05  # so long after a macro-action people answer it, in a recording
_PLANE_HALF_THICKNESS_M = 0.005
_KINDS = {
    mujoco.mjtGeom.mjGEOM_PLANE: ("box", 2),
    mujoco.mjtGeom.mjGEOM_BOX: ("box", 3),
    mujoco.mjtGeom.mjGEOM_SPHERE: ("sphere", 1),
    mujoco.mjtGeom.mjGEOM_CAPSULE: ("capsule", 2),
    mujoco.mjtGeom.mjGEOM_CYLINDER: ("cylinder", 2),
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: ("ellipsoid", 3),
    mujoco.mjtGeom.mjGEOM_MESH: ("mesh", 0),
}


def shapes_of(model: mujoco.MjModel) -> tuple[Shape3D, ...]:
    """Every geom that some view draws, also people who are hidden now; a plane is a thin box under its surface."""
    return tuple(_shape(model, index) for index in range(model.ngeom) if model.geom_group[index] in DRAWN_GROUPS)


def motion_of(model: mujoco.MjModel, time_s: Sequence[float], poses: Sequence[Floats]) -> Motion:
    """The motion of every body, the world included, from their poses (nbody, 7) at each time."""
    names = tuple(model.body(index).name for index in range(model.nbody))
    return Motion(body_names=names, time_s=np.array(time_s), poses_in_world=np.array(poses))


def body_poses(data: mujoco.MjData) -> Floats:
    """Positions (m) and quaternions (w, x, y, z) of all bodies, copied. Shape (nbody, 7)."""
    return np.hstack([data.xpos, data.xquat])


def _shape(model: mujoco.MjModel, index: int) -> Shape3D:
    geom = model.geom(index)
    geom_type = mujoco.mjtGeom(model.geom_type[index])
    pose = np.concatenate([model.geom_pos[index], model.geom_quat[index]])
    kind, n_sizes = _KINDS[geom_type]
    size = np.zeros(3)
    size[:n_sizes] = model.geom_size[index, :n_sizes]
    if geom_type == mujoco.mjtGeom.mjGEOM_PLANE:
        size[2] = _PLANE_HALF_THICKNESS_M
        pose[2] -= _PLANE_HALF_THICKNESS_M
    vertices = None
    faces = None
    if kind == "mesh":
        mesh = model.mesh(int(model.geom_dataid[index]))
        vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]].astype(np.float64)
        faces = model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]].astype(np.int64)
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


class FilmedScene:
    """A world and its latest macro-action, for people: as shapes, as motion, and as images.

    Args:
        world: The scene.
        motion_hz: :attr:`capture_motion_hz`.
    """

    def __init__(self, world: World, motion_hz: float) -> None:
        self.world = world
        self._capture_motion_hz: float
        self.capture_motion_hz = motion_hz
        self._cameras: list[Renderer] = []
        self.camera_for_people = HUMAN_CAMERA
        self.latest: MacroResult | None = None
        self._people = self._mocap()
        self.draws_quickly = False  #: whether images for people have coarser shadows and edges

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
        if not isinstance(rate_hz, Real) or not 0 <= rate_hz <= MAX_MOTION_HZ:
            raise InvalidValueError(f"Motion cannot be captured at {brief(rate_hz)} Hz; give 0 to {MAX_MOTION_HZ}.")
        self._capture_motion_hz = float(rate_hz)

    def shapes(self) -> tuple[Shape3D, ...]:
        """Every drawable part, arm included."""
        return shapes_of(self.model)

    def motion(self) -> Motion:
        """The motion of the latest macro-action as captured, else one sample of the standing scene.

        People stand still meanwhile; their gesture when it is over is one sample more.
        """
        data = self.data
        times_s = []
        poses = []
        for time_s in self.replay():
            times_s.append(time_s)
            poses.append(body_poses(data))
        as_before = all(np.array_equal(*pair) for pair in zip(self._people, self._mocap(), strict=True))
        if self._captured() and not as_before:
            times_s.append(times_s[-1] + _ANSWER_S)
            poses.append(body_poses(data))
        return motion_of(self.model, times_s, poses)

    def arm_motion(self) -> ArmMotion:
        """The arm during the latest macro-action as captured, else one sample of the standing scene."""
        data = self.data
        standing = Samples(np.zeros(1), data.qpos[None].copy(), data.qvel[None].copy(), data.ctrl[None].copy())
        samples = self._captured() or standing
        columns = arm_columns(self.model)
        qpos = samples.qpos[:, columns.qpos]
        ctrl = samples.ctrl[:, columns.ctrl]
        tcp = self.model.site(TCP_SITE).id
        n_joints = len(ARM_JOINTS)
        return ArmMotion(
            time_s=samples.time_s,
            joint_rad=qpos[:, :n_joints],
            joint_rad_s=samples.qvel[:, columns.qvel[:n_joints]],
            gripper_m=qpos[:, n_joints:],
            joint_command_rad=ctrl[:, :n_joints],
            gripper_command_m=ctrl[:, n_joints:],
            tcp_in_world=np.array([tcp_in_world(data, tcp) for _ in self.replay()]),
        )

    def camera(self, view: View) -> Renderer:
        """The renderer of a view, made when it is first asked for. Raises UnknownNameError: no such camera."""
        for camera in self._cameras:
            if camera.view == view:
                return camera
        self._cameras.append(Renderer(self.model, view))
        return self._cameras[-1]

    def agent_view(self) -> Frame:
        """The frame that agents see, drawn now. Shape (64, 64, 3)."""
        return self.world.composite(self.camera(agent_camera_view()).frame(self.data))

    def human_view(self, width: int = 640, height: int = 480) -> Frame:
        """An image for people from their camera: the table and the objects, with the arm. Shape (height, width, 3)."""
        return self.renderer_for_people(self.camera_for_people, width, height).frame(self.data)

    def renderer_for_people(self, camera: str, width: int, height: int) -> Renderer:
        """The renderer of images for people from a camera, by name.

        While a motion is replayed, or with ``draws_quickly``, it draws coarser shadows and edges, so that a window on a
        processor does not stall.
        """
        return self.camera(human_camera_view(camera, width, height, quick=self.draws_quickly))

    def film(self, width: int = 640, height: int = 480) -> Frame:
        """Images for people of the latest macro-action, as captured. Shape (K, height, width, 3)."""
        return np.stack([self.human_view(width, height) for _ in self.replay()])

    def agent_film(self) -> Frame:
        """The image of the agent's camera at each sample that :meth:`arm_motion` gives. Shape (K, 64, 64, 3)."""
        return np.stack([self.agent_view() for _ in self.replay()])

    def replay(self) -> Iterator[float]:
        """Set the scene to each captured sample of the latest macro-action in turn; at the end it stands as before.

        Yields:
            Simulated seconds since the macro-action began. One sample, the standing scene, where none were captured.
        """
        data = self.data
        captured = self._captured()
        if captured is None:
            yield 0.0
            return
        standing = data.qpos.copy()
        people = self._mocap()
        draws_quickly = self.draws_quickly
        try:
            data.mocap_pos[:], data.mocap_quat[:] = self._people
            self.draws_quickly = True
            for time_s, qpos in zip(captured.time_s.tolist(), captured.qpos, strict=True):
                data.qpos[:] = qpos
                self.world.update()
                yield time_s
        finally:
            self.draws_quickly = draws_quickly
            data.qpos[:] = standing
            data.mocap_pos[:], data.mocap_quat[:] = people
            self.world.update()

    def _captured(self) -> Samples | None:
        """The motion of the latest macro-action, if it was captured."""
        return self.latest.motion if self.latest is not None and len(self.latest.motion.time_s) else None

    def _mocap(self) -> tuple[Floats, Floats]:
        """Where people's hands are now: positions (nmocap, 3) and quaternions (nmocap, 4), copied."""
        return self.data.mocap_pos.copy(), self.data.mocap_quat.copy()
