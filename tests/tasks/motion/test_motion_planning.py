"""Planning: inverse kinematics against forward kinematics, and trajectories against the robot's limits."""

import itertools
import math

import mink
import numpy as np
import pytest
from imagine_bench.tasks.arrows.description import MAX_CUBES
from imagine_bench.tasks.arrows.scene import layout
from imagine_bench.tasks.motion.ik import ArmIK, ArmModel, UnreachableTargetError, pointing_down
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

from imagine_bench.errors import ImagineBenchError

SLOTS_XY_M = layout(3).slots_xy_m
ALL_SLOTS_XY_M = sorted({slot for cubes in range(1, MAX_CUBES + 1) for slot in layout(cubes).slots_xy_m})
QUARTER_RAD = math.pi / 2
CUBE_Z_M = TABLE_HEIGHT_M + CUBE_EDGE_M / 2


@pytest.fixture(scope="module")
def arm():
    return ArmModel()


@pytest.fixture(scope="module")
def ik(arm):
    return ArmIK(arm)


# Inverse kinematics


@pytest.mark.parametrize(("slot", "height_m"), list(itertools.product(ALL_SLOTS_XY_M, (CUBE_Z_M, CUBE_Z_M + 0.06))))
def test_ik_reaches_with_the_tool_straight_down(arm, ik, slot, height_m):
    solution = ik.solve(position_in_base_m=np.array([*slot, height_m]), yaw_rad=math.pi / 4)
    position, frame = arm.tcp_in_base(solution.qpos_rad)
    error_m = np.linalg.norm(position - [*slot, height_m])
    assert error_m < 5e-4
    assert solution.position_error_m == pytest.approx(error_m, abs=1e-9)
    assert math.acos(min(1.0, -frame[2, 2])) < math.radians(0.2)
    assert math.atan2(frame[1, 0], frame[0, 0]) == pytest.approx(math.pi / 4, abs=math.radians(0.2))
    assert (arm.model.jnt_range[:, 0] <= solution.qpos_rad).all()
    assert (solution.qpos_rad <= arm.model.jnt_range[:, 1]).all()


def test_pointing_down_is_the_rotation_it_says():
    for yaw in (0.0, 0.3, -2.0):
        expected = [[math.cos(yaw), math.sin(yaw), 0], [math.sin(yaw), -math.cos(yaw), 0], [0, 0, -1]]
        np.testing.assert_allclose(pointing_down(yaw).as_matrix(), expected, atol=1e-12)


def test_warm_start_needs_few_steps_and_gives_the_same_place(arm, ik):
    slot = np.array([*SLOTS_XY_M[0], CUBE_Z_M])
    near = ik.solve(position_in_base_m=slot, yaw_rad=math.pi / 4)
    moved = slot + np.array((0.004, -0.003, 0))
    cold = ik.solve(position_in_base_m=moved, yaw_rad=math.pi / 4)
    warm = ik.solve(position_in_base_m=moved, yaw_rad=math.pi / 4, start_qpos_rad=near.qpos_rad)
    assert warm.iterations <= 2 <= cold.iterations
    assert np.abs(warm.qpos_rad - cold.qpos_rad).max() < 5e-3


def test_ik_depends_on_its_arguments_alone(ik):
    target = {"position_in_base_m": np.array([0.6, 0.05, -0.05]), "yaw_rad": 0.6}
    first = ik.solve(**target).qpos_rad
    ik.solve(position_in_base_m=np.array([0.5, -0.2, 0.1]), yaw_rad=0.1)
    np.testing.assert_array_equal(ik.solve(**target).qpos_rad, first)


def test_steps_are_mink_s_to_the_bit(ik):
    """Near targets and far ones, at the joints' limits too."""
    rng, at_limits = np.random.default_rng(0), 0
    configuration, limits = ik._configuration, mink.ConfigurationLimit(ik._configuration.model)
    posture = mink.PostureTask(configuration.model, cost=1e-3)
    posture.set_target(np.array(HOME_QPOS_RAD))
    for _ in range(200):
        place = mink.SE3.from_rotation_and_translation(pointing_down(rng.uniform(-3, 3)), rng.uniform(-0.9, 0.9, 3))
        ik._reach.set_target(place)
        configuration.update(rng.uniform(limits.lower, limits.upper))
        expected = mink.solve_ik(configuration, [ik._reach, posture], 1.0, "daqp", limits=[limits])
        np.testing.assert_array_equal(ik._step(), expected)
        after = configuration.q + expected / limits.gain
        at_limits += bool(np.isclose(after, limits.lower).any() or np.isclose(after, limits.upper).any())
    assert 20 < at_limits


def test_ik_covers_the_table(ik):
    rng = np.random.default_rng(0)
    for _ in range(60):
        target = rng.uniform((0.4, -0.3, -0.08), (0.8, 0.3, 0.2))
        solution = ik.solve(position_in_base_m=target, yaw_rad=rng.uniform(0, QUARTER_RAD))
        assert solution.position_error_m < 5e-4


def test_unreachable_target_is_named(ik):
    message = r"cannot reach \[1\.5, 0\.0, 0\.0\] m at yaw 45 deg: after 40 steps \d+\.\d mm .* allowed are 0\.2 mm"
    with pytest.raises(UnreachableTargetError, match=message) as caught:
        ik.solve(position_in_base_m=np.array([1.5, 0.0, 0.0]), yaw_rad=math.pi / 4)
    assert isinstance(caught.value, ImagineBenchError)


