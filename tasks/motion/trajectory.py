"""Minimum-jerk motions in joint space, as fast as the joints' own speed and effort limits allow.

Between two waypoints every joint follows q0 + (q1 - q0) s(t / T) with s = 10 x³ - 15 x⁴ + 6 x⁵ (Flash and Hogan, 1985):
speed peaks at 1.875 Δq / T and acceleration at 10 / √3 Δq / T². The servo commands carry feed-forward terms, so that a
plain position servo follows without lag.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from imagine_bench.arrays import Floats

from .arm_model import ArmModel

PEAK_SPEED = 15 / 8
PEAK_ACCELERATION = 10 / math.sqrt(3)
"""Of the minimum-jerk profile, in Δq / T and Δq / T²."""
SPEED_SHARE = 0.97
"""Share of the speed limits that a plan uses; the rest is left to the servos."""
EFFORT_SHARE = 0.5
"""Share of the effort limits that accelerating may take; the rest is left to damping, load and the servos."""


@dataclass(frozen=True)
class Waypoint:
    """Where arm (7,) and fingers shall be next, at rest; the name, such as ``"close"``, is unique in its trajectory."""

    name: str
    qpos_rad: Floats
    opening_m: float  # commanded distance of each pad from the grip's middle; less than an object's half squeezes it
    min_duration_s: float = 0.0  # the motion takes at least so long, such as the time fingers need
    blend_s: float = 0.0  # the next motion begins so long before this one has ended; the two add up


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A motion sampled once a timestep; row k holds at the end of step k."""

    qpos_rad: Floats  #: planned arm joints. Shape (N, 7).
    arm_command_rad: Floats  #: commands to the arm's position servos. Shape (N, 7).
    opening_m: Floats  #: command to each finger. Shape (N,).
    last_step: dict[str, int]  #: index of the last step of each waypoint's motion, by name


@lru_cache(maxsize=512)
def minimum_jerk(steps: int) -> Floats:
    """The profile s and its first two derivatives at x = 1/steps, 2/steps, .., 1. Shape (steps, 3), read-only."""
    x = np.arange(1, steps + 1) / steps
    position = x**3 * (10 - 15 * x + 6 * x**2)
    profile = np.stack([position, 30 * x**2 * (1 - x) ** 2, 60 * x * (1 - x) * (1 - 2 * x)], axis=1)
    profile.setflags(write=False)
    return profile


def shortest_duration_s(arm: ArmModel, delta_rad: Floats, inertia: Floats) -> float:
    """The least time for a minimum-jerk motion by ``delta_rad`` (7,) within the shares of the arm's limits.

    ``inertia`` (7, 7) is the joint-space inertia along the way, in kg·m².
    """
    by_speed = np.abs(delta_rad / arm.speed_limit_rad_s).max() * PEAK_SPEED / SPEED_SHARE
    by_effort = np.abs(inertia @ delta_rad / arm.effort_limit_nm).max() * PEAK_ACCELERATION / EFFORT_SHARE
    return max(float(by_speed), math.sqrt(by_effort))


def plan(
    arm: ArmModel, *, start_qpos_rad: Floats, start_opening_m: float, waypoints: Sequence[Waypoint], timestep_s: float
) -> Trajectory:
    """Join the waypoints by minimum-jerk motions, each as short as the limits allow.

    The command is q + (K_d q' + M q'') / K_p, which cancels the lag of the servo by damping and inertia
    (gravity is compensated in the model). M is taken halfway along each motion. The arm (7,) and each finger rest at
    their starts before; there is at least one waypoint.
    """
    at_qpos_rad = start_qpos_rad
    at_opening_m = start_opening_m
    first = 0
    motions: list[tuple[int, Floats]] = []  # first step, rows [steps, 15]
    last_step: dict[str, int] = {}
    for waypoint in waypoints:
        delta_rad = waypoint.qpos_rad - at_qpos_rad
        duration_s = max(waypoint.min_duration_s, timestep_s)
        inertial_nms2 = np.zeros(7)
        if delta_rad.any():
            inertia = arm.inertia(at_qpos_rad + delta_rad / 2)
            inertial_nms2 = inertia @ delta_rad
            duration_s = max(shortest_duration_s(arm, delta_rad, inertia), duration_s)
        steps = math.ceil(duration_s / timestep_s - 1e-9)
        duration_s = steps * timestep_s
        # Rows weigh s, s' and s''; columns are the planned joints, the commands and the opening.
        weights = np.zeros((3, 15))
        weights[0, :7] = weights[0, 7:14] = delta_rad
        weights[0, 14] = waypoint.opening_m - at_opening_m
        weights[1, 7:14] = arm.damping_nms_rad * delta_rad / (duration_s * arm.stiffness_nm_rad)
        weights[2, 7:14] = inertial_nms2 / (duration_s**2 * arm.stiffness_nm_rad)
        motions.append((first, minimum_jerk(steps) @ weights))
        last_step[waypoint.name] = first + steps - 1
        first += max(0, steps - math.floor(waypoint.blend_s / timestep_s + 1e-9))
        at_qpos_rad = waypoint.qpos_rad
        at_opening_m = waypoint.opening_m
    rows = np.empty((max(last_step.values()) + 1, 15))
    rows[:] = np.concatenate([start_qpos_rad, start_qpos_rad, [start_opening_m]])
    for first, motion in motions:
        rows[first : first + len(motion)] += motion
        rows[first + len(motion) :] += motion[-1]
    return Trajectory(qpos_rad=rows[:, :7], arm_command_rad=rows[:, 7:14], opening_m=rows[:, 14], last_step=last_step)
