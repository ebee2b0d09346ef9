"""Macro-actions in contact: turns obey the rules, by contact, within the robot's limits, bit for bit."""

import math
import os
import shutil
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.motion.executor import MAX_SAVED, blew_up
from imagine_bench.tasks.scenes.appearance import Appearance
from imagine_bench.tasks.scenes.arm import arm_columns
from imagine_bench.tasks.scenes.constants import OBSERVATION_QPOS_RAD, TIMESTEP_S

from imagine_bench.errors import DivergedError

FIXED = Appearance(name="fixed", object_offset_m=0.0, object_yaw_rad=0.0)


@pytest.fixture(scope="module")
def world():
    return ArrowWorld(FIXED)


def place(world, *yaws_rad):
    """Stand the cubes on their slots, the first ones turned."""
    world.place((0, 0, 0, 0), np.random.default_rng(0))
    for row, yaw_rad in zip(world.object_qpos, yaws_rad, strict=False):
        world.data.qpos[row[3:]] = math.cos(yaw_rad / 2), 0, 0, math.sin(yaw_rad / 2)


def yaw_deg(world, cube):
    w, _, _, z = world.object_poses()[cube, 3:]
    return math.degrees(math.remainder(2 * math.atan2(z, w), 2 * math.pi))


def test_a_turn_keeps_the_limits_of_speed_and_force_and_returns(world):
    """Replay one turn step by step and read the forces: within the limits, at rest far below, the grip firm.

    Gravity is compensated beside the servos, so that a motor would give the sum: the shoulder's goes beyond its limit.
    """
    model, data = world.model, world.data
    place(world)
    peak, motor_peak_nm = np.zeros(model.nu), np.zeros(7)
    arm_dofs = [int(model.joint(f"right_j{index}").dofadr[0]) for index in range(7)]
    world.executor.capture_motion_hz = 1 / TIMESTEP_S
    result = world.executor.turn(cube=0, clockwise=True)
    motion = result.motion
    world.executor.capture_motion_hz = 0.0
    np.testing.assert_allclose(motion.time_s[[0, 1, -1]], [0, TIMESTEP_S, result.sim_time_s])
    arm_qpos = motion.qpos[:, arm_columns(model).qpos[:7]]
    speed_share = np.abs(np.diff(arm_qpos, axis=0)).max(axis=0) / TIMESTEP_S / ArmModel().speed_limit_rad_s
    assert 0.9 < speed_share.max() <= 1.0
    np.testing.assert_allclose(arm_qpos[[0, -1]], [OBSERVATION_QPOS_RAD] * 2, atol=1e-3)
    reached = data.qpos.copy()
    place(world)
    world.executor.rest()
    for command in motion.ctrl[:-1]:
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        peak = np.maximum(peak, np.abs(data.actuator_force))
        motor_peak_nm = np.maximum(motor_peak_nm, np.abs(data.qfrc_actuator + data.qfrc_gravcomp)[arm_dofs])
    shoulder_share, *other_shares = (motor_peak_nm / model.actuator_forcerange[:7, 1])[[1, 0, 2, 3, 4, 5, 6]]
    assert max(other_shares) < 1.0 and 1.1 < shoulder_share < 1.15  # as the page on environments says
    assert (peak[:6] < 0.95 * model.actuator_forcerange[:6, 1]).all()  # only the wrist's plan is near its limit
    assert (np.abs(data.actuator_force) < 0.1 * model.actuator_forcerange[:, 1]).all()
    assert 10 < peak[-1] < 30  # the grip
    np.testing.assert_array_equal(data.qpos, reached)  # rollout and stepping agree, bit for bit


def test_a_turn_depends_on_positions_alone(world):
    """Not on earlier speeds, nor on the solver's warm start or the servos' targets."""
    ends = []
    for left_over in (0.0, 0.3):
        place(world, 0, 0.1)
        for array in (world.data.qvel, world.data.qacc_warmstart, world.data.ctrl):
            array[:] = left_over
        assert world.executor.turn(cube=1, clockwise=True).fault is None
        ends.append(np.concatenate([world.data.qpos, world.data.qvel]))
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("skew_deg", [-25, 25])
def test_very_skew_cubes_are_squared(world, skew_deg, clockwise):
    """Even 25 degrees off, where the wrist would leave its range if it took the usual faces."""
    place(world, math.radians(skew_deg))
    assert world.executor.turn(cube=0, clockwise=clockwise).fault is None
    assert yaw_deg(world, 0) == pytest.approx(-90 if clockwise else 90, abs=1)


