"""``make speed``: it measures everything, and the figures that no machine may change hold."""

import json

import pytest

from imagine_bench import registry
from imagine_bench.tools.speed import figure_of, lanes_ratio, speed_report


@pytest.mark.slow
def test_figures_are_measured_and_kept(tmp_path):
    lines: list[str] = []
    all_met = speed_report(tmp_path / "deep" / "speed.json", turns=100, show=lines.append)
    kept = json.loads((tmp_path / "deep" / "speed.json").read_text())
    figures = {figure["what"]: figure for figure in kept["figures"]}
    assert len(lines) == len(figures) + 1 and kept["environment"]["versions"]["mujoco"]
    assert all_met == all(figure["met"] for figure in figures.values())
    assert any(name.startswith("a model update") for name in figures)
    assert sum("lanes, physics, times as fast as one environment" in name for name in figures) == 2
    measured = [spec for spec in map(registry.task, registry.TASKS) if spec.targets is not None]
    assert {spec.id for spec in measured} >= {"arrow_puzzle", "pick_place"}
    for spec in measured:
        wanted = ("macro-actions exactly", "other objects", "position error", "yaw error", "bundled")
        exact = [name for name in figures if name.startswith(tuple(f"{spec.id}: {words}" for words in wanted))]
        errors = [allowed for allowed in (spec.targets.error_mm, spec.targets.error_deg) if allowed is not None]
        assert len(exact) == 2 + len(errors) + 2 * len(spec.targets.encoders)
        for name in exact:
            assert figures[name]["met"], figures[name]


def test_lanes_are_timed_beside_one_environment() -> None:
    ratio = lanes_ratio(registry.task("arrow_puzzle"), "kinematic", 3, 12, blocks=1)
    assert 0.05 < ratio < 20


@pytest.mark.parametrize(
    ("sign", "met"), [(">=", (False, True, True)), ("<=", (True, True, False)), ("<", (True, False, False))]
)
def test_a_figure_meets_its_target_or_not(sign: str, met: tuple[bool, ...]) -> None:
    found = [figure_of("what", value, sign, 0.5, ".2f") for value in (0.4, 0.5, 0.6)]
    assert tuple(figure.met for figure in found) == met
    assert (found[0].required, found[0].measured) == (f"{sign} 0.5", "0.40")
