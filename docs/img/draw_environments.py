"""Draws an image of each environment: the scene as a person sees it, and beside it the agent's frame at five times."""

from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image

import imagine_bench  # noqa: F401  the environments

HERE = Path(__file__).parent
SCALE = 5
EDGE_PX = 64 * SCALE
GAP_PX = 8
ENVIRONMENTS = {
    "arrow_puzzle": ("ArrowPuzzle", {}, (3, 0, 1, 0), 0),
    "arrow_puzzle_hard": ("ArrowPuzzleHard", {}, (1, 3, 2, 2), 5),
    "arrow_puzzle_toward": ("ArrowPuzzleToward", {}, (0, 1, 3, 1), 2),
    "arrow_puzzle_clockwise": ("ArrowPuzzleClockwise", {}, (2, 1, 0, 1), 3),
    "arrow_puzzle_easy": ("ArrowPuzzleEasy", {}, (1, 0), 0),
    "arrows": ("Arrows", {"cubes": 5, "distractors": 2}, (1, 0, 3, 2, 0, 3), 6),
    "pick_place": ("PickPlace", {}, (0, 0, 0, 1), 1),
}
"""Name of the image: environment, its keywords, macrostate of the first frame, and a macro-action from there."""


def draw(name: str) -> Image.Image:
    """The scene in the middle of the macro-action, beside the frame that the agent saw before it."""
    env_id, keywords, macrostate, action = ENVIRONMENTS[name]
    with gymnasium.make(f"imagine_bench/{env_id}-v0", render_mode="rgb_array", **keywords) as env:
        env.unwrapped.capture_motion_hz = 10
        frame, _ = env.reset(seed=0, options={"macrostate": macrostate})
        env.step(action)
        film = env.unwrapped.film()
    scene = Image.fromarray(film[len(film) // 2]).resize((EDGE_PX * 4 // 3, EDGE_PX), Image.Resampling.LANCZOS)
    enlarged = frame.repeat(SCALE, axis=0).repeat(SCALE, axis=1)
    gap = np.full((EDGE_PX, GAP_PX, 3), 255, dtype=np.uint8)
    return Image.fromarray(np.hstack([scene, gap, enlarged]))


if __name__ == "__main__":
    for each in ENVIRONMENTS:
        draw(each).quantize(128).save(HERE / f"env_{each}.png", optimize=True)
