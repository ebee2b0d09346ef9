"""Frames patched of fragments: finite pools, others in tests, gamma and noise, and the rules as everywhere."""

from __future__ import annotations

from contextlib import closing

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.scenes.appearance import Appearance, appearance
from imagine_bench.tasks.scenes.fragments import draw_composite

import imagine_bench  # noqa: F401  (registers the environments)
from imagine_bench import registry
from imagine_bench.interfaces import HELD_OUT

PHOTO, HELD = appearance("photo"), appearance(HELD_OUT["photo"])
STATE = (2, 0, 1, 1)


def drawn_poses(level, draws):
    """Poses of cubes (draws, 3, 7) and hand (draws, 7) of frames of one macrostate."""
    world, rng, cubes, hands = ArrowWorld(level), np.random.default_rng(0), [], []
    for _ in range(draws):
        world.place(STATE, rng)
        world.vary(rng)
        cubes.append(world.object_poses())
        hands.append(np.concatenate([world.data.mocap_pos[0], world.data.mocap_quat[0]]))
        assert world.read().macrostate == STATE
    return np.array(cubes), np.array(hands)


def test_pools_hold_fifty_hands_and_sixteen_arrows():
    """Of each microstate, as in the thesis; training never meets one that is held out."""
    poses = {level.name: drawn_poses(level, 600) for level in (PHOTO, HELD)}
    for cubes, hands in poses.values():
        assert len(np.unique(hands, axis=0)) == 50
        assert [len(np.unique(cubes[:, cube], axis=0)) for cube in range(3)] == [16, 16, 16]
    (cubes, hands), (other_cubes, other_hands) = poses.values()
    for seen, held in [(hands, other_hands), *zip(cubes.swapaxes(0, 1), other_cubes.swapaxes(0, 1), strict=True)]:
        assert not {tuple(pose) for pose in seen} & {tuple(pose) for pose in held}


@pytest.mark.parametrize(
    ("size", "objects", "top", "seams"),
    [(64, (0, 1, 2), 34, [21, 43]), (96, (0, 1, 2, 3), 51, [24, 48, 72]), (256, (3, 1), 136, [128])],
)
def test_light_is_the_fragment_s_and_changes_at_the_seams_alone(size, objects, top, seams):
    level = Appearance(name="fixed", object_offset_m=0.0, object_yaw_rad=0.0, pool=1, light_fraction=0.15)
    photograph = draw_composite(level, objects, 0, np.random.default_rng(3))
    image = photograph.of(np.full((size, size, 3), 128, np.uint8)).astype(int)[..., 0]
    down, across = np.abs(np.diff(image, axis=0)).max(axis=1), np.abs(np.diff(image[top:], axis=1)).max(axis=0)
    assert (1 + np.flatnonzero(down > 3)).tolist() == [top]
    assert (1 + np.flatnonzero(across > 4)).tolist() == seams
    assert 108 <= image.min() and image.max() <= 148


def test_frames_of_macrostates_and_of_environments_are_photographs():
    """The bare table has a few colors in the renderer, and noise of its own in every pixel of a photograph."""
    spec, colors = registry.task("arrow_puzzle"), {}
    for level in ("mild", "photo"):
        with closing(gymnasium.make(spec.env_id, appearance=level, execution="kinematic")) as env:
            frames = [env.reset(seed=0)[0], env.step(0)[0], env.unwrapped.agent_view()]
        assert np.array_equal(frames[1], frames[2])
        frames += [*spec.render_macrostates(np.array([STATE]), level, np.random.default_rng(0))]
        colors[level] = [len(np.unique(frame[56:].reshape(-1, 3), axis=0)) for frame in frames]
    assert max(colors["mild"]) < 20 and min(colors["photo"]) > 200


def test_in_physics_cubes_stay_where_the_arm_left_them():
    spec = registry.task("arrow_puzzle")
    with closing(gymnasium.make(spec.env_id, appearance="photo", execution="physics")) as env:
        env.reset(seed=1)
        world, hands = env.unwrapped.world, []
        before = world.object_poses()[1:]
        for _ in range(2):
            env.step(0)
            hands.append(world.data.mocap_pos.copy())
            assert np.abs(world.object_poses()[1:, :3] - before[:, :3]).max() < 1e-4
    assert not np.array_equal(*hands)
