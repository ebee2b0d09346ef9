"""Differential inverse kinematics solves its least squares to the end, and turns about axes of the world."""

from __future__ import annotations

import mink
import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.continuous.controls import HandControl
from imagine_bench.tasks.continuous.differential import DifferentialIK
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.scenes.arm import JOINT_SPEED_LIMITS_RAD_S, TCP_SITE
from imagine_bench.tasks.scenes.constants import OBSERVATION_QPOS_RAD

PERIOD_S = 0.04
MOST_RAD = PERIOD_S * np.array(JOINT_SPEED_LIMITS_RAD_S)
POSTURE_COST = 0.005 * np.array([1.0] * 6 + [0.1])
"""Square roots of the weights of the posture term."""


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_a_step_within_limits_misses_the_motion_by_least_squares(share: float) -> None:
    """Metres count once and radians 0.3 times; a step that misses by more than 2 mm is held up.

    A joint's slope of the squares is 0, or at a limit it points outward: less is only to be had beyond.
    """
    arm = ArmModel()
    ik = DifferentialIK(arm)
    rng = np.random.default_rng(1)
    weights = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
    data = mujoco.MjData(arm.model)
    held_up = []
    for _ in range(20):
        data.qpos[:] = np.array(OBSERVATION_QPOS_RAD) + rng.uniform(-0.3, 0.3, 7)
        motion = share * np.concatenate([rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.5, 0.5, 3)])
        mujoco.mj_forward(arm.model, data)
        jacobian = np.empty((6, 7))
        mujoco.mj_jacSite(arm.model, data, jacobian[:3], jacobian[3:], arm.model.site(TCP_SITE).id)
        least_rad, most_rad = np.clip(arm.model.jnt_range.T - data.qpos, -MOST_RAD, MOST_RAD)
        rows = np.vstack([weights[:, None] * jacobian, np.diag(POSTURE_COST)])
        wanted = np.concatenate([weights * motion, POSTURE_COST * 0.15 * (OBSERVATION_QPOS_RAD - data.qpos)])
        ik.hand_pose(data.qpos.copy())
        step_rad, limited = ik.step(motion, MOST_RAD)
        slope = rows.T @ (rows @ step_rad - wanted)
        at_most = step_rad > most_rad - 1e-9
        at_least = step_rad < least_rad + 1e-9
        assert (slope[at_most] < 1e-8).all()
        assert (slope[at_least] > -1e-8).all()
        assert (np.abs(slope[~at_most & ~at_least]) < 1e-8).all()
        assert (least_rad - 1e-9 <= step_rad).all()
        assert (step_rad <= most_rad + 1e-9).all()
        missed_m = np.linalg.norm(weights * (jacobian @ step_rad - motion))
        assert limited == (missed_m > 2e-3)
        held_up.append(limited)
    assert np.mean(held_up) > 0.5 if share > 0.2 else np.mean(held_up) < 0.5


@pytest.mark.parametrize("axis", range(3))
def test_a_hand_that_is_asked_for_a_pose_turns_about_axes_of_the_world(axis: int) -> None:
    """From a hand that is tipped over: of one that points down, the rotation is its own inverse."""
    control = HandControl("pose", ArmModel(), PERIOD_S)
    joints_rad = np.array(OBSERVATION_QPOS_RAD) + np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.6, 0.0])
    place_m, rotation = control.hand_pose(joints_rad)
    wanted = mink.SO3.exp(0.2 * np.eye(3)[axis]).as_matrix() @ rotation
    quat = mink.SO3.from_matrix(wanted).wxyz
    action = control.checked(np.array([*place_m, *quat, 1.0]))
    for _ in range(25):
        joints_rad = control.command(action, joints_rad, 0.0).joints_rad
    reached_m, reached = control.hand_pose(joints_rad)
    assert np.abs(reached - wanted).max() < 1e-3
    assert np.abs(reached_m - place_m).max() < 1e-3
