"""A drawn stand-in for the arrow puzzle, so that encoder tests need neither MuJoCo nor a renderer."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from imagine_bench.agents.encoders.recipes import RECIPES
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame, RuleFacts, TaskSpec

JITTER = {"clean": 0.1, "mild": 1.0, "strong": 2.0, "photo": 1.0, "photo_held_out": 1.0}
"""Pixels; turns and light scale with it."""
_YX = np.mgrid[0:64, 0:64].astype(np.float32)
CHAPTER_5 = RECIPES["chapter_5"]
TINY = replace(
    CHAPTER_5["default"], name="tiny", widths=(32,), frames=300, held_out_frames=200, steps=40, batch=32, probe_steps=60
)
QUICK = replace(TINY, name="quick", frames=60, held_out_frames=30, steps=7, batch=8, probe_steps=5)
TINY_CONV = replace(
    CHAPTER_5["thesis"], name="tiny_conv", frames=40, held_out_frames=20, steps=2, batch=8, probe_steps=5
)


class ArrowRules:
    """The states of the puzzle; nothing else of the rules matters to an encoder."""

    states = tuple(itertools.product(range(4), range(4), range(4), range(3)))
    start_states = states


def draw(macrostates: NDArray[np.int64], appearance: str, rng: np.random.Generator) -> Frame:
    """Bright cubes that are dark where they point, and a hand above one; 0 is up, 1 to the right, and so on."""
    jitter = JITTER[appearance]
    image = np.full((len(macrostates), 64, 64), 0.4)

    def around(x: float | NDArray[np.float64], y: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How far pixels lie right of and below a place that jitters. Each of shape (N, 64, 64)."""
        right, down = rng.uniform(-jitter, jitter, (2, len(image), 1, 1))
        return _YX[1] - np.reshape(x, (-1, 1, 1)) - right, _YX[0] - y - down

    for cube in range(3):
        right, down = around(10.5 + 21.0 * cube, 44.0)
        turn = macrostates[:, cube, None, None] * np.pi / 2 + np.radians(4) * rng.uniform(-jitter, jitter)
        own = np.maximum(np.abs(right), np.abs(down)) < 7.0
        image[own] = 0.9
        image[own & (np.sin(turn) * right - np.cos(turn) * down > 2.0)] = 0.1
    right, down = around(10.5 + 21.0 * macrostates[:, 3], 20.0)
    image[(np.abs(right) < 3.0) & (np.abs(down) < 8.0)] = 0.75
    image *= 1.0 + 0.08 * rng.uniform(-jitter, jitter, (len(image), 1, 1))
    image += rng.normal(0.0, 0.01, image.shape)
    return np.repeat((image.clip(0.0, 1.0) * 255.0).astype(np.uint8)[..., None], 3, axis=-1)


def arrow_spec() -> TaskSpec:
    """A TaskSpec whose frames are drawn."""
    directions = ("up", "right", "down", "left")
    return TaskSpec(
        id="drawn_arrows",
        title="Drawn arrows",
        description="Three arrows and a hand, drawn.",
        env_id="none",
        horizon=10,
        action_names=("none",),
        macrostate_names=("left", "middle", "right", "pointed"),
        macrostate_values=(directions, directions, directions, ("left", "middle", "right")),
        preprocessing="gray_strips",
        encoder="drawn_arrows",
        rules=ArrowRules(),  # type: ignore[arg-type]
        facts=lambda: RuleFacts(chance_level=0.0, optimum=1.0, optimal_return=0.0, mean_plan_length=1.0),
        render_macrostates=draw,
    )
