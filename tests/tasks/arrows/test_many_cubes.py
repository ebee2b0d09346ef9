"""One to six cubes: placed and read back, turned with no neighbour moved, turned in twos, and slipping."""

import math

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.arrows.rules import Arrows
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.scenes.appearance import appearance


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


@pytest.mark.parametrize("seed", [1034, 1084])
def test_fingers_open_no_wider_than_there_is_room(seed):
    """With these seeds cubes stand so near that fingers opened as wide as at rest would move one by 0.4 mm or more."""
    env = gymnasium.make("imagine_bench/Arrows-v0", cubes=6, forbid="none", appearance="strong").unwrapped
    env.reset(seed=seed)
    before = env.world.object_poses()
    assert not env.step(3)[-1]["fault"]
    shift_m = np.linalg.norm(env.world.object_poses()[:, :3] - before[:, :3], axis=1)
    assert np.delete(shift_m, 1).max() < 1e-4 < shift_m[1]
    env.close()


@pytest.mark.parametrize("turned_deg", [-20, 0, 20])
@pytest.mark.parametrize("clockwise", [True, False])
def test_fingers_open_as_far_as_there_is_room(clockwise, turned_deg):
    """The next cube of its row stands 9 mm nearer, and the cube is put down 9 mm nearer to that, turned either way."""
    world = _world(cubes=6, forbid="none")
    world.place((0,) * 6 + (0,), np.random.default_rng(0))
    assert world.layout.slots_xy_m[1][0] == world.layout.slots_xy_m[3][0], "they stand side by side"
    world.data.qpos[world.object_qpos[3][1]] += 0.009
    before = world.object_poses()
    assert world.executor.turn(cube=1, clockwise=clockwise, noise=(0.0, -0.009, math.radians(turned_deg))).fault is None
    shift_m = np.linalg.norm(world.object_poses()[:, :3] - before[:, :3], axis=1)
    assert np.delete(shift_m, 1).max() < 1e-4 and shift_m[1] > 0.008


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
