"""The scene in a recording: one transform a body, with its shapes below it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from imagine_bench.arrays import Floats, Frame
from imagine_bench.environments import Env
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Motion, SceneReader, Shape3D
from imagine_bench.recording.stream import Recording, entity_name

ROOT = "/scene"
_MOTION_HZ = 20.0
_STILL_M = 1e-6  # bodies whose poses (metres; quaternions) change by less in a macro-action get no new transforms
_BACKDROP_M = 2.0
_SMALL_M = 0.07
_KINEMATIC_STEP_S = 1.0
_CAMERA_FROM_TARGET_M = np.array([0.62, -0.62, 0.52])  # beside the human's hand: no arm hides the objects from there


class Stage:
    """The scene of an environment, which keeps its motion from now on; one without a scene shows nothing."""

    def __init__(self, recording: Recording, env: Env) -> None:
        scene = env.unwrapped
        self.recording = recording
        self.env_step = -1
        self.scene = scene if isinstance(scene, SceneReader) else None
        if self.scene is not None:
            self.scene.capture_motion_hz = _MOTION_HZ

    def show(self, **sequences: int) -> None:
        """Go on by one ``env_step``, and log how the latest macro-action moved the scene: first what there is in it.

        The view looks at the middle of the small bodies, which are the objects and the fingers.
        """
        recording = self.recording
        self.env_step += 1
        recording.set_clocks(env_step=self.env_step, **sequences)
        if self.scene is None:
            return
        motion = self.scene.motion()
        if not recording.holds(ROOT):
            shapes = self.scene.shapes()
            log_shapes(recording, shapes)
            large = {shape.body for shape in shapes if _extent_m(shape) > _SMALL_M}
            small = [body not in large for body in motion.body_names]
            places = motion.poses_in_world[0, :, :3]
            recording.look_target_m = places[small if any(small) else slice(None)].mean(axis=0)
        log_motion(recording, motion)

    def act(self) -> None:
        """Let the clock go on as long as the latest macro-action took; a kinematic one is given a second."""
        lasted_s = 0.0 if self.scene is None else float(self.scene.motion().time_s[-1])
        self.recording.clock_s += lasted_s or _KINEMATIC_STEP_S


def log_shapes(recording: Recording, shapes: Sequence[Shape3D]) -> None:
    """Log every shape once, for all times, below its body; a backdrop as wide as a room is left out."""
    recording.log(ROOT, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for shape in shapes:
        if _extent_m(shape) <= _BACKDROP_M:
            path = f"{ROOT}/{entity_name(shape.body)}/{entity_name(shape.name)}"
            place = shape.pose_in_body[:3]
            turned = rr.Quaternion(xyzw=_xyzw(shape.pose_in_body[3:]))
            recording.log(path, rr.Transform3D(translation=place, quaternion=turned), static=True)
            recording.log(path, _drawable(shape), static=True)


def log_motion(recording: Recording, motion: Motion, *, only_moved: bool = True) -> None:
    """Log the bodies' poses over one macro-action, but for those that stood still where ``only_moved``.

    A motion of one sample is how the scene stands, and logged whole. It is over now, by the recording's clock; the
    sequence timelines are the same for all samples.
    """
    times = [rr.TimeColumn("sim_time", duration=recording.clock_s - motion.time_s[-1] + motion.time_s)]
    for name, value in recording.sequences.items():
        times.append(rr.TimeColumn(name, sequence=np.full(len(motion.time_s), value)))
    for index, body in enumerate(motion.body_names):
        poses = motion.poses_in_world[:, index]  # [K, 7]
        if only_moved and len(poses) > 1 and np.abs(poses - poses[0]).max() < _STILL_M:
            continue
        columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=_xyzw(poses[:, 3:]))
        recording.stream.send_columns(f"{ROOT}/{entity_name(body)}", indexes=times, columns=columns, strict=True)


def scene_view(recording: Recording) -> rrb.Spatial3DView:
    """The 3D scene, seen from beside the human's hand."""
    target = recording.look_target_m
    eye = rrb.EyeControls3D(position=target + _CAMERA_FROM_TARGET_M, look_target=target, eye_up=[0.0, 0.0, 1.0])
    name = "The scene: the arm acts, a human gestures"
    return rrb.Spatial3DView(origin=ROOT, name=name, eye_controls=eye, background=[214, 222, 230], line_grid=False)


def _extent_m(shape: Shape3D) -> float:
    """Roughly how far a shape reaches from its origin along its longest axis, in metres."""
    return float(np.abs(shape.size if shape.vertices is None else shape.vertices).max())


def _drawable(shape: Shape3D) -> rr.AsComponents:
    color = (np.clip(shape.rgba, 0.0, 1.0) * 255).astype(np.uint8)
    style: dict[str, Any] = {"colors": color, "fill_mode": "solid"}
    size = shape.size
    height = [2.0 * size[1]]
    match shape.kind:
        case "mesh":
            return _mesh(shape, color)
        case "box":
            return rr.Boxes3D(half_sizes=[size], **style)
        case "ellipsoid":
            return rr.Ellipsoids3D(half_sizes=[size], **style)
        case "sphere":
            return rr.Ellipsoids3D(half_sizes=[size[[0, 0, 0]]], **style)
        case "cylinder":
            return rr.Cylinders3D(lengths=height, radii=size[0], **style)
        case "capsule":  # Rerun's begins at its origin, ours has it in the middle
            return rr.Capsules3D(lengths=height, radii=size[0], translations=[[0.0, 0.0, -size[1]]], **style)
    raise InvalidValueError(f"Shape {shape.name!r} is of kind {shape.kind!r}, which a recording cannot draw.")


def _mesh(shape: Shape3D, color: Frame) -> rr.Mesh3D:
    """Flat-shaded: every face has its own three corners, so that edges stay sharp."""
    if shape.vertices is None or shape.faces is None:
        raise InvalidValueError(f"Shape {shape.name!r} is a mesh without vertices or faces.")
    corners = shape.vertices[shape.faces]  # [F, 3, 3]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0),
        triangle_indices=np.arange(3 * len(corners)).reshape(-1, 3),
        albedo_factor=color,
    )


def _xyzw(quaternions: Floats) -> Floats:
    """Rerun's order of quaternion components: (..., wxyz) to (..., xyzw)."""
    return np.roll(quaternions, -1, axis=-1)
