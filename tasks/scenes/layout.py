"""Where so many cubes stand, where the hand's fingertip is when it points at each, and how wide the camera looks.

Up to three cubes stand in one row. More stand in two, alternately far and near, so that each has a column of its own
and the finger reaches a near one through a gap of the far row, without covering an arrow.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

from . import constants as c
from .hand import fingertip_m

_ONE_ROW = 3
_NEAR_M = 0.56
_FAR_M = 0.65
_WIDTH_M = 0.225
_BACK_M = 0.027
"""So much further from a near cube the fingertip stays, beside those of the far row, and the palm behind them."""
_ONE_ROW_FOVY_DEG = 38.0
_TWO_ROWS_FOVY_DEG = 45.2


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Places of N cubes, left to right in the agent's frame."""

    slots_xy_m: tuple[tuple[float, float], ...]  #: nominal centres on the table
    fingertips_m: tuple[tuple[float, float, float], ...]  #: nominal, in the world, pointing at each
    fovy_deg: float  #: field of view of the agent's camera


@functools.cache
def layout(cubes: int) -> Layout:
    """The places of 1 to 6 cubes; more would not fit into the view."""
    two_rows = cubes > _ONE_ROW
    spacing_m = _WIDTH_M / (cubes - 1) if two_rows else c.SLOT_SPACING_M
    middle = (cubes - 1) / 2
    rows_m = [(_NEAR_M if cube % 2 else _FAR_M) if two_rows else c.ROW_X_M for cube in range(cubes)]
    slots = tuple((x_m, spacing_m * (middle - cube)) for cube, x_m in enumerate(rows_m))
    tips = tuple(fingertip_m((x_m + (_BACK_M if x_m == _NEAR_M else 0.0), y_m)) for x_m, y_m in slots)
    fovy_deg = _TWO_ROWS_FOVY_DEG if two_rows else _ONE_ROW_FOVY_DEG
    return Layout(slots_xy_m=slots, fingertips_m=tips, fovy_deg=fovy_deg)
