"""Models of motions are judged by the simulator, also where a motion grips nothing."""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from guest_packages import Guests
from imagine_bench.tasks.continuous.spec import make_arrows, make_pick_place
from imagine_bench_motion.judge.interface import GROUP, MotionModelEntry
from imagine_bench_motion.judge.judgement import SIMULATOR, MotionJudgement, judge, judged
from imagine_bench_motion.judge.labelled import Labelled
from imagine_bench_motion.judge.no_change import NoChange
from imagine_bench_motion.judge.questions import AnsweredMotions, MotionQuestions, MotionSource, moved, moving_actions
from imagine_bench_motion.judge.recurrent import MotionNetwork, images, patches
from imagine_bench_motion.judge.report import motion_rows, motion_tables
from imagine_bench_motion.judge.scores import MotionScores, Simulator, score

from imagine_bench import registry
from imagine_bench.arrays import Frame, Ints
from imagine_bench.errors import ArtefactError, ImagineBenchError, InvalidValueError, UnknownNameError
from imagine_bench.store.files import sealed, write_json


@pytest.mark.parametrize("others", [{}, {"encoder_kind": "latents"}])
def test_a_model_of_no_known_level_or_encoder_is_no_entry(others: dict[str, str]) -> None:
    made = {"make": "theirs:Model", "description": "A model.", "level": "commands", **others}
    MotionModelEntry(**made)
    for wrong in ({"level": "pixels"}, {"encoder_kind": "words"}):
        with pytest.raises(UnknownNameError, match=r"pixels|words"):
            MotionModelEntry(**{**made, **wrong})


FEW = MotionJudgement(task="arrow_puzzle", models=("no_change",), sizes=(3,), seeds=(0,), pairs=2, chains=1)


def test_a_world_has_one_name_however_it_is_typed() -> None:
    one, other = (
        replace(FEW, task=f"arrows:{typed}") for typed in ("cubes=2,goal_change=0.1", "goal_change=0.1,cubes=2")
    )
    assert one == other
    assert one.folder_name == other.folder_name


FAMILIES = {"arrows": make_arrows, "pick_place": make_pick_place}


def every(asked: MotionQuestions) -> tuple[AnsweredMotions, ...]:
    return (asked.planned, asked.raised, *asked.chains)


@functools.cache
def questions(family: str) -> MotionQuestions:
    """A few questions."""
    source = MotionSource(FAMILIES[family](observation="proprio", time_limit_s=1e9))
    rng = np.random.default_rng(0)
    planned, raised = source.pairs(4, rng)
    return MotionQuestions(planned=planned, raised=raised, chains=source.chains(8, 2, rng))


def moves(before: Ints, after: Ints) -> list[bool]:
    """In which rows an object moved."""
    return [moved(*ends) for ends in zip(before, after, strict=True)]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_pair_begins_alike_and_only_its_height_decides_the_end(family: str) -> None:
    planned, raised, *_ = every(questions(family))
    for part in ("before", "labels", "states"):
        np.testing.assert_array_equal(getattr(planned, part), getattr(raised, part))
    assert all(moves(planned.reached, raised.reached))
    assert planned.proper.all() and raised.proper.all()
    if family == "arrows":
        cubes = np.arange(3) == planned.labels[:, None] // 2
        turns = np.where(cubes, np.where(planned.labels % 2, 3, 1)[:, None], 0)
        np.testing.assert_array_equal((planned.reached - planned.states)[:, :3] % 4, turns)
        np.testing.assert_array_equal(raised.states, raised.reached)


@pytest.mark.parametrize("family", FAMILIES)
def test_each_motion_of_a_chain_begins_where_the_last_ended(family: str) -> None:
    first, second = questions(family).chains
    np.testing.assert_array_equal(first.reached, second.states)
    np.testing.assert_array_equal(first.after, second.before)
    rules = FAMILIES[family](observation="proprio").task.rules
    for motions in (first, second):
        assert all(moves(motions.states, motions.reached))
        assert all(moving_actions(rules, tuple(state)) for state in motions.reached.tolist()), "another can follow"


def test_questions_are_the_same_after_they_were_in_a_file() -> None:
    arrays = questions("arrows").arrays()
    again = MotionQuestions.of(arrays).arrays()
    assert arrays.keys() == again.keys()
    assert all(np.array_equal(arrays[name], again[name]) for name in arrays)
    planned = questions("arrows").planned
    learned = vars(planned.first(3))
    assert learned.keys() == {"before", "after", "actions", "lengths", "labels"}, "no answers"
    assert all(np.array_equal(part, getattr(planned, name)[:3]) for name, part in learned.items())


