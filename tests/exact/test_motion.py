"""The certificate of continuous control: both bounds, by hand-made measurements."""

from __future__ import annotations

import itertools
import json
import statistics
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from imagine_bench.tasks.arrows.rules import Arrows
from imagine_bench.tasks.continuous.segments import least_seconds

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import InvalidValueError
from imagine_bench.exact import motion
from imagine_bench.exact.motion import certificate, measured
from imagine_bench.interfaces import State, TaskSpec
from imagine_bench.rules import shortest_plans, states_of_play, tabulate
from imagine_bench.statistics import wilson
from imagine_bench.tools.describe import describe

MANY = 10**9
MEASURED = sorted(file.stem for file in Path(motion.__file__).parent.glob("measured/*.json"))


def measurement(
    spec: TaskSpec, *, of: int = MANY, right: int = MANY, longest_s: float = 2.0, limit_s: float = 20.0
) -> dict[str, Any]:
    """As if every pair of a task had been tried so often, and been right so often."""
    states = states_of_play(spec.rules)
    pairs = sorted({(state[:-1], action) for state in states for action in range(spec.n_actions)})
    segments = [[list(objects), action, of, right, longest_s, longest_s, False] for objects, action in pairs]
    least_s = [0.5 * longest_s] * len(pairs)
    counts = {"episodes": 0, "solved": 0, "random_episodes": 0, "random_solved": 0}
    return {"segments": segments, "pairs": len(pairs), "least_s": least_s, "time_limit_s": limit_s, **counts}


@pytest.mark.parametrize("task", ["arrow_puzzle", "arrow_puzzle_hard", "pick_place", "arrows:cubes=2,goal_change=0.2"])
def test_segments_that_never_fail_show_the_optimum(task: str) -> None:
    spec = registry.task(task)
    found = certificate(spec, measurement(spec, limit_s=2000.0))
    assert found.shown == pytest.approx(found.optimum, abs=1e-6)


def test_what_is_shown_is_the_product_of_the_segments_lower_bounds() -> None:
    """One cube: two starts are a turn from the goal, and one is two turns."""
    spec = registry.task("arrow_puzzle_easy")
    measure = measurement(spec, of=100, right=100)
    share, _ = wilson(600, 600)
    assert certificate(spec, measure).shown == pytest.approx((2 * share + share**2) / 3)
    measure = measurement(spec, of=100, right=80)
    share, _ = wilson(480, 600)
    assert certificate(spec, measure).shown == pytest.approx((2 * share + share**2) / 3)


def test_a_failure_of_one_pair_makes_no_other_pair_surer() -> None:
    """No pair counts for more than the lower end of all segments' interval, those without a failure included."""
    spec = registry.task("arrow_puzzle_easy")
    measure = measurement(spec, of=100, right=100)
    needed = {(state[:-1], spec.rules.optimal_action(state)) for state in spec.rules.start_states}
    failing = next(each for each in measure["segments"] if (tuple(each[0]), each[1]) not in needed)
    failing[3] = 0
    low, _ = wilson(500, 600)
    assert certificate(spec, measure).shown == pytest.approx((2 * low + low**2) / 3)


def test_a_short_time_limit_shows_one_macro_action() -> None:
    spec = registry.task("arrow_puzzle_easy")
    found = certificate(spec, measurement(spec, longest_s=2.0, limit_s=3.9))
    assert found.macro_actions == 1
    assert found.shown == pytest.approx(2 / 3, abs=1e-6)


def test_untried_pairs_show_nothing_unless_sampled() -> None:
    spec = registry.task("arrow_puzzle_easy")
    measure = measurement(spec, limit_s=5.0)
    measure["segments"] = [each for each in measure["segments"] if each[:2] != [[1], 1]]
    measure["least_s"].pop()
    assert certificate(spec, measure).shown == pytest.approx(1.0, abs=1e-6)  # taken for a sample
    measure["pairs"] -= 1
    assert certificate(spec, measure).shown == pytest.approx((0 + 1 + 1) / 3, abs=1e-6)


@pytest.mark.parametrize(("ending", "whole"), [(2, [1, 2, 3, 4]), (6, [1, 2, 3, 4, 5, 6])])
def test_mean_seconds_are_those_of_segments_that_go_on_if_there_are_any(ending: int, whole: list[float]) -> None:
    """The longest ones count all, since an episode may end with any."""
    spec = registry.task("arrow_puzzle_easy")
    measure = measurement(spec)
    for number, segment in enumerate(measure["segments"], 1):
        segment[4:] = [number, number + 0.5, number > 6 - ending]
        measure["least_s"][number - 1] = 0.1 * number
    found = certificate(spec, measure)
    mean_s = statistics.mean(whole)
    spread_s = 1.96 * statistics.pstdev(whole) / len(whole) ** 0.5
    assert [found.mean_low_s, found.mean_s, found.mean_high_s, found.least_s] == pytest.approx(
        [mean_s - spread_s, mean_s, mean_s + spread_s, 0.1 * mean_s]
    )
    assert (found.longest_s, found.macro_actions) == (6.5, 3)


