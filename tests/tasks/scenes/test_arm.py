"""The compiled arm against the published table of the robot, typed here a second time."""

import math

import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.scenes.arm import ARM_JOINTS, JOINT_SPEED_LIMITS_RAD_S, arm_spec
from imagine_bench.tasks.scenes.constants import OBSERVATION_QPOS_RAD

# RethinkRobotics/sawyer_robot, sawyer_base.urdf.xacro, commit 2fe61d9: origin xyz (m) and rpy (rad), limits (rad),
# effort (N m), speed (rad/s), mass (kg), centre of mass (m) and inertia xx yy zz xy xz yz (kg m2) per joint and link.
TABLE = [
    ((0, 0, 0.08), (0, 0, 0), (-3.0503, 3.0503), 80, 1.74, 5.3213, (0.024366, 0.010969, 0.14363),
     (0.053314, 0.057902, 0.023659, 0.0047093, 0.011734, 0.0080179)),
    ((0.081, 0.05, 0.237), (-math.pi / 2, math.pi / 2, 0), (-3.8095, 2.2736), 80, 1.328, 4.505,
     (-0.0030849, -0.026811, 0.092521), (0.022398, 0.014613, 0.017295, -0.00023986, -0.00029362, -0.0060875)),
    ((0, -0.14, 0.1425), (math.pi / 2, 0, 0), (-3.0426, 3.0426), 40, 1.957, 1.745, (-0.00016044, -0.014967, 0.13582),
     (0.025506, 0.0253, 0.0034179, 4.4101e-6, 1.4955e-5, -0.0033204)),
    ((0, -0.042, 0.26), (-math.pi / 2, 0, 0), (-3.0439, 3.0439), 40, 1.957, 2.5097, (-0.0048135, -0.0281, -0.084154),
     (0.01016, 0.0065685, 0.0069078, -9.7452e-6, 0.00026624, 0.0030316)),
    ((0, -0.125, -0.1265), (math.pi / 2, 0, 0), (-2.9761, 2.9761), 9, 3.485, 1.1136, (-0.0018844, 0.0069001, 0.1341),
     (0.013557, 0.013555, 0.0013658, 1.8109e-5, 0.00013523, 0.0010561)),
    ((0, 0.031, 0.275), (-math.pi / 2, 0, 0), (-2.9761, 2.9761), 9, 3.485, 1.5625, (0.0061133, -0.023697, 0.076416),
     (0.0047328, 0.0029676, 0.0031762, 0.00011526, 4.6269e-5, -0.0011557)),
    ((0, -0.11, 0.1053), (-math.pi / 2, -0.17453, 3.1416), (-4.7124, 4.7124), 9, 4.545, 0.3292,
     (-8.0726e-6, 0.0085838, -0.0049566), (0.00031105, 0.00021549, 0.00035976, 1.4771e-6, -3.7074e-7, -8.4533e-6)),
]  # fmt: skip
HAND_OFFSET_M, HAND_YAW_RAD = (0, 0, 0.0245), math.pi / 2


@pytest.fixture(scope="module")
def model():
    return arm_spec().compile()


def rotation(roll, pitch, yaw):
    """URDF's fixed-axis rpy: Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def chain(qpos):
    """World position and rotation of right_l0 .. right_l6 and right_hand."""
    position, frame, poses = np.zeros(3), np.eye(3), []
    for (xyz, rpy, *_), angle in zip(TABLE, qpos, strict=True):
        position = position + frame @ np.array(xyz)
        frame = frame @ rotation(*rpy) @ rotation(0, 0, angle)
        poses.append((position, frame))
    poses.append((position + frame @ np.array(HAND_OFFSET_M), frame @ rotation(0, 0, HAND_YAW_RAD)))
    return poses


def test_forward_kinematics_is_the_published_chain(model):
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    low, high = model.jnt_range[:7].T
    bodies = [model.body(name).id for name in [f"right_l{index}" for index in range(7)] + ["right_hand"]]
    for _ in range(200):
        data.qpos[:7] = rng.uniform(low, high)
        mujoco.mj_kinematics(model, data)
        for body, (position, frame) in zip(bodies, chain(data.qpos[:7]), strict=True):
            assert np.abs(data.xpos[body] - position).max() < 1e-9
            assert np.abs(data.xmat[body].reshape(3, 3) - frame).max() < 1e-9


def test_compiled_numbers_are_the_published_ones(model):
    for index, (_, _, limits, effort, speed, mass, centre, inertia) in enumerate(TABLE):
        body, joint, servo = model.body(f"right_l{index}"), model.joint(f"right_j{index}"), f"right_j{index}_servo"
        assert joint.name == ARM_JOINTS[index]
        np.testing.assert_array_equal(joint.range, limits)
        np.testing.assert_array_equal(joint.axis, (0, 0, 1))
        np.testing.assert_array_equal(model.actuator(servo).forcerange, (-effort, effort))
        assert speed == JOINT_SPEED_LIMITS_RAD_S[index]
        assert body.mass[0] == mass
        np.testing.assert_allclose(body.ipos, centre, atol=1e-12)
        principal = rotation_of(body.iquat)
        xx, yy, zz, xy, xz, yz = inertia
        np.testing.assert_allclose(
            principal @ np.diag(body.inertia) @ principal.T, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], atol=1e-8
        )


def rotation_of(quat):
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def test_arm_carries_itself(model):
    """Gravity is compensated on every moving part: at rest without control the arm stays."""
    data = mujoco.MjData(model)
    data.qpos[:7] = OBSERVATION_QPOS_RAD
    data.qpos[7:] = 0.02
    data.ctrl[:] = data.qpos
    mujoco.mj_forward(model, data)
    assert np.abs(data.qfrc_bias[:7]).max() > 1.0  # there is weight to carry
    mujoco.mj_step(model, data, nstep=200)
    assert np.abs(data.qpos[:7] - OBSERVATION_QPOS_RAD).max() < 1e-6
