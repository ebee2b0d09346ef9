"""A recording on disk: opened, written, laid out, closed however it ends; and the viewer."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from imagine_bench.errors import ArtefactError, SetupError
from imagine_bench.recording.filmstrips import png, rgb
from imagine_bench.store.files import make_folder
from imagine_bench.store.results import ComparedRollout

KINDS = {"epistemic": (204, 121, 167), "aleatoric": (86, 180, 233), "modal": (0, 158, 115)}
"""The color of each kind of uncertainty."""


def entity_name(words: str) -> str:
    """``"Turn left (cube 1)"`` as ``"turn_left_cube_1"``: lower_snake, as entity paths want it."""
    return re.sub(r"[^a-z0-9]+", "_", words.lower()).strip("_")


class Recording:
    """A Rerun stream, with a short way to log what is logged often; a component that does not fit is an error.

    Attributes:
        clock_s: Where the timeline ``sim_time`` has come to, in seconds.
        sequences: Where the other timelines have come to.
        look_target_m: What a view of the scene looks at. Shape (3,).
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.stream = stream
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

    def leave(self, timeline: str) -> None:
        """Log nothing more on a sequence timeline until it is set again."""
        self.sequences.pop(timeline, None)
        self.stream.disable_timeline(timeline)

    def curves(self, path: str, values: Mapping[str, float]) -> None:
        """Log one value of a curve for each name."""
        for name, value in values.items():
            self.log(f"{path}/{entity_name(name)}", rr.Scalars(float(value)))

    def text(self, path: str, markdown: str) -> None:
        """Log a text."""
        self.log(path, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def sheet(self, path: str, pixels: NDArray[np.uint8]) -> None:
        """Log a large image, compressed. Shape (H, W, 3)."""
        self.log(path, rr.EncodedImage(contents=png(pixels), media_type="image/png"))

    def frames(self, compared: ComparedRollout, done: int, *, real: str, imagined: str) -> None:
        """Log the real frame and the imagined one after so many macro-actions, for an entity each."""
        rollout = compared.rollout
        self.log(real, rr.Image(compared.real_frames[done - 1] if done else compared.start_frame))
        self.log(imagined, rr.Image(rgb(rollout.frames[done - 1] if done else rollout.start_frame)))

    def clear(self, path: str) -> None:
        """Remove what an entity and those below it show from now on."""
        if self.holds(path):
            self.log(path, rr.Clear(recursive=True))

    def holds(self, path: str) -> bool:
        """Whether anything was logged for an entity or one below it."""
        return any(logged.startswith(path) for logged in self._paths)

    def shown(self, *views: rrb.View) -> list[rrb.View]:
        """Those of some views that have something to show."""
        return [view for view in views if self.holds(str(view.origin))]


def sheet_view(origin: str, name: str) -> rrb.Spatial2DView:
    """A large image on white."""
    return rrb.Spatial2DView(origin=origin, name=name, background=[255, 255, 255])


@contextmanager
def recording_file(
    path: Path, task: str, layout: Callable[[Recording], rrb.Container], timeline: str = "sim_time"
) -> Iterator[Recording]:
    """A recording that is closed however the block ends, and gets its name only if it is complete.

    ``layout`` is how it looks when opened, with nothing around it but the time; where that is ``sim_time``, it runs
    over and over. Raises SetupError: the folder cannot be written.
    """
    make_folder(path.parent)
    partial = path.with_name(f"{path.stem}.partial.rrd")
    stream = rr.RecordingStream(re.sub(r"\W+", "_", f"imagine_bench_{task}"))
    stream.save(partial)
    recording = Recording(stream)
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
        stream.send_blueprint(rrb.Blueprint(layout(recording), *panels))
        stream.flush()
        stream.disconnect()
    partial.replace(path)


def open_in_viewer(path: Path) -> None:
    """Open a recording in the Rerun viewer and return when it is closed.

    Raises:
        ArtefactError: No such file.
        SetupError: There is no display; the message says how to look at it elsewhere.
    """
    if not path.is_file():
        raise ArtefactError(f"No recording {path}; a bench leaves them in its run folders as recording.rrd.")
    displayed = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or not sys.platform.startswith("linux")
    if not displayed or subprocess.run([sys.executable, "-m", "rerun", str(path)], check=False).returncode:
        raise SetupError(
            f"No display here to open {path}, or the viewer failed; copy it to a machine with one and run "
            f"'rerun {path.name}' there, or run 'rerun --serve-web {path}' here and open the address it prints."
        )
