"""A recording on disk: opened, written, laid out, closed however it ends; the scene in it; and the viewer.

A scene has one transform a body, with its shapes below it.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun.notebook

from imagine_bench.arrays import Floats, Frame, Pixels
from imagine_bench.errors import ArtefactError, InvalidValueError, SetupError, require_modules
from imagine_bench.interfaces import Motion, SceneReader, Shape3D
from imagine_bench.interfaces.environments import Env
from imagine_bench.recording.filmstrips import DARK, png, rgb
from imagine_bench.store.files import make_folder
from imagine_bench.store.results import ComparedRollout

KINDS = {"epistemic": (204, 121, 167), "aleatoric": (86, 180, 233), "modal": (240, 180, 0)}
"""The color of each kind of uncertainty: pink, blue and yellow, which color-blind readers tell apart."""
SERIES = (
    (86, 180, 233),
    (224, 102, 16),
    (252, 233, 139),
    (65, 93, 221),
    (241, 42, 174),
    (45, 255, 39),
    (255, 100, 126),
    (185, 214, 205),
)
"""The colors of other curves of one plot, in their order, on the viewer's dark ground."""
ROOT = "/scene"
_MOTION_HZ = 20.0
_STILL_M = 1e-6  # bodies whose poses (metres; quaternions) change by less in a macro-action get no new transforms
_BACKDROP_M = 2.0
_SMALL_M = 0.07
_KINEMATIC_STEP_S = 1.0
_CAMERA_FROM_TARGET_M = np.array([0.62, -0.62, 0.52])  # beside the human's hand: no arm hides the objects from there


def entity_name(words: str) -> str:
    """``"Turn left (cube 1)"`` as ``"turn_left_cube_1"``: lower_snake, as entity paths want it."""
    return re.sub(r"[^a-z0-9]+", "_", words.lower()).strip("_")


