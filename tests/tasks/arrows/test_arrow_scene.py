"""The compiled scene, its parts, its looks, and the agent's view of them."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.rendering import Renderer, View
from imagine_bench.tasks.rendering.cameras import agent_camera_view
from imagine_bench.tasks.scenes import constants as c
from imagine_bench.tasks.scenes.appearance import appearance

from imagine_bench.preprocessing import STRIP_WIDTH

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


@pytest.mark.parametrize("level", ["mild", "strong"])
def test_each_strip_shows_its_own_cube_only(level):
    world, generator = ArrowWorld(appearance(level)), rng()
    camera = world.model.camera(c.AGENT_CAMERA)
    focal_px = 32 / np.tan(np.radians(camera.fovy[0]) / 2)
    corners = np.array([(x, y, 1.0) for x in (-1, 1) for y in (-1, 1)]) * c.CUBE_EDGE_M / 2
    centers, extremes = [], []
    for _ in range(200):
        world.place((0, 1, 2, 1), generator)
        world.vary(generator)
        rotation, position = world.data.cam(c.AGENT_CAMERA).xmat.reshape(3, 3), world.data.cam(c.AGENT_CAMERA).xpos
        for cube in range(3):
            body = world.data.body(f"cube_{cube}")
            seen = (corners @ body.xmat.reshape(3, 3).T + body.xpos - position) @ rotation
            columns = 32 + focal_px * seen[:, 0] / -seen[:, 2]
            centers.append((cube, columns.mean()))
            extremes.append((cube, columns.min() - 21.5 * cube, columns.max() - 21.5 * cube))
    assert all(_strip_of_column(int(column)) == [cube] for cube, column in centers)
    spill_px = 3.5 if level == "strong" else 0.5
    assert min(low for _, low, _ in extremes) > -spill_px
    assert max(high for _, _, high in extremes) < 21.5 + spill_px


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
