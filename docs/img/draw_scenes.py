"""Draws pictures of scenes: parameters of worlds, nuisances, tasks. ``python docs/img/draw.py tasks`` draws one."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from imagine_bench_regression import robot_ik, toy_regression
from matplotlib import pyplot as plt
from PIL import Image, ImageDraw

from imagine_bench import appearance, registry
from imagine_bench.recording.filmstrips import Tile, font, sheet
from imagine_bench.report import figures

HERE = Path(__file__).parent
CELL_PX = (320, 240)
SCENES = {
    "arrow_puzzle": ("ArrowPuzzle", {}, (2, 1, 0, 1), 3),
    "arrow_puzzle_hard": ("ArrowPuzzleHard", {}, (1, 3, 0, 2), 5),
    "arrows:cubes=5,distractors=4": ("Arrows", {"cubes": 5, "distractors": 4}, (1, 0, 3, 2, 0, 3), 6),
    "pick_place": ("PickPlace", {}, (0, 0, 0, 1), 1),
}
"""Of each task with episodes: environment, keywords, first macrostate, and the macro-action that is shown."""


def scene(env_id: str, options: Mapping[str, Any], macrostate: tuple[int, ...], action: int) -> Image.Image:
    """A macro-action at its middle as people see it, and in the corner the agent's frame, two pixels a pixel."""
    with gymnasium.make(f"imagine_bench/{env_id}-v0", render_mode="rgb_array", **options) as env:
        env.unwrapped.capture_motion_hz = 10
        frame, _ = env.reset(seed=0, options={"macrostate": macrostate})
        env.step(action)
        film = env.unwrapped.film(2 * CELL_PX[0], 2 * CELL_PX[1])
    image = Image.fromarray(film[len(film) // 2]).resize(CELL_PX, Image.Resampling.LANCZOS)
    inset = Image.fromarray(np.pad(frame, ((1, 1), (1, 1), (0, 0)), constant_values=255))
    image.paste(inset, (CELL_PX[0] - 66, CELL_PX[1] - 66))
    ImageDraw.Draw(image).text((CELL_PX[0] - 88, CELL_PX[1] - 82), "agent's frame", "white", font())
    return image


def toy_function() -> Image.Image:
    """Training points of the toy regression: three functions at once, and more noise in the middle."""
    data = toy_regression.training("high_noise", np.random.default_rng(0))
    figure, axes = plt.subplots(figsize=(3.2, 2.4), layout="constrained")
    axes.scatter(data.inputs[:, 0], data.targets[:, 0], s=4, color=figures.COLORS[2])
    axes.set_title("three functions of x, noisy in the middle", fontsize=8)
    axes.set(xlabel="x", ylabel="y")
    axes.spines[["top", "right"]].set_visible(False)
    return as_image(figure)


def joints_in_plane(angles: np.ndarray) -> np.ndarray:
    """Where base, elbow, wrist and tip of the planar arm are, in metres. Angles (..., 3), result (..., 4, 2)."""
    heading = np.cumsum(angles, axis=-1)
    links = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * np.array(robot_ik.LINKS_M)[:, None]
    return np.concatenate([np.zeros_like(links[..., :1, :]), np.cumsum(links, axis=-2)], axis=-2)


def planar_arm() -> Image.Image:
    """The planar arm in four configurations whose tips are all at one place, which a star marks."""
    angles = np.random.default_rng(0).uniform(robot_ik.LOW_RAD, robot_ik.HIGH_RAD, (20_000, 3))
    target = np.array([0.35, 0.45])
    misses = np.linalg.norm(joints_in_plane(angles)[:, -1] - target, axis=1)
    figure, axes = plt.subplots(figsize=(3.2, 2.4), layout="constrained")
    for which, color in zip(misses.argsort()[[0, 3, 9, 12]], (2, 4, 5, 7), strict=True):
        axes.plot(*joints_in_plane(angles[which]).T, "o-", color=figures.COLORS[color], linewidth=3, markersize=5)
    axes.plot(*target, "*", color=figures.INK, markersize=14, zorder=5)
    axes.set_title("four postures reach one point (star)", fontsize=8)
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.spines[["top", "right"]].set_visible(False)
    return as_image(figure)


def as_image(figure: plt.Figure) -> Image.Image:
    """A figure as an image of a cell's size."""
    figure.set_dpi(100)
    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())


PARAMETERS = ({}, {"slip": 0.5}, {"goal_change": 0.7}, {"gesture": "first"}, {"lag": 1}, {"distractors": 4})
FACTORS = ("", *(f"{name}=1" for name in appearance.FACTORS))
START = (2, 1, 0, 1)
TURNS = {"left turned": 0, "middle turned": 2, "right turned": 4}
"""A start and macro-actions by whose rules no two arrows are ever equal and no episode ends."""


def walk(options: Mapping[str, Any]) -> list[np.ndarray]:
    """Frames of the same episode in a world of these parameters."""
    with gymnasium.make("imagine_bench/Arrows-v0", execution="kinematic", **options) as env:
        frame, info = env.reset(seed=18, options={"macrostate": START})
        frames = [frame]
        for action in TURNS.values():
            frame, _, over, _, info = env.step(action)
            if over or not info["legal"]:
                raise ValueError(f"With {options} the episode ends at {info['macrostate']}; choose another start.")
            frames.append(frame)
    return frames


def vary(factor: str) -> list[np.ndarray]:
    """Frames of one macrostate where one factor of appearance varies."""
    world, rng = registry.task("arrow_puzzle"), np.random.default_rng(1)
    return list(world.render_macrostates(np.array([(0, 1, 2, 1)] * 4), factor or "clean", rng))


def strips(rows: Mapping[str, list[np.ndarray]], titles: Sequence[str]) -> np.ndarray:
    """Named rows of frames below one another, with titles above the first row."""
    drawn = []
    for label, frames in rows.items():
        above = [""] * len(frames) if drawn else titles
        drawn.append((label, [Tile(frame, title) for frame, title in zip(frames, above, strict=True)]))
    return sheet(drawn)


def parameters() -> None:
    """Each parameter as frames of one episode, and each factor of appearance as frames of one macrostate.

    A pixel of a frame is two pixels of the image in each direction, so that none is interpolated.
    """
    worlds = {" ".join(f"{name} = {value}" for name, value in each.items()): walk(each) for each in PARAMETERS}
    worlds = {name or "no parameter": frames for name, frames in worlds.items()}
    factors = {each or "clean": vary(each) for each in FACTORS}
    halves = (strips(worlds, ["start", *TURNS]), strips(factors, ["one macrostate", "", "", ""]))
    Image.fromarray(np.concatenate(halves, axis=1)).save(HERE / "parameters.png", optimize=True)


def nuisances() -> None:
    """Each nuisance of frames in three frames of one episode and in the first frame of another."""
    rows = {}
    for given in ("clean", *(f"{name}=1" for name in appearance.NUISANCES[:4]), "harsh"):
        with gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic", appearance=given) as env:
            frames = [env.reset(seed=3, options={"macrostate": START})[0]]
            frames += [env.step(action)[0] for action in (0, 2)]
            frames.append(env.reset(options={"macrostate": START})[0])
        rows[given] = frames
    drawn = strips(rows, ["start", "after one action", "after two", "another start"])
    Image.fromarray(drawn.repeat(2, axis=0).repeat(2, axis=1)).save(HERE / "nuisances.png", optimize=True)


def tasks() -> None:
    """An image of every task, two rows of three, each below its name."""
    cells = {name: scene(*facts) for name, facts in SCENES.items()}
    cells |= {"toy_regression": toy_function(), "robot_ik": planar_arm()}
    width, height = CELL_PX
    canvas = Image.new("RGB", (3 * (width + 8) - 8, 2 * (height + 28)), "white")
    for place, (name, image) in enumerate(cells.items()):
        left, top = (width + 8) * (place % 3), (height + 28) * (place // 3)
        ImageDraw.Draw(canvas).text((left + 2, top + 7), name, figures.INK, font(bold=True))
        canvas.paste(image, (left, top + 26))
    canvas.quantize(256, dither=Image.Dither.NONE).save(HERE / "tasks.png", optimize=True)
