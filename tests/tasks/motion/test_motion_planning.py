"""Planning: inverse kinematics against forward kinematics, and trajectories against the robot's limits."""

import math
import re

import mink
import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.arrows.rules import MAX_CUBES
from imagine_bench.tasks.arrows.scene import compile_arrow_scene, layout
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.motion.ik import (
    ANGLE_TOLERANCE_RAD,
    POSITION_TOLERANCE_M,
    ArmIK,
    Reach,
    UnreachableTargetError,
    pointing_down,
)
from imagine_bench.tasks.motion.trajectory import (
    EFFORT_SHARE,
    PEAK_ACCELERATION,
    PEAK_SPEED,
    SPEED_SHARE,
    Waypoint,
    minimum_jerk,
    plan,
    shortest_duration_s,
)
from imagine_bench.tasks.scenes.constants import CUBE_EDGE_M, HOME_QPOS_RAD, TABLE_HEIGHT_M, TIMESTEP_S

PARTS = (("joint", ""), ("actuator", "_servo"))
SLOTS_XY_M = sorted({slot for cubes in range(1, MAX_CUBES + 1) for slot in layout(cubes).slots_xy_m})
CUBE_Z_M = TABLE_HEIGHT_M + CUBE_EDGE_M / 2


@pytest.fixture(scope="module")
def arm():
    return ArmModel()


@pytest.fixture(scope="module")
def ik(arm):
    return ArmIK(arm)


# Inverse kinematics


@pytest.mark.parametrize("lift_m", [0.0, 0.07])
@pytest.mark.parametrize("off_deg", [(0, 0, 0), (0, 0, -90), (0, 0, 1), (5, 0, 0), (0, -20, 0)], ids=str)
def test_a_search_from_a_turned_or_tilted_tool_rights_it(arm, ik, off_deg, lift_m):
    """It starts at its place, or below it; an upright tool only has to be lifted."""
    yaw_rad, place_m = 0.3, np.array([*SLOTS_XY_M[0], CUBE_Z_M])
    turned = mink.SO3.from_rpy_radians(*np.radians(off_deg)) @ pointing_down(yaw_rad)
    ik.frame_task.set_target(mink.SE3.from_rotation_and_translation(turned, place_m))
    ik.configuration.update(np.array(HOME_QPOS_RAD))
    for _ in range(40):
        ik.configuration.integrate_inplace(ik.next_step(), 1.0)
    start_rad = ik.configuration.q.copy()
    assert np.linalg.norm(arm.tcp_in_base(start_rad)[0] - place_m) < POSITION_TOLERANCE_M
    to_m = place_m + np.array([0, 0, lift_m])
    found_rad = ik.solve(to_m, yaw_rad, start_rad).qpos_rad
    assert np.linalg.norm(arm.tcp_in_base(found_rad)[0] - to_m) < POSITION_TOLERANCE_M
    for qpos_rad, wanted in ((start_rad, turned), (found_rad, pointing_down(yaw_rad))):
        apart = wanted.inverse() @ mink.SO3.from_matrix(arm.tcp_in_base(qpos_rad)[1])
        assert np.linalg.norm(apart.log()) < ANGLE_TOLERANCE_RAD


@pytest.mark.parametrize("slot", SLOTS_XY_M)
def test_ik_reaches_with_the_tool_straight_down(arm, ik, slot):
    """Each slot and above it; the error of a reach is the larger one of its two places."""
    home = np.array(HOME_QPOS_RAD)
    near, errors_m = Reach(at_qpos_rad=home, above_qpos_rad=home, error_m=0.0), []
    found = ik.reach(np.array([*slot, CUBE_Z_M]), math.pi / 4, 0.06, near)
    for qpos_rad, height_m in ((found.at_qpos_rad, CUBE_Z_M), (found.above_qpos_rad, CUBE_Z_M + 0.06)):
        position, frame = arm.tcp_in_base(qpos_rad)
        errors_m.append(np.linalg.norm(position - [*slot, height_m]))
        assert math.acos(min(1.0, -frame[2, 2])) < math.radians(0.2)
        assert math.atan2(frame[1, 0], frame[0, 0]) == pytest.approx(math.pi / 4, abs=math.radians(0.2))
        assert (arm.model.jnt_range[:, 0] <= qpos_rad).all()
        assert (qpos_rad <= arm.model.jnt_range[:, 1]).all()
    assert found.error_m == pytest.approx(max(errors_m), abs=1e-9) and found.error_m < 5e-4


