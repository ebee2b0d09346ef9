"""The contents of a recording, read from its file."""

from __future__ import annotations

import re
import subprocess
import sys
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader


def rerun(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run Rerun's own command line."""
    command = [sys.executable, "-m", "rerun", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def contents(path: Path) -> dict[str, set[str]]:
    """Entity paths and their timelines."""
    found: dict[str, set[str]] = {}
    for chunk in RrdReader(path).stream():
        found.setdefault(chunk.entity_path, set()).update(chunk.timeline_names)
    return found


def times(path: Path, entity: str, timeline: str) -> set[int]:
    """When something was logged for an entity."""
    return {
        time
        for chunk in RrdReader(path).stream()
        if chunk.entity_path == entity and timeline in chunk.timeline_names
        for time in chunk.to_record_batch().column(timeline).to_pylist()
    }


def logged(path: Path, entity: str, column: str, timeline: str) -> list[tuple[Any, Any]]:
    """The times at which a component of an entity was logged, and its values, in the order of the times."""
    found = []
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and {column, timeline} <= set(batch.schema.names):
            found += zip(batch.column(timeline).to_pylist(), batch.column(column).to_pylist(), strict=True)
    return sorted(found, key=lambda pair: pair[0])


def view_names(path: Path) -> set[str]:
    """The names of the views in the recording's blueprint."""
    reader = RrdReader(path)
    return {
        name
        for store in reader.blueprints()
        for chunk in reader.stream(store=store)
        for column in chunk.to_record_batch().schema.names
        if column.endswith("Blueprint:display_name")
        for names in chunk.to_record_batch().column(column).to_pylist()
        for name in names or ()
    }


CLOCKS = {"episode", "env_step", "imagined_depth", "depth", "sim_time"}
FORMS = ("format", "media_type", "fill_mode", "RowId")


def as_text(path: Path) -> str:
    """The whole recording: a line for each column of an entity, its values in the order of time, and names of views."""
    rows: dict[str, list[tuple[str, str]]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        lines = sorted(CLOCKS & set(chunk.timeline_names))
        clocks = [batch.column(name).to_pylist() for name in lines]
        times = [" ".join(map(_clock, each)) for each in zip(*clocks, strict=True)]
        for name in set(batch.schema.names) - set(chunk.timeline_names):
            if not chunk.entity_path.startswith("/__") and not name.endswith(FORMS):
                words = [_in_words(name, value) for value in batch.column(name).to_pylist()]
                key = f"{chunk.entity_path} {name} by {' '.join(lines) or 'no clock'}"
                rows.setdefault(key, []).extend(zip(times or [""] * len(words), words, strict=True))
    text = []
    for key, found in sorted(rows.items()):
        values = [f"{clock}: {words}" if clock else words for clock, words in sorted(found)]
        text.append(f"{key}\n  " + " | ".join(values))
    return "\n".join([*text, "views", *(f"  {name}" for name in sorted(view_names(path)))])


def _clock(at: object) -> str:
    return f"{at.total_seconds():05.2f}s" if isinstance(at, timedelta) else f"{at:02d}" if isinstance(at, int) else "-"


def _in_words(column: str, value: Any) -> str:
    """A value as a short text: the mean of an image as a tenth of the brightest, the number of points of a mesh."""
    if column.endswith("buffer"):
        return f"{np.mean(value[0]) / 25.5:.1f}"
    if column.endswith(("blob", "vertex_positions", "triangle_indices", "vertex_normals")):
        return "image" if column.endswith("blob") else f"{len(value)} rows"
    return re.sub(r"-?\d+\.\d+(e[-+]?\d+)?", lambda found: f"{float(f'{float(found[0]):.3f}') + 0.0:g}", str(value))
