"""Differential inverse kinematics is the problem that mink solves."""

from __future__ import annotations

import mink
import numpy as np
from imagine_bench.tasks.continuous.differential import DifferentialIK
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.scenes.arm import ARM_JOINTS, JOINT_SPEED_LIMITS_RAD_S, TCP_SITE
from imagine_bench.tasks.scenes.constants import OBSERVATION_QPOS_RAD

from imagine_bench.arrays import Floats

PERIOD_S = 0.04
MOST_RAD = PERIOD_S * np.array(JOINT_SPEED_LIMITS_RAD_S)
POSTURE_COST = 0.005 * np.array([1.0] * 6 + [0.1])
"""Square roots of the weights of the posture term."""


def mink_step(arm: ArmModel, qpos_rad: Floats, motion: Floats) -> Floats:
    """The step of ``mink.solve_ik`` with a frame task, a posture task and the limits of range and speed. Shape (7,)."""
    configuration = mink.Configuration(arm.model)
    configuration.update(qpos_rad)
    place_m, rotation = arm.tcp_in_base(qpos_rad)
    frame = mink.FrameTask(TCP_SITE, "site", position_cost=1.0, orientation_cost=0.3)
    turned = mink.SO3.from_matrix(mink.SO3.exp(motion[3:]).as_matrix() @ rotation)
    frame.set_target(mink.SE3.from_rotation_and_translation(turned, place_m + motion[:3]))
    posture = mink.PostureTask(arm.model, cost=POSTURE_COST, gain=0.15)
    posture.set_target(np.array(OBSERVATION_QPOS_RAD))
    speeds = dict(zip(ARM_JOINTS, JOINT_SPEED_LIMITS_RAD_S, strict=True))
    limits = [mink.ConfigurationLimit(arm.model, gain=1.0), mink.VelocityLimit(arm.model, speeds)]
    return PERIOD_S * mink.solve_ik(configuration, [frame, posture], PERIOD_S, "daqp", limits=limits)


def test_small_steps_are_those_of_mink() -> None:
    """Both linearise; mink's error is a logarithm, so they differ in the second order of the motion."""
    arm = ArmModel()
    ik = DifferentialIK(arm)
    rng = np.random.default_rng(0)
    off_rad: dict[float, list[float]] = {1.0: [], 0.1: []}
    for _ in range(30):
        qpos_rad = np.array(OBSERVATION_QPOS_RAD) + rng.uniform(-0.3, 0.3, 7)
        motion = np.concatenate([rng.uniform(-0.01, 0.01, 3), rng.uniform(-0.05, 0.05, 3)])
        for share, found in off_rad.items():
            ik.hand_pose(qpos_rad)
            step_rad, _ = ik.step(share * motion, MOST_RAD)
            found.append(float(np.abs(step_rad - mink_step(arm, qpos_rad, share * motion)).max()))
    assert max(off_rad[0.1]) < 2e-4
    assert max(off_rad[1.0]) < 1e-2
