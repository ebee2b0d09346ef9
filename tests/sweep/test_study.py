"""Studies: one factor at a time on tuning seeds, which no reported result may use."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
import math
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bench_fakes  # noqa: F401 - registers its agents
import numpy as np
import pytest
from imagine_bench.agents.imagination.settings import HYPERPARAMETERS
from imagine_bench.agents.settings import flatten
from numpy.typing import NDArray
from report_pages import page_in_words
from small_runs import Inline
from whole_outputs import Expected

import imagine_bench
from imagine_bench import registry, statistics
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import InvalidValueError, UnknownNameError
from imagine_bench.exact.values import true_model
from imagine_bench.interfaces.capabilities import ExpectedOutcomes
from imagine_bench.protocols.data import digest
from imagine_bench.report.page import write_page
from imagine_bench.report.sweep import study_page
from imagine_bench.rules import states_of
from imagine_bench.running.bench import load_bench
from imagine_bench.statistics import Estimate
from imagine_bench.store.results import PolicyTable
from imagine_bench.sweep.grid import BASE, GRIDS, Study, Variant, read_grid
from imagine_bench.sweep.run import imagined_right, run_study

STUDIES = {name: grid for name, grid in GRIDS.items() if isinstance(grid, Study)}
STUDY = Study(
    name="fakes",
    question="Is a table better than a table?",
    budgets=(3, 6),
    seeds=(1000, 1001),
    evaluation_episodes=4,
    appearance="clean",
    execution="kinematic",
    variants=(
        Variant(name="table", factor=BASE, agent="table"),
        Variant(name="mild", factor="appearance", agent="table", against="table", world={"appearance": "mild"}),
        Variant(name="imaginer", factor="agent", agent="imaginer", against="mild"),
    ),
)


def test_every_variant_is_run_once_and_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], expected: Expected
) -> None:
    launcher = Inline()
    lines = run_study(STUDY, "arrow_puzzle", root=tmp_path, launcher=launcher)
    assert [line.variant.name for line in lines] == ["table", "mild", "imaginer"]
    assert {job.spec.protocol.appearance for job in launcher.jobs[2:4]} == {"mild"}
    again = run_study(STUDY, "arrow_puzzle", root=tmp_path, launcher=launcher)
    assert len(launcher.jobs) == 6, "finished runs are not run again"
    assert [one.success.tolist() for one in lines] == [one.success.tolist() for one in again]
    write_page(tmp_path / "out", study_page(STUDY, lines))
    assert "also holds" not in capsys.readouterr().out
    (tmp_path / "out" / "former.png").touch()
    write_page(tmp_path / "out", study_page(STUDY, lines))
    assert "out also holds former.png, of an earlier report" in capsys.readouterr().out
    shares = np.array([[0.1, 0.2], [0.3, 0.4]])
    changes = tuple(Estimate(value, math.nan, math.nan) for value in (0.1, -0.2))
    right = dataclasses.replace(lines[1], imagined_right=shares, difference=changes)
    page = study_page(STUDY, [dataclasses.replace(lines[0], success=shares), right])
    expected("study", page_in_words(page).partition("How it was made")[0])
    rows = list(csv.DictReader(page.files["seeds.csv"].splitlines()))
    assert [row["success"] for row in rows][:4] == ["0.1", "0.2", "0.3", "0.4"]
    assert [row["imagined_right"] for row in rows][4:] == ["0.1000", "0.2000", "0.3000", "0.4000"]


def test_rows_of_a_study_are_those_of_its_runs_and_are_loaded(tmp_path: Path) -> None:
    table = Variant(name="table", agent="table")
    study = dataclasses.replace(STUDY, seeds=(1001, 1000), budgets=(15, 30), evaluation_episodes=40, variants=(table,))
    (line,) = run_study(study, "arrow_puzzle", root=tmp_path, launcher=Inline())
    kept = load_bench(line.folder)
    assert line.train_cpu_s == np.mean([run.checkpoints[-1].train_cpu_s for run in kept.runs]) > 0.0
    write_page(tmp_path / "out", study_page(study, [line]))
    frame = imagine_bench.load(tmp_path / "out").frame()
    told = zip(frame["seed"], frame["episodes"], frame["success"], strict=True)
    rates = {(run.seed, row.episodes): row.success_rate for run in kept.runs for row in run.checkpoints}
    assert {(seed, budget): rate for seed, budget, rate in told} == pytest.approx(rates, abs=1e-5)
    assert len(set(rates.values())) > 1 and set(frame["protocol"]) == {kept.protocol.hash}


def test_settings_in_the_name_of_an_agent_may_be_spelled_in_any_way(tmp_path: Path) -> None:
    spelled = Variant(name="slow", agent="count_table:controller.discount=0.90")
    study = dataclasses.replace(STUDY, seeds=(1000,), budgets=(1,), evaluation_episodes=1, variants=(spelled,))
    (line,) = run_study(study, "arrow_puzzle", root=tmp_path, launcher=Inline())
    assert line.success.shape == line.imagined_right.shape == (1, 1)


def test_a_difference_is_that_from_what_a_variant_is_compared_with(tmp_path: Path) -> None:
    optimal = Variant(name="optimal", factor="agent", agent="oracle", against="table")
    second = Variant(name="imaginer", factor="agent", agent="imaginer", against="optimal")
    five = (1000, 1001, 1002, 1003, 1004)
    study = dataclasses.replace(STUDY, seeds=five, variants=(STUDY.variants[0], optimal, second))
    lines = run_study(study, "arrow_puzzle", root=tmp_path, launcher=Inline())
    assert lines[0].difference is None and (lines[1].success == 1.0).all() and lines[0].success.min() < 1.0
    for base, line in itertools.pairwise(lines):
        both = zip(line.success.T, base.success.T, strict=True)
        assert line.difference == tuple(statistics.difference(*each, trials=study.evaluation_episodes) for each in both)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": (0, 1)}, r"chooses settings on seeds \(0, 1\); give seeds from 1000 on"),
        ({"seeds": (1001, 1001)}, r"^seeds \(1001, 1001\) must be one or more different integers"),
        ({"variants": STUDY.variants[:1] * 2}, "each name once"),
        ({"variants": STUDY.variants[1:]}, "'mild' is compared with 'table', which the study lacks"),
    ],
)
def test_a_study_that_would_deceive_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        dataclasses.replace(STUDY, **changes)  # type: ignore[arg-type]


_FILE = """
question = "Does a world that looks or feels otherwise matter?"
preset = "smoke"
budgets = [2]
seeds = [1000]
evaluation_episodes = 2

