"""``make speed``: it measures everything, and the figures that no machine may change hold."""

import json

import pytest

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, UnknownNameError
from imagine_bench.tools.fidelity import Fidelity, measure_fidelity
from imagine_bench.tools.speed import _slips, figure_of, lanes_ratio, measure_worlds, speed_report


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


def test_fidelity_of_any_world_counts_what_slips() -> None:
    spec = registry.task("arrows:cubes=5,coupling=neighbour,slip=0.3")
    found = measure_fidelity(spec, spec.targets, 40, "strong")
    assert found.as_ruled == found.actions == len(found.slips) == 40, found.faults
    assert [said for _, said in found.slips] == pytest.approx([0.3] * 40)
    assert 0 < found.slipped_mm < 4 and found.other_objects_mm < 1
    turned = sum(not slipped for slipped, _ in found.slips)
    assert 20 < turned < 36
    assert turned < len(found.error_deg) < 2 * turned  # all but turns of the last cube turn two


def test_a_rate_is_judged_by_its_binomial_interval() -> None:
    for slipped, met in ((0, False), (20, True), (40, False)):
        found = Fidelity(slips=[(each < slipped, 0.2) for each in range(100)], slipped_mm=0.1)
        rate, moved = _slips("w", found)
        assert (rate.required, rate.met, moved.met) == ("10.0% to 31.0%", met, True)


def test_a_world_that_another_measures_is_refused() -> None:
    with pytest.raises(
        InvalidValueError, match="arrow_puzzle_hard has no targets, for another task measures its scene"
    ):
        next(measure_worlds(["arrow_puzzle_hard"], ["clean"]))
    with pytest.raises(UnknownNameError, match="No appearance 'dark'"):
        next(measure_worlds(["arrows:cubes=2"], ["dark"]))


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
