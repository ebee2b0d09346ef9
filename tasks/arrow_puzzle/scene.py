"""The arrow puzzle's scene as one MJCF model, compiled by plain MuJoCo."""

from __future__ import annotations

import copy
import functools

import mujoco

from ..scenes.arm import arm_root
from ..scenes.composing import mjcf
from ..scenes.hand import add_hand
from ..scenes.tabletop import add_tabletop
from .cubes import add_cubes


def arrow_root() -> mjcf.RootElement:
    """The whole scene; the arm is its root, so that every name stays without a prefix."""
    root = arm_root()
    root.model = "arrow_puzzle"
    add_tabletop(root)
    add_cubes(root)
    add_hand(root)
    return root


@functools.cache
def _compiled() -> mujoco.MjModel:
    root = arrow_root()
    return mujoco.MjModel.from_xml_string(root.to_xml_string(), assets=root.get_assets())


def compile_arrow_scene() -> mujoco.MjModel:
    """A model of the scene of one's own: appearance may write its colours, lights and cameras."""
    return copy.copy(_compiled())
