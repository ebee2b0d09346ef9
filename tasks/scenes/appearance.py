"""How much a scene's appearance varies: frozen levels, and writing one sample into a model without recompiling."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from imagine_bench.appearance import POINTS, appearance_name, factors_of
from imagine_bench.interfaces import HELD_OUT, Floats

_CHANNELS = 3


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """Half-widths of uniform variation about the nominal scene; 0 means fixed."""

    name: str  #: the level's, or its factors
    object_offset_m: float  #: of every loose object's start, along x and along y
    object_yaw_rad: float  #: of every loose object's start
    hand_offset_m: float = 0.0  #: of the human's hand, along each axis, every frame until an object lies in its palm
    hand_yaw_rad: float = 0.0  #: of the human's hand about the vertical through its fingertip, every frame
    light_fraction: float = 0.0  #: of the brightness of all lights together, every frame
    color_fraction: float = 0.0  #: of each color channel of each material, every frame
    camera_offset_m: float = 0.0  #: of each agent's camera, along each axis, every frame
    camera_angle_rad: float = 0.0  #: of each agent's camera, about each axis, every frame
    #: None, or the seed of the finite pools of :mod:`.fragments`, which then decide poses, light and colors
    pool: int | None = None
    gamma_half_width: float = 0.0  #: of gamma about 1, every frame; with a pool only
    noise_std: float = 0.0  #: of the sensor's Gaussian noise, of full scale, every frame; with a pool only
    shift_px: float = 0.0  #: of an episode's frames, of 64 pixels, down and to the right
    shadow_depth: float = 0.0  #: share of the light that is missing in the middle of the shadow; no half-width
    noise_levels: float = 0.0  #: standard deviation of the sensor's noise, of 255, every frame
    occluder_px: float = 0.0  #: edge of a gray square somewhere in every frame, of 64 pixels
    reward_std: float = 0.0  #: standard deviation of the noise of every reward
    reward_step: float = 0.0  #: added to every reward, taken from it, or neither, each in a third of all cases

    @property
    def varies_every_frame(self) -> bool:
        """Whether anything but the objects' start varies."""
        hand = (self.hand_offset_m, self.hand_yaw_rad)
        camera = (self.camera_offset_m, self.camera_angle_rad)
        return any(amount > 0 for amount in (*hand, *camera, self.light_fraction, self.color_fraction))

    @property
    def has_nuisances(self) -> bool:
        """Whether frames change after they are rendered; see :mod:`.nuisances`."""
        return any((self.shift_px, self.shadow_depth, self.noise_levels, self.occluder_px))


_CLEAN = Appearance(name="clean", object_offset_m=0.0025, object_yaw_rad=math.radians(2.0))
_PHOTO = Appearance(
    name="photo",
    object_offset_m=0.005,
    object_yaw_rad=math.radians(4.6),
    hand_offset_m=0.006,
    hand_yaw_rad=math.radians(8.0),
    light_fraction=0.15,
    color_fraction=0.04,
    pool=521,
    gamma_half_width=0.5,
    noise_std=0.015,
)

LEVELS: dict[str, Appearance] = {
    level.name: level
    for level in (
        _CLEAN,
        Appearance(
            name="mild",
            object_offset_m=0.005,
            object_yaw_rad=math.radians(4.6),
            hand_offset_m=0.004,
            hand_yaw_rad=math.radians(4.0),
            light_fraction=0.10,
        ),
        Appearance(
            name="strong",
            object_offset_m=0.010,
            object_yaw_rad=math.radians(8.0),
            hand_offset_m=0.006,
            hand_yaw_rad=math.radians(8.0),
            light_fraction=0.25,
            color_fraction=0.06,
            camera_offset_m=0.003,
            camera_angle_rad=math.radians(0.5),
        ),
        _PHOTO,
        replace(_PHOTO, name=HELD_OUT["photo"]),
    )
}