def test_iterations_are_bounded(ik):
    slot = np.array([*SLOTS_XY_M[0], CUBE_Z_M])
    with pytest.raises(UnreachableTargetError, match="after 1 steps"):
        ik.solve(position_in_base_m=slot, yaw_rad=math.pi / 4, max_iterations=1)
    assert ik.solve(position_in_base_m=slot, yaw_rad=math.pi / 4).iterations > 1


# Trajectories


def test_minimum_jerk_has_the_stated_peaks_and_derivatives():
    steps = 2000
    s, ds, dds = minimum_jerk(steps).T
    assert (s[-1], ds[-1], dds[-1]) == (1.0, 0.0, 0.0)
    assert ds.max() == pytest.approx(PEAK_SPEED, rel=1e-5)
    assert np.abs(dds).max() == pytest.approx(PEAK_ACCELERATION, rel=1e-5)
    np.testing.assert_allclose(np.gradient(s, 1 / steps)[1:-1], ds[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(ds, 1 / steps)[1:-1], dds[1:-1], atol=1e-4)


def random_plan(arm, rng):
    low, high = arm.model.jnt_range.T
    stops = [np.clip(np.array(HOME_QPOS_RAD) + rng.uniform(-1, 1, 7), low, high) for _ in range(4)]
    waypoints = [Waypoint(name=str(index), qpos_rad=stop, opening_m=0.03) for index, stop in enumerate(stops)]
    start = np.array(HOME_QPOS_RAD)
    return plan(arm, start_qpos_rad=start, start_opening_m=0.02, waypoints=waypoints, timestep_s=TIMESTEP_S), waypoints


def test_plans_keep_speed_limits_and_use_them(arm):
    """Peak speeds by finite differences: never above the limits, and each motion is limited by speed or effort."""
    rng = np.random.default_rng(1)
    shares = []
    for _ in range(20):
        trajectory, waypoints = random_plan(arm, rng)
        qpos = np.vstack([HOME_QPOS_RAD, trajectory.qpos_rad])
        speed_share = np.abs(np.diff(qpos, axis=0) / TIMESTEP_S) / arm.speed_limit_rad_s
        assert speed_share.max() <= SPEED_SHARE + 1e-9
        shares.append(speed_share.max())
        for waypoint in waypoints:
            np.testing.assert_allclose(trajectory.qpos_rad[trajectory.last_step[waypoint.name]], waypoint.qpos_rad)
    assert max(shares) > 0.95


def test_blended_motions_add_up(arm):
    """A blend shortens the plan by its length, and every joint still stops at the last waypoint within its limits."""
    start, via = np.array(HOME_QPOS_RAD), np.array(HOME_QPOS_RAD) + 0.3
    end = via - np.array((0.3, -0.2, 0.1, 0.0, 0.2, 0.1, -0.3))

    def planned(blend_s):
        waypoints = [
            Waypoint(name="via", qpos_rad=via, opening_m=0.03, blend_s=blend_s),
            Waypoint(name="end", qpos_rad=end, opening_m=0.01),
        ]
        return plan(arm, start_qpos_rad=start, start_opening_m=0.02, waypoints=waypoints, timestep_s=TIMESTEP_S)

    stopping, blended = planned(0.0), planned(10 * TIMESTEP_S)
    assert len(blended.opening_m) == len(stopping.opening_m) - 10
    np.testing.assert_allclose(blended.qpos_rad[-1], end, atol=1e-12)
    np.testing.assert_allclose(blended.arm_command_rad[-1], end, atol=1e-12)
    assert blended.opening_m[-1] == pytest.approx(0.01)
    speed_rad_s = np.abs(np.diff(np.vstack([start, blended.qpos_rad]), axis=0)) / TIMESTEP_S
    assert (speed_rad_s <= arm.speed_limit_rad_s).all()
    assert np.abs(blended.qpos_rad[stopping.last_step["via"]] - via).max() > 1e-4  # it did not stop there


def test_heavy_motions_are_limited_by_effort(arm):
    delta = np.zeros(7)
    delta[0] = 0.02
    inertia = arm.inertia(np.array(HOME_QPOS_RAD))
    duration_s = shortest_duration_s(arm, delta, inertia)
    effort_nm = PEAK_ACCELERATION * np.abs(inertia @ delta) / duration_s**2
    assert (effort_nm / arm.effort_limit_nm).max() == pytest.approx(EFFORT_SHARE)
    assert duration_s > PEAK_SPEED * delta[0] / arm.speed_limit_rad_s[0]


def test_inertia_is_symmetric_positive_and_holds_the_armature(arm):
    inertia = arm.inertia(np.array(HOME_QPOS_RAD))
    np.testing.assert_allclose(inertia, inertia.T, atol=1e-12)
    assert np.linalg.eigvalsh(inertia).min() > 0
    assert (np.diag(inertia) >= arm.model.dof_armature).all()


def test_the_error_of_a_reach_is_the_larger_of_both_ends(arm, ik):
    worse_above = 0
    for x_m, y_m in [(0.5, 0.0), (0.55, 0.1), (0.6, -0.1), (0.62, 0.09), (0.65, 0.05), (0.7, 0.0)]:
        place_m, lift_m = np.array([x_m, y_m, -0.05]), 0.1
        reach = ik.reach(place_m, yaw_rad=0.0, lift_m=lift_m)
        at_m, above_m = (
            math.dist(arm.tcp_in_base(qpos)[0], place_m + np.array([0.0, 0.0, height_m]))
            for qpos, height_m in ((reach.at_qpos_rad, 0.0), (reach.above_qpos_rad, lift_m))
        )
        assert reach.error_m == pytest.approx(max(at_m, above_m), abs=1e-9)
        worse_above += above_m > at_m + 1e-7
    assert worse_above > 0
