"""What the report shows of sampled rollouts, and only where there are any."""

from __future__ import annotations

import dataclasses
import textwrap
from pathlib import Path

import numpy as np
import pytest
from fake_results import bench_result, compared_rollout
from PIL import Image

from imagine_bench import registry
from imagine_bench.protocols.control import Protocol
from imagine_bench.recording import filmstrips
from imagine_bench.recording.filmstrips import changes, sampled_filmstrips
from imagine_bench.report import bench_page, write_report
from imagine_bench.store.results import BenchResult, RunResult


def with_chance(run: RunResult) -> RunResult:
    rng = np.random.default_rng(run.seed)
    if run.agent == "dqn":
        return run
    compared = compared_rollout(rng, depth=2)
    states = np.array([[0, 1, 0, 2], [0, 0, 0, 2]])
    inside = dataclasses.replace(compared.rollout, macrostates=states, actions=np.array([1, 1]))
    compared = dataclasses.replace(compared, rollout=inside, start_macrostate=np.array([0, 0, 0, 1]))
    return dataclasses.replace(run, imagined=(compared,), sampled_rollouts=(compared,) * 3)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    agents = ("dqn", "imagination_only")
    protocol = Protocol(task="pick_place", preset="quick", agents=agents, seeds=(0, 1), budgets=(500, 1000))
    plain = bench_result(tmp_path_factory.mktemp("bench"), protocol=protocol)
    return dataclasses.replace(plain, runs=tuple(with_chance(run) for run in plain.runs))


@pytest.fixture(scope="module")
def folder(result: BenchResult) -> Path:
    return write_report(result).parent


def test_page_and_markdown_show_the_rollouts(result: BenchResult, folder: Path) -> None:
    page, markdown = (folder / "index.html").read_text(), (folder / "report.md").read_text()
    name = "sampled_rollouts_imagination_only.png"
    with Image.open(folder / name) as picture:
        assert picture.width > 300
    assert name in markdown
    assert "One start, several futures" in page


def test_the_values_of_rollouts_are_not_clipped(result: BenchResult) -> None:
    """Each value that changes is written in full: where all change, the image gets more lines."""
    spec = registry.task("pick_place")
    (compared,) = result.of("imagination_only")[0].imagined
    few = sampled_filmstrips((compared,) * 2, spec)
    start = np.array([0, 0, 0, 0])
    other = np.array([len(values) - 1 for values in spec.macrostate_values])
    rollout = dataclasses.replace(compared.rollout, macrostates=np.stack([other, start]))
    many = sampled_filmstrips((dataclasses.replace(compared, start_macrostate=start, rollout=rollout),) * 2, spec)
    words = textwrap.wrap(changes(start, other, spec), width=20)
    assert len(words) > 4 and many.shape[0] > few.shape[0] and many.shape[1] == few.shape[1]
    row = (many.shape[0] - 24) // 2
    last_line = many[12 + row - 14 - 12 - 14 : 12 + row - 14, 150:]  # above the gap to the second row
    assert (last_line != 255).any()


def test_chapter_3_is_quoted_without_a_standard_deviation(folder: Path) -> None:
    page = (folder / "index.html").read_text()
    assert "<small>thesis 98.0</small>" in page
    assert "<small>thesis 78.0</small>" in page
    assert "mean of 10 runs, 100 test episodes each" in page


def test_a_bench_without_chance_shows_no_futures(tmp_path: Path) -> None:
    assert "One start, several futures" not in [each.title for each in bench_page(bench_result(tmp_path)).sections]


def test_strip_marks_cut_error_and_end() -> None:
    names = tuple(f"turn cube {index}" for index in range(6))
    cut, whole = (filmstrips.filmstrip(compared_rollout(np.random.default_rng(0), cut=cut), names) for cut in (3, None))
    assert cut.shape == whole.shape
    assert (cut == filmstrips._CUT).all(axis=2).sum() > 500  # the line
    assert not (whole == filmstrips._CUT).all(axis=2).any()
    for color in (filmstrips.RIGHT, filmstrips.WRONG):
        assert (whole == color).all(axis=2).sum() > 500  # frames in both colors
    narrow = filmstrips.filmstrip(compared_rollout(np.random.default_rng(0)), names, columns=2)
    assert narrow.shape[1] < whole.shape[1]


def test_real_frames_are_shown_unaltered_and_upright() -> None:
    compared = compared_rollout(np.random.default_rng(0), cut=None)
    strip = filmstrips.filmstrip(compared, tuple("abcdef"))
    left, top = filmstrips.left_px(0), filmstrips.HEADER_PX
    shown = strip[top : top + 128 : 2, left : left + 128 : 2]
    np.testing.assert_array_equal(shown, compared.start_frame)


PICK_PLACE = registry.task("pick_place")
START, ASKS_RIGHT, IMPOSSIBLE = np.array([[0, 0, 0, 0], [1, 0, 0, 2], [1, 1, 0, 2]])


def test_changes_are_named_and_judged_by_the_rules() -> None:
    assert changes(START, ASKS_RIGHT, PICK_PLACE) == "left object picked, gesture right"
    assert changes(ASKS_RIGHT, ASKS_RIGHT, PICK_PLACE) == "nothing changes"
    assert filmstrips.is_possible(PICK_PLACE.rules, START, 0, ASKS_RIGHT)
    assert not filmstrips.is_possible(PICK_PLACE.rules, START, 0, IMPOSSIBLE)
    assert not filmstrips.is_possible(PICK_PLACE.rules, START, 1, ASKS_RIGHT), "another macro-action leads elsewhere"
    assert not filmstrips.is_possible(PICK_PLACE.rules, IMPOSSIBLE, 0, ASKS_RIGHT), "nothing follows the impossible"


def test_impossible_steps_are_marked_unless_frames_hide_something() -> None:
    compared = compared_rollout(np.random.default_rng(0), depth=2)
    states = np.array([IMPOSSIBLE, ASKS_RIGHT])
    rollout = dataclasses.replace(compared.rollout, macrostates=states, actions=np.zeros(2, dtype=np.int64))
    wrong = dataclasses.replace(compared, start_macrostate=START, rollout=rollout)
    right = dataclasses.replace(wrong, rollout=dataclasses.replace(rollout, macrostates=states[::-1]))
    hidden = dataclasses.replace(PICK_PLACE, sight=registry.task("pick_place:gesture=first").sight)
    for rows, task, green, red in (
        ((right,), PICK_PLACE, True, True),  # right at first, then a step that is impossible
        ((wrong,), PICK_PLACE, False, True),
        ((right, wrong), hidden, False, False),
    ):
        sheet = sampled_filmstrips(rows, task)
        marked = [bool((sheet == color).all(axis=2).any()) for color in (filmstrips.RIGHT, filmstrips.WRONG)]
        assert marked == [green, red]
