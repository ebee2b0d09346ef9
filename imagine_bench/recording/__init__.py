"""Rerun recordings, the only room that knows Rerun: scene, blueprint, episodes, plans, viewer."""

from imagine_bench.recording.episodes import q_table, record_run
from imagine_bench.recording.stream import open_in_viewer, recording_file

__all__ = ["open_in_viewer", "q_table", "record_run", "recording_file"]