[[variants]]
name = "table"
agent = "table"

[[variants]]
name = "other looks"
factor = "appearance"
agent = "table"
against = "table"
world = { test_appearance = "strong", open_loop_starts = 5 }

[[variants]]
name = "slippery"
factor = "physics"
agent = "table"
against = "table"
world.execution = "physics"
world.physics = { pad_friction = 0.1 }
"""


def test_a_study_from_a_file_changes_the_world_too(tmp_path: Path) -> None:
    path, launcher = tmp_path / "mine.toml", Inline()
    path.write_text(_FILE)
    study = read_grid(path)
    assert (study.name, study.execution, study.variants[0].factor) == ("mine", "kinematic", BASE)
    run_study(study, "arrow_puzzle", root=tmp_path, launcher=launcher)
    planned = [job.spec.protocol for job in launcher.jobs]
    tests = [(each.budgets, each.evaluation_episodes, each.recorded_episodes) for each in planned]
    assert tests == [((2,), 2, 0)] * 3 and [each.open_loop_starts for each in planned] == [0, 5, 0]
    assert {(each.preset, each.seeds) for each in planned} == {("smoke", (1000,))}
    worlds = [(job.spec.protocol.appearance_in_words, job.spec.protocol.world) for job in launcher.jobs]
    assert worlds == [
        ("clean", {"execution": "kinematic"}), ("clean, tested at strong", {"execution": "kinematic"}),
        ("clean", {"execution": "physics", "physics": {"pad_friction": 0.1}}),
    ]  # fmt: skip
    (tmp_path / "mine.json").write_text(json.dumps(tomllib.loads(_FILE)))
    assert read_grid(tmp_path / "mine.json") == study
    twice = json.dumps(tomllib.loads(_FILE)).replace("{", '{"name": "first", ', 1)
    (tmp_path / "twice.json").write_text(twice[:-1] + ', "name": "second"}')
    with pytest.raises(InvalidValueError, match="is given twice"):
        read_grid(tmp_path / "twice.json")
    nested = 'settings = { controller.discount = 0.9, "controller.hidden" = [8, 8] }'
    path.write_text(f'{_FILE}[[variants]]\nname = "slow"\nagent = "dqn"\n{nested}\n')
    assert read_grid(path).variants[-1].settings == {"controller.discount": 0.9, "controller.hidden": (8, 8)}


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("budgets = [2]", "budgets = [true]", "budgets was given (True,); it takes a list, each item a whole number"),
        ("budgets = [2]", "budgets = [", "is no study: Invalid value (at"),
        ("test_appearance", "looks", "No field that a variant may change 'looks'"),
        ('preset = "smoke"', 'name = "a/b"', "a name is 1 to 60 letters"),
        ('[[variants]]', '[[variant]]', "'variants' is missing. Give name"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_study_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, sentence: str
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(_FILE.replace(old, new))
    assert main(["sweep", "arrow_puzzle", "--name", str(path)]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert sentence in said and str(path) in said


def test_chosen_variants_bring_what_they_are_compared_with() -> None:
    assert [variant.name for variant in STUDY.only(("imaginer",)).variants] == ["table", "mild", "imaginer"]
    assert STUDY.only(()) == STUDY
    with pytest.raises(UnknownNameError, match="No variant 'milld'"):
        STUDY.only(("milld",))


DIGESTS = {
    "factors": "783723911a58", "deviations": "9448576e1c0c", "ladder": "16c2e21e0136", "controller": "a461c222ed4c",
    "curiosity": "f24530419bb3", "uncertainty": "286a80f9b84c", "remarks": "234d3c347058", "smoke": "4d5a5ddbd8cc",
}  # fmt: skip
"""Of every study that kept results may name: its variants when they were made."""


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_is_that_of_kept_results_and_its_settings_exist(name: str) -> None:
    assert digest(dataclasses.asdict(STUDIES[name])) == DIGESTS[name]
    for variant in STUDIES[name].variants:
        settings = registry.load(registry.agent_entry(variant.agent).settings)
        changed = settings.resolve("fast", variant.settings, "chapter_5")
        assert (changed == settings.resolve("fast", {}, "chapter_5")) == (not variant.settings)


def test_what_isimagined_right_is_what_the_rules_have_too() -> None:
    task = registry.task("arrow_puzzle")
    states = states_of(task.rules)
    truth = true_model(task.rules, states)
    alive = [row for row, state in enumerate(states) if not task.rules.is_terminal(state)]
    macrostates = np.array(states)[truth.following]
    half = truth.p_continues.copy()
    half[alive[: len(alive) // 2]] = 0.0  # of these it expects that every macro-action ends the episode

    def tested(*shares: NDArray[np.float64] | None) -> Any:
        """A run that holds these beliefs on whether an episode goes on, a checkpoint each, and else the right ones."""
        checkpoints = []
        for each in shares:
            beliefs = None
            if each is not None:
                model = ExpectedOutcomes(macrostates=macrostates, p_continues=each, reward=truth.reward)
                beliefs = PolicyTable(action=np.zeros(len(states), dtype=np.int16), model=model)
            checkpoints.append(SimpleNamespace(beliefs=beliefs))
        return SimpleNamespace(checkpoints=checkpoints)

    found = imagined_right(task.rules, [tested(None, truth.p_continues), tested(half, np.zeros_like(half))])
    ends = (truth.p_continues.sum(axis=2) == 0.0)[alive]
    right = ends.copy()
    right[len(alive) // 2 :] = True
    assert 0.0 < ends.mean() < right.mean() < 1.0
    np.testing.assert_allclose(found, [[np.nan, 1.0], [right.mean(), ends.mean()]])


UNSTUDIED = {
    "imagination.weight_samples": "nothing is sampled where nothing is dropped",
    "imagination.end_episode": "after the last budget of a study",
}


def test_every_deviation_of_quick_is_undone_or_varied_by_a_study() -> None:
    varied = {name for study in STUDIES.values() for variant in study.variants for name in variant.settings}
    chapter_5 = HYPERPARAMETERS.groups["chapter_5"]
    deviations = set(chapter_5.sets["fast"])
    assert deviations - varied == UNSTUDIED.keys()
    for variant in STUDIES["deviations"].variants:
        for name, value in variant.settings.items():
            if name != "model.precision":  # the thesis' is that of the machine
                assert value == flatten(chapter_5.published)[name] != chapter_5.sets["fast"][name].value
