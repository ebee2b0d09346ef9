"""Agents are compared start by start, in plain words below the table; every figure again by its definition."""

from __future__ import annotations

import dataclasses
import functools
import html
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from fake_results import bench_result
from scipy import stats
from scipy.optimize import brentq

from imagine_bench import registry
from imagine_bench.interfaces import Rules
from imagine_bench.protocols.control import Protocol
from imagine_bench.report import summary_table, write_report
from imagine_bench.report.data import collect
from imagine_bench.report.text import percent
from imagine_bench.store.results import BenchResult, Checkpoint, KeptEpisodes


def kept(result: BenchResult) -> BenchResult:
    """The result with test episodes that say which were solved, at random, and how."""
    spec, rng = registry.task(result.protocol.task), np.random.default_rng(5)
    starts = rng.choice(np.array(spec.rules.start_states), result.protocol.evaluation_episodes)

    def told(row: Checkpoint) -> Checkpoint:
        solved = rng.permutation(np.arange(row.test_episodes) < row.successes)
        zeros, lengths = np.zeros(row.test_episodes, dtype=np.int64), rng.integers(3, 11, row.test_episodes)
        episodes = KeptEpisodes(
            starts=starts, lengths=lengths, actions=np.zeros(lengths.sum(), dtype=np.int64), returns=zeros * 0.0,
            success=solved, faults=zeros, fingerprints=zeros,
        )  # fmt: skip
        return dataclasses.replace(row, solved="".join("01"[int(each)] for each in solved), kept=episodes)

    runs = [dataclasses.replace(run, checkpoints=tuple(map(told, run.checkpoints))) for run in result.runs]
    return dataclasses.replace(result, runs=tuple(runs))


@functools.cache
def shortest(rules: Rules, start: tuple[int, ...]) -> int:
    """The length of a shortest plan, by trying out all of one length after the other."""
    for length in range(1, 11):
        for plan in itertools.product(range(rules.n_actions), repeat=length):
            state, outcome = start, None
            for action in plan:
                (outcome,) = rules.outcomes(state, action)
                if outcome.terminated:
                    break
                state = outcome.macrostate
            if outcome is not None and outcome.success:
                return length
    raise AssertionError("no plan")


@pytest.mark.parametrize("seeds", [(0,), (0, 1, 7)])
def test_the_same_starts_are_compared_in_plain_words(seeds: tuple[int, ...], tmp_path: Path) -> None:
    """In page, Markdown and terminal; every figure again by its definition, from the tests themselves."""
    protocol = Protocol(task="arrow_puzzle", preset="smoke", seeds=seeds, budgets=(10, 20), evaluation_episodes=60)
    result = kept(bench_result(tmp_path, protocol=protocol))
    data, rules = collect(result), registry.task("arrow_puzzle").rules
    told = {
        (run.agent, row.episodes, run.seed): [each == "1" for each in row.solved or ""]
        for run in result.runs
        for row in run.checkpoints
    }
    found = {}
    for agent, budget in itertools.product(data.comparisons, protocol.budgets):
        pairs = [
            pair for seed in seeds for pair in zip(told[agent, budget, seed], told["dqn", budget, seed], strict=True)
        ]
        alone, dqn_alone = pairs.count((True, False)), pairs.count((False, True))
        tail = sum(math.comb(alone + dqn_alone, k) for k in range(min(alone, dqn_alone) + 1))
        found[agent, budget] = (alone, dqn_alone, min(1.0, tail * 2 / 2 ** (alone + dqn_alone)))
    ordered = sorted(found, key=lambda cell: found[cell][2])
    corrected = {
        cell: min(1.0, max((len(ordered) - i) * found[each][2] for i, each in enumerate(ordered[: place + 1])))
        for place, cell in enumerate(ordered)
    }
    budget = data.decisive_budget
    said = [line for line in summary_table(result).splitlines() if line.startswith("From the same starts")]
    assert len(said) == len(data.comparisons) >= 2
    for agent, line in zip(data.comparisons, said, strict=True):
        alone, dqn_alone, _ = found[agent, budget]
        assert f"alone solves {alone} tests and DQN alone {dqn_alone} (" in line
        p = corrected[agent, budget]
        assert (f"(p = {p:.3f}, McNemar" if p >= 0.001 else "(p < 0.001, McNemar") in line
        assert ("is not shown" in line) == (p >= 0.05) and ("are better" in line) == (p < 0.05 and alone > dqn_alone)
        z = stats.norm.isf(0.025 / len(found)) + stats.norm.ppf(0.8)
        pairs, apart = 60 * len(seeds), (alone + dqn_alone) / (60 * len(seeds))
        size = brentq(lambda d: pairs * d**2 - z**2 * (max(apart, d) - d**2), 1e-6, 1.0)  # noqa: B023 - called at once
        assert f"a difference of {percent(size)} points" in line
        scores = [[sum(told[name, budget, seed]) for seed in seeds] for name in (agent, "dqn")]
        wins = [0.5 * (a == b) + (a > b) for a in scores[0] for b in scores[1]]
        assert f"in {percent(np.mean(wins))} % of pairs" in line
    (last,) = (line for line in summary_table(result).splitlines() if line.startswith("Macro-actions beyond"))
    for agent in protocol.agents:
        rows = [run.checkpoints[protocol.budgets.index(budget)].kept for run in result.of(agent)]
        beyond = [
            int(row.lengths[test]) - shortest(rules, tuple(row.starts[test].tolist()))
            for row in rows
            if row is not None
            for test in np.flatnonzero(row.success)
        ]
        assert f" {np.mean(beyond):.2f}" in last
    folder = write_report(result).parent
    page, markdown = ((folder / name).read_text() for name in ("index.html", "report.md"))
    for line in (*said, last):
        assert f"<li>{html.escape(line).replace('&#x27;', '&#39;')}</li>" in page
        assert line in markdown.replace("\\", "")
    for of_dqn in (True, False):  # one that is not told leaves nothing to pair
        mixed = [
            plain if (plain.agent == "dqn") == of_dqn else run
            for plain, run in zip(bench_result(tmp_path, protocol=protocol).runs, result.runs, strict=True)
        ]
        assert "McNemar" not in summary_table(dataclasses.replace(result, runs=tuple(mixed)))
