"""Agents are compared start by start; every figure again by its definition, from the tests themselves."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from fake_results import bench_result, rewritten

from imagine_bench import registry
from imagine_bench.interfaces import Rules
from imagine_bench.protocols.control import Protocol
from imagine_bench.report import bench_page
from imagine_bench.report.data import agent_title
from imagine_bench.report.tables import DASH, Cell, p_value, percent
from imagine_bench.store.results import BenchResult, Checkpoint, KeptEpisodes, RunResult


def kept(result: BenchResult) -> BenchResult:
    """The result with test episodes that say which were solved, at random, and how."""
    spec, rng = registry.task(result.protocol.task), np.random.default_rng(5)
    starts = rng.choice(np.array(spec.rules.start_states), result.protocol.evaluation_episodes)

    def told(_: RunResult, row: Checkpoint) -> Checkpoint:
        solved = rng.permutation(np.arange(row.test_episodes) < row.successes)
        zeros, lengths = np.zeros(row.test_episodes, dtype=np.int64), rng.integers(3, 11, row.test_episodes)
        episodes = KeptEpisodes(
            starts=starts, lengths=lengths, actions=np.zeros(lengths.sum(), dtype=np.int64), returns=zeros * 0.0,
            success=solved, faults=zeros, fingerprints=zeros,
        )  # fmt: skip
        return dataclasses.replace(row, solved="".join("01"[int(each)] for each in solved), kept=episodes)

    return rewritten(result, told)


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


def cells(result: BenchResult, name: str) -> dict[tuple[str, str], Cell]:
    """The cells of a table of the report by agent's title and budget."""
    tables = [each for section in bench_page(result).sections for each in section.tables if each.name == name]
    return {
        (row[0].text, budget): cell
        for table in tables
        for row in table.cells
        for budget, cell in zip(table.header[1:], row[1:], strict=True)
    }


@pytest.mark.parametrize("seeds", [(0,), (0, 1, 7)])
def test_the_same_starts_are_compared(seeds: tuple[int, ...], tmp_path: Path) -> None:
    protocol = Protocol(task="arrow_puzzle", preset="smoke", seeds=seeds, budgets=(10, 20), evaluation_episodes=60)
    plain = bench_result(tmp_path, protocol=protocol)
    result = kept(plain)
    rules = registry.task("arrow_puzzle").rules
    told = {
        (run.agent, row.episodes, run.seed): [each == "1" for each in row.solved or ""]
        for run in result.runs
        for row in run.checkpoints
    }
    found = {}
    learners = [agent for agent in protocol.agents if agent.startswith("imagination")]
    for agent, budget in itertools.product(learners, protocol.budgets):
        pairs = [
            pair for seed in seeds for pair in zip(told[agent, budget, seed], told["dqn", budget, seed], strict=True)
        ]
        alone, dqn_alone = pairs.count((True, False)), pairs.count((False, True))
        tail = sum(math.comb(alone + dqn_alone, k) for k in range(min(alone, dqn_alone) + 1))
        found[agent, budget] = (alone, dqn_alone, min(1.0, tail * 2 / 2 ** (alone + dqn_alone)))
    ordered = sorted(found, key=lambda cell: found[cell][2])
    shown = cells(result, "paired")
    assert len(shown) == len(found) >= 4
    for place, (agent, budget) in enumerate(ordered):
        alone, dqn_alone, _ = found[agent, budget]
        holm = min(1.0, max((len(ordered) - i) * found[each][2] for i, each in enumerate(ordered[: place + 1])))
        scores = [[sum(told[name, budget, seed]) for seed in seeds] for name in (agent, "dqn")]
        wins = np.mean([0.5 * (a == b) + (a > b) for a in scores[0] for b in scores[1]])
        cell = shown[agent_title(agent), str(budget)]
        assert (cell.text, cell.interval) == (f"{alone} : {dqn_alone}", f"({p_value(holm)})")
        assert cell.note == f"ahead in {percent(wins)} % of pairs of runs"
    excess = cells(result, "excess")
    for agent, budget in itertools.product(protocol.agents, protocol.budgets):
        rows = [run.checkpoints[protocol.budgets.index(budget)].kept for run in result.of(agent)]
        beyond = [
            int(row.lengths[test]) - shortest(rules, tuple(row.starts[test].tolist()))
            for row in rows
            if row is not None
            for test in np.flatnonzero(row.success)
        ]
        assert excess[agent_title(agent), str(budget)].text == f"{np.mean(beyond):.2f}"
    for of_dqn in (True, False):  # an agent whose tests are not known leaves nothing to pair
        runs = [
            known if (known.agent == "dqn") == of_dqn else unknown
            for known, unknown in zip(result.runs, plain.runs, strict=True)
        ]
        mixed = cells(dataclasses.replace(result, runs=tuple(runs)), "paired")
        assert {cell.text for cell in mixed.values()} == {DASH}