def frames_of(*states: tuple[int, ...]) -> Frame:
    """Frames that show two objects and a gesture; -1 where nothing can be read."""
    frames = np.zeros((len(states), 64, 64, 3), dtype=np.uint8)
    frames[:, 0, 0] = np.add(states, 1)
    return frames


def ending(*states: tuple[int, ...]) -> AnsweredMotions:
    """Motions that end so."""
    numbers = {name: np.arange(len(states)) for name in ("lengths", "labels", "variants", "states", "proper")}
    after = frames_of(*states)
    actions = np.zeros((len(states), 1, 7), dtype=np.float32)
    return AnsweredMotions(before=after[::-1], after=after, actions=actions, reached=np.array(states), **numbers)


READER = mock.Mock(read=lambda frames: frames[:, 0, 0].astype(np.int64) - 1)
REST, MOVED, UNREAD = (0, 0, 2), (1, 0, 2), (-1, -1, -1)


def test_each_score_is_the_share_of_what_it_says() -> None:
    """Of four motions; a model is given each part in its place, and people's gestures do not matter."""
    asked = MotionQuestions(
        planned=ending(MOVED, MOVED, MOVED, REST),
        raised=ending(REST, REST, REST, REST),
        chains=[ending(MOVED, MOVED, REST, REST), ending(REST, REST, REST, MOVED)],
    )
    answers = [
        frames_of((1, 0, 0), MOVED, UNREAD, (0, 1, 2)),
        frames_of(REST, MOVED, (0, 0, 1), REST),
        frames_of(MOVED, MOVED, REST, MOVED),
        frames_of(MOVED, REST, REST, MOVED),
    ]
    model = mock.Mock(imagine_motion=mock.Mock(side_effect=answers))
    found = score("noting", model, asked, READER)
    assert found == MotionScores(
        right=0.5, unread=0.25, raised_right=0.75, painted=1 / 3, pairs=0.25, by_depth=(0.75, 0.5)
    )
    calls = model.imagine_motion.call_args_list
    wanted = [(each.actions, each.lengths, each.labels) for each in every(asked)]
    assert [tuple(map(id, call.args[1:])) for call in calls] == [tuple(map(id, each)) for each in wanted]
    begun = [asked.planned.before, asked.raised.before, asked.chains[0].before, answers[2]]
    assert all(np.array_equal(call.args[0], each) for call, each in zip(calls, begun, strict=True))
    exact = {**dict.fromkeys(("right", "raised_right", "pairs"), 1.0), "unread": 0.0, "painted": 0.0}
    assert score("simulator", Simulator(asked), asked, READER) == MotionScores(by_depth=(1.0, 1.0), **exact)
    same = (begun[0], *calls[0].args[1:])
    assert NoChange().imagine_motion(*same) is begun[0]


def test_a_motion_is_as_planned_or_aside_or_raised_as_it_says() -> None:
    """Its last command would be nearly none, and brings the hand back: an eighth of the shift in 0.04 s."""
    source = MotionSource(make_arrows(observation="proprio", time_limit_s=1e9))
    drawn = source.draw(12, np.random.default_rng(0))
    shift_m = -8 * 0.04 * drawn.actions[np.arange(12), drawn.lengths - 9, :3]
    far_m = np.array([[0, 0], [0.008, 0], [0, 0.06]])[drawn.variants]
    assert set(drawn.variants) == {0, 1, 2}
    np.testing.assert_allclose(np.hypot(*shift_m.T[:2]), far_m[:, 0], atol=2.5e-3)
    np.testing.assert_allclose(shift_m[:, 2], far_m[:, 1], atol=7e-3)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"task": "arrow_puzzle_cloned"}, "has no continuous control"),
        ({"task": "arrows:cubes=2,slip=0.1"}, "Chance decides where a motion of arrows:cubes=2,slip=0.1 ends"),
        ({"models": ()}, "There is nothing to judge"),
        ({"models": ("no_change", "no_change")}, "give each once"),
        ({"models": ("patches",)}, "No model of motions 'patches'"),
        ({"sizes": (9, 3)}, "give ascending numbers of motions"),
        ({"seeds": (-1,)}, "one seed of at least 0"),
        ({"pairs": 0}, "give at least 1 of each"),
    ],
)
def test_a_judgement_that_cannot_be_is_one_sentence(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ImagineBenchError, match=sentence):
        replace(FEW, **change)


