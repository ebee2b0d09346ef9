"""The compiled scene, its parts, its looks, and the agent's view of them."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from imagine_bench.tasks.arrows.scene import arrow_outline
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.rendering import Renderer, View
from imagine_bench.tasks.rendering.cameras import agent_camera_view
from imagine_bench.tasks.scenes import constants as c
from imagine_bench.tasks.scenes.appearance import appearance

from imagine_bench import registry
from imagine_bench.preprocessing import STRIP_WIDTH, preprocess

FIXED = appearance("clean").__class__(name="fixed", object_offset_m=0.0, object_yaw_rad=0.0)


@pytest.fixture(scope="module")
def world():
    return ArrowWorld(FIXED)


@pytest.fixture(scope="module")
def camera(world):
    renderer = Renderer(world.model, agent_camera_view())
    yield renderer
    renderer.close()


def rng():
    return np.random.default_rng(0)


def test_the_arm_is_out_of_the_agent_s_view(world, camera):
    world.place((0, 1, 2, 1), rng())

    def frame(camera, *groups):
        with closing(Renderer(world.model, View(camera=camera, groups=groups))) as renderer:
            return renderer.frame(world.data)

    seen = c.SCENE_GROUP, c.AGENT_GROUP
    assert np.array_equal(camera.frame(world.data), frame(c.AGENT_CAMERA, *seen, c.ARM_GROUP))
    assert not np.array_equal(frame(c.HUMAN_CAMERA, *seen), frame(c.HUMAN_CAMERA, *seen, c.ARM_GROUP))


def _strip_of_column(column):
    return [strip for strip, start in enumerate((0, 21, 42)) if start <= column < start + STRIP_WIDTH]


def windows(spec):
    """First and last column and row of each cube's own part of its channel. Shape (2, cubes, 2)."""
    places = np.indices((64, 64), dtype=np.uint8)[::-1, ..., None].repeat(3, axis=-1)
    shown = np.rint(255 * preprocess(spec.preprocessing)(places))
    low, high = (end(shown, axis=(2, 3)) for end in (np.min, np.max))
    if low.shape[1] > 3:  # above are the rows where the hand is
        low[1] = high[1] - 17
    return np.transpose([low, high], (0, 2, 1))


@pytest.mark.parametrize("level", ["mild", "strong"])
@pytest.mark.parametrize("cubes", range(1, 7))
def test_each_channel_shows_its_own_arrow_and_pointing_hand(cubes, level):
    """All corners of the arrow, those of the cube's top but for 3 pixels at strong, and the fingertip's column."""
    spec = registry.task(f"arrows:cubes={cubes}")
    world, generator = ArrowWorld(appearance(level), spec.rules.world), rng()
    focal_px = 32 / np.tan(np.radians(world.model.camera(c.AGENT_CAMERA).fovy[0]) / 2)
    square = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)]) * c.CUBE_EDGE_M / 2
    corners = [np.insert(outline, 2, c.CUBE_EDGE_M / 2, axis=1) for outline in (arrow_outline(), square)]
    low, high = windows(spec)

    def at_px(points_m):
        camera = world.data.cam(c.AGENT_CAMERA)
        x, y, z = ((points_m - camera.xpos) @ camera.xmat.reshape(3, 3)).T
        return 32 + focal_px * np.stack([x / -z, y / z], axis=1)

    for _ in range(40):
        pointed = int(generator.integers(cubes))
        world.place((*(0, 1, 2, 3, 0, 1)[:cubes], pointed), generator)
        world.vary(generator)
        for cube in range(cubes):
            body = world.data.body(f"cube_{cube}")
            for outline, spill_px in zip(corners, (0.0, 3.0 if level == "strong" else 0.0), strict=True):
                seen = at_px(outline @ body.xmat.reshape(3, 3).T + body.xpos)
                assert (low[cube] - spill_px <= seen).all() and (seen <= high[cube] + 1 + spill_px).all(), cube
        assert low[pointed, 0] + 4 < at_px(world.data.mocap_pos)[0, 0] < high[pointed, 0] - 3


def _is_dark(frame):
    return frame.max(axis=2) < 70


def _pointing(dark):
    """An arrow's tip is its narrow end, its tail the broad one; across, both ends are barbs and alike."""
    dark = dark[np.ix_(dark.any(axis=1), dark.any(axis=0))]
    down = int(dark[:2].sum()) - int(dark[-2:].sum())
    right = int(dark[:, :2].sum()) - int(dark[:, -2:].sum())
    assert min(abs(down), abs(right)) <= 1
    assert max(abs(down), abs(right)) >= 2
    return ("down" if down > 0 else "up") if abs(down) > abs(right) else ("right" if right > 0 else "left")


def test_arrows_point_where_their_names_say(world, camera):
    for direction, name in enumerate(("up", "right", "down", "left")):
        world.place((direction,) * 3 + (1,), rng())
        dark = _is_dark(camera.frame(world.data))[34:]
        assert [_pointing(dark[:, columns]) for columns in (slice(0, 20), slice(22, 42), slice(45, 64))] == [name] * 3


def _skin(frame):
    red, green, blue = (frame[..., channel].astype(int) for channel in range(3))
    return (red - blue > 45) & (red - green > 20)


def test_the_hand_is_at_the_top_its_finger_in_its_cube_s_strip(world, camera):
    for pointed in range(3):
        world.place((0, 1, 2, pointed), rng())
        rows, columns = np.nonzero(_skin(camera.frame(world.data)))
        assert len(rows) > 100
        assert rows.max() < 36
        tip = columns[rows >= rows.max() - 6]
        assert {strip for column in tip for strip in _strip_of_column(int(column))} == {pointed}