_FIELDS = {
    "light": ("light_fraction",),
    "colors": ("color_fraction",),
    "camera": ("camera_offset_m", "camera_angle_rad"),
    "pose": ("object_offset_m", "object_yaw_rad"),
    "hand": ("hand_offset_m", "hand_yaw_rad"),
}
"""The variations of each factor."""
NUISANCE_FIELDS = {
    "shift": ("shift_px", 4.0),
    "shadow": ("shadow_depth", 0.5),
    "noise": ("noise_levels", 20.0),
    "occlusion": ("occluder_px", 8.0),
    "reward_noise": ("reward_std", 0.5),
    "reward_steps": ("reward_step", 0.5),
}
"""The variation of each nuisance, and its value at 1."""
_DARKEST = 0.95
"""Most of the light that a shadow takes."""


def appearance(given: str | Mapping[str, float]) -> Appearance:
    """The level of that name, or the point of these factors. Raises as :func:`.appearance_name`."""
    name = appearance_name(given, LEVELS)
    return LEVELS[name] if name in LEVELS else between(name, factors_of(name))


def between(name: str, factors: Mapping[str, float]) -> Appearance:
    """The point of these factors: each is interpolated between the levels that are points, a nuisance also beyond."""
    widths = dict[str, Any]()
    for factor, fields in _FIELDS.items():
        levels = {POINTS[level].get(factor, 0.0): LEVELS[level] for level in ("clean", "mild", "strong")}
        for each in fields:
            at = [getattr(level, each) for level in levels.values()]
            widths[each] = float(np.interp(factors.get(factor, 0.0), list(levels), at))
    for nuisance, (each, at_1) in NUISANCE_FIELDS.items():
        widths[each] = factors.get(nuisance, 0.0) * at_1
    widths["shadow_depth"] = min(widths["shadow_depth"], _DARKEST)
    return Appearance(name=name, **widths)


LEVELS["harsh"] = between("harsh", POINTS["harsh"])


def appearance_arrays(model: mujoco.MjModel) -> tuple[Floats, ...]:
    """The values that any appearance writes into a model: views of it."""
    headlight = model.vis.headlight
    return headlight.ambient, headlight.diffuse, model.light_diffuse, model.mat_rgba, model.cam_pos, model.cam_quat


class AppearanceSampler:
    """Writes samples of light, colors and cameras into one model.

    Args:
        model: The scene; its arrays are changed by :meth:`vary`.
        level: How much varies.
        cameras: Names of the cameras that move, each by a draw of its own.
        materials: Names of the materials whose colors vary.
    """

    def __init__(
        self, model: mujoco.MjModel, level: Appearance, *, cameras: Sequence[str], materials: Sequence[str]
    ) -> None:
        self._model = model
        self._level = level
        self._cameras = [model.camera(name).id for name in cameras]
        self._materials = np.array([model.material(name).id for name in materials])
        self._nominal = [each.copy() for each in appearance_arrays(model)]

    def vary(self, rng: np.random.Generator) -> None:
        """Write one new sample; it replaces the one before, nothing adds up."""
        level = self._level
        *lights, rgba, cam_pos, cam_quat = appearance_arrays(self._model)
        *nominal_lights, nominal_rgba, nominal_pos, nominal_quat = self._nominal
        if level.light_fraction:
            brightness = 1.0 + level.light_fraction * rng.uniform(-1.0, 1.0)
            for light, nominal in zip(lights, nominal_lights, strict=True):
                light[:] = nominal * brightness
        if level.color_fraction:
            tint = 1.0 + level.color_fraction * rng.uniform(-1.0, 1.0, (len(self._materials), _CHANNELS))
            rgba[self._materials, :_CHANNELS] = np.minimum(nominal_rgba[self._materials, :_CHANNELS] * tint, 1.0)
        if level.camera_offset_m or level.camera_angle_rad:
            for camera in self._cameras:
                shift, turn = rng.uniform(-1.0, 1.0, (2, 3))
                cam_pos[camera] = nominal_pos[camera] + level.camera_offset_m * shift
                quat = nominal_quat[camera].copy()
                mujoco.mju_quatIntegrate(quat, level.camera_angle_rad * turn, 1.0)
                cam_quat[camera] = quat
