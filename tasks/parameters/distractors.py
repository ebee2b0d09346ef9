"""Distractors: a screen that shows noise, lying on the table under the hands, and balls that roll about on it.

The first is the screen, every other a ball. They touch nothing, hide nothing that matters, and no rule knows of them.
"""

from __future__ import annotations

import mujoco
import numpy as np

from ..scenes import constants as c

_TILES = (4, 8)
"""Of the screen, away from the robot and across."""
LOW_M = (0.695, -0.12)
HIGH_M = (0.795, 0.12)
"""Corners of the screen in the plane of the table, behind whatever stands there and in every frame."""
_THICKNESS_M = 0.002
RADIUS_M = 0.012
_ON_SCREEN_M = np.array(LOW_M) + RADIUS_M, np.array(HIGH_M) - RADIUS_M
"""Where a ball's middle may be."""
_ROLL_M = 0.03
"""The most that a ball rolls along each axis between two frames; at the screen's edge it turns back."""
_RGBA = ((0.95, 0.80, 0.15, 1.0), (0.15, 0.75, 0.80, 1.0), (0.70, 0.25, 0.75, 1.0))
"""Of the balls."""
_DRAWN_ONLY = {"contype": 0, "conaffinity": 0, "mass": 0.0, "group": c.SCENE_GROUP}


def add_distractors(spec: mujoco.MjSpec, count: int) -> None:
    """Add the screen's tiles ``screen_i`` and mocap bodies ``distractor_1`` and on; nothing if the count is 0."""
    if not count:
        return
    sizes_m = (np.array(HIGH_M) - LOW_M) / _TILES
    for index, cell in enumerate(np.ndindex(_TILES)):
        x_m, y_m = LOW_M + (np.array(cell) + 0.5) * sizes_m
        name = f"screen_{index}"
        spec.add_material(name=name, rgba=(0.5, 0.5, 0.5, 1.0), specular=0.0, emission=0.1)
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(*sizes_m / 2, _THICKNESS_M / 2),
            material=name,
            pos=(x_m, y_m, c.TABLE_HEIGHT_M + _THICKNESS_M / 2),
            **_DRAWN_ONLY,
        )
    for ball in range(1, count):
        name = f"distractor_{ball}"
        middle_m = np.mean([LOW_M, HIGH_M], axis=0)
        spec.add_material(name=name, rgba=_RGBA[ball - 1], specular=0.2, shininess=0.3)
        body = spec.worldbody.add_body(
            name=name, mocap=True, pos=(*middle_m, c.TABLE_HEIGHT_M + _THICKNESS_M + RADIUS_M)
        )
        body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(RADIUS_M, 0, 0), material=name, **_DRAWN_ONLY)


class Distraction:
    """The motion of a model's distractors; all their state is in ``mat_rgba`` of the model and ``mocap_pos`` of data.

    Args:
        model: A scene with at least one distractor.
        count: How many it has.
    """

    def __init__(self, model: mujoco.MjModel, count: int) -> None:
        self._model = model
        self._tiles = [model.material(f"screen_{index}").id for index in range(int(np.prod(_TILES)))]
        self._balls = [int(model.body(f"distractor_{ball}").mocapid[0]) for ball in range(1, count)]

    def place(self, data: mujoco.MjData, rng: np.random.Generator) -> None:
        """Put every ball anywhere on the screen."""
        data.mocap_pos[self._balls, :2] = rng.uniform(*_ON_SCREEN_M, (len(self._balls), 2))

    def vary(self, data: mujoco.MjData, rng: np.random.Generator) -> None:
        """Draw the screen anew and roll every ball a little; one that was anywhere is anywhere, equally likely."""
        self._model.mat_rgba[self._tiles, :3] = rng.random((len(self._tiles), 3))
        there_m = data.mocap_pos[self._balls, :2] + rng.uniform(-_ROLL_M, _ROLL_M, (len(self._balls), 2))
        low_m, high_m = _ON_SCREEN_M
        there_m = np.abs(there_m - low_m) + low_m
        data.mocap_pos[self._balls, :2] = high_m - np.abs(high_m - there_m)
