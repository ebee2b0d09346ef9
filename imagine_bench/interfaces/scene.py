"""The interface of a scene that can be drawn elsewhere, such as in Rerun: its shapes and how they moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from imagine_bench.arrays import Floats, Frame, Ints


@dataclass(frozen=True, kw_only=True)
class Shape3D:
    """One drawable part of a scene, fixed to a body."""

    name: str  #: unique element name
    body: str  #: name of the body it moves with
    #: ``"box"`` (half sizes), ``"sphere"`` (radius), ``"capsule"`` / ``"cylinder"`` (radius, half length),
    #: ``"ellipsoid"`` (radii) or ``"mesh"``
    kind: str
    size: Floats  #: as ``kind`` says, in metres. Shape (3,), unused entries 0.
    pose_in_body: Floats  #: position (m) and quaternion (w, x, y, z). Shape (7,).
    rgba: Floats  #: in [0, 1]. Shape (4,).
    vertices: Floats | None = None  #: for meshes, (V, 3) in metres; else None
    faces: Ints | None = None  #: for meshes, (F, 3) vertex indices; else None


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How the bodies of a scene moved during one macro-action."""

    body_names: tuple[str, ...]  #: one a body. Length B.
    time_s: Floats  #: seconds since the macro-action began, ascending. Shape (K,).
    poses_in_world: Floats  #: position (m) and quaternion (w, x, y, z). Shape (K, B, 7).


@dataclass(frozen=True, kw_only=True)
class ArmMotion:
    """How the arm moved during one macro-action; joints from the base to the wrist, a command holds from then.

    Rows are the samples of :class:`Motion`: ``capture_motion_hz`` a second, and the last moment.
    """

    time_s: Floats  #: seconds since the macro-action began, ascending. Shape (K,).
    joint_rad: Floats  #: Shape (K, 7).
    joint_rad_s: Floats  #: Shape (K, 7).
    gripper_m: Floats  #: each finger's distance from the grip's middle. Shape (K, 2).
    joint_command_rad: Floats  #: commands of the servos, feed-forward included. Shape (K, 7).
    gripper_command_m: Floats  #: the same of the fingers. Shape (K, 2).
    #: the point between the fingers: position (m) and quaternion (w, x, y, z). Shape (K, 7).
    tcp_in_world: Floats


@runtime_checkable
class ArmReader(Protocol):
    """An environment (``env.unwrapped``) with an arm whose motion can be read."""

    capture_motion_hz: float  #: samples of the motion a second kept during :meth:`step`; 0 keeps none

    def arm_motion(self) -> ArmMotion:
        """The latest macro-action's as captured; where nothing was, one sample of the standing scene (K = 1)."""

    def agent_film(self) -> Frame:
        """The image of the agent's camera at each sample. Shape (K, 64, 64, 3)."""


@runtime_checkable
class SceneReader(Protocol):
    """An environment (``env.unwrapped``) whose scene can be drawn elsewhere, such as in Rerun."""

    capture_motion_hz: float  #: samples of the motion a second kept during :meth:`step`; 0 keeps none

    def shapes(self) -> tuple[Shape3D, ...]:
        """Every drawable part, arm included."""

    def motion(self) -> Motion:
        """The motion of the latest macro-action; after ``reset`` one sample of the standing scene."""

    def agent_view(self) -> Frame:
        """The frame that agents see, drawn now. Shape (64, 64, 3)."""

    def human_view(self, width: int = 640, height: int = 480) -> Frame:
        """An image of the whole scene with the arm. Shape (height, width, 3)."""

    def film(self, width: int = 640, height: int = 480) -> Frame:
        """Images of the whole scene during the latest macro-action, as captured. Shape (K, height, width, 3)."""
