"""What an environment shows of one moment: the agent's frame, the human's view, the macrostate, the arm's own sense."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Observed
from imagine_bench.errors import InvalidValueError, brief, require_known
from imagine_bench.interfaces import OBSERVATION_SIZES_PX, OBSERVATIONS, Frame

from .rendering.renderer import Renderer
from .scene_reader import arm_columns, tcp_in_world
from .scenes.arm import TCP_SITE
from .world import World

Part = NDArray[np.uint8] | NDArray[np.float32]
"""An image, or a vector."""
_Space = gymnasium.Space[Any]  # of one part, or of several
_Camera = Callable[[str, int], Renderer]
_Moment = tuple["Observer", tuple[int, ...]]
_LOW = np.array([*[-2 * math.pi] * 7, -0.1, -0.1, *[-2.0] * 3, *[-1.0] * 4], dtype=np.float32)
"""Of ``proprio``: joints (rad), fingers (m), and the tool's position (m) and quaternion. The arm reaches 1.3 m."""


class Observer:
    """Observations of a world: one part as it is, several, separated by commas, as a dict.

    ``frame`` is the agent's camera and ``human`` the whole scene, uint8 (size, size, 3). ``state`` is the macrostate, a
    one-hot vector for each coordinate, zeros where it is hidden, float32. ``proprio`` is float32 (16,): seven joints
    (rad), each finger's distance from the grip's middle (m), and the point between them: position (m) and quaternion
    (w, x, y, z).

    Args:
        choice: Names in :data:`.interfaces.OBSERVATIONS`.
        size: Edge of images in pixels.
        world: What is observed.
        values: Names of the values of each coordinate of a macrostate.
        camera: The renderer of an image, by its name and size.

    Raises:
        UnknownNameError: Another part.
        InvalidValueError: A part twice, or another size.
    """

    def __init__(self, choice: str, size: int, world: World, values: Sequence[Sequence[str]], camera: _Camera) -> None:
        names = choice.split(",") if isinstance(choice, str) else [choice]
        self._names = tuple(require_known("observation", name, OBSERVATIONS) for name in names)
        if len(set(names)) < len(names):
            raise InvalidValueError(
                f"Observation {choice!r} names a part twice; give each of {', '.join(OBSERVATIONS)} once."
            )
        low, high = OBSERVATION_SIZES_PX
        if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or not low <= size <= high:
            raise InvalidValueError(f"Observation size {brief(size)} must be an integer from {low} to {high} pixels.")
        self._world = world
        self._arm_qpos, _, _ = arm_columns(world.model)
        self._tcp = world.model.site(TCP_SITE).id
        self._offsets = np.cumsum([0, *(len(each) for each in values)])  # where each coordinate's values begin
        self._cameras: dict[str, Renderer] = {}
        for name in ("frame", "human"):
            if name in names:
                self._cameras[name] = camera(name, int(size))
        image = gymnasium.spaces.Box(0, 255, (int(size), int(size), 3), np.uint8)
        one_hot = gymnasium.spaces.Box(0.0, 1.0, (int(self._offsets[-1]),), np.float32)
        arm = gymnasium.spaces.Box(_LOW, -_LOW)
        spaces: dict[str, _Space] = {"frame": image, "human": image, "state": one_hot, "proprio": arm}
        chosen = {name: spaces[name] for name in self._names}
        self.space: _Space = gymnasium.spaces.Dict(chosen) if len(chosen) > 1 else chosen[self._names[0]]

    def observe(self, moments: Sequence[_Moment]) -> Sequence[Observed]:
        """Worlds as they stand, each read as a macrostate, by observers like this one and drawn with its cameras."""
        scenes = [(observer._world.model, observer._world.data) for observer, _ in moments]
        images = {name: camera.frames(scenes) for name, camera in self._cameras.items()}
        columns = {name: self._column(name, moments, images.get(name)) for name in self._names}
        if len(columns) == 1:
            return columns[self._names[0]]
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def close(self) -> None:
        """Free the OpenGL contexts; may be called again."""
        for camera in self._cameras.values():
            camera.close()

    def _column(self, name: str, moments: Sequence[_Moment], images: list[Frame] | None) -> Sequence[Part]:
        """One part of each moment."""
        if images is None:
            return [each._one_hot(state) if name == "state" else each._proprio() for each, state in moments]
        if name == "human":
            return images
        return [each._world.develop(image) for (each, _), image in zip(moments, images, strict=True)]

    def _one_hot(self, macrostate: tuple[int, ...]) -> NDArray[np.float32]:
        one_hot = np.zeros(self._offsets[-1], dtype=np.float32)
        one_hot[[first + value for first, value in zip(self._offsets, macrostate, strict=False) if value >= 0]] = 1.0
        return one_hot

    def _proprio(self) -> NDArray[np.float32]:
        data = self._world.data
        return np.concatenate([data.qpos[self._arm_qpos], tcp_in_world(data, self._tcp)], dtype=np.float32)
