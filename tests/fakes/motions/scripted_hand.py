"""A hand that goes where a script says: the motions with which tests try to cheat the referee."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from imagine_bench.tasks.continuous.controls import MOST_OPEN_M
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.scenes.constants import TABLE_HEIGHT_M

from imagine_bench.arrays import Floats

WIDE_M = 0.036
"""Fingers so wide apart pass beside a cube."""
CLOSED_M = 0.0
SQUEEZE_M = 0.0235
"""The command to each finger that squeezes a cube."""
_DOWN = (0.0, 1.0, 0.0, 0.0)


@dataclass
class Hand:
    """Moves the hand of an environment with ``control="pose"``, and keeps the infos of all events.

    Heights are above the table; at yaw 0 the fingers are apart along the row, at 90 across it.
    """

    env: MotionEnv
    at_m: Floats = field(init=False)
    yaw_deg: float = field(init=False)
    tilt_deg: float = 0.0
    opening_m: float = WIDE_M
    over: bool = False
    total: float = 0.0
    events: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.at_m, rotation = self.env.controls.hand_pose(self.env.data.ctrl[self.env.columns.ctrl[:7]])
        self.yaw_deg = math.degrees(math.atan2(rotation[1, 0], rotation[0, 0]))

    def go(
        self,
        x_m: float | None = None,
        y_m: float | None = None,
        height_m: float | None = None,
        *,
        yaw_deg: float | None = None,
        tilt_deg: float | None = None,
        seconds: float = 0.8,
    ) -> Hand:
        """Move there smoothly; a value of None stays."""
        to_m = self.at_m.copy()
        for axis, value in enumerate((x_m, y_m, None if height_m is None else TABLE_HEIGHT_M + height_m)):
            if value is not None:
                to_m[axis] = value
        yaw_to = self.yaw_deg if yaw_deg is None else yaw_deg
        tilt_to = self.tilt_deg if tilt_deg is None else tilt_deg
        from_m, yaw_from, tilt_from = self.at_m, self.yaw_deg, self.tilt_deg
        steps = max(1, round(seconds / self.env.period_s))
        for step in range(1, steps + 1):
            x = step / steps
            share = x**3 * (10 - 15 * x + 6 * x**2)
            self.at_m = from_m + share * (to_m - from_m)
            self.yaw_deg = yaw_from + share * (yaw_to - yaw_from)
            self.tilt_deg = tilt_from + share * (tilt_to - tilt_from)
            self._step()
        return self

    def grip(self, opening_m: float, seconds: float = 0.28) -> Hand:
        """Close or open each finger to a distance from the middle."""
        self.opening_m = opening_m
        return self.wait(seconds)

    def wait(self, seconds: float) -> Hand:
        """Stay."""
        for _ in range(max(1, round(seconds / self.env.period_s))):
            self._step()
        return self

    def _step(self) -> None:
        if self.over:
            return
        quat = _times(_about("z", self.yaw_deg), _times(_about("y", self.tilt_deg), np.array(_DOWN)))
        action = [*self.at_m, *quat, 2.0 * self.opening_m / MOST_OPEN_M - 1.0]
        _, reward, terminated, truncated, info = self.env.step(np.array(action, dtype=np.float32))
        self.total += reward
        if info["event"]:
            self.events.append({**info, "reward": reward, "terminated": terminated})
        self.over = terminated or truncated


def _about(axis: str, deg: float) -> Floats:
    quat = np.zeros(4)
    quat[0] = math.cos(math.radians(deg) / 2)
    quat["wxyz".index(axis)] = math.sin(math.radians(deg) / 2)
    return quat


def _times(first: Floats, second: Floats) -> Floats:
    product = np.empty(4)
    mujoco.mju_mulQuat(product, first, second)
    return product