_OILY = """from dataclasses import replace
from imagine_bench import registry
from imagine_bench.tasks.arrows.spec import spec_of
HOLDS = replace(spec_of(cubes=2), id="oily", env_id="oily/Oily-v0")
SLIPS = replace(spec_of(cubes=2, slip=0.2), id="oily", env_id="oily/Oily-v0")
DRY = replace(registry.TASKS["arrows"], spec="oily:HOLDS", env_id="oily/Oily-v0", horizon=None, world="", options={})
OILY = replace(DRY, spec="oily:SLIPS")
"""


def test_grips_that_slip_are_refused_without_an_option_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The task of another package, whose name and options do not say that its world slips."""
    guests = Guests(tmp_path / "site", monkeypatch)
    folder = guests.write("oily", _OILY, {registry.TASK_GROUP: {"oily": "oily:DRY"}})
    assert replace(FEW, task="oily").task == "oily"
    guests.offer(folder, {registry.TASK_GROUP: {"oily": "oily:OILY"}})
    with pytest.raises(InvalidValueError, match="Chance decides where a motion of oily ends"):
        replace(FEW, task="oily")
    guests.forget()


def test_tables_and_rows_say_what_was_measured() -> None:
    """Means over seeds by hand, with their ends; a dash where nothing was measured; the simulator learns nothing."""
    measured = {
        "right": 0.5,
        "unread": 0.0,
        "raised_right": 1.0,
        "painted": None,
        "pairs": 0.5,
        "by_depth": [1.0, 0.5, 0.5, 0.0],
    }
    judgement = replace(FEW, sizes=(3, 30), seeds=(0, 1), pairs=4, chains=2)
    cells = [
        {"model": name, "transitions": size, "seed": seed, **measured, "pairs": share, "fit_s": seconds}
        for name, size, seed, share, seconds in (
            ("no_change", 3, 0, 0.25, 1.0), ("no_change", 3, 1, 0.75, 4.0), ("no_change", 30, 0, 0.25, 9.0),
            (SIMULATOR.model, 0, 0, 1.0, 0.0), ("gone", 3, 0, 0.25, 1.0),
        )
    ]  # fmt: skip
    del cells[3]["fit_s"]
    scores, drift = motion_tables(judgement, cells)
    shares = ["50", "0", "100", "–"]
    assert scores.rows == [
        ["no_change", "3", "commands", "2", *shares, "50 (25 to 75)", "2"],
        ["no_change", "30", "commands", "1", *shares, "25", "9"],
        [SIMULATOR.model, "–", "–", "–", *shares, "100", "–"],
        ["gone", "3", "–", "1", *shares, "25", "1"],
    ]
    assert [row[2:] for row in drift.rows] == [["100", "50", "50", "0"]] * 4
    assert "of 4 pairs" in scores.remark and "of 2 chains of 4 planned" in drift.remark
    seven = [{**cells[0], "seed": seed, "right": 0.1 * seed} for seed in range(7)]
    assert re.fullmatch(r"30 \[\d+, \d+\]", motion_tables(judgement, seven)[0].rows[0][4])
    first, *_ = motion_rows(cells)
    kept = {name: value for name, value in cells[0].items() if name not in ("by_depth", "transitions")}
    assert first == {**kept, "motions": 3, "after_1": 1.0, "after_2": 0.5, "after_3": 0.5, "after_4": 0.0}


@pytest.mark.slow
def test_a_judgement_goes_on_and_refuses_damaged_cells(tmp_path: Path) -> None:
    folder, failed = judge(FEW, tmp_path, workers=1)
    assert not failed
    (cell,) = [each for each in FEW.cells if each != SIMULATOR]
    first = (folder / cell.file).read_bytes()
    more = replace(FEW, seeds=(0, 1))
    assert judge(more, tmp_path, workers=2) == (folder, [])
    assert (folder / cell.file).read_bytes() == first
    kept = judged(more, folder)
    assert len(kept) == len(more.cells)
    assert len({each["questions"] for each in kept}) == 1
    assert len({each["data"] for each in kept if "data" in each}) == 2
    scores, drift = motion_tables(more, kept)
    assert [row[0] for row in scores.rows] == [row[0] for row in drift.rows] == ["simulator", "no_change"]
    (folder / cell.file).write_bytes(first.replace(b'"right": 0.0', b'"right": 1.0'))
    with pytest.raises(ArtefactError, match="is damaged"):
        judge(more, tmp_path, workers=1)


def test_a_model_whose_code_has_changed_is_judged_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    guests = Guests(tmp_path / "site", monkeypatch)
    code = "from imagine_bench_motion.judge.interface import MotionModelEntry\n"
    code += "ENTRY = MotionModelEntry(make='theirs:Model', level='commands', description='A model.')\n"
    module = guests.write("theirs", code, {GROUP: {"theirs": "theirs:ENTRY"}}) / "theirs.py"
    judgement = replace(FEW, models=("theirs", "no_change"))
    for cell in judgement.cells:
        made_by = registry.package_code("theirs:Model") if cell.model == "theirs" else ""
        write_json(tmp_path / cell.file, sealed({**cell._asdict(), "questions": "1", "code": made_by}))
    assert [cell["model"] for cell in judged(judgement, tmp_path)] == ["simulator", "theirs", "no_change"]
    module.write_text(f"{code}# another version\n")
    assert [cell["model"] for cell in judged(judgement, tmp_path)] == ["simulator", "no_change"]
    before = sealed({"model": "theirs", "questions": "1"})  # of a version that kept no digest
    write_json(tmp_path / judgement.cells[1].file, before)
    assert [cell["model"] for cell in judged(judgement, tmp_path)] == ["simulator", "theirs", "no_change"]
    guests.forget()


def test_what_is_no_frame_is_refused() -> None:
    asked = ending(*[REST] * 4)
    half = mock.Mock(imagine_motion=lambda frames, *_: frames[::2])
    with pytest.raises(InvalidValueError, match=r"half: imagine_motion\(\) gave uint8 \(2, 64, 64, 3\)"):
        score("half", half, MotionQuestions(planned=asked, raised=asked, chains=[asked]), READER)


def test_a_network_follows_its_generator_until_a_motions_end() -> None:
    motions = questions("arrows").planned
    networks = []
    for global_seed in (1, 2):
        with torch.random.fork_rng():
            torch.random.default_generator.manual_seed(global_seed)
            networks.append(MotionNetwork(motions.actions.shape[2]))
            networks[-1].draw_weights(torch.Generator().manual_seed(3))
    network, again = networks
    frames = torch.rand(len(motions), 16, 16, 48, generator=torch.Generator().manual_seed(0))
    actions = torch.from_numpy(motions.actions)
    longer = torch.cat([actions, torch.zeros(len(actions), 7, actions.shape[2])], dim=1)
    lengths = torch.from_numpy(motions.lengths)
    with torch.no_grad():
        imagined = network(frames, actions, lengths)
        assert torch.equal(imagined, again(frames, actions, lengths)), "the global generator draws nothing"
        torch.testing.assert_close(imagined, network(frames, longer, lengths))
    rows = torch.rand(2, 8, 12, 3, generator=torch.Generator().manual_seed(0))
    cut = patches(rows)
    assert torch.equal(cut[1, 1, 2], rows[1, 4:8, 8:12].flatten()) and torch.equal(images(cut), rows)


def test_a_labelled_model_learns_each_motion_and_gives_images_of_the_scenes_size() -> None:
    """Each pixel of a smaller image fills a square of the large one."""
    small = np.arange(2 * 4 * 4, dtype=np.uint8).reshape(2, 1, 1, 4, 4)
    inner = mock.Mock(imagine=lambda *_: SimpleNamespace(pictures=small))
    model = Labelled(inner, n_actions=3)
    motions = ending(REST, MOVED, UNREAD)
    model.fit(motions, np.random.default_rng(0))
    (episodes, _), _ = inner.fit.call_args
    learned = [episodes.frames[::2], episodes.frames[1::2], episodes.actions, episodes.lengths]
    for found, wanted in zip(learned, (motions.before, motions.after, motions.labels, [1, 1, 1]), strict=True):
        np.testing.assert_array_equal(found, wanted)
    frames = np.zeros((2, 8, 8, 3), dtype=np.uint8)
    drawn = model.imagine_motion(frames, np.zeros((2, 1, 7), np.float32), np.ones(2, np.int64), np.zeros(2, np.int64))
    assert drawn.shape == frames.shape and drawn.dtype == np.uint8
    assert (drawn == small[:, 0, 0].repeat(2, axis=1).repeat(2, axis=2)[..., None]).all()
