"""Why a bench's agents failed: every failure of every test is in the table, once, and the report shows it."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from small_runs import Inline, small
from whole_outputs import Expected, masked

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ArtefactError, ImagineBenchError
from imagine_bench.interfaces import Agent, AgentContext, TaskSpec
from imagine_bench.judge import causes
from imagine_bench.judge.causes import CAUSES, FORMER_CAUSES, beliefs, frames_to_ask_with, misread
from imagine_bench.report.page import Page, texts
from imagine_bench.report.sections import causes_table, read_causes
from imagine_bench.rules import states_of
from imagine_bench.running.bench import bench, load_bench
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders
from imagine_bench.store.files import make_folder, write_bytes
from imagine_bench.tools import audits
from imagine_bench.tools.audits import verify, why_report

SPEC = registry.task("arrow_puzzle")


def write_texts(folder: Path, page: Page) -> None:
    """A report without images, which are slow to draw."""
    for name, text in texts(page, images=False).items():
        write_bytes(make_folder(folder) / name, text.encode())


def test_the_shares_of_a_bench_sum_to_all_failures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, expected: Expected
) -> None:
    monkeypatch.setattr(audits, "write_page", write_texts)
    wanted = small(agents=("table", "random"), seeds=(0, 1), evaluation_episodes=12)
    folder = bench(wanted, {}, root=tmp_path, launcher=Inline()).folder
    said = why_report(folder, root=tmp_path, task=None, encoder=None)
    with (folder / "why" / "causes.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected("why", masked(f"{said}\n{(folder / 'why' / 'causes.csv').read_text()}", tmp_path))
    result = load_bench(folder)
    for run in result.of("table"):  # type: ignore[union-attr]
        for row in run.checkpoints:
            mine = [r for r in rows if (int(r["seed"]), int(r["episodes"])) == (run.seed, row.episodes) and r["cause"]]
            failed = [test for test, each in enumerate(row.solved) if each == "0"]
            assert [int(r["test"]) for r in mine] == failed and {r["cause"] for r in mine} <= set(CAUSES)
    assert {row["agent"] for row in rows} == {"table"}, "one that does not learn has nothing to explain"
    for line in read_causes(folder).rows:
        shares = [float(str(cell)) for cell in line[3:]]
        assert abs(sum(shares) - 100.0) < 0.2
        mine = [row["cause"] for row in rows if row["episodes"] == line[1] and row["cause"]]
        assert line[2] == f"{len(mine)} of {2 * 12}"
        assert shares == [round(100 * mine.count(name) / len(mine), 1) for name in CAUSES]
    assert "\ntable " in said and 'id="causes"' in (folder / "report" / "index.html").read_text()
    assert not any(each.complaint for each in verify(folder)), "the report with its causes follows from the runs"


def test_tests_in_which_nothing_failed_are_counted_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 7 tests after 4 episodes two failed, and after 9 none: the table says so, and shares are of failures."""
    found = [
        causes.Tested(episodes=4, tests=7, causes={1: next(iter(CAUSES)), 5: next(iter(CAUSES))}),
        causes.Tested(episodes=9, tests=7, causes={}),
    ]
    monkeypatch.setattr(audits, "write_page", lambda folder, page: None)
    monkeypatch.setattr(audits, "causes_of", lambda trained: found)
    folder = bench(small(evaluation_episodes=1), {}, root=tmp_path, launcher=Inline()).folder
    why_report(folder, root=tmp_path, task=None, encoder=None)
    assert [line[1:3] for line in read_causes(folder).rows] == [["4", "2 of 7"], ["9", "0 of 7"]]


@pytest.mark.parametrize("former", FORMER_CAUSES)
def test_a_cause_by_its_former_name_counts_as_the_one_of_today(former: str) -> None:
    then, now = (causes_table([("dqn", 0, 5, 9, 1, cause)]).rows for cause in (former, FORMER_CAUSES[former]))
    assert then == now
    assert former not in CAUSES


def test_a_run_that_keeps_no_episodes_is_one_sentence(tmp_path: Path) -> None:
    folder = bench(small(), {}, root=tmp_path, launcher=Inline()).folder
    (folder / "table" / "seed_0" / "DONE").unlink()
    with pytest.raises(ArtefactError, match="is not finished; give the bench command again"):
        why_report(folder, root=tmp_path, task=None, encoder=None)
    (folder / "why").mkdir(exist_ok=True)
    (folder / "why" / "causes.csv").write_text("agent,cause\n")
    with pytest.raises(ImagineBenchError, match="not a table of causes"):
        read_causes(folder)


def learner(name: str, spec: TaskSpec) -> Agent:
    entry = registry.agent_entry(name)
    encoder = encoders.own(spec, "clean", entry.encoder_kind)
    context = AgentContext(
        n_actions=spec.n_actions, preprocessing=spec.preprocessing, encoder=encoder, seeds=SeedTree(1000).child(name)
    )
    return registry.make_agent(name, context)


@pytest.mark.parametrize("name", ["dqn", "imagination", "imagination_uncertainty", "factored:given", "count_table"])
def test_an_agent_says_what_it_reads_and_expects(name: str) -> None:
    agent, states = learner(name, SPEC), np.array(states_of(SPEC.rules))
    before = agent.state()
    frames = frames_to_ask_with(agent, SPEC, appearance="clean", purpose="evaluation")
    asked = frames.any(axis=(1, 2, 3))
    assert not misread(agent, frames[asked], states[asked]).any()
    held = beliefs(agent, SPEC.rules, frames, np.random.default_rng(0), privileged=False)
    assert held.action.shape == (192,) and (held.model is None) == (name == "dqn")
    if held.model is not None:
        assert held.model.macrostates.shape[:2] == held.model.reward.shape == (192, 6)
        assert held.model.macrostates.shape[:3] == held.model.p_continues.shape
        assert (held.model.p_continues >= 0).all() and (held.model.p_continues.sum(axis=2) < 1.0001).all()
    after = agent.state()
    assert {**before.values, "meters": 0} == {
        **after.values,
        "meters": 0,
    } and before.arrays.keys() == after.arrays.keys()
    assert all(np.array_equal(array, after.arrays[name]) for name, array in before.arrays.items())


@pytest.mark.parametrize(
    ("folder", "complaint"),
    [
        ("docs/results/arrow_puzzle_hard-thesis", "holds kept results and no agents; give a bench's own folder"),
        ("docs/results/toy_regression-thesis", "in which no agent acts"),
    ],
)
def test_folders_without_agents_are_named(
    folder: str, complaint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])
    assert main(["why", folder]) == 2
    assert complaint in capsys.readouterr().err
