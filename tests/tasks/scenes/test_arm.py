"""The compiled arm is the published robot's, and carries itself."""

import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.scenes.arm import JOINT_SPEED_LIMITS_RAD_S, arm_spec
from imagine_bench.tasks.scenes.constants import OBSERVATION_QPOS_RAD
from whole_outputs import tabulated


@pytest.fixture(scope="module")
def model():
    return arm_spec().compile()


def rotation(quat):
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def test_the_compiled_numbers_are_the_published_ones(model, expected):
    """The kept table has those of RethinkRobotics/sawyer_robot, sawyer_base.urdf.xacro, commit 2fe61d9.

    A row is a joint and its link: origin (m) and axes in the link before, mass (kg), centre of mass (m), inertia
    xx yy zz xy xz yz about it (kg m2), and the joint's axis, range (rad), effort (N m) and speed (rad/s).
    """
    rows = []
    for index, speed_rad_s in enumerate(JOINT_SPEED_LIMITS_RAD_S):
        body, joint = model.body(f"right_l{index}"), model.joint(f"right_j{index}")
        principal = rotation(body.iquat)
        inertia = (principal @ np.diag(body.inertia) @ principal.T)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        effort_nm = model.actuator(f"right_j{index}_servo").forcerange
        rows.append([body.pos, *rotation(body.quat), body.mass, body.ipos, inertia, joint.axis, joint.range])
        rows[-1] += [effort_nm, speed_rad_s]
    hand = model.body("right_hand")
    expected("arm", tabulated([*rows, [hand.pos, *rotation(hand.quat)]], digits=5), exactly=False)


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
