"""Macro-actions in contact: turns obey the rules, by contact, within the robot's limits, bit for bit."""

import math
import os
import tempfile

import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.arrows.scene import compile_arrow_scene, layout
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.motion.executor import MAX_SAVED
from imagine_bench.tasks.motion.orientation import Sensing
from imagine_bench.tasks.motion.turn import TurnExecutor
from imagine_bench.tasks.scenes.arm import arm_columns
from imagine_bench.tasks.scenes.constants import (
    CUBE_EDGE_M,
    OBSERVATION_QPOS_RAD,
    TABLE_HEIGHT_M,
    TIMESTEP_S,
)

from imagine_bench.errors import DivergedError

SLOTS_XY_M = layout(3).slots_xy_m
QUARTER_RAD = math.pi / 2
CUBE_Z_M = TABLE_HEIGHT_M + CUBE_EDGE_M / 2


@pytest.fixture(scope="module")
def arm():
    return ArmModel()


@pytest.fixture(scope="module")
def turner():
    model = compile_arrow_scene()
    return TurnExecutor(model, mujoco.MjData(model), SLOTS_XY_M, Sensing())


def cube_slice(model, cube):
    start = int(model.joint(f"cube_{cube}_joint").qposadr[0])
    return slice(start, start + 7)


def place(model, data, yaws_rad, offsets_m=((0, 0), (0, 0), (0, 0))):
    """Stand the cubes on their slots, turned and shifted."""
    mujoco.mj_resetData(model, data)
    for cube, (yaw, (dx, dy)) in enumerate(zip(yaws_rad, offsets_m, strict=True)):
        x, y = SLOTS_XY_M[cube]
        data.qpos[cube_slice(model, cube)] = [x + dx, y + dy, CUBE_Z_M, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]


def poses(model, data):
    """Position and yaw of each cube, read from the rotation matrix. Shape (3, 4)."""
    rows = []
    for cube in range(3):
        position, quat = np.split(data.qpos[cube_slice(model, cube)], [3])
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, quat)
        rows.append([*position, math.atan2(matrix[3], matrix[0])])
    return np.array(rows)


def wrap(angle_rad):
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def test_a_turn_keeps_the_limits_of_speed_and_force_and_returns(arm, turner):
    """Replay one turn step by step and read the forces: within the limits, at rest far below, the grip firm.

    Gravity is compensated beside the servos, so that a motor would give the sum: the shoulder's goes beyond its limit.
    """
    model, data = turner.model, turner.data
    place(model, data, (0, 0, 0))
    peak, motor_peak_nm = np.zeros(model.nu), np.zeros(7)
    arm_dofs = [int(model.joint(f"right_j{index}").dofadr[0]) for index in range(7)]
    turner.capture_motion_hz = 1 / TIMESTEP_S
    result = turner.turn(cube=0, clockwise=True)
    motion = result.motion
    turner.capture_motion_hz = 0.0
    np.testing.assert_allclose(motion.time_s[[0, 1, -1]], [0, TIMESTEP_S, result.sim_time_s])
    arm_qpos = motion.qpos[:, arm_columns(model).qpos[:7]]
    speed_share = np.abs(np.diff(arm_qpos, axis=0)).max(axis=0) / TIMESTEP_S / arm.speed_limit_rad_s
    assert 0.9 < speed_share.max() <= 1.0
    np.testing.assert_allclose(arm_qpos[[0, -1]], [OBSERVATION_QPOS_RAD] * 2, atol=1e-3)
    reached = data.qpos.copy()
    place(model, data, (0, 0, 0))
    turner.rest()
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


def test_a_turn_depends_on_positions_alone(turner):
    """Not on earlier speeds, nor on the solver's warm start or the servos' targets."""
    ends = []
    for left_over in (0.0, 0.3):
        place(turner.model, turner.data, (0, 0.1, 0))
        for array in (turner.data.qvel, turner.data.qacc_warmstart, turner.data.ctrl):
            array[:] = left_over
        assert turner.turn(cube=1, clockwise=True).fault is None
        ends.append(np.concatenate([turner.data.qpos, turner.data.qvel]))
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("clockwise", [True, False])
def test_very_skew_cubes_are_squared(turner, clockwise):
    """Even 25 degrees off, where the wrist would leave its range if it took the usual faces."""
    model, data = turner.model, turner.data
    for skew_rad in (-math.radians(25), math.radians(25)):
        place(model, data, (skew_rad, 0, 0))
        assert turner.turn(cube=0, clockwise=clockwise).fault is None
        target = -QUARTER_RAD if clockwise else QUARTER_RAD
        assert abs(math.degrees(wrap(poses(model, data)[0, 3] - target))) < 1


def tips(model):
    return [index for index in range(model.ngeom) if "_tip_" in model.geom(index).name]


