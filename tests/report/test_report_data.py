"""The numbers of a report before anybody words or draws them, each once more in plain numpy."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from fake_results import WIDE, bench_result, rewritten
from guest_packages import Guests

from imagine_bench import reference, registry, statistics
from imagine_bench.errors import SetupError, UnknownNameError
from imagine_bench.protocols.control import Protocol
from imagine_bench.report.bench import bench_page, cost, gain, verdict
from imagine_bench.report.data import (
    DIFFERENCE,
    SCORE,
    card_of,
    collect,
    frames_before,
    known_agent,
    known_task,
)
from imagine_bench.report.page import count, seconds
from imagine_bench.rules import fewest_actions
from imagine_bench.store import encoders
from imagine_bench.store.results import BenchResult, Checkpoint, KeptEpisodes, RunResult


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    """Seven seeds that differ in all they cost."""
    rng = np.random.default_rng(0)
    protocol = dataclasses.replace(WIDE, seeds=tuple(range(statistics.FEWEST)))

    def change(run: RunResult, row: Checkpoint) -> Checkpoint:
        said = {name: float(rng.uniform()) for name in (*row.diagnostics, "gradient_updates") if row.diagnostics}
        return dataclasses.replace(
            row, env_steps=row.episodes + int(rng.integers(99)), diagnostics=said, train_cpu_s=float(rng.uniform(5, 9)),
            eval_cpu_s=float(rng.uniform(1, 2)), faults=int(rng.integers(9)),
        )  # fmt: skip

    return rewritten(bench_result(tmp_path_factory.mktemp("bench"), protocol=protocol), change)


def test_the_card_of_an_encoder_outlives_two_merges(result: BenchResult) -> None:
    """A merged bench keeps the facts of its benches below their numbers, and may be merged again."""
    protocol = dataclasses.replace(result.protocol, encoder="mine@0123456789ab")
    card = {"frames": 8_000, "probe": {"mlp": 0.115}}
    kept = {"encoders": {"mine@0123456789ab": card}}
    for facts in (kept, {"bench 1": {}, "bench 2": kept}, {"bench 1": {"bench 1": {}, "bench 2": kept}}):
        merged = dataclasses.replace(result, protocol=protocol, environment=facts)
        assert card_of(collect(merged), "imagination") == card
        warned = [line.split(" sees through ", 1) for line in verdict(collect(merged))[-2:]]
        assert [agent for agent, _ in warned] == ["“imagination”", "“imagination_uncertainty”"]
        assert all("encoder mine, from which a probe reads only 11.5%" in words for _, words in warned)


@pytest.mark.parametrize("agent", ["random", "imagination"])
def test_costs_are_means_over_seeds(result: BenchResult, agent: str) -> None:
    data, runs = collect(result), result.of(agent)
    records = data.of(agent)
    for record, rows in zip(records, zip(*(run.checkpoints for run in runs), strict=True), strict=True):
        for name in ("env_steps", "train_cpu_s"):
            assert record[name] == pytest.approx(np.mean([getattr(row, name) for row in rows]))
        updates = [row.diagnostics.get("gradient_updates", math.nan) for row in rows]
        assert record["gradient_updates"] == pytest.approx(np.mean(updates), nan_ok=True)
    tests = [row for run in runs for row in run.checkpoints[: 1 if agent == "random" else 3]]
    steps = round(sum(row.test_episodes * row.mean_length for row in tests))
    shown = {row[0]: row[1:] for row in cost(data).tables[0].rows}[agent]
    counts = map(count, (records[-1]["env_steps"], frames_before(data, agent), records[-1]["gradient_updates"]))
    faults = f"{sum(row.faults for row in tests)} of {steps:,}"
    assert shown == [*counts, seconds(records[-1]["train_cpu_s"]), faults]


def test_frames_seen_beforehand_are_those_of_the_card(result: BenchResult) -> None:
    path, agents = encoders.bundled()["arrow_puzzle-clean"], ("random", "imagination")
    seen = json.loads(path.with_suffix(".json").read_text())["recipe"]["frames"]
    codes = encoders.identity(encoders.bundled()["arrow_puzzle-clean-codes"])
    offered = {"of_theirs@0123456789ab": {"recipe": {"frames": 7}, "offer": "theirs:Encoder"}}  # trained elsewhere
    unknown = [*offered, "foreign@0123456789ab"]
    for identity, frames in ((encoders.identity(path), seen), *((each, math.nan) for each in unknown)):
        protocol = dataclasses.replace(result.protocol, agents=agents, encoder=identity, codes=codes)
        runs = tuple(run for run in result.runs if run.agent in agents)
        facts = {**result.environment, "encoders": offered}
        data = collect(dataclasses.replace(result, protocol=protocol, runs=runs, environment=facts))
        assert [frames_before(data, agent) for agent in agents] == [0, pytest.approx(frames, nan_ok=True)]
        assert frames_before(data, "factored:given") == 8_000 != seen, "through an encoder of another kind"


def test_gains_are_of_learners_over_dqn(result: BenchResult) -> None:
    data = collect(result)
    trials = result.protocol.evaluation_episodes
    learners = {agent for agent in result.protocol.agents if registry.agent_entry(agent).learns}
    assert {record["agent"] for record in data.records if "gain" in record} == learners - {"dqn"}
    assert {record["agent"] for record in data.records if "area" in record} == learners
    shares, base = (result.success_rates(agent)[:, 1] for agent in ("imagination", "dqn"))
    row = data.of("imagination")[1]
    assert tuple(row[name] for name in DIFFERENCE) == statistics.difference(shares, base, trials=trials)
    assert row["gain"] == pytest.approx((shares.mean() - base.mean()) / base.mean())
    assert row["thesis_gain"] == reference.gain("arrow_puzzle", "imagination")[2000]
    dqn = data.of("dqn")[1]
    assert (dqn["thesis_mean"], dqn["thesis_std"]) == reference.success("arrow_puzzle", "dqn")[2000]
    assert tuple(dqn[name] for name in SCORE) == (statistics.iqm(base), *statistics.interval(base, trials=trials))


def test_areas_begin_at_the_chance_level(tmp_path: Path) -> None:
    protocol = Protocol(task="arrow_puzzle", preset="quick", seeds=(0, 1, 2))

    def change(run: RunResult, row: Checkpoint) -> Checkpoint:
        return dataclasses.replace(row, successes=row.test_episodes) if run.agent == "dqn" else row

    data = collect(rewritten(bench_result(tmp_path, protocol=protocol), change))
    chance = data.facts.chance_level
    first, *_, last = data.of("dqn")
    assert 0.0 < chance < 0.2
    assert first["area"] == pytest.approx((chance + 1.0) / 2.0)
    assert last["area"] == pytest.approx(1.0 - (1.0 - chance) / 2.0 * first["episodes"] / last["episodes"])


# Start by start ----------------------------------------------------------------------------------------------------


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


def solved_by(result: BenchResult, agent: str, place: int) -> str:
    """Which tests all seeds of an agent solved at a budget, one seed behind the other."""
    return "".join(str(run.checkpoints[place].solved) for run in result.of(agent))


def test_the_same_starts_are_compared(tmp_path: Path) -> None:
    protocol = Protocol(task="arrow_puzzle", preset="smoke", seeds=(0, 1, 7), budgets=(10, 20), evaluation_episodes=60)
    result = kept(bench_result(tmp_path, protocol=protocol))
    data = collect(result)
    compared = [record for record in data.records if "gain" in record]
    assert len(compared) >= 4
    for record in compared:
        place = protocol.budgets.index(record["episodes"])
        solved = [solved_by(result, name, place) for name in (record["agent"], "dqn")]
        assert tuple(record[name] for name in ("alone", "dqn_alone", "p_mcnemar")) == statistics.mcnemar(*solved)
        rates = [result.success_rates(name)[:, place] for name in (record["agent"], "dqn")]
        assert record["probability_of_improvement"] == statistics.probability_of_improvement(*rates)
    corrected = statistics.holm([record["p_mcnemar"] for record in compared])
    assert [record["p_mcnemar_holm"] for record in compared] == corrected.tolist()
    (_, shown) = gain(data).tables  # type: ignore[union-attr]
    for row, record, p in zip(shown.rows, compared, corrected, strict=True):
        alone = [count(record[name]) for name in ("episodes", "alone", "dqn_alone")]
        assert row == [record["agent"], *alone, f"{p:.3f}"]
    rules = protocol.spec(testing=True).rules
    fewest = {start: fewest_actions(rules, start) for start in rules.start_states}
    for record in data.records:
        place = protocol.budgets.index(record["episodes"])
        beyond = []
        for row in (run.checkpoints[place].kept for run in result.of(record["agent"])):
            beyond += [row.lengths[test] - fewest[tuple(row.starts[test])] for test in np.flatnonzero(row.success)]
        assert record["excess_macro_actions"] == pytest.approx(np.mean(beyond))


@pytest.mark.parametrize("base_has_fewer", [False, True])
def test_an_agent_of_fewer_seeds_is_paired_where_both_have_one(result: BenchResult, base_has_fewer: bool) -> None:
    """As in the default bench, whose report must be written."""
    known = kept(result)
    agent = next(name for name in collect(known).compared if name != "dqn")
    few = "dqn" if base_has_fewer else agent
    last = known.protocol.seeds[-2]
    protocol = dataclasses.replace(known.protocol, few_seeds=((few, last),))
    runs = tuple(run for run in known.runs if run.agent != few or run.seed <= last)
    fewer = dataclasses.replace(known, protocol=protocol, runs=runs)
    solved = (solved_by(known, name, 0)[: -known.protocol.evaluation_episodes] for name in (agent, "dqn"))
    pairs = Counter(zip(*solved, strict=True))
    (record, *_) = [record for record in collect(fewer).records if record["agent"] == agent]
    assert record["alone"] == pairs["1", "0"] > 0
    assert f" · 7 seeds ({few} 6), " in bench_page(fewer).summary


def test_an_agent_whose_tests_are_not_known_leaves_nothing_to_pair(result: BenchResult) -> None:
    known = kept(result)
    runs = [run if run.agent == "dqn" else each for run, each in zip(result.runs, known.runs, strict=True)]
    data = collect(dataclasses.replace(known, runs=tuple(runs)))
    assert not any("alone" in record for record in data.records)


@pytest.mark.parametrize("offered", [{}, {registry.TASK_GROUP: {"their_task": "their_module:gone"}}])
def test_a_task_of_an_absent_package_has_no_facts(offered: dict[str, dict[str, str]], guests: Guests) -> None:
    guests.write("their_module", "", offered)
    with pytest.raises(SetupError if offered else UnknownNameError):
        registry.task("their_task")
    found = known_task("their_task")
    assert (found.id, found.title, found.horizon) == ("their_task", "their task", 0)
    assert math.isnan(found.facts().chance_level)


def test_an_agent_of_an_absent_package_makes_nothing() -> None:
    found = known_agent("of_nobody")
    assert found.make == "" and found.description == "Its package is not installed here."
    assert known_agent("dqn") == registry.agent_entry("dqn")
