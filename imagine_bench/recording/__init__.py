"""Rerun recordings. The only room that knows Rerun: the scene, its blueprint, the story of an episode, the viewer."""

from imagine_bench.recording.episodes import open_in_viewer, q_table, record_run, recording_file

__all__ = ["open_in_viewer", "q_table", "record_run", "recording_file"]
