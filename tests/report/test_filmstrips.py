"""Filmstrips show real frames as they are, mark forbidden steps and the cut of the filter, and clip no words."""

from __future__ import annotations

import dataclasses
import io
import textwrap
from pathlib import Path

import numpy as np
import pytest
from fake_results import bench_result, compared_rollout, rewritten
from PIL import Image

from imagine_bench import registry
from imagine_bench.interfaces import TaskSpec
from imagine_bench.protocols.control import Protocol
from imagine_bench.recording import filmstrips
from imagine_bench.recording.filmstrips import (
    CELL_PX,
    LABELS_PX,
    RIGHT,
    STEP_PX,
    TITLE_PX,
    WRONG,
    Tile,
    changes,
    rgb,
    sampled_filmstrips,
)
from imagine_bench.report.bench import bench_page
from imagine_bench.report.levels import film_image
from imagine_bench.store.results import ComparedRollout, RecordedEpisode

PICK_PLACE = registry.task("pick_place")
START, ASKS_RIGHT, IMPOSSIBLE = np.array([[0, 0, 0, 0], [1, 0, 0, 2], [1, 1, 0, 2]])


def rollout(*states: np.ndarray) -> ComparedRollout:
    """Two steps from a start, by the first macro-action."""
    compared = compared_rollout(np.random.default_rng(0), depth=2)
    imagined = dataclasses.replace(
        compared.rollout, macrostates=np.array(states[1:]), actions=np.zeros(2, dtype=np.int64)
    )
    return dataclasses.replace(compared, start_macrostate=states[0], rollout=imagined)


def colored(sheet: np.ndarray) -> list[bool]:
    """Whether something is marked as right, and as wrong."""
    return [bool((sheet == color).all(axis=2).any()) for color in (RIGHT, WRONG)]


def test_only_agents_that_sampled_rollouts_show_some(tmp_path: Path) -> None:
    protocol = Protocol(task="pick_place", preset="quick", agents=("dqn", "imagination_only"), seeds=(0,), budgets=(5,))
    plain = bench_result(tmp_path, protocol=protocol)
    one = rollout(START, ASKS_RIGHT, START)
    dqn, imagination = (dataclasses.replace(run, imagined=(one,) * 4) for run in plain.runs)
    runs = (dqn, dataclasses.replace(imagination, sampled_rollouts=(one,) * 3))
    page = bench_page(dataclasses.replace(plain, runs=runs))
    names = [image.name for section in page.sections for image in section.images]
    assert [name for name in names if name.startswith("sampled")] == ["sampled_rollouts_imagination_only"]
    assert "rollout_dqn_3" in names and "rollout_dqn_4" not in names


def test_the_values_of_rollouts_are_not_clipped() -> None:
    """Each value that changes is written in full: where all change, the image gets more lines."""
    other = np.array([len(values) - 1 for values in PICK_PLACE.macrostate_values])
    assert len(textwrap.wrap(changes(START, other, PICK_PLACE), width=18)) > 4
    few = sampled_filmstrips((rollout(START, ASKS_RIGHT, ASKS_RIGHT),), PICK_PLACE)
    many = sampled_filmstrips((rollout(START, other, START),), PICK_PLACE)
    assert many.shape[0] > few.shape[0] and many.shape[1] == few.shape[1]
    ends = [int(np.flatnonzero((sheet != 255).any(axis=(1, 2)))[-1]) for sheet in (few, many)]
    assert ends[0] + 30 < ends[1] < many.shape[0] - 4, "more lines, and nothing at the edge"


