"""A suite of small experiments: fixed by its hash, resumable, and open to agents of other packages."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from pathlib import Path

import numpy as np
import pytest
from report_pages import page_in_words
from small_runs import Inline
from whole_outputs import masked

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, InvalidValueError, UnableError
from imagine_bench.exact.splits import split_of
from imagine_bench.report.page import texts
from imagine_bench.report.sweep import levels_csv, scores_csv, suite_page
from imagine_bench.running.bench import load_bench
from imagine_bench.store.bench_folder import read_control
from imagine_bench.sweep import grid
from imagine_bench.sweep.grid import GRIDS, SUITE, Experiment, Level, Suite
from imagine_bench.sweep.run import LevelResult, SuiteResult, plan_level, run_suite
from imagine_bench.sweep.score import Scale

RESULTS = Path(__file__).parents[2] / "docs" / "results"
TINY = Suite(
    name="tiny",
    experiments=(
        Experiment(
            name="stochasticity", parameter="slip", question="?",
            levels=(Level(name="0", task="arrows", episodes=5), Level(name="0.3", task="arrows:slip=0.3", episodes=5)),
        ),
        Experiment(name="size", parameter="cubes", question="?", levels=(Level(name="3", task="arrows", episodes=5),)),
        Experiment(
            name="transfer", parameter="goal", question="?",
            levels=(
                Level(
                    name="hard", task="arrow_puzzle_hard", episodes=5,
                    protocol={"after": ("arrow_puzzle",), "after_episodes": 3},
                ),
            ),
        ),
        Experiment(
            name="uncertainty", parameter="real episodes", question="?", measure="auroc",
            levels=(Level(name="5", task="arrows", episodes=5, protocol={"open_loop_starts": 4}),),
        ),
    ),
    evaluation_episodes=10, hyperparameters="minimal",
)  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def result(root):
    return run_suite(TINY, ("random", "oracle", "table"), root=root, launcher=Inline())


def _without_times(text):
    return [
        {name: value for name, value in row.items() if name != "cpu_s"} for row in csv.DictReader(io.StringIO(text))
    ]


@pytest.mark.parametrize(("measure", "is_of_tests"), [("success", True), ("auroc", False)])
def test_the_number_of_tests_widens_intervals_of_success_alone(measure, is_of_tests):
    """An AUROC is no share of the tests: its interval is that over seeds, and one seed has none."""
    level = Level(name="a", task="arrows", protocol={"open_loop_starts": 1})
    experiment = Experiment(name="a", parameter="p", question="?", levels=(level,), measure=measure)
    scale = Scale(chance=0.5, optimum=1.0)

    def interval(tests, *values):
        suite = Suite(name="own", experiments=(experiment,), evaluation_episodes=tests)
        found = LevelResult(level=level, values=np.array(values), benches=(), scale=scale)
        score = SuiteResult(suite=suite, agents=("dqn",), levels={("a", "dqn"): (found,)}).score(experiment, "dqn")
        return score.low, score.high

    assert all(np.isnan(interval(10, 0.8))) != is_of_tests
    alike = [0.8, 0.8, 0.8, 0.81, 0.8, 0.8, 0.8]
    few, many = interval(10, *alike), interval(10_000, *alike)
    assert (few != many) == is_of_tests
    assert few[0] <= many[0] < many[1] <= few[1]


def test_rows_name_the_seeds_of_their_benches(tmp_path):
    suite = dataclasses.replace(TINY, seeds=(1, 0), experiments=TINY.experiments[1:2])
    found = run_suite(suite, ("random",), root=tmp_path, launcher=Inline())
    rows = list(csv.DictReader(io.StringIO(levels_csv(found))))
    runs = {row["seed"]: read_control(tmp_path / row["bench"]).seeds for row in rows}
    assert runs == {"0": (0,), "1": (1,)}
    (level,) = found.levels["size", "random"]
    costly = {("size", "random"): (dataclasses.replace(level, train_cpu_s=12.34),)}
    rows = csv.DictReader(io.StringIO(levels_csv(dataclasses.replace(found, levels=costly))))
    assert {(row["task"], row["cpu_s"]) for row in rows} == {("arrows", "12.3")}


def test_a_level_of_several_budgets_counts_at_the_last(tmp_path):
    level = Level(name="3", task="arrows", episodes=30, protocol={"budgets": [2, 30]})
    size = dataclasses.replace(TINY.experiments[1], levels=(level,))
    suite = dataclasses.replace(TINY, seeds=(0,), evaluation_episodes=40, experiments=(size,))
    (found,) = run_suite(suite, ("table",), root=tmp_path, launcher=Inline()).levels["size", "table"]
    (run,) = load_bench(tmp_path / found.benches[0]).runs
    first, last = run.checkpoints
    assert (found.values.tolist(), found.train_cpu_s) == ([last.success_rate], last.train_cpu_s)
    assert first.success_rate != last.success_rate


def test_experiments_share_a_level(result, root):
    (size,) = result.levels["size", "table"]
    stochasticity, _ = result.levels["stochasticity", "table"]
    assert size.benches == stochasticity.benches and np.array_equal(size.values, stochasticity.values)
    rows = [run.checkpoints[-1] for bench in size.benches for run in load_bench(root / bench).runs]
    assert size.train_cpu_s == np.mean([row.train_cpu_s for row in rows]) > 0.0 and len(rows) == 2
    (uncertainty,) = result.levels["uncertainty", "table"]
    assert set(uncertainty.benches).isdisjoint(size.benches)


def test_an_interrupted_suite_ends_in_the_same_numbers(result, tmp_path):
    suite, agents = TINY.only(["size", "transfer"]), ("oracle", "table")
    with pytest.raises(KeyboardInterrupt):
        run_suite(suite, agents, root=tmp_path, launcher=Inline(patience=3))
    launcher = Inline()
    again = run_suite(suite, agents, root=tmp_path, launcher=launcher)
    assert len(launcher.order) == 2 * 2 * 2 - 3  # runs of two seeds, levels and agents
    kept = [row for row in _without_times(levels_csv(result)) if row["agent"] in agents]
    assert _without_times(levels_csv(again)) == [row for row in kept if row["experiment"] in ("size", "transfer")]
    launcher = Inline()
    first = run_suite(dataclasses.replace(suite, seeds=(1,)), agents, root=tmp_path, launcher=launcher)
    assert first.levels["size", "table"][0].values == again.levels["size", "table"][0].values[1]
    assert scores_csv(run_suite(suite, agents, root=tmp_path, launcher=launcher)) == scores_csv(again)
    assert launcher.order == []


def test_a_failing_agent_costs_the_others_nothing(tmp_path):
    suite = TINY.only(["size"])
    found = run_suite(suite, ("failing", "oracle"), root=tmp_path, launcher=Inline())
    assert ["failing seed 1 in arrows: this agent breaks on purpose" in each for each in found.failures] == [True]
    assert np.isnan(found.score(suite.experiments[0], "failing").value)
    assert found.score(suite.experiments[0], "oracle").value == 1.0


def test_the_page_shows_every_score_and_the_hash(result, expected):
    page = suite_page(result)
    text = page_in_words(page).partition("How it was made")[0]
    expected("suite", masked(text.partition("training of all levels")[0]))
    (section,) = page.sections
    cells = [row[1:] for row in section.tables[0].rows[:-1]]
    scores = list(csv.DictReader(io.StringIO(page.files["scores.csv"])))
    shown = [f"{float(row['score']):.2f}".replace("-", "\u2212") if row["score"] else "–" for row in scores]
    assert [cell.split()[0] for row in cells for cell in row] == shown
    assert TINY.hash in texts(page)["index.html"]
    changed = {}
    for key, levels in result.levels.items():
        changed[key] = tuple(
            dataclasses.replace(each, train_cpu_s=10.0, environment={"commit": f"of {each.level.name}"})
            for each in levels
        )
    page = suite_page(dataclasses.replace(result, levels=changed))
    assert page.facts["commits of all benches"] == "of 0, of 0.3, of 3, of 5, of hard"
    runs = len(TINY.seeds) * sum(len(each.levels) for each in TINY.experiments)
    assert page.table.rows[-1][1:] == [f"{10.0 * runs:.1f}"] * 3


def test_the_suite_is_that_of_all_kept_scores():
    kept = json.loads((RESULTS / "suite" / "suite.json").read_text())
    assert GRIDS[SUITE].hash == kept["hash"] == "95bb5d4a0450" and len(GRIDS[SUITE].experiments) == 12


def test_a_suite_may_call_its_parameter_a_dial_as_before(tmp_path):
    today = (Path(grid.__file__).parent / "grids/suite.toml").read_text()
    (tmp_path / "suite.toml").write_text(today.replace("\nparameter = ", "\ndial = "))
    assert "\nparameter" not in (tmp_path / "suite.toml").read_text()
    assert grid.read_grid(tmp_path / "suite.toml") == GRIDS[SUITE]


def test_any_change_of_any_level_changes_the_hash():
    first, *others = GRIDS[SUITE].experiments
    hashes = {GRIDS[SUITE].hash}
    for change in ({"name": "other"}, {"task": "pick_place"}, {"episodes": 7}, {"protocol": {"queries": 1}}):
        levels = (*first.levels[:-1], dataclasses.replace(first.levels[-1], **change))
        changed = dataclasses.replace(first, levels=levels)
        hashes.add(dataclasses.replace(GRIDS[SUITE], experiments=(changed, *others)).hash)
    for change in ({"seeds": (2,)}, {"evaluation_episodes": 7}, {"execution": "physics"}, {"hyperparameters": "own"}):
        hashes.add(dataclasses.replace(GRIDS[SUITE], **change).hash)
    assert len(hashes) == 9


def test_every_level_is_a_world_in_which_something_can_be_learned():
    for each in GRIDS[SUITE].experiments:
        assert 3 <= len(each.levels) <= 5
        for level in each.levels:
            assert registry.task_name(level.task) == level.task
            if (split := level.protocol.get("split")) is not None:
                assert split_of(registry.task(level.task).rules, split).test


def test_separating_names_its_agents_and_hides_the_changed_rule():
    separating = GRIDS["separating"]
    assert separating.agents != GRIDS[SUITE].agents and {"dqn", "lewm", "laws:given"} < set(separating.agents)
    assert dataclasses.replace(separating, agents=("dqn",)).hash == separating.hash
    by_name = {each.name: each.levels for each in separating.experiments}
    for level in (level for name, levels in by_name.items() for level in levels if name != "changed_rule"):
        (planned, _), *others = plan_level(separating, level, "sb3_dqn")
        assert len(others) == 2 and planned.seeds == (400,) and planned.budgets[-1] == level.episodes
    told = [plan_level(separating, by_name["changed_rule"][0], agent)[0][0] for agent in ("dqn", "random")]
    assert [(each.after, each.unannounced) for each in told] == [(("arrow_puzzle",), True), ((), False)]
    with pytest.raises(UnableError, match=r"'sb3_dqn' .*, or that agent"):
        plan_level(separating, by_name["changed_rule"][0], "sb3_dqn")


def test_who_cannot_carry_over_starts_anew():
    """With all else as the suite says."""
    level = TINY.experiments[2].levels[0]
    suite = dataclasses.replace(TINY, seeds=(3, 5), execution="physics")
    of_suite = {name: getattr(suite, name) for name in ("execution", "evaluation_episodes", "hyperparameters")}
    for agent, after in (("table", ()), ("factored:given", ("arrow_puzzle",))):
        planned = [each for each, _ in plan_level(suite, level, agent)]
        assert [(each.seeds, each.after) for each in planned] == [((3,), after), ((5,), after)]
        wanted = {**of_suite, "budgets": (5,), "open_loop_starts": 0, "recorded_episodes": 0}
        assert all(vars(each).items() >= wanted.items() for each in planned)


def test_a_level_keeps_the_world_that_a_file_described(tmp_path):
    world = tmp_path / "world.json"
    made = []
    for cubes in (1, 2):
        world.write_text(json.dumps({"cubes": cubes}))
        levels = (Level(name="a", task=f"arrows:@{world}"),)
        made.append(Suite(name="own", experiments=(Experiment(name="a", parameter="p", question="?", levels=levels),)))
    assert [each.experiments[0].levels[0].task for each in made] == ["arrows:cubes=1", "arrows:cubes=2"]
    assert made[0].hash != made[1].hash


def test_settings_of_physics_are_a_table_in_a_level():
    fields = {"physics": {"pad_friction": 0.5}, "execution": "physics"}
    ((planned, _), *_) = plan_level(TINY, Level(name="smooth", task="arrows", protocol=fields), "table")
    assert planned.physics == (("pad_friction", 0.5),)
    for wrong in (["pad_friction=0.5"], "pad_friction=0.5", [["pad_friction"]], 1):
        level = Level(name="smooth", task="arrows", protocol={**fields, "physics": wrong})
        with pytest.raises(InvalidValueError, match=r"^physics is .*; give a table of settings, such as pad_friction"):
            plan_level(TINY, level, "table")


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"evaluation_episodes": 5}, "No field that a level may change 'evaluation_episodes'"),
        ({"seeds": (3, 4)}, "No field that a level may change 'seeds'"),
        ({"budgets": (10, 20)}, "Level '3' has 250 episodes; give budgets that end there"),
        ({"after": ("pick_place",)}, "cannot come after pick_place"),
        ({}, r"its levels \['3'\] have no rollouts to measure"),
    ],
)
def test_a_level_that_its_scores_would_misstate_is_refused(fields, sentence):
    with pytest.raises(ImagineBenchError, match=sentence):
        level = Level(name="3", task="arrows", protocol=fields)
        plan_level(TINY, level, "table")
        Experiment(name="uncertainty", parameter="episodes", question="?", measure="auroc", levels=(level,))


@pytest.mark.parametrize("seeds", [(), (1, 1), (-1,), (0, 1000), tuple(range(1200))])
def test_seeds_that_no_bench_takes_are_refused_by_a_suite_in_a_sentence(seeds):
    said = r"^seeds .* (must be one or more different integers|mix tuning seeds)"
    with pytest.raises(InvalidValueError, match=said) as refused:
        dataclasses.replace(TINY, seeds=seeds)
    assert len(str(refused.value)) < 300
    assert dataclasses.replace(TINY, seeds=(3, 0, 2)).seeds == (0, 2, 3)
