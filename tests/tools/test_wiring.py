"""Every option of every command reaches the function that does the work, and each left out is what its help says."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

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

HERE = Path("here")
RUNS = Path("runs")


class ReachedError(Exception):
    """The function that does the work was called."""


class Call(NamedTuple):
    """A command, the function that it should call, and what this should be given."""

    words: str
    target: str
    given: tuple[Any, ...]
    named: Mapping[str, Any]


def call(words: str, target: str, *given: Any, **named: Any) -> Call:
    return Call(words, target, given, named)


_PHYSICS = (("pad_friction", 0.5), ("plan_error_mm", 3))
_JUDGING = "imagine_bench.cli.judging"
_TOOLS = "imagine_bench.cli.tools"
_BENCHES = "imagine_bench.cli.benches"
_AUDITS = "imagine_bench.tools.audits"
_PLAY = "imagine_bench.tools.play"
_PLANS = {"task": None, "count": 100, "recorded": 5, "execution": None, "max_epistemic": None, "encoder": None}
_COLLECTED = {"episodes": 200, "seed": 0, "execution": "physics", "appearance": "clean", "motion_hz": 0.0}
_SHOWN = {"policy": "expert", "episodes": 200, "seed": 0, "appearance": "clean", "size": 64, "format": "npz"}
_RETRAINED = {"recipe": "default", "appearance": "clean", "steps": None, "batch": None, "latents": None}
_KEPT = {"tests": None, "training": None, "seed": 0, "like": None, "execution": None, "appearance": None}
_GAME = {"model": None, "seed": 0, "camera": "human", "execution": None, "appearance": None, "encoder": None}
_SERVED = {
    "task": None, "observation": "words", "player": None, "tests": None, "training": None, "like": None,
    "execution": None, "appearance": None, "most_players": 16, "host": "127.0.0.1", "port": 8765, "out": RUNS,
}  # fmt: skip
_BOARD = {
    "action": "open", "path": HERE, "out": Path("build/board"), "closes": None, "tests": 100, "round": None,
    "secret": Path("secret.json"),
}  # fmt: skip
_JUDGED: dict[str, Any] = {
    "task": "pick_place", "models": ("copy",), "sizes": (2, 3), "seeds": (4, 5), "samples": 6, "appearance": "mild",
    "policy": "mixed", "order": 7,
}  # fmt: skip
CALLS = [
    call(
        "judge --models copy",
        f"{_JUDGING}.judge",
        Judgement(task="arrow_puzzle", models=("copy",)),
        Path("runs/judge"),
        workers=mock.ANY,
    ),
    call(
        "judge pick_place --models copy --sizes 2 3 --seeds 4 5 --samples 6 --appearance mild --policy mixed --order 7 "
        "--workers 1 --out here",
        f"{_JUDGING}.judge",
        Judgement(**_JUDGED),
        HERE,
        workers=1,
    ),
    call(
        "judge pick_place --models gaussian --encoder pick_place-mild",
        f"{_JUDGING}.judge",
        Judgement(task="pick_place", models=("gaussian",), encoder="pick_place-mild"),
        Path("runs/judge"),
        workers=mock.ANY,
    ),
    call(
        "verify tests --train 2 --nonce word --dataset here --encoder e",
        f"{_JUDGING}.Retraining",
        runs=2,
        nonce="word",
        launcher=mock.ANY,
        encoder="e",
        dataset=HERE,
    ),
    call("verify tests --train 2 --workers 3", f"{_JUDGING}.launcher", "local", 3),
    call("verify", f"{_AUDITS}.chosen", None, RUNS, None),
    call("verify --out here --task arrows", f"{_AUDITS}.chosen", None, HERE, "arrows"),
    call("verify here --causes --encoder e", f"{_AUDITS}.why_report", HERE, root=RUNS, task=None, encoder="e"),
    call("plan", f"{_AUDITS}.plan_report", None, root=RUNS, **_PLANS),
    call(
        "plan --task pick_place --out here --count 3 --recorded 0 --execution kinematic --max-epistemic 0.5 "
        "--encoder e",
        f"{_AUDITS}.plan_report",
        None,
        root=HERE,
        task="pick_place",
        count=3,
        recorded=0,
        execution="kinematic",
        max_epistemic=0.5,
        encoder="e",
    ),
    call("dataset arrow_puzzle", f"{_TOOLS}.collect", mock.ANY, mock.ANY, **_COLLECTED),
    call(
        "dataset arrow_puzzle --episodes 3 --seed 4 --execution kinematic --appearance mild --motion-hz 5",
        f"{_TOOLS}.collect",
        mock.ANY,
        mock.ANY,
        episodes=3,
        seed=4,
        execution="kinematic",
        appearance="mild",
        motion_hz=5.0,
    ),
    call("dataset arrow_puzzle", f"{_TOOLS}.policy_of", "random", mock.ANY, 0, None),
    call("dataset arrow_puzzle --policy here --seed 4 --encoder e", f"{_TOOLS}.policy_of", "here", mock.ANY, 4, "e"),
    call("dataset arrow_puzzle --out here", f"{_TOOLS}.require_new", HERE),
    call("dataset arrow_puzzle --policy mixed", f"{_TOOLS}.require_new", Path("datasets/arrow_puzzle-mixed")),
    call("dataset arrow_puzzle --format minari", f"{_TOOLS}.require_format", "minari"),
    call("dataset --standard", f"{_TOOLS}.standard_sets", Path("datasets"), "npz", 200),
    call("dataset --standard --out here --format lerobot --episodes 7", f"{_TOOLS}.standard_sets", HERE, "lerobot", 7),
    call("dataset --describe here", f"{_TOOLS}.read_dataset", HERE),
    call(
        "dataset ArrowPuzzleMotion --policy expert",
        "imagine_bench_motion.control.datasets.collect",
        "arrow_puzzle",
        folder=Path("datasets/ArrowPuzzleMotion-expert"),
        workers=None,
        **_SHOWN,
    ),
    call(
        "dataset ArrowPuzzleMotion --policy noisy --episodes 3 --seed 4 --appearance mild --size 96 "
        "--out here --workers 2",
        "imagine_bench_motion.control.datasets.collect",
        "arrow_puzzle",
        policy="noisy",
        episodes=3,
        seed=4,
        appearance="mild",
        size=96,
        format="npz",
        folder=HERE,
        workers=2,
    ),
    call(
        "encoder arrow_puzzle",
        "imagine_bench.agents.encoders.cli.retrain",
        mock.ANY,
        device="cpu",
        seed=0,
        out=Path("encoders"),
        **_RETRAINED,
    ),
    call(
        "encoder arrow_puzzle --recipe codes --appearance mild --steps 1 --batch 2 --latents 3 --device cuda --seed 4 "
        "--out here",
        "imagine_bench.agents.encoders.cli.retrain",
        mock.ANY,
        recipe="codes",
        appearance="mild",
        steps=1,
        batch=2,
        latents=3,
        device="cuda",
        seed=4,
        out=HERE,
    ),
    call("view", f"{_TOOLS}.newest_recording", RUNS, None),
    call("view --task arrows --out here", f"{_TOOLS}.newest_recording", HERE, "arrows"),
    call("view here.rrd", "imagine_bench.recording.stream.open_in_viewer", Path("here.rrd")),
    call("describe", f"{_TOOLS}.names"),
    call("describe dqn", f"{_TOOLS}.describe", "dqn"),
    call("play arrow_puzzle", f"{_PLAY}.play", "arrow_puzzle", **_GAME),
    call(
        "play --model here --execution kinematic --appearance mild --encoder e --camera far --seed 4",
        f"{_PLAY}.play",
        None,
        model=HERE,
        seed=4,
        camera="far",
        execution="kinematic",
        appearance="mild",
        encoder="e",
    ),
    call(
        "play ArrowPuzzleMotion --seed 4 --camera far --appearance mild",
        "imagine_bench_motion.control.keyboard.play_motion",
        "arrow_puzzle",
        seed=4,
        appearance="mild",
        camera="far",
    ),
    call(
        "play arrow_puzzle --film",
        f"{_PLAY}.film",
        "arrow_puzzle",
        Path("film.gif"),
        seed=0,
        appearance="clean",
        camera="human",
    ),
    call(
        "play arrow_puzzle --film --out here --seed 4 --appearance mild --camera far",
        f"{_PLAY}.film",
        "arrow_puzzle",
        HERE,
        seed=4,
        appearance="mild",
        camera="far",
    ),
    call(
        "play arrow_puzzle --quiz 3 --seed 4 --appearance mild",
        "imagine_bench.tools.quiz.quiz",
        "arrow_puzzle",
        3,
        seed=4,
        appearance="mild",
    ),
    call("play arrow_puzzle --keep anna", f"{_TOOLS}.protocol_of_player", "arrow_puzzle", "person", "anna", **_KEPT),
    call(
        "play arrow_puzzle --keep anna --tests 3 --training 4 --seed 5 --like here --execution kinematic "
        "--appearance mild",
        f"{_TOOLS}.protocol_of_player",
        "arrow_puzzle",
        "person",
        "anna",
        tests=3,
        training=4,
        seed=5,
        like=HERE,
        execution="kinematic",
        appearance="mild",
    ),
    call("play arrow_puzzle --keep anna", f"{_PLAY}.keep_playing", mock.ANY, RUNS, camera="human"),
    call(
        "play arrow_puzzle --keep anna --out here --camera far", f"{_PLAY}.keep_playing", mock.ANY, HERE, camera="far"
    ),
    call("serve", "imagine_bench_serving.server.serve_command", **_SERVED),
    call(
        "serve pick_place --observation png --player anna --tests 3 --training 4 --like here --execution kinematic "
        "--appearance mild --most-players 5 --host 0.0.0.0 --port 6 --out here",
        "imagine_bench_serving.server.serve_command",
        task="pick_place",
        observation="png",
        player="anna",
        tests=3,
        training=4,
        like=HERE,
        execution="kinematic",
        appearance="mild",
        most_players=5,
        host="0.0.0.0",
        port=6,
        out=HERE,
    ),
    call("check arrow_puzzle", "imagine_bench.testing.contract.checks", "arrow_puzzle", None, None),
    call(
        "check arrow_puzzle --agent dqn --model copy",
        "imagine_bench.testing.contract.checks",
        "arrow_puzzle",
        "dqn",
        "copy",
    ),
    call(
        "check arrow_puzzle --physics",
        "imagine_bench.testing.physics.check_physics",
        "arrow_puzzle",
        Path("runs/margins.json"),
        turns=2_000,
        trials=200,
        appearances=("clean",),
    ),
    call(
        "check arrow_puzzle --physics --turns 3 --trials 4 --appearances mild strong --out here",
        "imagine_bench.testing.physics.check_physics",
        "arrow_puzzle",
        HERE,
        turns=3,
        trials=4,
        appearances=("mild", "strong"),
    ),
    call(
        "check ArrowPuzzleMotion --physics --turns 3 --trials 4 --random 5",
        "imagine_bench.testing.physics.check_motion",
        "ArrowPuzzleMotion",
        Path("runs/margins.json"),
        turns=3,
        trials=4,
        random_episodes=5,
        appearances=("clean",),
    ),
    call("new agent mine", "imagine_bench.tools.new.new_package", "agent", "mine", Path()),
    call("new model mine --out here", "imagine_bench.tools.new.new_package", "model", "mine", HERE),
    call("report", f"{_BENCHES}.newest_bench", RUNS, None),
    call("report --task arrows --out here", f"{_BENCHES}.newest_bench", HERE, "arrows"),
    call("report here", f"{_BENCHES}.load_so_far", HERE),
    call("report here --track wandb", f"{_BENCHES}.track", HERE, "wandb"),
    call("sweep", f"{_BENCHES}.run_suite", mock.ANY, mock.ANY, root=RUNS, launcher=mock.ANY),
    call(
        "sweep --agents dqn --out here --workers 1",
        f"{_BENCHES}.run_suite",
        mock.ANY,
        ("dqn",),
        root=HERE,
        launcher=mock.ANY,
    ),
    call(
        "sweep arrow_puzzle --out here",
        f"{_BENCHES}.run_study",
        mock.ANY,
        "arrow_puzzle",
        root=HERE,
        launcher=mock.ANY,
    ),
    call("bench arrow_puzzle --workers 2 --launcher ray", "imagine_bench.cli.options.launcher", "ray", 2),
    call("bench arrow_puzzle", "imagine_bench.cli.options.launcher", "local", None),
    call("bench arrow_puzzle", f"{_BENCHES}.bench", mock.ANY, mock.ANY, root=RUNS, launcher=mock.ANY),
    call("bench arrow_puzzle --out here", f"{_BENCHES}.bench", mock.ANY, mock.ANY, root=HERE, launcher=mock.ANY),
    call("bench arrow_puzzle --track wandb", f"{_BENCHES}.Tracked", mock.ANY, "wandb", "arrow_puzzle"),
    call("bench arrow_puzzle --until-decided", f"{_BENCHES}.until_decided", mock.ANY, mock.ANY, most=19, root=RUNS),
    call(
        "bench arrow_puzzle --until-decided --most-seeds 9 --out here",
        f"{_BENCHES}.until_decided",
        mock.ANY,
        mock.ANY,
        most=9,
        root=HERE,
    ),
    call(
        "submit here",
        "imagine_bench_board.commands.submit",
        run=HERE,
        out=Path("rows"),
        author="",
        round=None,
        encoder=None,
    ),
    call("board open here", "imagine_bench_board.commands.board", **_BOARD),
    call(
        "daily --date 2026-12-24 --secret word", "imagine_bench_board.commands.daily", date="2026-12-24", secret="word"
    ),
]


@pytest.mark.parametrize("one", CALLS, ids=lambda one: f"{one.words} {one.target.rpartition('.')[2]}")
def test_a_command_gives_its_options_to_the_function_that_does_its_work(one: Call, tmp_path: Path) -> None:
    with contextlib.chdir(tmp_path), mock.patch(one.target, side_effect=ReachedError) as reached:
        with pytest.raises(ReachedError):
            main(one.words.split())
    reached.assert_called_once_with(*one.given, **one.named)


OPTIONS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "execution": ("--execution kinematic", {"execution": "kinematic"}),
    "appearance": ("--appearance mild", {"appearance": "mild"}),
    "physics": ("--physics pad_friction=0.5 --physics plan_error_mm=3", {"physics": _PHYSICS}),
    "observation": ("--observation frame,proprio", {"observation": "frame,proprio"}),
    "observation_size": ("--observation-size 96", {"observation_size": 96}),
    "agents": ("--agents pupil random", {"agents": ("pupil", "random")}),
    "after": ("--after arrow_puzzle", {"after": ("arrow_puzzle",)}),
    "after_episodes": (
        "--after arrow_puzzle --after-episodes 7",
        {"after": ("arrow_puzzle",), "after_episodes": 7},
    ),
    "unannounced": ("--after arrow_puzzle --unannounced", {"after": ("arrow_puzzle",), "unannounced": True}),
    "demonstrations": ("--demonstrations 2", {"demonstrations": 2}),
    "queries": ("--queries 3", {"queries": 3}),
    "feedback": ("--feedback 1.5", {"feedback": 1.5}),
    "feedback_error": ("--feedback 1.5 --feedback-error 0.25", {"feedback": 1.5, "feedback_error": 0.25}),
    "seeds": ("--seeds 3-5 8", {"seeds": (3, 4, 5, 8)}),
    "budgets": ("--budgets 5 25", {"budgets": (5, 25)}),
    "evaluation_episodes": ("--evaluation-episodes 7", {"evaluation_episodes": 7}),
    "test_appearance": ("--test-appearance mild", {"test_appearance": "mild"}),
    "split": ("--split plan_length=2", {"split": mock.ANY}),
}
"""Words for each option of a bench of agents, and the fields of the protocol that they set."""
OF_ANY_FRAME = ("observation", "observation_size")
"""The options that refuse an agent that learns from usual frames."""
OF_OTHERS = {
    "set": "an agent with settings, below",
    "encoder": "an agent that sees through one, below",
    "dataset": "a folder, tests/running/test_offline.py",
    "device": "an accelerator, tests/running/test_runner.py",
    "variants": "regression tasks, below",
    "networks": "regression tasks, below",
    "until_decided": "the commands above",
    "most_seeds": "the commands above",
}
"""The options that need more than an agent, and where they are tested."""


@functools.cache
def planned(words: str) -> dict[str, Any]:
    """The fields of the protocol that a bench would have."""
    command = parsed(["bench", *words.split()])
    assert isinstance(command, benches.Bench)
    return {each.name: getattr(command.planned()[0], each.name) for each in dataclasses.fields(command.planned()[0])}


@pytest.mark.parametrize(
    ("agent", "words", "given"),
    [
        *(
            (f"arrow_puzzle --preset smoke --agents {'random' if name in OF_ANY_FRAME else 'pupil'}", *row)
            for name, row in OPTIONS.items()
        ),
        (
            "arrow_puzzle --preset smoke --agents dqn",
            "--set controller.discount=0.9",
            {"overrides": (("controller.discount", 0.9),), "settings_digest": mock.ANY},
        ),
        ("arrow_puzzle --preset smoke --agents dqn", "--encoder arrow_puzzle-mild", {"encoder": mock.ANY}),
        ("toy_regression --preset smoke", "--networks 3", {"networks": 3}),
    ],
)
def test_an_option_of_a_bench_sets_its_fields_of_the_protocol_and_no_other(
    agent: str, words: str, given: Mapping[str, Any]
) -> None:
    before, after = planned(agent), planned(f"{agent} {words}")
    assert {name: value for name, value in after.items() if value != before[name]} == given


def test_every_option_of_a_bench_has_a_row_or_a_reason() -> None:
    sections = (benches.WorldOptions, benches.Learner, benches.Budget, benches.Tests)
    names = {each.name for section in sections for each in dataclasses.fields(section)}
    assert names == OPTIONS.keys() | OF_OTHERS.keys()


def test_a_bench_is_by_default_what_its_help_says() -> None:
    before = planned("arrow_puzzle --agents pupil")
    said = {
        "preset": "quick",
        "execution": "physics",
        "appearance": "clean",
        "observation": "frame",
        "observation_size": 64,
        "demonstrations": 0,
        "queries": 0,
        "feedback": 0.0,
        "feedback_error": 0.0,
        "device": "cpu",
    }
    assert {name: before[name] for name in said} == said
    assert planned("arrow_puzzle --agents pupil --after arrow_puzzle")["after_episodes"] == 100
