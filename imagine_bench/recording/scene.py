"""The scene in a recording, one transform a body with its shapes below it; and how a recording looks when opened."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from imagine_bench.environments import Env
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Motion, SceneReader, Shape3D
from imagine_bench.recording.stream import Recording, entity_name

ROOT = "/scene"
_STILL_M = 1e-6  # bodies whose poses (metres; quaternions) change by less in a macro-action get no new transforms
_BACKDROP_M = 2.0
_SMALL_M = 0.07
_KINEMATIC_STEP_S = 1.0


def _extent_m(shape: Shape3D) -> float:
    """Roughly how far a shape reaches from its origin along its longest axis, in metres."""
    return float(shape.size.max() if shape.vertices is None else np.abs(shape.vertices).max())


def _body_path(body: str) -> str:
    """Entity path of a body."""
    return f"{ROOT}/{entity_name(body)}"


def log_shapes(recording: Recording, shapes: Sequence[Shape3D]) -> None:
    """Log every shape once, for all times, below its body; a backdrop as wide as a room is left out."""
    recording.log(ROOT, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for shape in shapes:
        if _extent_m(shape) > _BACKDROP_M:
            continue
        path = f"{_body_path(shape.body)}/{entity_name(shape.name)}"
        pose = shape.pose_in_body
        recording.log(
            path, rr.Transform3D(translation=pose[:3], quaternion=rr.Quaternion(xyzw=_xyzw(pose[3:]))), static=True
        )
        recording.log(path, _drawable(shape), static=True)


def log_motion(
    recording: Recording, motion: Motion, *, end_s: float, sequences: dict[str, int], only_moved: bool = True
) -> None:
    """Log the bodies' poses over one macro-action, but for those that stood still where ``only_moved``.

    A motion of one sample is how the scene stands, and logged whole. It was over at ``end_s`` on the timeline
    ``sim_time``, in seconds; ``sequences`` are values of the sequence timelines, the same for all samples.
    """
    times = [rr.TimeColumn("sim_time", duration=end_s - motion.time_s[-1] + motion.time_s)]
    times += [rr.TimeColumn(name, sequence=np.full(len(motion.time_s), value)) for name, value in sequences.items()]
    for index, body in enumerate(motion.body_names):
        poses = motion.poses_in_world[:, index]  # [K, 7]
        if only_moved and len(poses) > 1 and np.abs(poses - poses[0]).max() < _STILL_M:
            continue
        columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=_xyzw(poses[:, 3:]))
        recording.stream.send_columns(_body_path(body), indexes=times, columns=columns, strict=True)


def macro_duration_s(scene: Env) -> float:
    """How long the latest macro-action took, in simulated seconds; a kinematic one takes none and is given one."""
    return (float(scene.motion().time_s[-1]) if isinstance(scene, SceneReader) else 0.0) or _KINEMATIC_STEP_S


def look_target_m(scene: Env) -> NDArray[np.float64]:
    """What the 3D view looks at: the middle of the small bodies, which are the objects and the fingers."""
    if not isinstance(scene, SceneReader):
        return np.zeros(3)
    motion = scene.motion()
    large = {shape.body for shape in scene.shapes() if _extent_m(shape) > _SMALL_M}
    small = [index for index, body in enumerate(motion.body_names) if body not in large]
    chosen = small or list(range(len(motion.body_names)))
    return np.asarray(motion.poses_in_world[0, chosen, :3].mean(axis=0))


def _drawable(shape: Shape3D) -> rr.AsComponents:
    color = (np.clip(shape.rgba, 0.0, 1.0) * 255).astype(np.uint8)
    style: dict[str, Any] = {"colors": [color], "fill_mode": "solid"}
    size = shape.size
    if shape.kind == "mesh":
        return _mesh(shape, color)
    if shape.kind == "box":
        return rr.Boxes3D(half_sizes=[size], **style)
    if shape.kind == "ellipsoid":
        return rr.Ellipsoids3D(half_sizes=[size], **style)
    if shape.kind == "sphere":
        return rr.Ellipsoids3D(half_sizes=[np.full(3, size[0])], **style)
    if shape.kind == "cylinder":
        return rr.Cylinders3D(lengths=[2.0 * size[1]], radii=size[:1], **style)
    if shape.kind == "capsule":  # Rerun's begins at its origin, ours has it in the middle
        return rr.Capsules3D(lengths=[2.0 * size[1]], radii=size[:1], translations=[[0.0, 0.0, -size[1]]], **style)
    raise InvalidValueError(f"Shape {shape.name!r} is of kind {shape.kind!r}, which a recording cannot draw.")


def _mesh(shape: Shape3D, color: NDArray[np.uint8]) -> rr.Mesh3D:
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


def _xyzw(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rerun's order of quaternion components: (..., wxyz) to (..., xyzw)."""
    return np.roll(quaternions, -1, axis=-1)


