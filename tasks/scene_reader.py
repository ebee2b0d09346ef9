"""A compiled scene as plain shapes and motions, for drawing elsewhere."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import ArmMotion, Floats, Shape3D

from .scenes.arm import ARM_JOINTS, FINGER_JOINTS, TCP_SITE
from .scenes.constants import ARM_GROUP, SCENE_GROUP, SETTING_GROUP

DRAWN_GROUPS = (SCENE_GROUP, ARM_GROUP, SETTING_GROUP)
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
    """Every geom that some view draws; a plane becomes a thin box under its surface."""
    return tuple(_shape(model, index) for index in range(model.ngeom) if model.geom_group[index] in DRAWN_GROUPS)


def _shape(model: mujoco.MjModel, index: int) -> Shape3D:
    geom = model.geom(index)
    geom_type, pose = (
        mujoco.mjtGeom(model.geom_type[index]),
        np.concatenate([model.geom_pos[index], model.geom_quat[index]]),
    )
    size, vertices, faces = np.zeros(3), None, None
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
        name=geom.name, body=model.body(int(model.geom_bodyid[index])).name, kind=kind, size=size,
        pose_in_body=pose, rgba=rgba.astype(np.float64), vertices=vertices, faces=faces,
    )  # fmt: skip


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    vertex, face = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
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
    data.mocap_pos[:], data.mocap_quat[:] = mocap_pos, mocap_quat
    poses = np.empty((len(qpos), model.nbody, 7))
    for row, positions in enumerate(qpos):
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        poses[row, :, :3], poses[row, :, 3:] = data.xpos, data.xquat
    return poses


def arm_columns(model: mujoco.MjModel) -> tuple[list[int], list[int], list[int]]:
    """Where the seven joints, then the two fingers, are in positions, velocities and controls of a scene."""
    names = (*ARM_JOINTS, *FINGER_JOINTS)
    joints, servos = [model.joint(name) for name in names], [f"{name.replace('_slide', '')}_servo" for name in names]
    qpos, qvel = [int(joint.qposadr[0]) for joint in joints], [int(joint.dofadr[0]) for joint in joints]
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
    data, poses, tcp = mujoco.MjData(model), np.empty((len(qpos), 7)), model.site(TCP_SITE).id
    for row, positions in enumerate(qpos):
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        poses[row] = tcp_in_world(data, tcp)
    at, moving, told = arm_columns(model)
    (joints, fingers), (speeds, _), (commands, grips) = (
        np.split(values, [len(ARM_JOINTS)], axis=1) for values in (qpos[:, at], qvel[:, moving], ctrl[:, told])
    )
    return ArmMotion(
        time_s=time_s, joint_rad=joints, joint_rad_s=speeds, gripper_m=fingers,
        joint_command_rad=commands, gripper_command_m=grips, tcp_in_world=poses,
    )  # fmt: skip
