"""``make speed``: it measures everything, and the figures that no machine may change hold."""

import json

from imagine_bench.speed import speed_report


def test_figures_are_measured_and_kept(tmp_path):
    lines: list[str] = []
    all_met = speed_report(tmp_path / "deep" / "speed.json", turns=100, show=lines.append)
    kept = json.loads((tmp_path / "deep" / "speed.json").read_text())
    figures = {figure["what"]: figure for figure in kept["figures"]}
    assert len(lines) == len(figures) + 1 and kept["environment"]["versions"]["mujoco"]
    assert all_met == all(figure["met"] for figure in figures.values())
    exact = [name for name in figures if name.startswith(("macro-actions exactly", "other cubes", "yaw", "bundled"))]
    assert len(exact) == 6
    for name in exact:
        assert figures[name]["met"], figures[name]
