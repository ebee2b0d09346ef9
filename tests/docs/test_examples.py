"""The examples run: in this process on small benches, and, slowly, as the scripts that they are."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest
from doc_cells import ROOT
from small_runs import Inline

from imagine_bench import registry
from imagine_bench.bench.bench import bench, plan
from imagine_bench.protocols.control import Protocol
from imagine_bench.store.results import BenchResult
from imagine_bench.studies.study import _plan, load_study
from imagine_bench.testing.contract import checks, report

EXAMPLES = ROOT / "docs" / "examples"
_FEW = {"execution": "kinematic", "open_loop_starts": 0, "recorded_episodes": 0}


@pytest.fixture
def example(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(EXAMPLES)
    tasks, agents = dict(registry.TASKS), dict(registry.AGENTS)
    monkeypatch.delitem(sys.modules, request.param, raising=False)
    yield importlib.import_module(request.param)
    for table, before in ((registry.TASKS, tasks), (registry.AGENTS, agents)):
        table.clear()
        table.update(before)  # type: ignore[arg-type]
    gymnasium.registry.pop("own/Corridor-v0", None)


def run(tmp_path: Path, task: str, agent: str, **changes: object) -> BenchResult:
    wanted, paths = plan(task, "smoke", agents=(agent,), **{**_FEW, **changes})
    result = bench(wanted, paths, root=tmp_path, launcher=Inline())
    assert isinstance(result, BenchResult)
    return result


@pytest.mark.parametrize("example", ["own_agent"], indirect=True)
def test_the_agent_keeps_the_contract_and_learns(example: ModuleType, tmp_path: Path) -> None:
    assert report(checks(agent="own_agent")) == 0
    found = run(tmp_path, "pick_place", "own_agent", budgets=(5, 500), evaluation_episodes=50)
    few, many = found.success_rates("own_agent")[0]
    assert many > 0.6 > 2 * few


@pytest.mark.parametrize("example", ["own_task"], indirect=True)
def test_the_task_keeps_the_contract(example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report(checks("corridor")) == 0
    assert capsys.readouterr().out.count("ok  ") == 6  # its state cannot be kept, which is no duty
    found = run(tmp_path, "corridor", "oracle", budgets=(2,), evaluation_episodes=50)
    assert found.success_rates("oracle")[0, 0] >= registry.task("corridor").facts().optimum - 0.05 > 0.9


@pytest.mark.parametrize("example", ["own_world_model"], indirect=True)
def test_the_world_model_is_held_against_the_truth(example: ModuleType, tmp_path: Path) -> None:
    found = run(tmp_path, "pick_place", "own_model", budgets=(5, 100), evaluation_episodes=20, sampled_futures=4)
    first, last = (row.futures for row in found.runs[0].checkpoints)
    assert first is not None and last is not None
    assert first.total_variation.mean() > 2 * last.total_variation.mean()
    assert np.abs(last.total_variation - last.sampling_noise_floor).mean() < 0.2
    assert found.success_rates("own_model")[0, 1] > 0.8


def test_the_study_on_a_page_could_be_run(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "how_to" / "add_agent.md").read_text()
    (text,) = re.findall(r"^```toml\n(question.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "mine.toml").write_text(text)
    study = load_study(tmp_path / "mine.toml")
    found = [_plan(study, "arrow_puzzle", variant)[0] for variant in study.variants]
    assert [(dict(each.overrides), each.looks) for each in found if isinstance(each, Protocol)] == [
        ({}, "clean"), ({"controller.discount": 0.9}, "clean"), ({}, "clean, tested at strong"),
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "agents"),
    [("own_agent", "random own_agent"), ("own_task", "random oracle"), ("own_world_model", "dqn own_model")],
)
def test_scripts_run(name: str, agents: str, tmp_path: Path) -> None:
    words = f"--budgets 3 --evaluation-episodes 3 --seeds 1 --out {tmp_path} --agents {agents}".split()
    script = [sys.executable, EXAMPLES / f"{name}.py", *words]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Report:" in done.stdout and len(list(tmp_path.glob("*/*/*/seed_1/DONE"))) == 2
