"""The observation of one moment: the agent's frame, the human's view, the macrostate, the arm's own sense.

Frames of macrostates that nobody acted for come from one scene and one renderer a thread, world and appearance level.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Frame, Observed, State
from imagine_bench.errors import InvalidValueError, brief, require_known
from imagine_bench.interfaces import OBSERVATION_SIZES_PX, OBSERVATIONS, Rules
from imagine_bench.rules import require_macrostates, states_of

from .parameters.parameters import HIDDEN
from .rendering.cameras import agent_camera_view, control_view, human_camera_view
from .rendering.renderer import Renderer, View
from .scenes.appearance import Appearance
from .scenes.appearance import appearance as appearance_level
from .scenes.arm import TCP_SITE, arm_columns, tcp_in_world
from .scenes.constants import CONTROL_CAMERAS, FRAME_PX, HUMAN_CAMERA
from .world import World

CONTROL_OBSERVATIONS = (*CONTROL_CAMERAS, "proprio", "objects", "state")
"""Parts of an observation of one moment in continuous control."""
Part = NDArray[np.uint8] | NDArray[np.float32]
"""An image, or a vector."""
_Space = gymnasium.Space[Any]  # of one part, or of several
_Moment = tuple["Observer", State]
_LOW = np.array([*[-2 * math.pi] * 7, -0.1, -0.1, *[-2.0] * 3, *[-1.0] * 4], dtype=np.float32)
"""Of ``proprio``: joints (rad), fingers (m), and the tool's position (m) and quaternion. The arm reaches 1.3 m."""


class Observer:
    """Observations of a world: one part as it is, several, separated by commas, as a dict.

    ``frame`` is the agent's camera and ``human`` the whole scene, uint8 (size, size, 3). ``state`` is the macrostate, a
    one-hot vector for each coordinate, zeros where it is hidden, float32. ``proprio`` is float32 (16,): seven joints
    (rad), each finger's distance from the grip's middle (m), and the point between them: position (m) and quaternion
    (w, x, y, z). In continuous control the images are ``hand``, from the hand past its fingers, and ``front``; and
    ``objects`` is float32 (N, 7), the position (m) and quaternion (w, x, y, z) of each loose object.

    Args:
        choice: Names in :data:`.interfaces.OBSERVATIONS`, or in :data:`CONTROL_OBSERVATIONS`.
        size: Edge of images in pixels.
        world: The parts that are observed.
        values: Names of the values of each coordinate of a macrostate.
        camera: The renderer of a view.
        control: Whether this is continuous control.

    Raises:
        UnknownNameError: Another part.
        InvalidValueError: A part twice, or another size.
    """

    def __init__(
        self,
        choice: str,
        size: int,
        world: World,
        values: Sequence[Sequence[str]],
        camera: Callable[[View], Renderer],
        *,
        control: bool = False,
    ) -> None:
        known = CONTROL_OBSERVATIONS if control else OBSERVATIONS
        names = choice.split(",") if isinstance(choice, str) else [choice]
        for name in names:
            require_known("observation", name, known)
        if len(set(names)) < len(names):
            raise InvalidValueError(f"Observation {choice!r} names a part twice; give each of {', '.join(known)} once.")
        low, high = OBSERVATION_SIZES_PX
        if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or not low <= size <= high:
            raise InvalidValueError(f"Observation size {brief(size)} must be an integer from {low} to {high} pixels.")
        self._world = world
        self._arm_qpos = arm_columns(world.model).qpos
        self._tcp = world.model.site(TCP_SITE).id
        self._offsets = np.cumsum([0, *(len(each) for each in values)])  # where each coordinate's values begin
        if control:
            views = {name: control_view(name, int(size)) for name in CONTROL_CAMERAS}
        else:
            views = {"frame": agent_camera_view(int(size)), "human": human_camera_view(HUMAN_CAMERA, size, size)}
        self._cameras = {name: camera(view) for name, view in views.items() if name in names}
        image = gymnasium.spaces.Box(0, 255, (int(size), int(size), 3), np.uint8)
        one_hot = gymnasium.spaces.Box(0.0, 1.0, (int(self._offsets[-1]),), np.float32)
        arm = gymnasium.spaces.Box(_LOW, -_LOW)
        lowest = np.tile(_LOW[-7:], (len(world.object_names), 1))
        poses = gymnasium.spaces.Box(lowest, -lowest)
        spaces: dict[str, _Space] = {"state": one_hot, "proprio": arm, "objects": poses, **dict.fromkeys(views, image)}
        chosen = {name: spaces[name] for name in names}
        self.space: _Space = gymnasium.spaces.Dict(chosen) if len(chosen) > 1 else chosen[names[0]]
        self._names = tuple(names)

    def observe(self, moments: Sequence[_Moment]) -> Sequence[Observed]:
        """Worlds as they stand, each read as a macrostate, by observers like this one and drawn with its cameras."""
        scenes = [(observer._world.model, observer._world.data) for observer, _ in moments]
        columns: dict[str, Sequence[Part]] = {}
        for name in self._names:
            if name == "state":
                columns[name] = [self._one_hot(macrostate) for _, macrostate in moments]
            elif name == "proprio":
                columns[name] = [observer._proprio() for observer, _ in moments]
            elif name == "objects":
                columns[name] = [observer._world.object_poses().astype(np.float32) for observer, _ in moments]
            else:
                images = self._cameras[name].frames(scenes)
                if name == "frame":
                    worlds = [observer._world for observer, _ in moments]
                    images = [world.composite(image) for world, image in zip(worlds, images, strict=True)]
                columns[name] = images
        if len(columns) == 1:
            return columns[self._names[0]]
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def _one_hot(self, macrostate: State) -> NDArray[np.float32]:
        one_hot = np.zeros(self._offsets[-1], dtype=np.float32)
        one_hot[[first + value for first, value in zip(self._offsets, macrostate, strict=False) if value >= 0]] = 1.0
        return one_hot

    def _proprio(self) -> NDArray[np.float32]:
        data = self._world.data
        sense = np.empty(len(_LOW), dtype=np.float32)
        n_joints = len(self._arm_qpos)
        sense[:n_joints] = data.qpos[self._arm_qpos]
        sense[n_joints:] = tcp_in_world(data, self._tcp)
        return sense


MakeWorld = Callable[[Appearance], World]


@functools.lru_cache(maxsize=8)
def _frame_renderer(make_world: MakeWorld, level: Appearance, thread: int) -> tuple[World, Renderer]:
    world = make_world(level)
    return world, Renderer(world.model, agent_camera_view())


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
        frames[row] = world.composite(camera.frame(world.data))
    return frames
