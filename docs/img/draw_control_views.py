"""Draws both images of continuous control through motions: ``python docs/img/draw_control_views.py``."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from imagine_bench.tasks.arrows.rules import Arrows
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.pick_place.world import PickWorld
from imagine_bench.tasks.rendering import Renderer
from imagine_bench.tasks.rendering.cameras import control_view
from imagine_bench.tasks.scenes.appearance import appearance
from imagine_bench.tasks.scenes.constants import CONTROL_CAMERAS
from imagine_bench.tasks.world import World
from PIL import Image, ImageDraw, ImageFont

HERE = Path(__file__).parent
SCALE = 4
EDGE_PX = 64 * SCALE
GAP_PX = 6
TITLE_PX = 26
CLEAN = appearance("clean")


@dataclass(frozen=True)
class Motion:
    """A macro-action, and at which shares of its time images are drawn, each with its title."""

    cubes: int  # 0: pick-and-place
    macrostate: tuple[int, ...]
    action: int
    outcome: tuple[int, ...]
    shown: dict[str, float]


MOTIONS = (
    Motion(1, (1, 0), 0, (2, 0), {"one cube, at rest": 0.0, "above": 0.25, "gripped": 0.42, "turned 45 degrees": 0.53}),
    Motion(3, (3, 0, 1, 0), 3, (3, 3, 1, 0), {"three cubes, at rest": 0.0, "turned 45 degrees": 0.53}),
    Motion(6, (1, 0, 3, 2, 0, 1, 3), 5, (1, 0, 0, 2, 0, 1, 3), {"six cubes, at rest": 0.0, "one gripped": 0.42}),
    Motion(0, (0, 0, 0, 1), 1, (0, 1, 0, 3), {"pick-and-place, at rest": 0.0, "car gripped": 0.45, "car held": 1.0}),
    Motion(0, (0, 1, 0, 3), 3, (0, 2, 0, 3), {"car over the palm": 0.5}),
)


def images(motion: Motion) -> list[Image.Image]:
    """A column for each moment: its title, and the image of each camera, enlarged."""
    if motion.cubes:
        world: World = ArrowWorld(CLEAN, Arrows(cubes=motion.cubes), control=True)
    else:
        world = PickWorld(CLEAN, control=True)
    world.place(motion.macrostate, np.random.default_rng(0))
    hands_m = world.data.mocap_pos.copy()
    world.executor.capture_motion_hz = 50
    qpos = world.execute(motion.action, motion.outcome).motion.qpos
    world.data.mocap_pos[:] = hands_m
    return [column(title, world, qpos[round(share * (len(qpos) - 1))]) for title, share in motion.shown.items()]


def column(title: str, world: World, qpos: np.ndarray) -> Image.Image:
    """One moment by all cameras, one below the other."""
    world.data.qpos[:] = qpos
    world.update()
    canvas = Image.new("RGB", (EDGE_PX, TITLE_PX + len(CONTROL_CAMERAS) * (EDGE_PX + GAP_PX)), "white")
    ImageDraw.Draw(canvas).text((2, 3), title, "#202020", ImageFont.load_default(19))
    for row, camera in enumerate(CONTROL_CAMERAS):
        frame = Image.fromarray(Renderer(world.model, control_view(camera)).frame(world.data))
        enlarged = frame.resize((EDGE_PX, EDGE_PX), Image.Resampling.NEAREST)
        canvas.paste(enlarged, (0, TITLE_PX + row * (EDGE_PX + GAP_PX)))
    return canvas


def draw() -> Image.Image:
    """All moments in two rows; in each row the camera on the hand above the camera in front."""
    columns = [each for motion in MOTIONS for each in images(motion)]
    half = len(columns) // 2
    width, height = columns[0].size
    sheet = Image.new("RGB", (half * (width + GAP_PX) - GAP_PX, 2 * height), "white")
    for place, each in enumerate(columns):
        sheet.paste(each, (place % half * (width + GAP_PX), place // half * height))
    return sheet


if __name__ == "__main__":
    draw().quantize(128).save(HERE / "control_views.png", optimize=True)