def test_two_motions_of_one_macro_action_have_one_clock(world):
    """The first fault is theirs, and the larger error."""
    place(world)
    world.executor.capture_motion_hz = 10.0
    first, second = (world.executor.turn(cube=cube, clockwise=True) for cube in (0, 1))
    world.executor.capture_motion_hz = 0.0
    both = first.then(second)
    assert both.sim_time_s == first.sim_time_s + second.sim_time_s
    assert both.motion.time_s[0] == 0.0 and both.motion.time_s[-1] == pytest.approx(both.sim_time_s)
    assert (np.diff(both.motion.time_s) >= 0.0).all()
    assert len(both.motion.time_s) == len(both.motion.qpos) == len(first.motion.qpos) + len(second.motion.qpos)
    broken = replace(second, fault="late", ik_error_m=0.0)
    late, early = first.then(broken), replace(first, fault="early").then(broken)
    assert (late.fault, early.fault) == ("late", "early")
    assert late.ik_error_m == broken.then(first).ik_error_m == first.ik_error_m > 0.0


@pytest.mark.parametrize(("rest_rad", "off_rad"), [(-1.0, "0.101"), (1.0, "0.100")])
def test_an_arm_of_which_one_joint_does_not_come_back_is_a_fault(rest_rad, off_rad):
    """The wrist's 9 Nm hold a spring of 10 Nm/rad, whose rest is a radian away to either side, 0.1 rad off."""
    pulled = ArrowWorld(FIXED)
    joint = pulled.model.joint("right_j6")
    pulled.model.jnt_stiffness[joint.id] = 10.0
    pulled.model.qpos_spring[joint.qposadr[0]] = OBSERVATION_QPOS_RAD[6] + rest_rad
    place(pulled)
    fault = pulled.executor.turn(cube=1, clockwise=True).fault
    assert fault == f"the arm ended {off_rad} rad off its observation pose"


@pytest.mark.parametrize(
    ("columns", "values", "message"),
    [
        (slice(3, 7), (math.cos(0.1), 0, math.sin(0.1), 0), "cube 1 is tipped by 11 degrees"),
        (slice(0, 1), 1.4, "cube 1 is out of reach: The gripper cannot reach"),
    ],
    ids=["leaning", "far"],
)
def test_what_the_robot_cannot_do_is_a_fault(world, columns, values, message):
    place(world)
    world.data.qpos[world.object_qpos[1, columns]] = values
    before = world.object_poses()
    result = world.executor.turn(cube=1, clockwise=True)
    assert message in result.fault
    assert (result.sim_time_s, len(result.motion.qpos)) == (0.0, 0)
    np.testing.assert_array_equal(world.object_poses(), before)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_joint_that_runs_away_to_either_side_is_noticed(world, sign):
    """Nothing in the scene moves at 200 rad/s; several things may at 150."""
    place(world)
    found = []
    for speed in (150, 250):
        world.data.qvel[:3] = sign * speed, 150, 150
        found.append(blew_up(world.data))
    assert found == [False, True]


def test_bad_positions_speeds_and_accelerations_are_explosions(world):
    """MuJoCo warns of them and resets the data by itself; its other warnings are of small matters."""
    warnings = mujoco.mjtWarning
    found = set()
    for which in range(warnings.mjNWARNING.value):
        place(world)
        world.data.warning.number[which] = 1
        found |= {warnings(which)} if blew_up(world.data) else set()
        world.data.warning.number[which] = 0
    assert found == {warnings.mjWARN_BADQPOS, warnings.mjWARN_BADQVEL, warnings.mjWARN_BADQACC}


def explode(world, said):
    world.data.qpos[world.object_qpos[2]] = [1e11, 0, 0, 1, 0, 0, 0]
    with pytest.raises(DivergedError, match=f"its start state and controls {said}"):
        world.executor.turn(cube=0, clockwise=True)


def test_exploded_physics_is_reported_with_its_start(world, own_folder):
    """In one file of a bounded number, or without one where none can be written."""
    for index in range(MAX_SAVED + 3):
        old = own_folder / f"imagine_bench_diverged_{index}.npz"
        old.touch()
        os.utime(old, (index, index))
    place(world)
    explode(world, "were saved in")
    saved = sorted(own_folder.glob("imagine_bench_diverged_*.npz"), key=os.path.getmtime)
    assert len(saved) == MAX_SAVED and saved[0].stem.endswith("_4")
    with np.load(saved[-1]) as contents:
        assert contents["start_state"].max() == 1e11
        assert contents["control"].shape[1] == world.model.nu
    shutil.rmtree(own_folder)
    explode(world, "could not be saved")
