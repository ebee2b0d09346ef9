"""Frames of macrostates that nobody acted for: one scene and one renderer a thread, world and appearance level."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame, Rules
from imagine_bench.rules import require_macrostates, states_of

from .parameters.gesture import HIDDEN
from .rendering.cameras import FRAME_PX, agent_camera
from .rendering.renderer import Renderer
from .scenes.appearance import Appearance
from .scenes.appearance import appearance as appearance_level
from .world import World

MakeWorld = Callable[[Appearance], World]


@functools.lru_cache(maxsize=8)
def _frame_renderer(make_world: MakeWorld, level: Appearance, thread: int) -> tuple[World, Renderer]:
    world = make_world(level)
    return world, agent_camera(world.model)


def frames_of(
    make_world: MakeWorld, rules: Rules, macrostates: NDArray[np.int64], appearance: str, rng: np.random.Generator
) -> Frame:
    """Frames (N, 64, 64, 3), uint8, of macrostates (N, M) in the kinematic mode, each placed and varied anew.

    A gesture of -1 is hidden.

    Raises:
        UnknownNameError: No such appearance.
        InvalidValueError: Macrostates of another shape or type, or none of the rules'.
    """
    macrostates = np.asarray(macrostates)
    hidden = macrostates[..., -1] == HIDDEN
    if hidden.any():  # the hand is somewhere
        like = {state[:-1]: state for state in states_of(rules)}
        macrostates = np.array([like.get(tuple(row[:-1]), row) if row[-1] == HIDDEN else row for row in macrostates])
    macrostates = require_macrostates(rules, macrostates)
    world, camera = _frame_renderer(make_world, appearance_level(appearance), threading.get_ident())
    frames = np.empty((len(macrostates), FRAME_PX, FRAME_PX, 3), dtype=np.uint8)
    for row, macrostate in enumerate(macrostates.tolist()):
        world.place(tuple(macrostate), rng)
        world.hide_gesture(bool(hidden[row]))
        world.vary(rng)
        frames[row] = world.develop(camera.frame(world.data))
    return frames
