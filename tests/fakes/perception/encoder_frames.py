"""A drawn stand-in for the arrow puzzle, so that encoder tests need neither MuJoCo nor a renderer."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from imagine_bench.agents.encoders.recipes import RECIPES
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame, Outcome, RuleFacts, TaskSpec

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

    def outcomes(self, macrostate: tuple[int, ...], action: int) -> tuple[Outcome, ...]:
        return (Outcome(1.0, macrostate, 0.0, False, False),)

    def is_terminal(self, macrostate: tuple[int, ...]) -> bool:
        return False

    def optimal_action(self, macrostate: tuple[int, ...]) -> int:
        return 0


def _local(centre_xy: NDArray[np.float32], turn_rad: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """Pixel coordinates in each cube's own frame, v along its arrow. Shapes (N, 64, 64)."""
    dx = _YX[1] - centre_xy[:, 0, None, None]
    dy = _YX[0] - centre_xy[:, 1, None, None]
    sin, cos = np.sin(turn_rad)[:, None, None], np.cos(turn_rad)[:, None, None]
    return dx * cos + dy * sin, dx * sin - dy * cos


def draw(macrostates: NDArray[np.int64], appearance: str, rng: np.random.Generator) -> Frame:
    """Gray cubes with dark arrows below a bright hand; direction 0 is up, each next one a quarter turn clockwise."""
    n, jitter = len(macrostates), JITTER[appearance]
    image = np.full((n, 64, 64), 0.4, dtype=np.float32)
    for cube in range(3):
        centre = np.array([10.5 + 21 * cube, 44.0]) + rng.uniform(-jitter, jitter, (n, 2))
        turn = macrostates[:, cube] * np.pi / 2 + np.radians(4) * rng.uniform(-jitter, jitter, n)
        u, v = _local(centre.astype(np.float32), turn.astype(np.float32))
        image[np.maximum(np.abs(u), np.abs(v)) < 7.0] = 0.9
        shaft = (np.abs(u) < 1.5) & (v > -5) & (v < 1)
        head = (v >= 0) & (v < 5) & (np.abs(u) < 4.5 - v * 0.9)
        image[shaft | head] = 0.1
    tip = np.stack([10.5 + 21 * macrostates[:, 3], np.full(n, 30.0)], -1) + rng.uniform(-jitter, jitter, (n, 2))
    u, v = _local(tip.astype(np.float32), np.radians(3) * rng.uniform(-jitter, jitter, n).astype(np.float32))
    image[(np.abs(u) < 1.5) & (v > 0) & (v < 14)] = 0.75
    image[(np.abs(u - 1) < 7) & (v >= 13)] = 0.75
    image *= 1 + 0.08 * rng.uniform(-jitter, jitter, (n, 1, 1)).astype(np.float32)
    image += rng.normal(0, 0.01, image.shape).astype(np.float32)
    return np.repeat((image.clip(0, 1) * 255).astype(np.uint8)[..., None], 3, axis=-1)


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
        rules=ArrowRules(),
        facts=lambda: RuleFacts(chance_level=0.0, optimum=1.0, optimal_return=0.0, mean_plan_length=1.0),
        render_macrostates=draw,
    )