@pytest.mark.parametrize("task", MEASURED)
@pytest.mark.parametrize("appearance", ["clean", "strong"])
def test_what_was_measured_leaves_less_than_a_point(task: str, appearance: str) -> None:
    """Both bounds of success within 1 point, mean time within 10 %, and room within the time limit for every plan."""
    spec = registry.task(task)
    found = certificate(spec, measured(task)["appearances"][appearance])
    assert found.optimum - found.shown <= 0.01
    assert (found.mean_high_s - found.mean_low_s) / found.mean_s <= 0.1
    assert found.measured_pairs == found.pairs
    assert found.solved >= 0.99 * found.episodes
    assert found.random_solved <= 0.01 * found.random_episodes
    assert 0.1 < found.least_s < found.mean_s
    assert found.macro_actions >= int(shortest_plans(tabulate(spec.rules)).max())


@pytest.mark.parametrize("task", MEASURED)
def test_what_was_measured_is_of_the_task_as_it_is(task: str) -> None:
    """Each pair once, with its least time as computed now; a pair ends episodes if none of its macrostates goes on."""
    rules, entry = registry.task(task).rules, registry.task_entry(task)
    wanted: dict[tuple[State, int], tuple[bool, State]] = {}
    for state, action in itertools.product(states_of_play(rules), range(rules.n_actions)):
        first, *_ = outcomes = rules.outcomes(state, action)
        if any(each.macrostate[:-1] != state[:-1] for each in outcomes):
            pair = (state[:-1], action)
            wanted[pair] = min(wanted.get(pair, (True, state)), (first.terminated, state))
    for appearance, kept in measured(task)["appearances"].items():
        env = registry.load(entry.motion)(**entry.options, appearance=appearance, observation="proprio")
        found = {(tuple(objects), action): ends for objects, action, *_, ends in kept["segments"]}
        assert found == {pair: ends for pair, (ends, _) in wanted.items()}
        assert kept["pairs"] == len(kept["segments"]) == len(found)
        assert kept["time_limit_s"] == env.time_limit_s
        least_s = [least_seconds(env, wanted[pair][1], pair[1]) for pair in found]
        assert kept["least_s"] == pytest.approx(least_s)
        for (*_, tries, right, mean_s, longest_s, _), least in zip(kept["segments"], least_s, strict=True):
            assert right <= tries and least <= mean_s <= longest_s


@pytest.mark.parametrize("name", ["ArrowPuzzleEasyMotion", "PickPlaceMotion"])
def test_the_command_measures_and_keeps_a_certificate(name: str, tmp_path: Any, capsys: Any) -> None:
    out = tmp_path / "kept.json"
    words = ["check", name, "--physics", "--trials", "2", "--turns", "2", "--random", "1", "--out", str(out)]
    words += ["--appearances", "clean", "strong"]
    assert main(words) == 0
    kept = json.loads(out.read_text())
    found = certificate(registry.task(kept["task"]), kept["appearances"]["clean"])
    assert kept["appearances"]["strong"]["segments"] != kept["appearances"]["clean"]["segments"]
    assert found.as_ruled == found.segments >= 2
    assert found.solved == found.episodes >= 1
    assert kept["environment"]["commit"]
    assert "shown reachable" in capsys.readouterr().out
    assert main([*words, "--trials", "0", "--random", "3"]) == 0  # the later value of an option counts
    assert main([*words, "--appearances", "clean", "patched"]) == 2  # before anything is measured
    more = json.loads(out.read_text())
    assert more["appearances"]["clean"].pop("random_episodes") == 3
    assert kept["appearances"]["clean"].pop("random_episodes") == 1
    assert more["appearances"] == kept["appearances"]
    assert main(["check", "ArrowPuzzleHardMotion", "--physics", "--trials", "0", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert "'patched' patches" in said
    assert "not of arrow_puzzle_hard" in said


@pytest.mark.parametrize(
    ("name", "nearest"), [("ArowPuzzleMotion", "ArrowPuzzleMotion"), ("PickMotion", "PickPlaceMotion")]
)
def test_a_misspelt_control_task_is_answered_by_the_nearest(name: str, nearest: str, capsys: Any) -> None:
    assert main(["describe", name]) == 2
    assert f"Did you mean '{nearest}'?" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["coupling=neighbour", "shuffle=1"])
def test_no_certificate_of_commands_where_there_are_none(option: str) -> None:
    """Such a world cannot be made in continuous control."""
    assert "\nby hand  " in describe("arrows:cubes=2")
    assert "\nby hand  " not in describe(f"arrows:cubes=2,{option}")
    with pytest.raises(InvalidValueError, match="leave it out at this level"):
        describe(f"ArrowsMotion:cubes=2,{option}")


@pytest.mark.parametrize("name", ["ArrowsMotion:cubes=2", "arrows:cubes=2"])
def test_a_described_world_is_asked_once_whether_a_hand_can_act(name: str) -> None:
    """And before its exact facts are computed, where one that cannot is described as continuous control."""
    can = mock.Mock()
    with mock.patch.object(Arrows, "require_motion", can):
        describe(name)
    assert can.call_count == 1
    with (
        mock.patch("imagine_bench.tools.describe.certificate", side_effect=AssertionError("computed")),
        pytest.raises(InvalidValueError, match="leave it out at this level"),
    ):
        describe("ArrowsMotion:cubes=2,coupling=neighbour")