@pytest.mark.parametrize("last", [0, 2, 3, 4, 9])
@pytest.mark.parametrize("carried_out", [5, 4])
def test_a_strip_sets_each_prediction_beside_the_truth(last: int, carried_out: int) -> None:
    """The third is imagined wrongly, and the filter cuts the fourth.

    After the end real frames are pale, and nothing is judged that was not done.
    """
    compared = compared_rollout(np.random.default_rng(0))
    rewards = ("-1.0", "+2.0", "-3.0", "+4.0", "+0.0")[:carried_out]
    compared = dataclasses.replace(
        compared,
        real_frames=compared.real_frames[:carried_out],
        real_macrostates=compared.real_macrostates[:carried_out],
        real_rewards=np.array([float(reward) for reward in rewards]),
        real_terminated=(np.arange(5) >= last)[:carried_out],
    )
    of = compared.rollout
    real, imagined = [Tile(compared.start_frame, "start")], [Tile(rgb(of.start_frame), "", "\npredicted\n(true)")]
    for step in range(5):
        is_real, over, cut = step < carried_out, last < step <= carried_out, step == 3
        right = step != 2 if is_real and not over else None
        verdict = {True: "as the rules say", False: "not as the rules say", None: "episode over" * over}[right]
        truth = f" ({rewards[step]})" if is_real else ""
        lines = [verdict, f"reward {of.rewards[step]:+.1f}{truth}", f"P(end) {of.p_terminated[step]:.2f}"]
        words = "\n".join([*lines, f"epistemic {of.epistemic[step]:.2g}", "filter cuts here" * cut])
        frame = compared.real_frames[step] if is_real else None
        real.append(Tile(frame, f"{step + 1}. {'abcdef'[of.actions[step]]}", pale=over, cut=cut))
        imagined.append(Tile(rgb(of.frames[step]), "", words, right, pale=step > 2, cut=cut))
    strip = filmstrips.filmstrip(compared, tuple("abcdef"))
    np.testing.assert_array_equal(strip, filmstrips.sheet([("real", real), ("imagined", imagined)]))
    assert (strip == filmstrips.CUT).all(axis=2).sum() > 500, "the line"
    left = LABELS_PX + 5 * STEP_PX
    shown = strip[TITLE_PX : TITLE_PX + CELL_PX : 2, left : left + CELL_PX : 2]
    assert np.array_equal(shown, compared.real_frames[-1]) == (carried_out == 5 and last >= 4), "else it is pale"


def recorded(length: int, success: bool) -> RecordedEpisode:
    """An episode; each frame has a color of its own."""
    colors = np.arange(1, length + 2, dtype=np.uint8)[:, None, None, None] * np.array([20, 7, 3], dtype=np.uint8)
    return RecordedEpisode(
        frames=np.broadcast_to(colors, (length + 1, 64, 64, 3)),
        actions=np.arange(length) % 4,
        rewards=np.zeros(length),
        success=np.array(success),
        end=np.array("solved" if success else "lost, because no macro-actions are left"),
    )


def numbered(actions: list[int]) -> list[Tile]:
    """The words above the images of an episode."""
    words = [f"{step}. {PICK_PLACE.action_names[action]}" for step, action in enumerate(actions, 1)]
    return [Tile(None, above) for above in ("start", *words)]


@pytest.mark.parametrize("length", [1, 4, 6])
def test_an_episode_s_strip_shows_every_frame_macro_action_and_reward_and_the_end(length: int) -> None:
    """Rewards with their fractions, as they are where chance changes them; four frames a row."""
    success = length != 4
    rewards = {"-1.5": -1.5, "+0": 0.0, "-1.23": -1.234, "+50": 50.0, "-0.5": -0.5, "+2": 2.0}
    episode = dataclasses.replace(recorded(length, success), rewards=np.array([*rewards.values()][:length]))
    below = ["", *(f"reward {reward}" for reward in [*rewards][:length])]
    below[-1] += "\nsolved" if success else "\nlost, because no\nmacro-actions are\nleft"
    tiles = zip(numbered(episode.actions.tolist()), episode.frames, below, strict=True)
    expected = [tile._replace(frame=frame, below=words) for tile, frame, words in tiles]
    expected[-1] = expected[-1]._replace(right=success)
    strip = filmstrips.episode_strip(episode, PICK_PLACE.action_names)
    rows = [("" if first else "real frames", expected[first : first + 4]) for first in range(0, length + 1, 4)]
    np.testing.assert_array_equal(strip, filmstrips.sheet(rows, columns=4))
    assert colored(strip) == [success, not success] and strip.shape[1] < 700, "it fits a page"