class Recording:
    """A Rerun stream, with a short way to log common components; a component that does not fit is an error.

    Attributes:
        clock_s: Where the timeline ``sim_time`` has come to, in seconds.
        sequences: Where the other timelines have come to.
        scene: The scene of an environment, which keeps its motion from now on; None shows nothing.
        env_step: How often that was shown, from 0.
        look_target_m: The point at which a view of the scene looks. Shape (3,).
    """

    def __init__(self, stream: rr.RecordingStream, env: Env | None = None) -> None:
        self.stream = stream
        scene = env and env.unwrapped
        self.scene = scene if isinstance(scene, SceneReader) else None
        if self.scene is not None:
            self.scene.capture_motion_hz = _MOTION_HZ
        self.env_step = -1
        self.clock_s = 0.0
        self.look_target_m = np.zeros(3)
        self.sequences: dict[str, int] = {}
        self._paths: set[str] = set()

    def log(self, path: str, component: rr.AsComponents, *, static: bool = False) -> None:
        """Log a component for an entity, now or for all times."""
        self._paths.add(path)
        self.stream.log(path, component, static=static, strict=True)

    def set_clocks(self, **sequences: int) -> None:
        """Set sequence timelines, and ``sim_time`` to the clock."""
        self.sequences |= sequences
        self.stream.set_time("sim_time", duration=self.clock_s)
        for name, value in sequences.items():
            self.stream.set_time(name, sequence=value)

    def show(self, **sequences: int) -> None:
        """Go on by one ``env_step``, and log how the latest macro-action moved the scene: first the scene itself.

        The view looks at the middle of the small bodies, which are the objects, the fingers and the wrist above them.
        """
        self.env_step += 1
        self.set_clocks(env_step=self.env_step, **sequences)
        if self.scene is None:
            return
        motion = self.scene.motion()
        if not self.holds(ROOT):
            shapes = self.scene.shapes()
            log_shapes(self, shapes)
            large = {shape.body for shape in shapes if _extent_m(shape) > _SMALL_M}
            small = [body not in large for body in motion.body_names]
            places = motion.poses_in_world[0, :, :3]
            self.look_target_m = places[small if any(small) else slice(None)].mean(axis=0)
        log_motion(self, motion)

    def act(self) -> None:
        """Let the clock go on as long as the latest macro-action took; a kinematic one is given a second."""
        lasted_s = 0.0 if self.scene is None else float(self.scene.motion().time_s[-1])
        self.clock_s += lasted_s or _KINEMATIC_STEP_S

    def leave(self, timeline: str) -> None:
        """Log nothing more on a sequence timeline until it is set again."""
        self.sequences.pop(timeline, None)
        self.stream.disable_timeline(timeline)

    def curves(self, path: str, values: Mapping[str, float]) -> None:
        """Log one value of a curve for each name, which the plot shows; kinds of uncertainty have their colors."""
        for index, (name, value) in enumerate(values.items()):
            entity = f"{path}/{entity_name(name)}"
            if entity not in self._paths:
                color = KINDS.get(name, SERIES[index % len(SERIES)])
                self.log(entity, rr.SeriesLines(names=name, colors=color), static=True)
            self.log(entity, rr.Scalars(float(value)))

    def text(self, path: str, markdown: str) -> None:
        """Log a text."""
        self.log(path, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def sheet(self, path: str, pixels: Pixels) -> None:
        """Log a large image, compressed. Shape (H, W, 3)."""
        self.log(path, rr.EncodedImage(contents=png(pixels), media_type="image/png"))

    def frames(self, compared: ComparedRollout, done: int, *, real: str, imagined: str) -> None:
        """Log the real frame and the imagined one after so many macro-actions, for an entity each."""
        rollout = compared.rollout
        self.log(real, rr.Image(compared.real_frames[done - 1] if done else compared.start_frame))
        self.log(imagined, rr.Image(rgb(rollout.frames[done - 1] if done else rollout.start_frame)))

    def clear(self, path: str) -> None:
        """Remove the content of an entity, and of those below it, from now on."""
        if self.holds(path):
            self.log(path, rr.Clear(recursive=True))

    def holds(self, path: str) -> bool:
        """Whether anything was logged for an entity or one below it."""
        return any(logged.startswith(path) for logged in self._paths)

    def shown(self, *views: rrb.View) -> list[rrb.View]:
        """Those of some views that have something to show."""
        return [view for view in views if self.holds(str(view.origin))]


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


def sheet_view(origin: str, name: str) -> rrb.Spatial2DView:
    """A large image on paper as dark as the viewer."""
    return rrb.Spatial2DView(origin=origin, name=name, background=list(DARK.paper))


@contextmanager
def recording_file(
    path: Path,
    task: str,
    layout: Callable[[Recording], rrb.Container],
    *,
    env: Env | None = None,
    timeline: str = "sim_time",
) -> Iterator[Recording]:
    """A recording that is closed however the block ends, and gets its name only if it is complete.

    It shows the scene of ``env``. ``layout`` is how it looks when opened, with nothing around it but the time; where
    that is ``sim_time``, it runs over and over. Raises SetupError: the folder cannot be written.
    """
    make_folder(path.parent)
    partial = path.with_name(f"{path.stem}.partial.rrd")
    stream = rr.RecordingStream(re.sub(r"\W+", "_", f"imagine_bench_{task}"))
    stream.save(partial)
    recording = Recording(stream, env)
    try:
        yield recording
    finally:
        panels = (
            rrb.BlueprintPanel(state="hidden"),
            rrb.SelectionPanel(state="hidden"),
            rrb.TimePanel(
                state="collapsed",
                timeline=timeline,
                play_state="playing" if timeline == "sim_time" else "paused",
                loop_mode="all",
            ),
        )
        stream.send_blueprint(rrb.Blueprint(layout(recording), *panels), make_active=False)
        stream.flush()
        stream.disconnect()
    partial.replace(path)


_MAGIC = b"RRF"
"""The beginning of each recording."""


def show_in_notebook(path: Path) -> None:
    """Show a recording in the viewer below the cell of a notebook that calls this.

    Raises:
        SetupError: The extra ``notebook`` is not installed.
    """
    require_modules("rerun_notebook")
    stream = rr.RecordingStream("imagine_bench")
    rerun.notebook.Viewer(recording=stream).display()
    stream.log_file_from_path(path)
    stream.flush()


def open_in_viewer(path: Path) -> None:
    """Open a recording in the Rerun viewer and return when it is closed.

    Raises:
        ArtefactError: No such file.
        SetupError: There is no display; the message says how to look at it elsewhere.
    """
    if not path.is_file():
        raise ArtefactError(f"No recording {path}; a bench leaves them in its run folders as recording.rrd.")
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise ArtefactError(f"{path} is no recording of Rerun; a bench leaves them as recording.rrd.")
    viewer = [sys.executable, "-P", "-m", "rerun", str(path)]  # -P: no rerun.py of the current folder
    if subprocess.run(viewer, capture_output=True, check=False).returncode:
        raise SetupError(
            f"No display here to open {path}, or the viewer failed; copy it to a machine with one and run "
            f"'rerun {path.name}' there, or run 'rerun --serve-web {path}' here and open the address it prints."
        )
