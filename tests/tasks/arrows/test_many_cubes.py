"""One to six cubes: placed and read back, turned with no neighbour moved, turned in twos, and slipping."""

import math

import numpy as np
import pytest
from imagine_bench.tasks.arrows.rules import Arrows
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.motion.orientation import about_vertical
from imagine_bench.tasks.scenes.appearance import Appearance, appearance


def _world(level="clean", **fields):
    return ArrowWorld(appearance(level), Arrows(**fields))


@pytest.mark.parametrize("cubes", range(1, 7))
def test_a_turn_of_any_cube_moves_no_neighbour(cubes):
    world, rng = _world(cubes=cubes, forbid="none"), np.random.default_rng(cubes)
    world.place((0,) * cubes + (0,), rng)
    for cube in range(cubes):
        state, before = world.read().macrostate, world.object_poses()
        wanted = (*state[:cube], 1, *state[cube + 1 :])
        assert world.execute(2 * cube, wanted).fault is None
        assert world.read().macrostate == wanted
        shift_m = np.linalg.norm(world.object_poses()[:, :3] - before[:, :3], axis=1)
        assert np.delete(shift_m, cube).max(initial=0.0) < 1e-3


ROOMS = [
    ([], True, "x", 36.5),
    ([], False, "y", 36.5),
    ([(0, 75, 0)], False, "x", 36.5),
    ([(75, 0, 0)], True, "y", 36.5),
    ([(76, 0, 0), (0, -74, 0)], False, "x", 76 - 30.5 - 11),
    ([(74, 0, 0), (0, -76, 0)], True, "y", 76 - 30.5 - 11),
    ([(80, 0, 10), (0, -74, 0)], False, "x", 80 - 34.86 - 11),
    ([(-74, 0, 0), (30, 70, 0)], True, "y", math.hypot(30, 70) - 30.5 - 11),
    ([(66, 0, 0), (0, 65, 0)], False, "x", 29.5),
    ([(75, 43, 0)], True, "y", 36.5),
    ([(75, 46, 0)], True, "x", 36.5),
]
"""Other cubes beside one, by their distance along x and y (mm) and their yaw (deg); whether it is turned clockwise; and
along which axis and how far (mm) the fingers that come down then open.
"""


LEAVES = [
    ([(0, 80, 0)], True, (0, 5, 0), "y", 75 - 30.5 - 11),
    ([(0, 80, 0)], False, (0, 5, 0), "x", 36.5),
    ([(0, 80, 0)], True, (0, 5, -10), "y", 75 - 30.5 - 11 - 14 * math.sin(math.radians(10))),
    ([(80, 0, 0)], False, (4, 0, 10), "x", 76 - 30.5 - 11 - 14 * math.sin(math.radians(10))),
]
"""The same of fingers that let go, and before that how far off its place the cube is put (mm, mm, deg)."""


def test_fingers_open_where_there_is_more_room_and_as_far():
    """Half a turned cube, 3 mm of clearance and the finger's 11 mm are left out, and what a turned finger's half width
    reaches further; at least 2 mm a side remain.
    """
    fixed = Appearance(name="fixed", object_offset_m=0.0, object_yaw_rad=0.0)
    world, arm = ArrowWorld(fixed, Arrows(forbid="none")), ArmModel()
    coming = [(others, clockwise, (0, 0, 0), *expected) for others, clockwise, *expected in ROOMS]
    for others, clockwise, noise, axis, opening_mm in (*coming, *LEAVES):
        world.place((0, 0, 0, 0), np.random.default_rng(0))
        stands_m, *rows = (world.data.qpos[row[0] : row[-1] + 1] for row in world.object_qpos)
        for number, row in enumerate(rows):
            x_mm, y_mm, yaw_deg = others[number] if number < len(others) else (200, -100 * number, 0)
            row[:2] = stands_m[:2] + 1e-3 * np.array([x_mm, y_mm])
            row[3:] = about_vertical(math.radians(yaw_deg))
        off = (1e-3 * noise[0], 1e-3 * noise[1], math.radians(noise[2]))
        before_m = world.object_poses()[1:, :3]
        assert world.executor.turn(cube=0, clockwise=clockwise, noise=off).fault is None
        shift_m = np.abs(world.object_poses()[1:, :3] - before_m).max()
        assert shift_m < 1e-4 or not any(noise), "it comes down where it shall and touches no other"
        trajectory = world.executor.trajectory
        step = trajectory.last_step["open" if any(noise) else "reach"]
        opens_along = arm.tcp_in_base(trajectory.qpos_rad[step])[1][:2, 1]
        found = "xy"[np.abs(opens_along).argmax()], 1e3 * trajectory.opening_m[step]
        assert found == (axis, pytest.approx(opening_mm, abs=0.01)), (others, clockwise, noise)


@pytest.mark.parametrize("action", [0, 1, 2, 3])
def test_a_cube_that_slips_stays_though_it_was_gripped(action):
    world = _world(cubes=2, forbid="none", slip=0.2)
    state = (1, 3, 0)
    world.place(state, np.random.default_rng(0))
    before = world.object_poses()
    world.executor.capture_motion_hz = 50.0
    result = world.execute(action, state)
    assert result.fault is None
    assert world.read().macrostate == state
    assert np.linalg.norm(world.object_poses()[:, :3] - before[:, :3], axis=1).max() < 4e-3  # squared in the fingers
    assert world.executor.opening_m(result.motion.qpos).min() < 0.0275  # the fingers did close on it