def turned_deg(turner, model, change=None):
    """How far cube 1 turns in a clockwise macro-action on a changed scene, and the fault."""
    if change:
        change(model)
    data = mujoco.MjData(model)
    executor = TurnExecutor(model, data, SLOTS_XY_M, Sensing())
    place(model, data, (0, 0, 0))
    result = executor.turn(cube=1, clockwise=True)
    return -math.degrees(poses(model, data)[1, 3]), result.fault


def test_two_motions_of_one_macro_action_have_one_clock(turner):
    place(turner.model, turner.data, (0, 0, 0))
    turner.capture_motion_hz = 10.0
    first, second = (turner.turn(cube=cube, clockwise=True) for cube in (0, 1))
    turner.capture_motion_hz = 0.0
    both = first.then(second)
    assert both.sim_time_s == first.sim_time_s + second.sim_time_s
    assert both.motion.time_s[0] == 0.0 and both.motion.time_s[-1] == pytest.approx(both.sim_time_s)
    assert (np.diff(both.motion.time_s) >= 0.0).all()
    assert len(both.motion.time_s) == len(both.motion.qpos) == len(first.motion.qpos) + len(second.motion.qpos)


def test_only_contact_turns_the_cube(turner):
    """No weld, no teleport: fingertips that pass through the cube leave it alone, and the robot feels it holds none."""

    def ghost_tips(model):
        model.geom_contype[tips(model)] = 0
        model.geom_conaffinity[tips(model)] = 0
        model.geom_contype[model.geom_contype == 2] = 0  # the fingers' backs

    assert turned_deg(turner, compile_arrow_scene())[0] == pytest.approx(90, abs=1)
    angle, fault = turned_deg(turner, compile_arrow_scene(), ghost_tips)
    assert angle == pytest.approx(0, abs=0.1)
    assert fault == "the fingers closed past cube 1"


def test_an_arm_of_which_one_joint_does_not_come_back_is_a_fault(turner):
    """The wrist's 9 Nm hold a spring of 10 Nm/rad, whose rest is a radian away, 0.1 rad off."""

    def pulled_wrist(model):
        joint = model.joint("right_j6")
        model.jnt_stiffness[joint.id], model.qpos_spring[joint.qposadr[0]] = 10.0, OBSERVATION_QPOS_RAD[6] + 1.0

    fault = turned_deg(turner, compile_arrow_scene(), pulled_wrist)[1]
    assert fault == "the arm ended 0.100 rad off its observation pose"


@pytest.mark.parametrize(
    ("quat", "position", "message"),
    [
        ((math.cos(0.1), 0, math.sin(0.1), 0), (*SLOTS_XY_M[1], CUBE_Z_M), "cube 1 is tipped by 11 degrees"),
        ((1, 0, 0, 0), (1.4, 0, CUBE_Z_M), "cube 1 is out of reach: The gripper cannot reach"),
    ],
    ids=["leaning", "far"],
)
def test_what_the_robot_cannot_do_is_a_fault(turner, quat, position, message):
    model, data = turner.model, turner.data
    place(model, data, (0, 0, 0))
    data.qpos[cube_slice(model, 1)] = [*position, *quat]
    before = poses(model, data)
    result = turner.turn(cube=1, clockwise=True)
    assert message in result.fault
    assert result.sim_time_s == 0.0
    assert result.motion.qpos.shape == (0, model.nq)
    np.testing.assert_array_equal(poses(model, data), before)


def test_exploded_physics_is_reported_with_its_start(turner, tmp_path, monkeypatch):
    """In one file of a bounded number, or without one where none can be written."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)  # MuJoCo's own log
    for index in range(MAX_SAVED + 3):
        old = tmp_path / f"imagine_bench_diverged_{index}.npz"
        old.touch()
        os.utime(old, (index, index))
    model, data = turner.model, turner.data
    place(model, data, (0, 0, 0))
    data.qpos[cube_slice(model, 2)] = [1e11, 0, 0, 1, 0, 0, 0]
    with pytest.raises(DivergedError, match="its start state and controls were saved in"):
        turner.turn(cube=0, clockwise=True)
    saved = sorted(tmp_path.glob("imagine_bench_diverged_*.npz"), key=os.path.getmtime)
    assert len(saved) == MAX_SAVED and saved[0].stem.endswith("_4")
    with np.load(saved[-1]) as contents:
        assert contents["start_state"].max() == 1e11
        assert contents["control"].shape[1] == model.nu
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    data.qpos[cube_slice(model, 2)] = [1e11, 0, 0, 1, 0, 0, 0]
    with pytest.raises(DivergedError, match="its start state and controls could not be saved"):
        turner.turn(cube=0, clockwise=True)
