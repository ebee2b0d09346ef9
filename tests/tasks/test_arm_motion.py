"""The readings of the arm's motion during a macro-action, and that reading it changes nothing."""

from __future__ import annotations

import math

import gymnasium
import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.scenes.constants import TIMESTEP_S

import imagine_bench  # noqa: F401  (registers the environments)
from imagine_bench import registry
from imagine_bench.interfaces import ArmReader

pytestmark = pytest.mark.usefixtures("without_shadows")


def make(task="arrow_puzzle", **options):
    return gymnasium.make(registry.TASKS[task].env_id, disable_env_checker=True, **options)


def turned(motion_hz):
    env = make(motion_hz=motion_hz)
    env.reset(seed=0, options={"macrostate": (0, 1, 2, 1)})
    info = env.step(2)[4]
    return env, env.unwrapped.arm_motion(), info


def test_velocities_and_poses_belong_to_the_angles():
    env, motion, info = turned(1 / TIMESTEP_S)
    assert isinstance(env.unwrapped, ArmReader)
    np.testing.assert_allclose(motion.time_s, TIMESTEP_S * np.arange(len(motion.time_s)))
    assert motion.time_s[-1] == pytest.approx(info["sim_time_s"])
    np.testing.assert_allclose(np.diff(motion.joint_rad, axis=0) / TIMESTEP_S, motion.joint_rad_s[1:], atol=1e-9)
    assert np.abs(motion.joint_rad_s).max() > 1.0
    arm = ArmModel()
    for joint_rad, pose in list(zip(motion.joint_rad, motion.tcp_in_world, strict=True))[::20]:
        position_m, turn = arm.tcp_in_base(joint_rad)
        np.testing.assert_allclose(pose[:3], position_m, atol=1e-9)
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, pose[3:])
        np.testing.assert_allclose(matrix.reshape(3, 3), turn, atol=1e-9)
    assert motion.gripper_m.min() < 0.03 < motion.gripper_m.max()  # closed on a cube of 55 mm, and open
    assert (motion.gripper_command_m.min(axis=0) < motion.gripper_m.min(axis=0) - 5e-4).all(), "told to squeeze"
    assert np.abs(motion.joint_command_rad - motion.joint_rad).max() > 0.01, "told ahead of the motion"


def test_rates_below_the_simulation_s_take_its_nearest_steps_and_rates_above_are_interpolated():
    _, steps, _ = turned(1 / TIMESTEP_S)
    _, motion, _ = turned(30)  # 4.17 steps apart
    taken = [*np.round(np.arange(0, len(steps.time_s) - 1, 125 / 30)).astype(int), -1]
    for name in ("time_s", "joint_rad", "joint_rad_s", "gripper_m", "joint_command_rad", "tcp_in_world"):
        np.testing.assert_allclose(getattr(motion, name), getattr(steps, name)[taken], atol=1e-12, err_msg=name)
    env, motion, info = turned(200)
    assert len(motion.time_s) == 1 + math.ceil(200 * info["sim_time_s"] - 1e-6)
    np.testing.assert_allclose(np.diff(motion.time_s)[:-1], 0.005)
    for name in ("joint_rad", "joint_rad_s", "gripper_m"):
        columns = [np.interp(motion.time_s, steps.time_s, each) for each in getattr(steps, name).T]
        np.testing.assert_allclose(getattr(motion, name).T, columns, atol=1e-9)
    held = np.searchsorted(steps.time_s, motion.time_s + 1e-9, side="right") - 1
    np.testing.assert_array_equal(motion.joint_command_rad[:-1], steps.joint_command_rad[held[:-1]])
    quats = env.unwrapped.latest.motion.qpos[:, env.unwrapped.world.object_qpos[:, 3:]]
    np.testing.assert_allclose(np.linalg.norm(quats, axis=-1), 1.0, atol=1e-12)


@pytest.mark.parametrize("task", ["arrow_puzzle", "pick_place"])
def test_recording_the_motion_changes_no_bit(task):
    plain, recorded = make(task, appearance="mild"), make(task, appearance="mild", motion_hz=200)
    np.testing.assert_equal(plain.reset(seed=4), recorded.reset(seed=4))
    for action in (1, 0, 1):
        np.testing.assert_equal(plain.step(action), recorded.step(action))
        recorded.unwrapped.arm_motion()
    state, state_too = (env.unwrapped.get_state() for env in (plain, recorded))
    np.testing.assert_array_equal(state.world.physics, state_too.world.physics)
    assert state.generator == state_too.generator
    assert len(plain.unwrapped.motion().time_s) < len(recorded.unwrapped.motion().time_s)


READINGS = {
    "motion": lambda scene: scene.motion(),
    "arm motion": lambda scene: scene.arm_motion(),
    "agent's film": lambda scene: scene.agent_film(),
    "film for people": lambda scene: scene.film(80, 60),
    "a replay that is left": lambda scene: next(scene.replay()),
}


def test_both_cameras_film_the_motion_and_no_reading_of_it_changes_a_later_image():
    """Nor the scene: neither for the agent nor for people, whether these are drawn quickly or not."""
    env = make(motion_hz=5)
    begun, _ = env.reset(seed=1)
    seen, *_ = env.step(0)
    scene = env.unwrapped
    count, agent = len(scene.arm_motion().time_s), scene.agent_film()
    assert agent.shape == (count, 64, 64, 3) and scene.film(80, 60).shape == (count, 60, 80, 3)
    assert len(np.unique(agent, axis=0)) == count, "the wrist moves"
    np.testing.assert_array_equal(agent[0], begun)
    np.testing.assert_array_equal(scene.agent_view(), seen)
    for quickly in (False, True):
        scene.draws_quickly = quickly
        before = scene.human_view(80, 60), scene.agent_view(), scene.world.physics()
        for name, read in READINGS.items():
            read(scene)
            after = scene.human_view(80, 60), scene.agent_view(), scene.world.physics()
            for then, now in zip(before, after, strict=True):
                np.testing.assert_array_equal(now, then, err_msg=name)
            assert scene.draws_quickly == quickly, name
    env.close()


def test_a_standing_scene_is_one_sample_at_rest():
    for options in ({"execution": "kinematic", "motion_hz": 100}, {}):
        env = make(**options)
        env.reset(seed=0)
        env.step(0)
        motion = env.unwrapped.arm_motion()
        assert motion.time_s.tolist() == [0.0]
        assert motion.joint_rad.shape == motion.joint_command_rad.shape == (1, 7)
        np.testing.assert_array_equal(motion.joint_rad, motion.joint_command_rad)
        assert not motion.joint_rad_s.any()