def test_what_is_missing_to_a_place_out_of_reach_is_said(arm, ik):
    place_m = np.array([1.3, 0.2, 0.1])
    with pytest.raises(UnreachableTargetError) as caught:
        ik.solve(place_m, 0.3, np.array(HOME_QPOS_RAD))
    there_m, frame = arm.tcp_in_base(ik.configuration.q)
    off_deg = math.degrees(np.linalg.norm((pointing_down(0.3).inverse() @ mink.SO3.from_matrix(frame)).log()))
    said = r"reach \[1.3, 0.2, 0.1\] m at yaw 17 deg: after 40 steps (\S+) mm and (\S+) deg are missing"
    missing = [float(each) for each in re.search(said, str(caught.value)).groups()]
    assert missing == pytest.approx([1000 * np.linalg.norm(there_m - place_m), off_deg], rel=0.01)


def test_steps_are_mink_s_to_the_bit(ik):
    """Near targets and far ones, at the joints' limits too."""
    rng, at_limits = np.random.default_rng(0), 0
    configuration, limits = ik.configuration, mink.ConfigurationLimit(ik.configuration.model)
    posture = mink.PostureTask(configuration.model, cost=1e-3)
    posture.set_target(np.array(HOME_QPOS_RAD))
    for _ in range(200):
        place = mink.SE3.from_rotation_and_translation(pointing_down(rng.uniform(-3, 3)), rng.uniform(-0.9, 0.9, 3))
        ik.frame_task.set_target(place)
        configuration.update(rng.uniform(limits.lower, limits.upper))
        expected = mink.solve_ik(configuration, [ik.frame_task, posture], 1.0, "daqp", limits=[limits])
        np.testing.assert_array_equal(ik.next_step(), expected)
        after = configuration.q + expected / limits.gain
        at_limits += bool(np.isclose(after, limits.lower).any() or np.isclose(after, limits.upper).any())
    assert 20 < at_limits


# Trajectories