def test_the_macro_actions_of_an_overrated_policy_are_numbered_from_one() -> None:
    believed, real = [(0, 0.0, False), (2, 10.0, True)], [(0, 0.0, False), (1, -1.0, True), (3, -2.5, False)]
    below = [["", "reward 0.000", "reward 10.0\nthe end"]]
    below.append(["", "reward 0.000", "reward \u22121.00\nthe end", "reward \u22122.50"])
    film = {"start": "here", "returns": (10.0, -2.0), "believed": believed, "real": real}
    ways = (("believed", 1), ("real", -1))
    frames = {f"film_{name}": recorded(len(film[name]), success=True).frames[::way] for name, way in ways}
    image = film_image("exact", "the model", PICK_PLACE, film, frames)
    rows = []
    for name, words, lines in zip(("believed", "real"), ("the model believes", "the world does"), below, strict=True):
        tiles = zip(numbered([action for action, *_ in film[name]]), frames[f"film_{name}"], lines, strict=True)
        rows.append((words, [tile._replace(frame=frame, below=line) for tile, frame, line in tiles]))
    shown = np.asarray(Image.open(io.BytesIO(image.png)).convert("RGB"))
    np.testing.assert_array_equal(shown, filmstrips.sheet(rows))
    assert "from here: expected return 10.0 in the model and \u22122.00 in the world" in image.caption


def test_a_report_begins_with_a_solved_and_a_lost_episode(tmp_path: Path) -> None:
    scores = {"random": 9, "dqn": 1, "imagination_only": 5}
    protocol = Protocol(task="pick_place", preset="quick", agents=tuple(scores), seeds=(0, 1), budgets=(5,))
    plain = bench_result(tmp_path, protocol=protocol)
    plain = rewritten(plain, lambda run, row: dataclasses.replace(row, successes=scores[run.agent]))
    assert not any(section.links for section in bench_page(plain).sections), "older runs kept no episodes"
    best = "imagination_only"
    for failures, captions in (([], "random, seed 0"), ([False], "dqn, seed 1")):
        shown = {("random", 0): [True, False], ("dqn", 0): [True], ("dqn", 1): [True, *failures], (best, 1): [True]}
        runs = []
        for run in plain.runs:
            episodes = shown.get((run.agent, run.seed), ())
            runs.append(dataclasses.replace(run, recorded=tuple(recorded(2, solved) for solved in episodes)))
        first = bench_page(dataclasses.replace(plain, runs=tuple(runs))).sections[0]
        solved, lost = first.images
        assert solved.caption == f"{best}, seed 1: solved." and lost.caption.startswith(f"{captions}: lost, because")
        folders = (f"{best}/seed_1", "dqn/seed_0", "dqn/seed_1", "random/seed_0")
        assert list(first.links.values()) == [f"../{folder}/recording.rrd" for folder in folders]


def test_changes_are_named_and_judged_by_the_rules() -> None:
    assert changes(START, ASKS_RIGHT, PICK_PLACE) == "left object picked, gesture right"
    assert changes(ASKS_RIGHT, ASKS_RIGHT, PICK_PLACE) == "nothing changes"
    assert filmstrips.is_possible(PICK_PLACE.rules, START, 0, ASKS_RIGHT)
    assert not filmstrips.is_possible(PICK_PLACE.rules, START, 1, ASKS_RIGHT), "another macro-action leads elsewhere"


def test_impossible_steps_are_marked_unless_frames_hide_something() -> None:
    hidden: TaskSpec = dataclasses.replace(PICK_PLACE, sight=registry.task("pick_place:gesture=first").sight)
    right = rollout(START, ASKS_RIGHT, IMPOSSIBLE)  # right at first, then a step that is impossible
    wrong = rollout(START, IMPOSSIBLE, ASKS_RIGHT)
    ends = dataclasses.replace(right.rollout, p_terminated=np.array([0.4, 0.6], dtype=np.float32))
    told = [
        Tile(right.start_frame),
        Tile(rgb(ends.frames[0]), PICK_PLACE.action_names[0], "left object\npicked, gesture\nright", right=True),
        Tile(rgb(ends.frames[1]), PICK_PLACE.action_names[0], "middle object\npicked; the end", right=False),
    ]
    shown = sampled_filmstrips((dataclasses.replace(right, rollout=ends),) * 2, PICK_PLACE)
    again = ("the same start, imagined again", [Tile(None), *told[1:]])
    np.testing.assert_array_equal(shown, filmstrips.sheet([("the real start", told), again]))
    assert colored(sampled_filmstrips((wrong,), PICK_PLACE)) == [False, True]
    assert colored(sampled_filmstrips((right, wrong), hidden)) == [False, False]
