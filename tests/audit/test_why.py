"""Why a bench's agents failed: every failure of every test is in the table, once, and the report shows it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_runs import made_bench, small
from whole_outputs import Expected, masked

from imagine_bench import registry
from imagine_bench.arrays import Bools, Ints
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ArtefactError, ImagineBenchError
from imagine_bench.interfaces import AgentContext, TaskSpec
from imagine_bench.judge import causes
from imagine_bench.judge.causes import CAUSES, FORMER_CAUSES, beliefs, frames_to_ask_with, misread
from imagine_bench.report.page import Page, texts
from imagine_bench.report.sections import causes_table, read_causes
from imagine_bench.rules import states_of
from imagine_bench.running.trained import load_trained
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders
from imagine_bench.store.files import make_folder, write_bytes
from imagine_bench.store.results import PolicyTable
from imagine_bench.store.run_folder import load_run
from imagine_bench.testing.checks import same_arrays
from imagine_bench.tools import audits
from imagine_bench.tools.audits import verify, why_report

SPEC = registry.task("arrow_puzzle")


def write_texts(folder: Path, page: Page) -> None:
    """A report without images, which are slow to draw."""
    for name, text in texts(page, images=False).items():
        write_bytes(make_folder(folder) / name, text.encode())


def explained(folder: Path) -> str:
    return why_report(folder, root=folder.parents[1], task=None, encoder=None)


def test_the_causes_of_a_bench_are_in_its_table_and_on_its_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, expected: Expected
) -> None:
    monkeypatch.setattr(audits, "write_page", write_texts)
    wanted = small(agents=("table", "random"), seeds=(0, 1), evaluation_episodes=12)
    folder = made_bench(wanted, tmp_path).folder
    said = explained(folder)
    text = (folder / "why" / "causes.csv").read_text()
    expected("why", masked(f"{said}\n{text}", tmp_path))
    assert "\ntable " in said and 'id="causes"' in (folder / "report" / "index.html").read_text()
    assert not any(each.complaint for each in verify(folder)), "the report with its causes follows from the runs"


def test_experience_at_a_budget_is_that_of_the_episodes_before_it(
    pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the first of two budgets it is that of a run that ends there."""
    given = []
    real = causes.Attribution

    def attribution(spec: TaskSpec, held: PolicyTable, tried: Ints, readable: Bools) -> causes.Attribution:
        given.append(tried.tolist())
        return real(spec, held, tried, readable)

    monkeypatch.setattr(causes, "Attribution", attribution)
    causes.causes_of(load_trained(pair / "table" / "seed_0"))
    first = small(agents=("table",), seeds=(0,), budgets=(4,), evaluation_episodes=8)
    ended = made_bench(first, tmp_path).folder
    tried = load_run(ended / "table" / "seed_0").tried
    assert tried is not None
    assert given[0] == tried[:, :-1].tolist()
    assert len(given[0]) < len(given[1])


def test_tests_in_which_nothing_failed_are_counted_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 7 tests after 4 episodes two failed, and after 9 none: the table says so, and shares are of failures.

    A run that is not finished, and a table that is none, are a sentence each.
    """
    some = dict.fromkeys((1, 5), next(iter(CAUSES)))
    found = [causes.Tested(episodes=4, tests=7, causes=some), causes.Tested(episodes=9, tests=7, causes={})]
    monkeypatch.setattr(audits, "write_page", lambda folder, page: None)
    monkeypatch.setattr(audits, "causes_of", lambda trained: found)
    folder = made_bench(small(evaluation_episodes=1), tmp_path).folder
    explained(folder)
    assert [line[1:3] for line in read_causes(folder).rows] == [["4", "2 of 7"], ["9", "0 of 7"]]
    monkeypatch.undo()
    (folder / "table" / "seed_0" / "DONE").unlink()
    with pytest.raises(ArtefactError, match="is not finished; give the bench command again"):
        explained(folder)
    (folder / "why" / "causes.csv").write_text("agent,cause\n")
    with pytest.raises(ImagineBenchError, match="not a table of causes"):
        read_causes(folder)


def test_shares_are_those_of_the_failures_of_all_seeds_at_a_budget() -> None:
    """Counted by hand; a row without a cause is a budget at which nothing failed."""
    failures = {("dqn", 0, 100, 40): ["values"] * 3 + ["misread"], ("dqn", 1, 100, 60): ["values", "unlucky"],
                ("dqn", 0, 200, 40): [""], ("dqn", 1, 200, 60): ["unlucky"], ("oracle", 0, 0, 50): [""]}  # fmt: skip
    rows = [(*run, test, cause) for run, found in failures.items() for test, cause in enumerate(found)]
    table = causes_table(rows)
    header = [str(each) for each in table.header]
    found = {tuple(row[:3]): dict(zip(header[3:], row[3:], strict=True)) for row in table.rows}
    named = dict.fromkeys([f"{cause}, %" for cause in CAUSES], "0.0")
    assert found == {
        ("dqn", "100", "6 of 100"): {**named, "values, %": "66.7", "misread, %": "16.7", "unlucky, %": "16.7"},
        ("dqn", "200", "1 of 100"): {**named, "unlucky, %": "100.0"},
        ("oracle", "0", "0 of 50"): dict.fromkeys(named, "–"),
    }


@pytest.mark.parametrize("former", FORMER_CAUSES)
def test_a_cause_by_its_former_name_counts_as_the_one_of_today(former: str) -> None:
    then, now = (causes_table([("dqn", 0, 5, 9, 1, cause)]).rows for cause in (former, FORMER_CAUSES[former]))
    assert then == now
    assert former not in CAUSES


@pytest.mark.parametrize("name", ["dqn", "imagination_uncertainty", "factored:given", "count_table"])
def test_an_agent_says_what_it_reads_and_expects(name: str) -> None:
    kind = registry.agent_entry(name).encoder_kind
    context = AgentContext(
        n_actions=SPEC.n_actions, preprocessing=SPEC.preprocessing, encoder=encoders.own(SPEC, "clean", kind),
        seeds=SeedTree(1000).child(name),
    )  # fmt: skip
    agent = registry.make_agent(name, context)
    states = np.array(states_of(SPEC.rules))
    before = agent.state()
    frames = frames_to_ask_with(agent, SPEC, appearance="clean", purpose="evaluation")
    asked = frames.any(axis=(1, 2, 3))
    assert not misread(agent, frames[asked], states[asked]).any()
    held = beliefs(agent, SPEC.rules, frames, np.random.default_rng(0), privileged=False)
    assert held.action.shape == (192,) and (held.model is None) == (name == "dqn")
    if held.model is not None:
        assert held.model.macrostates.shape[:3] == held.model.p_continues.shape
        assert held.model.p_continues.shape[:2] == held.model.reward.shape == (192, 6)
        assert (held.model.p_continues >= 0).all() and (held.model.p_continues.sum(axis=2) < 1.0001).all()
    after = agent.state()
    assert {**before.values, "meters": 0} == {**after.values, "meters": 0}
    assert same_arrays(before, after)


def test_folders_without_agents_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    results = Path(__file__).parents[2] / "docs" / "results"
    for folder, complaint in (
        ("arrow_puzzle_hard-thesis", "holds kept results and no agents; give a bench's own folder"),
        ("toy_regression-thesis", "in which no agent acts"),
    ):
        assert main(["why", str(results / folder)]) == 2
        assert complaint in capsys.readouterr().err