def test_minimum_jerk_has_the_stated_peaks_and_derivatives():
    steps = 2000
    s, ds, dds = minimum_jerk(steps).T
    assert (s[-1], ds[-1], dds[-1]) == (1.0, 0.0, 0.0)
    assert ds.max() == pytest.approx(PEAK_SPEED, rel=1e-5)
    assert np.abs(dds).max() == pytest.approx(PEAK_ACCELERATION, rel=1e-5)
    np.testing.assert_allclose(np.gradient(s, 1 / steps)[1:-1], ds[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(ds, 1 / steps)[1:-1], dds[1:-1], atol=1e-4)


def planned(arm, start_rad, *waypoints):
    return plan(arm, start_qpos_rad=start_rad, start_opening_m=0.02, waypoints=waypoints, timestep_s=TIMESTEP_S)


def test_a_motion_is_as_short_as_speed_and_effort_allow(arm):
    """At its peaks: one of the limits is met, and none is exceeded, whichever is the tighter one."""
    rng, tight = np.random.default_rng(0), set()
    inertia = arm.inertia(np.array(HOME_QPOS_RAD))
    for size_rad in np.geomspace(1e-3, 1.0, 30):
        delta_rad = size_rad * rng.uniform(-1, 1, 7)
        duration_s = shortest_duration_s(arm, delta_rad, inertia)
        speed = PEAK_SPEED * np.abs(delta_rad) / duration_s / arm.speed_limit_rad_s
        effort = PEAK_ACCELERATION * np.abs(inertia @ delta_rad) / duration_s**2 / arm.effort_limit_nm
        shares = [speed.max() / SPEED_SHARE, effort.max() / EFFORT_SHARE]
        assert max(shares) == pytest.approx(1.0)
        tight.add(int(np.argmax(shares)))
    assert tight == {0, 1}
    held = planned(arm, np.zeros(7), Waypoint("", np.full(7, 1e-3), 0.02, min_duration_s=0.504))
    assert len(held.opening_m) == 63, "unless it shall be longer"


def test_a_command_is_ahead_by_the_lag_of_damping_and_inertia(arm):
    """By (K_d q' + M q'') / K_p of the scene in which the arm acts, M that halfway, but for 0.1 mrad."""
    rng, model = np.random.default_rng(2), compile_arrow_scene()
    data, inertia = mujoco.MjData(model), np.empty((model.nv, model.nv))
    joints, servos = ([getattr(model, kind)(f"right_j{index}{end}") for index in range(7)] for kind, end in PARTS)
    columns = [int(joint.dofadr[0]) for joint in joints]
    gains = np.array([servo.gainprm[0] for servo in servos])
    damping = np.array([joint.damping[0] - servo.biasprm[2] for joint, servo in zip(joints, servos, strict=True)])
    assert all(joint.damping[0] > 0.0 for joint in joints)
    for _ in range(5):
        start, end = rng.uniform(*arm.model.jnt_range.T, (2, 7))
        told = planned(arm, start, Waypoint("", end, 0.02))
        data.qpos[[int(joint.qposadr[0]) for joint in joints]] = (start + end) / 2
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        steps = len(told.opening_m)
        _, speed, push = minimum_jerk(steps).T[..., None]
        lag_nm = damping * speed * (end - start) / (steps * TIMESTEP_S)
        lag_nm += push * (inertia[np.ix_(columns, columns)] @ (end - start)) / (steps * TIMESTEP_S) ** 2
        np.testing.assert_allclose(told.arm_command_rad - told.qpos_rad, lag_nm / gains, atol=1e-4)


@pytest.mark.parametrize("blend_steps", [0, 10, 1000])
@pytest.mark.parametrize("sizes_rad", [(0.3, 0.1), (0.1, 0.3)])
def test_blended_motions_add_up(arm, sizes_rad, blend_steps):
    """Each as one alone, whichever is longer; the next begins so many steps before the end, at most with it."""
    start = np.array(HOME_QPOS_RAD)
    via = start + sizes_rad[0]
    end = via + sizes_rad[1] * np.array((-1.0, -0.7, 0.3, 0.0, 0.7, 0.3, -1.0))
    one, other = planned(arm, start, Waypoint("", via, 0.03)), planned(arm, via, Waypoint("", end, 0.0))
    both = planned(arm, start, Waypoint("via", via, 0.03, blend_s=blend_steps * TIMESTEP_S), Waypoint("end", end, 0.01))
    firsts = 0, max(0, len(one.opening_m) - blend_steps)
    lasts = [first + len(each.opening_m) - 1 for first, each in zip(firsts, (one, other), strict=True)]
    assert both.last_step == {"via": lasts[0], "end": lasts[1]}
    for name, begins in (("qpos_rad", (start, via)), ("arm_command_rad", (start, via)), ("opening_m", (0.02, 0.02))):
        added = np.zeros((max(lasts) + 1, *np.shape(begins[0]))) + begins[0]
        for each, begin, first, last in zip((one, other), begins, firsts, lasts, strict=True):
            moved = getattr(each, name) - begin
            added[first : last + 1] += moved
            added[last + 1 :] += moved[-1]
        np.testing.assert_allclose(getattr(both, name), added, atol=1e-12)
    np.testing.assert_allclose((both.qpos_rad[-1], both.arm_command_rad[-1]), (end, end), atol=1e-12)
    speed_rad_s = np.abs(np.diff(np.vstack([start, both.qpos_rad]), axis=0)) / TIMESTEP_S
    assert blend_steps > 10 or (speed_rad_s <= SPEED_SHARE * arm.speed_limit_rad_s + 1e-9).all()
