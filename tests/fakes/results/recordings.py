"""The contents of a recording, read from its file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

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