_CAMERA_FROM_TARGET_M = np.array([0.62, -0.62, 0.52])  # beside the human's hand: no arm hides the objects from there


def scene_view(target_m: NDArray[np.float64]) -> rrb.Spatial3DView:
    """The 3D scene, seen from beside the human's hand."""
    eye = rrb.EyeControls3D(position=target_m + _CAMERA_FROM_TARGET_M, look_target=target_m, eye_up=[0.0, 0.0, 1.0])
    name = "The scene: the arm acts, a human gestures"
    return rrb.Spatial3DView(origin=ROOT, name=name, eye_controls=eye, background=[214, 222, 230], line_grid=False)


def sheet_view(origin: str, name: str) -> rrb.Spatial2DView:
    """A large image on white."""
    return rrb.Spatial2DView(origin=origin, name=name, background=[255, 255, 255])


def blueprint(
    *, target_m: NDArray[np.float64], values: bool, imagines: bool, several: bool, sees: bool, explores: bool
) -> rrb.Blueprint:
    """The layout: the scene large, beside it what the agent sees and predicts, below it what it imagines.

    ``target_m`` (3,) is what the 3D view looks at; ``several`` rollouts may be imagined from each frame; ``sees``: it
    shows how it learned to see; ``explores``: it tells how unknown each macro-action is.
    """
    frame = rrb.Spatial2DView(origin="/real/frame", name="Agent's view, 64 x 64")
    text = rrb.TextDocumentView(origin="/real/text", name="What happens")
    side: list[rrb.Container | rrb.View] = [rrb.Horizontal(text, frame)]
    if values:
        side.append(rrb.TextDocumentView(origin="/real/q_table", name="Q-values: return expected of each macro-action"))
    top = rrb.Horizontal(scene_view(target_m), rrb.Vertical(*side), column_shares=[1.1, 1.0])
    pages: list[rrb.Container | rrb.View] = [_over_time(values=values, explores=explores)]
    if imagines:
        futures = [sheet_view("/imagined/sampled_rollouts", "Several futures from the current frame")]
        pages = [_imagined_now(), *(futures if several else []), *pages, _by_depth()]
    if sees:
        name = "What it has learned to see: a color a factor, and beside it a look of each of its values"
        pages = [sheet_view("/seen/factors", name), *pages]
    bottom = rrb.Tabs(*pages, active_tab=0)
    return playing(rrb.Vertical(top, bottom, row_shares=[1.45, 1.0]))


def playing(layout: rrb.Container) -> rrb.Blueprint:
    """A layout with nothing around it but the time, which runs over and over."""
    return rrb.Blueprint(
        layout,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"),
    )


def _imagined_now() -> rrb.Horizontal:
    name = "The agent's own plan from here: what would really happen (above), what it imagines (below)"
    strip = sheet_view("/imagined/filmstrip", name)
    name = "Uncertainty by depth: epistemic pink, aleatoric blue, modal green"
    hidden = rrb.PlotLegend(visible=False)
    bars = rrb.BarChartView(origin="/imagined/uncertainty", name=name, plot_legend=hidden)
    return rrb.Horizontal(strip, bars, column_shares=[1.9, 1.0], name="Imagination from the current frame")


def _over_time(*, values: bool, explores: bool) -> rrb.Horizontal:
    views = [rrb.TimeSeriesView(origin="/real/reward", name="Reward of each real macro-action")]
    if values:
        views.append(rrb.TimeSeriesView(origin="/real/q_values", name="Q-value of each macro-action"))
    if explores:
        views.append(rrb.TimeSeriesView(origin="/real/novelty", name="What is unknown of each macro-action"))
    return rrb.Horizontal(*views, name="Rewards and values over time")


def _by_depth() -> rrb.Horizontal:
    """For the timeline ``imagined_depth``: the rollout from the first episode's first frame, step by step."""
    root = "/imagined/episode_1"
    return rrb.Horizontal(
        rrb.Spatial2DView(origin=f"{root}/real_frame", name="Real"),
        rrb.Spatial2DView(origin=f"{root}/frame", name="Imagined"),
        rrb.TimeSeriesView(origin=f"{root}/uncertainty", name="Uncertainty by depth"),
        rrb.TimeSeriesView(origin=f"{root}/prediction", name="Predicted reward and P(end) by depth"),
        column_shares=[1, 1, 2, 2],
        name="Episode 1 by depth (choose the timeline imagined_depth below)",
    )
