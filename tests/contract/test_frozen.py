"""Two packages of others, written against the state of November 27 and never edited since: they work unmodified.

``five_cubes`` has two tasks, one of which hides something; ``recaller`` an agent with a model, and a world model.
"""

from __future__ import annotations

import hashlib
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_reader import read_nothing
from guest_packages import Guests
from small_runs import benched

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.judge import judgement
from imagine_bench.running.trained import load_trained
from imagine_bench.store.results import RunResult

FROZEN = Path(__file__).parent / "frozen"
DIGESTS = {
    "five_cubes": "b333473325566343386f517b8f2a6abf4b611011adec2e4121aaa78cbc175f59",
    "recaller": "2d7058650b54f25b78266a75390719ac50ac611fd649ee59f609484bd072c656",
}
"""SHA-256 of each package's files. A package that has to be edited is a contract that was broken."""


def digest(folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.suffix in (".py", ".toml"))
    content = b"".join(path.relative_to(folder).as_posix().encode() + path.read_bytes() for path in files)
    return hashlib.sha256(content).hexdigest()


@pytest.fixture(scope="module", autouse=True)
def _installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Both packages, as pip would leave them."""
    site = tmp_path_factory.mktemp("site")
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # old paths warn
        guests = Guests(site, patch)
        for name in DIGESTS:
            guests.add(shutil.copytree(FROZEN / name, site / name, ignore=shutil.ignore_patterns("__pycache__")))
        registry.offers(registry.AGENT_GROUP)
        registry.offers(registry.WORLD_MODEL_GROUP)
        for module in ("recaller.agent", "recaller.model"):
            registry.load(module)
        yield
        guests.forget()


@pytest.mark.parametrize("name", DIGESTS)
def test_a_frozen_package_is_as_it_was_written(name: str) -> None:
    assert digest(FROZEN / name) == DIGESTS[name]


@pytest.mark.parametrize(
    "words",
    [
        "--task five_cubes",
        "--task five_cubes_covered",
        "--agent recaller",
        "--model recall --task five_cubes",
    ],
)
def test_a_frozen_package_passes_check(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", *words.split()]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) >= 3 and {line.split()[0] for line in lines} <= {"ok", "none"}, "none is not offered or refused"


@pytest.mark.parametrize(
    "task", ["five_cubes", pytest.param("five_cubes_covered", marks=pytest.mark.slow)]
)  # the exact facts of a world that hides something take half a minute
def test_the_frozen_worlds_are_benched(task: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = benched(tmp_path, task, "random", "oracle", budgets=(5,), evaluation_episodes=10)
    solved = {run.agent: run.checkpoints[-1].success_rate for run in result.runs}
    assert solved["oracle"] > 0.8 > solved["random"], "the optimum is at least 0.95, chance 0.15"
    assert main(["report", str(result.folder)]) == 0
    assert "chance level" in capsys.readouterr().out


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """The frozen agent after twelve episodes, with one setting of its own."""
    few = {"budgets": (12,), "evaluation_episodes": 2, "open_loop_starts": 2, "recorded_episodes": 1}
    folder = tmp_path_factory.mktemp("runs")
    return benched(folder, "arrow_puzzle", "recaller:recalling.depth=5", seeds=(0,), **few).runs[0]


def test_the_frozen_agent_is_benched_with_what_it_imagines(learned: RunResult) -> None:
    row = learned.checkpoints[-1]
    assert row.diagnostics["imagination/transitions"] > 0.0 and row.diagnostics["known_states"] > 10.0
    assert row.open_loop is not None
    assert (learned.folder / "recording.rrd").stat().st_size > 10_000
    assert load_trained(learned.folder).agent.settings.recalling.depth == 5


@pytest.fixture
def _blind(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A reader that costs nothing and reads the same from every image."""

    monkeypatch.setattr(judgement, "reader_in", read_nothing)
    yield
    judgement.prepare.cache_clear()
    judgement.data_of.cache_clear()


@pytest.mark.parametrize(
    "task",
    ["five_cubes", *(pytest.param(task, marks=pytest.mark.slow) for task in ("arrow_puzzle", "the agent's run"))],
)
@pytest.mark.usefixtures("_blind")
def test_the_frozen_model_and_run_are_judged(
    task: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest
) -> None:
    model = "recall"
    if task == "the agent's run":
        task, model = "arrow_puzzle", str(request.getfixturevalue("learned").folder)
    few = "--sizes 30 --seeds 1000 --samples 2 --workers 1".split()
    assert main(["judge", "--task", task, "--models", model, *few, "--out", str(tmp_path)]) == 0
    assert "recall" in capsys.readouterr().out
