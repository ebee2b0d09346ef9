"""Trained agents are judged by their pictures: what they say those show counts for nothing."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_reader import BlindReader
from small_runs import Inline, small

from imagine_bench.errors import InvalidValueError
from imagine_bench.judge.models import study
from imagine_bench.judge.models.study import Judgement, judge, kept, shown
from imagine_bench.judge.models.trained import load_model, model_entry
from imagine_bench.report.judge import judgement_report
from imagine_bench.running import bench as benches


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The run of seed 0 of each agent; that of seed 1 lies beside it."""
    wanted = small(budgets=(2,), agents=("table", "imaginer"), seeds=(0, 1))
    result = benches.bench(wanted, {}, root=tmp_path_factory.mktemp("bench"), launcher=Inline())
    return {run.agent: run.folder for run in result.runs if run.seed == 0}


@pytest.fixture
def blind(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A reader that sees nothing, and few questions."""
    monkeypatch.setattr(study, "_reader", lambda spec, appearance, folder: BlindReader(len(spec.macrostate_names)))
    monkeypatch.setattr(study.asking, "STATES", 20)
    yield
    study._prepared.cache_clear()
    study._data.cache_clear()


def report(folder: Path, judgement: Judgement) -> str:
    errors = ("misread", "refused", "black_read", "gray_read", "noise_read", "blends_read")
    (folder / "reader.json").write_text(json.dumps(dict.fromkeys(errors, 0.0)))
    return judgement_report(folder, judgement)


@pytest.mark.usefixtures("blind")
def test_right_macrostates_beside_black_frames_are_fog(runs: dict[str, Path], tmp_path: Path) -> None:
    run = str(runs["imaginer"])
    judgement = Judgement(task="arrow_puzzle", models=(run, "copy"), sizes=(20, 40), seeds=(1000, 1001), samples=1)
    folder, failed = judge(judgement, tmp_path, workers=1)
    assert failed == []
    found = [cell for cell in kept(folder, judgement) if cell["model"] == run]
    assert [(cell["seed"], cell["transitions"]) for cell in found] == [(0, 40)], "it learns nothing here: once"
    assert found[0]["nothing"] == found[0]["total_variation"] == found[0]["after_the_end"] == 1.0
    assert found[0]["fit_s"] is None
    seen = found[0]["where"]["in its data"]
    assert set(seen) <= {"seen", "never"}
    assert "imaginer, seed 0  " in report(folder, judgement)
    page = (folder / "report/report.md").read_text()
    assert "Smallest total variation after 40 transitions: copy" in page and "then imaginer, seed 0 (1.00)" in page
    assert "by depth after 40 transitions" in page


@pytest.mark.usefixtures("blind")
def test_the_folder_of_an_agent_stands_for_all_its_runs(
    runs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, loaded = str(runs["imaginer"].parent), []
    monkeypatch.setattr(study, "load_model", lambda folder, task: loaded.append(folder) or load_model(folder, task))
    judgement = Judgement(task="arrow_puzzle", models=(agent,), sizes=(20, 40), seeds=(1000,), samples=1)
    folder, failed = judge(judgement, tmp_path, workers=1)
    assert failed == []
    assert [folder.name for folder in loaded] == ["seed_0", "seed_1"]
    assert [(cell["model"], cell["seed"]) for cell in kept(folder, judgement)] == [(agent, 0), (agent, 1)]
    assert not list(folder.glob("data-*")), "nothing is collected for what does not learn"
    assert list(shown(folder, judgement)) == [agent]
    (row,) = (line for line in report(folder, judgement).splitlines() if line.startswith("imaginer"))
    assert "seed" not in row
    page = (folder / "report/report.md").read_text()
    assert "after 40 transitions" not in page
    assert "How much data" not in page


@pytest.mark.usefixtures("blind")
def test_pictures_are_made_up_for_where_another_seed_is_shown(tmp_path: Path) -> None:
    for seeds in ((1000, 1001), (1001,)):
        judgement = Judgement(task="arrow_puzzle", models=("copy",), sizes=(20,), seeds=seeds, samples=1)
        folder, failed = judge(judgement, tmp_path, workers=1)
        assert failed == []
        assert shown(folder, judgement)["copy"]["seed"] == seeds[0]


def test_runs_that_cannot_be_judged_say_why(runs: dict[str, Path]) -> None:
    assert model_entry(str(runs["table"])).title == "table, seed 0"
    with pytest.raises(InvalidValueError, match="does not imagine"):
        load_model(runs["table"], "arrow_puzzle")
    with pytest.raises(InvalidValueError, match="learned arrow_puzzle, not pick_place"):
        load_model(runs["imaginer"], "pick_place")


def test_what_it_experienced_is_what_the_bench_counted(runs: dict[str, Path]) -> None:
    visited = load_model(runs["imaginer"], "arrow_puzzle").visited
    assert 0 < len(visited) <= 2 * 20
    assert all(len(state) == 4 and 0 <= action < 6 for state, action in visited)
