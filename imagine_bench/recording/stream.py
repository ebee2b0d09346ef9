"""A recording on disk: opened, written, closed however it ends; and the viewer."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from imagine_bench.errors import ArtefactError, SetupError
from imagine_bench.recording.filmstrips import png


def entity_name(words: str) -> str:
    """``"Turn left (cube 1)"`` as ``"turn_left_cube_1"``: lower_snake, as entity paths want it."""
    return re.sub(r"[^a-z0-9]+", "_", words.lower()).strip("_")


class Recording:
    """A Rerun stream, with a short way to log what is logged often; a component that does not fit is an error."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.stream = stream

    def log(self, path: str, component: rr.AsComponents, *, static: bool = False) -> None:
        """Log a component for an entity, now or for all times."""
        self.stream.log(path, component, static=static, strict=True)

    def set_clocks(self, sim_time_s: float, **sequences: int) -> None:
        """Set the timeline ``sim_time`` in seconds, and sequence timelines."""
        self.stream.set_time("sim_time", duration=sim_time_s)
        for name, value in sequences.items():
            self.stream.set_time(name, sequence=value)

    def scalar(self, path: str, value: float) -> None:
        """Log one value of a curve."""
        self.log(path, rr.Scalars(float(value)))

    def curves(self, path: str, names: Sequence[str], values: NDArray[np.floating]) -> None:
        """Log one value of a curve for each name."""
        for name, value in zip(names, values, strict=True):
            self.scalar(f"{path}/{entity_name(name)}", value)

    def text(self, path: str, markdown: str) -> None:
        """Log a text."""
        self.log(path, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def sheet(self, path: str, pixels: NDArray[np.uint8]) -> None:
        """Log a large image, compressed. Shape (H, W, 3)."""
        self.log(path, rr.EncodedImage(contents=png(pixels), media_type="image/png"))

    def clear(self, path: str) -> None:
        """Remove what an entity shows from now on."""
        self.log(path, rr.Clear(recursive=False))


@contextmanager
def recording_file(path: Path, task: str, layout: rrb.Blueprint) -> Iterator[Recording]:
    """A recording that is closed however the block ends, and gets its name only if it is complete."""
    partial = path.with_name(f"{path.stem}.partial.rrd")
    stream = rr.RecordingStream(re.sub(r"\W+", "_", f"imagine_bench_{task}"))
    stream.save(partial, default_blueprint=layout)
    try:
        yield Recording(stream)
    finally:
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
