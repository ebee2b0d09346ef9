"""Every option of every command reaches the function that does the work, and each left out is what its help says."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import ANY, patch

import bench_fakes  # noqa: F401 - registers its agents
import pytest

import imagine_bench.testing.contract
import imagine_bench.testing.physics
import imagine_bench.tools.new
import imagine_bench.tools.play
import imagine_bench.tools.quiz  # noqa: F401 - all are loaded in no test's time
from imagine_bench.cli import benches, parsed
from imagine_bench.cli import exit_code as main
from imagine_bench.judge.judgement import Judgement
from imagine_bench.store import loading
from imagine_bench.sweep.grid import Study, Suite


class ReachedError(Exception):
    """The function that does the work was called."""


class Wire(NamedTuple):
    """A command, options that say what it does without them, others, and the function that is given all of them."""

    line: str
    default: str
    others: str
    target: str
    places: Mapping[str, str | int]  # the argument of an option, where it has another name or none


def wire(line: str, default: str, others: str, target: str, **places: str | int) -> Wire:
    return Wire(line, default, others, target, places)


def meant(word: str) -> Any:
    try:
        return ast.literal_eval(word)
    except (ValueError, SyntaxError):
        return word


def chosen(line: str) -> dict[str, Any]:
    """The options of a command line and their values: of ``--motion-hz 5 --sizes 2 3``, ``motion_hz`` is 5."""
    found: dict[str, Any] = {}
    for option in f" {line}".split(" --")[1:]:
        first, *words = option.split()
        name = first.replace("-", "_")
        values = (*found.get(name, ()), *map(meant, words))
        found[name] = values or (True,)
    return {name: values if len(values) > 1 else values[0] for name, values in found.items()}


_JUDGING = "imagine_bench.cli.judging"
_TOOLS = "imagine_bench.cli.tools"
_BENCHES = "imagine_bench.cli.benches"
_AUDITS = "imagine_bench.tools.audits"
_PLAY = "imagine_bench.tools.play"
_CONTROL = "imagine_bench_motion.control"
_TESTING = "imagine_bench.testing"
_BOARD = "imagine_bench_board.commands"
WIRES = [
    wire(
        "judge pick_place --models gaussian copy",
        "--seeds 0 1 2 --samples 8 --appearance clean --policy random --order 0 --out runs/judge",
        "--sizes 2 3 --seeds 4 5 --samples 6 --appearance mild --policy mixed --order 7 --encoder pick_place-mild "
        "--workers 1 --out here",
        f"{_JUDGING}.judge",
        out=1,
    ),
    wire("judge --models copy gaussian", "--task arrow_puzzle", "--task pick_place", f"{_JUDGING}.judge"),
    wire(
        "verify tests --train 2 --nonce word", "", "--dataset here --encoder e", f"{_JUDGING}.Retraining", train="runs"
    ),
    wire("verify tests --train 2", "", "--workers 3", f"{_JUDGING}.launcher", workers=1),
    wire("verify", "--out runs", "--out here --task arrows", f"{_AUDITS}.chosen", out=1, task=2),
    wire("verify here --causes", "", "--encoder e", f"{_AUDITS}.why_report"),
    wire(
        "plan",
        "--out runs --count 100 --recorded 5",
        "--task pick_place --out here --count 3 --recorded 0 --execution kinematic --max-epistemic 0.5 --encoder e",
        f"{_AUDITS}.plan_report",
        out="root",
    ),
    wire(
        "dataset arrow_puzzle",
        "--episodes 200 --seed 0 --execution physics --appearance clean --motion-hz 0",
        "--episodes 3 --seed 4 --execution kinematic --appearance mild --motion-hz 5",
        f"{_TOOLS}.collect",
    ),
    wire(
        "dataset arrow_puzzle",
        "--policy random --seed 0",
        "--policy here --seed 4 --encoder e",
        f"{_TOOLS}.policy_of",
        policy=0,
        seed=2,
        encoder=3,
    ),
    wire(
        "dataset arrow_puzzle --policy mixed",
        "--out datasets/arrow_puzzle-mixed",
        "--out here",
        f"{_TOOLS}.require_new",
        out=0,
    ),
    wire("dataset arrow_puzzle", "--format npz", "--format minari", f"{_TOOLS}.require_format", format=0),
    wire(
        "dataset --standard",
        "--out datasets --format npz --episodes 200",
        "--out here --format lerobot --episodes 7",
        f"{_TOOLS}.standard_sets",
        out=0,
        format=1,
        episodes=2,
    ),
    wire(
        "dataset ArrowPuzzleMotion --policy noisy",
        "--episodes 200 --seed 0 --appearance clean --size 64 --format npz --out datasets/ArrowPuzzleMotion-noisy",
        "--episodes 3 --seed 4 --appearance mild --size 96 --format minari --out here --workers 2",
        f"{_CONTROL}.datasets.collect",
        out="folder",
    ),
    wire(
        "encoder arrow_puzzle",
        "--recipe default --appearance clean --device cpu --seed 0 --out encoders",
        "--recipe codes --appearance mild --steps 1 --batch 2 --latents 3 --device cuda --seed 4 --out here",
        "imagine_bench.agents.encoders.cli.retrain",
    ),
    wire("view", "--out runs", "--task arrows --out here", f"{_TOOLS}.newest_recording", out=0, task=1),
    wire(
        "play arrow_puzzle",
        "--camera human --seed 0",
        "--model here --execution kinematic --appearance mild --encoder e --camera far --seed 4",
        f"{_PLAY}.play",
    ),
    wire(
        "play ArrowPuzzleMotion",
        "--seed 0 --camera human",
        "--seed 4 --camera far --appearance mild",
        f"{_CONTROL}.keyboard.play_motion",
    ),
    wire(
        "play arrow_puzzle --film",
        "--out film.gif --seed 0 --appearance clean --camera human",
        "--out here --seed 4 --appearance mild --camera far",
        f"{_PLAY}.film",
        out=1,
    ),
    wire(
        "play arrow_puzzle --quiz 3",
        "--seed 0 --appearance clean",
        "--seed 4 --appearance mild",
        "imagine_bench.tools.quiz.quiz",
        quiz=1,
    ),
    wire(
        "play arrow_puzzle --keep anna",
        "--seed 0",
        "--tests 3 --training 4 --seed 5 --like here --execution kinematic --appearance mild",
        f"{_TOOLS}.protocol_of_player",
        keep=2,
    ),
    wire(
        "play arrow_puzzle --keep anna",
        "--out runs --camera human",
        "--out here --camera far",
        f"{_PLAY}.keep_playing",
        out=1,
    ),
    wire(
        "serve",
        "--observation words --most-players 16 --host 127.0.0.1 --port 8765 --out runs",
        "--task pick_place --observation png --player anna --tests 3 --training 4 --like here --execution kinematic "
        "--appearance mild --most-players 5 --host 0.0.0.0 --port 6 --out here",
        "imagine_bench_serving.server.serve_command",
    ),
    wire("check arrow_puzzle", "", "--agent dqn --model copy", f"{_TESTING}.contract.checks", agent=1, model=2),
    wire(
        "check arrow_puzzle --physics",
        "--turns 2000 --trials 200 --appearances clean --out runs/margins.json",
        "--turns 3 --trials 4 --appearances mild strong --out here",
        f"{_TESTING}.physics.check_physics",
        out=1,
    ),
    wire(
        "check ArrowPuzzleMotion --physics",
        "--random 100",
        "--turns 3 --trials 4 --random 5 --out here",
        f"{_TESTING}.physics.check_motion",
        random="random_episodes",
        out=1,
    ),
    wire("new agent mine", "--out .", "--out here", "imagine_bench.tools.new.new_package", out=2),
    wire("report", "--out runs", "--task arrows --out here", f"{_BENCHES}.newest_bench", out=0, task=1),
    wire("report here --track wandb", "", "", f"{_BENCHES}.track", track=1),
    wire(
        "sweep",
        "--seeds 0 1 --out runs",
        "--seeds 3 5 --experiment size --experiment memory --agents dqn random --out here",
        f"{_BENCHES}.run_suite",
        agents=1,
        out="root",
    ),
    wire(
        "sweep arrow_puzzle --name factors",
        "--out runs",
        "--variants dqn imagination_uncertainty --out here",
        f"{_BENCHES}.run_study",
        out="root",
    ),
    wire(
        "bench arrow_puzzle",
        "--launcher local",
        "--workers 2 --launcher ray",
        "imagine_bench.cli.options.launcher",
        launcher=0,
        workers=1,
    ),
    wire("bench arrow_puzzle", "--out runs", "--out here", f"{_BENCHES}.bench", out="root"),
    wire("bench arrow_puzzle --track wandb", "", "", f"{_BENCHES}.Tracked", track=1),
    *(
        wire(
            f"bench arrow_puzzle --until-decided{tracked}",
            "--most-seeds 19 --out runs",
            "--most-seeds 9 --out here",
            f"{_BENCHES}.until_decided",
            most_seeds="most",
            out="root",
        )
        for tracked in ("", " --track tensorboard")
    ),
    wire("submit here", "--out rows", "--out there --author me --encoder e --round r", f"{_BOARD}.submit"),
    wire(
        "board open here",
        "--out build/board --tests 100 --secret secret.json",
        "--out there --tests 5 --secret word.json --closes 2026-12-24",
        f"{_BOARD}.board",
    ),
    wire("daily", "", "--date 2026-12-24 --secret word", f"{_BOARD}.daily"),
]


def fields_of(given: object) -> Mapping[str, Any]:
    """Of a judgement its fields; of a grid the parts of it that are wanted."""
    if isinstance(given, Suite):
        return {"seeds": given.seeds, "experiment": tuple(each.name for each in given.experiments)}
    if isinstance(given, Study):
        return {"name": given.name, "variants": tuple(each.name for each in given.variants)}
    return vars(given) if isinstance(given, Judgement) else {}


def arguments(line: str, target: str) -> dict[str | int, Any]:
    """Those of the function that a command calls, by place or name, and :func:`fields_of` each."""
    none_runs = patch(f"{_BENCHES}.bench", side_effect=AssertionError("a bench was run instead"))
    with none_runs, patch(target, side_effect=ReachedError) as function, pytest.raises(ReachedError):
        main(line.split())
    given, named = function.call_args
    found = {**dict(enumerate(given)), **named}
    for each in given:
        found |= fields_of(each)
    plain = {name: str(value) if isinstance(value, Path) else value for name, value in found.items()}
    return {
        name: value for name, value in plain.items() if value is None or isinstance(value, str | float | int | tuple)
    }


@pytest.mark.parametrize("one", WIRES, ids=lambda one: f"{one.line} {one.target.rpartition('.')[2]}")
def test_an_option_reaches_its_argument_alone(one: Wire, tmp_path: Path) -> None:
    with contextlib.chdir(tmp_path):
        before, same, after = (arguments(f"{one.line} {more}", one.target) for more in ("", one.default, one.others))
    assert same == before
    given, others = ({one.places.get(n, n): v for n, v in chosen(words).items()} for words in (one.line, one.others))
    assert {name: value for name, value in after.items() if value != before[name]} == others
    assert all(before[name] == value for name, value in given.items() if name in before or name in one.places.values())


def test_every_folder_that_shall_be_merged_is_read() -> None:
    reading = patch.object(loading, "load_so_far", side_effect=str)
    merging = patch.object(loading, "merge", side_effect=ReachedError)
    with reading, merging as merge, pytest.raises(ReachedError):
        main("report a --merge b c --merge d --out here".split())
    assert merge.call_args.args == (["a", "b", "c", "d"], Path("here"))


def test_the_agents_of_a_days_world_are_run_as_the_command_says() -> None:
    world = patch(f"{_BOARD}.daily", return_value="arrows:cubes=2")
    with world, patch(f"{_BENCHES}.carry_out", side_effect=ReachedError) as run, pytest.raises(ReachedError):
        main("daily --agents dqn random --seeds 3 4 --budgets 7 9 --out here".split())
    options = {"agents": ("dqn", "random"), "seeds": (3, 4), "budgets": (7, 9), "execution": "kinematic"}
    assert run.call_args.args == ("arrows:cubes=2", "quick", {**options, "overrides": (), "device": "cpu"})
    assert run.call_args.kwargs["root"] == Path("here")


_PUPIL = "arrow_puzzle --preset smoke --agents pupil"
_RANDOM = "arrow_puzzle --preset smoke --agents random"  # takes other frames than the usual
_DQN = "arrow_puzzle --preset smoke --agents dqn"
_AFTER = {"after": ("arrow_puzzle",)}
_PHYSICS = (("pad_friction", 0.5), ("plan_error_mm", 3))
_DISCOUNT = (("controller.discount", 0.9),)
OPTIONS: list[tuple[str, str, Mapping[str, Any]]] = [
    (_PUPIL, "--execution kinematic", {}),
    (_PUPIL, "--appearance mild", {}),
    (_PUPIL, "--physics pad_friction=0.5 --physics plan_error_mm=3", {"physics": _PHYSICS}),
    (_RANDOM, "--observation frame,proprio", {"observation": "frame,proprio"}),
    (_RANDOM, "--observation-size 96", {}),
    (_PUPIL, "--agents pupil random", {}),
    (_PUPIL, "--after arrow_puzzle", _AFTER),
    (_PUPIL, "--after arrow_puzzle --after-episodes 7", _AFTER),
    (_PUPIL, "--after arrow_puzzle --unannounced", _AFTER),
    (_PUPIL, "--demonstrations 2", {}),
    (_PUPIL, "--queries 3", {}),
    (_PUPIL, "--feedback 1.5", {}),
    (_PUPIL, "--feedback 1.5 --feedback-error 0.25", {}),
    (_PUPIL, "--seeds 3-5 8", {"seeds": (3, 4, 5, 8)}),
    (_PUPIL, "--budgets 5 25", {}),
    (_PUPIL, "--evaluation-episodes 7", {}),
    (_PUPIL, "--test-appearance mild", {}),
    (_PUPIL, "--split plan_length=2", {"split": ANY}),
    (_DQN, "--set controller.discount=0.9", {"set": ANY, "overrides": _DISCOUNT, "settings_digest": ANY}),
    (_DQN, "--encoder arrow_puzzle-mild", {"encoder": ANY}),
    ("toy_regression --preset smoke", "--networks 3", {}),
]
"""A bench, words for an option, and the fields of the protocol that are not named and given as the words are."""
OF_OTHERS = {
    "dataset": "a folder, tests/running/test_offline.py",
    "device": "an accelerator, tests/running/test_runner.py",
    "variants": "regression tasks",
    "until_decided": "the commands above",
    "most_seeds": "the commands above",
}
"""The options that need more, and where they are tested."""


@functools.cache
def planned(words: str) -> dict[str, Any]:
    """The fields of the protocol that a bench would have."""
    command = parsed(["bench", *words.split()])
    assert isinstance(command, benches.Bench)
    return {each.name: getattr(command.planned()[0], each.name) for each in dataclasses.fields(command.planned()[0])}


@pytest.mark.parametrize(("bench", "words", "otherwise"), OPTIONS)
def test_an_option_of_a_bench_sets_its_own_fields_alone(bench: str, words: str, otherwise: Mapping[str, Any]) -> None:
    before, after = planned(bench), planned(f"{bench} {words}")
    given = {**chosen(words), **otherwise}
    given.pop("set", None)
    assert {name: value for name, value in after.items() if value != before[name]} == given


def test_every_option_of_a_bench_has_a_row_or_a_reason() -> None:
    sections = (benches.WorldOptions, benches.Learner, benches.Budget, benches.Tests)
    names = {each.name for section in sections for each in dataclasses.fields(section)}
    rows = set().union(*(chosen(words) for _, words, _ in OPTIONS))
    assert names == rows | OF_OTHERS.keys()


def test_a_bench_is_by_default_what_its_help_says() -> None:
    said = chosen(
        "--preset quick --execution physics --appearance clean --observation frame --observation-size 64 "
        "--demonstrations 0 --queries 0 --feedback 0 --feedback-error 0 --device cpu"
    )
    assert planned("arrow_puzzle --agents pupil").items() >= said.items()
    assert planned("arrow_puzzle --agents pupil --after arrow_puzzle")["after_episodes"] == 100
