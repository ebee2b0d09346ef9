"""Every number of a report, computed once from a BenchResult: page, Markdown, tables and plots all read these."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from imagine_bench import reference, statistics
from imagine_bench.interfaces import RuleFacts, TaskSpec
from imagine_bench.report.missing import known_agent, known_task
from imagine_bench.rules import facts as rule_facts
from imagine_bench.rules import fewest_actions
from imagine_bench.store import encoders
from imagine_bench.store.files import csv_text
from imagine_bench.store.results import BenchResult, Checkpoint, OpenLoop, RunResult

Value = TypeVar("Value")
BASE_AGENT = "dqn"  # what gains are measured against, as in the thesis

_SUMMARY_COLUMNS = (
    *("agent", "episodes", "seeds", "success_iqm", "low_95", "high_95", "interval_over", "thesis_mean", "thesis_std"),
    *("difference_to_dqn", "difference_low_95", "difference_high_95", "p", "p_holm", "detectable_difference"),
    *("gain", "gain_low_95", "gain_high_95", "thesis_gain", "alone", "dqn_alone", "p_mcnemar", "p_mcnemar_holm"),
    *("probability_of_improvement", "excess_macro_actions", "area", "area_low_95", "area_high_95"),
)


@dataclass(frozen=True, kw_only=True)
class Score:
    """Success of one agent at one budget, as shares in [0, 1]."""

    value: float  # interquartile mean over the seeds
    low: float  # lower end of the 95 % interval
    high: float  # upper end
    over: str  # what the interval covers: ``"seeds"``, or ``"episodes"`` where there is one seed only
    by_seed: tuple[float, ...]  # success of each seed, in the protocol's order
    thesis: tuple[float, float] | None  # (mean, standard deviation) of the thesis at this budget, or None


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """An agent against DQN at one budget; NaN ends where one seed allows no interval."""

    # difference of the interquartile means of the success shares, with its 95 % interval and p-value
    difference: statistics.Estimate
    p_adjusted: float  # of the difference, by Holm over all comparisons of the report; NaN with one seed
    detectable: float  # the smallest difference that this cell would have shown with probability 80 %; NaN likewise
    gain: statistics.Estimate  # (P_aug - P_base) / P_base of the means over seeds, with its interval
    thesis_gain: float | None  # the thesis' gain at this budget, or None
    # the tests of the two agents' runs from the same starts, seed by seed; None where it is not known which were solved
    paired: statistics.PairedTests | None
    paired_p: float  # of these, by Holm over all comparisons; NaN where not known
    paired_detectable: float  # the smallest difference that they would have shown with probability 80 %; NaN likewise
    improvement: float  # probability that a run of the agent scores more than one of DQN

    @property
    def shown(self) -> int:
        """1 where the agent is ahead, -1 where it is behind, 0 where no difference is shown."""
        return int(np.sign(self.difference.value)) if self.p_adjusted < 1.0 - statistics.LEVEL else 0


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Means over an agent's runs."""

    train_cpu_s: float  # CPU seconds of training in one run
    learner_cpu_s: float  # those the agent itself reports for learning and imagining; NaN where it reports none
    eval_cpu_s: float  # CPU seconds of all evaluations of one run
    env_steps: float  # real training macro-actions of one run
    test_steps: int  # test macro-actions of all runs
    faults: int  # those whose physics disagreed with the rules


@dataclass(frozen=True, kw_only=True)
class Price:
    """What one run had had until a budget, means over seeds."""

    env_steps: float  # real training macro-actions
    updates: float  # gradient updates of all networks; NaN where the agent counts none
    train_cpu_s: float  # CPU seconds of training


@dataclass(frozen=True, kw_only=True)
class ReportData:
    """What the report says in numbers; dictionaries are keyed by agent, inner ones by budget (real episodes).

    ``reached`` holds for each seed the first budget from which on success never falls below the task's
    ``success_threshold``, or None.
    ``prices`` holds what each agent had had until each budget, and ``frames_before`` the frames that its encoder was
    trained on, None where that is not known.
    ``areas`` holds the area under each learner's success curve from episode 0, where it is at the chance level, to each
    budget, divided by the budget: the mean success until then, with its interval over seeds.
    """

    result: BenchResult
    spec: TaskSpec
    facts: RuleFacts
    scores: dict[str, dict[int, Score]]
    comparisons: dict[str, dict[int, Comparison]]
    acceptance: dict[str, dict[int, float]]
    open_loop: dict[str, OpenLoop]
    reached: dict[str, tuple[int | None, ...]]
    areas: dict[str, dict[int, statistics.Estimate]]
    # mean macro-actions of solved tests beyond the fewest that the rules allow from their starts; NaN where not kept
    excess: dict[str, dict[int, float]]
    timing: dict[str, Timing]
    prices: dict[str, dict[int, Price]]
    frames_before: dict[str, int | None]
    thesis: dict[str, dict[int, tuple[float, float]]]
    thesis_gains: dict[str, dict[int, float]]
    thesis_source: str
    thesis_random: float | None

    @property
    def budgets(self) -> tuple[int, ...]:
        """Real episodes at which agents were tested."""
        return self.result.protocol.budgets

    @property
    def decisive_budget(self) -> int:
        """The budget at which the learners differ most; the last of several such ones."""
        return max(reversed(self.budgets), key=self.spread)

    def spread(self, budget: int) -> float:
        """Median distance of the learners' scores from DQN's at a budget, as a share; without DQN, their range.

        A median, so that one agent far ahead of all others does not choose a budget at which the others are alike.
        """
        values = {agent: self.scores[agent][budget].value for agent in self.areas}
        base = values.pop(BASE_AGENT, None)
        if base is None:
            return max(values.values(), default=0.0) - min(values.values(), default=0.0)
        return float(np.median([abs(value - base) for value in values.values()])) if values else 0.0


def collect(result: BenchResult) -> ReportData:
    """Compute a report's numbers."""
    spec = known_task(result.protocol.task)
    facts, agents, is_here = spec.facts(), result.protocol.agents, bool(spec.action_names)
    if result.protocol.split is not None and is_here:
        facts = rule_facts(result.protocol.spec(testing=True).rules, spec.horizon)
    if (known := result.certificate) is not None:  # what is hidden or late counts there, and the tests' own starts
        exact = {name: getattr(known, name) for name in ("chance_level", "optimum", "optimal_return")}
        facts = dataclasses.replace(facts, **exact)
    learners = [agent for agent in agents if known_agent(agent).learns and is_here]
    thesis = {agent: reference.success(spec.reference, agent) if spec.reference else {} for agent in agents}
    thesis_gains = {agent: reference.gain(spec.reference, agent) if spec.reference else {} for agent in agents}
    open_loops = {agent: _open_loop(result.of(agent)) for agent in agents}
    return ReportData(
        result=result,
        spec=spec,
        facts=facts,
        scores={agent: _scores(result, agent, thesis[agent]) for agent in agents},
        comparisons=_comparisons(result, thesis_gains),
        acceptance={agent: rates for agent in agents if (rates := _acceptance(result.of(agent)))},
        open_loop={agent: loop for agent, loop in open_loops.items() if loop is not None},
        reached={agent: _reached(result, agent, spec.success_threshold) for agent in learners},
        areas={agent: _areas(result, agent, facts.chance_level) for agent in learners},
        excess={agent: _excess(result.of(agent), spec) for agent in agents} if is_here else {},
        timing={agent: _timing(result.of(agent), learns=known_agent(agent).learns) for agent in agents},
        prices={agent: _prices(result.of(agent)) for agent in agents},
        frames_before={agent: _frames_before(result, agent) for agent in agents},
        thesis={agent: rows for agent, rows in thesis.items() if rows},
        thesis_gains={agent: gains for agent, gains in thesis_gains.items() if gains},
        thesis_source=reference.success_source(spec.reference) if spec.reference else "",
        thesis_random=reference.random_success(spec.reference) if spec.reference else None,
    )


def open_loop_csv(result: BenchResult) -> str:
    """One row an imagining agent, seed, budget and imagined depth, with and without the filter."""
    names = list(OpenLoop.__dataclass_fields__)
    rows: list[list[object]] = [["agent", "seed", "episodes", "depth", *names]]
    for run, checkpoint in result.rows:
        loop = checkpoint.open_loop
        for index in range(0 if loop is None else len(loop.count)):
            values = [getattr(loop, name)[index] for name in names]
            rows.append([run.agent, run.seed, checkpoint.episodes, index + 1, *values])
    return csv_text(rows)


def summary_csv(data: ReportData) -> str:
    """One row an agent and budget: score, interval, thesis, difference to DQN, gain."""
    rows: list[list[object]] = [list(_SUMMARY_COLUMNS)]
    for agent, scores in data.scores.items():
        for budget, score in scores.items():
            row: list[object] = [agent, budget, len(score.by_seed), score.value, score.low, score.high, score.over]
            row += list(score.thesis or ("", ""))
            versus = data.comparisons.get(agent, {}).get(budget)
            columns = (*versus.difference, versus.p_adjusted, versus.detectable, *versus.gain[:3]) if versus else ()
            row += [*columns, versus.thesis_gain] if versus else [""] * 10
            row += [*(versus.paired or [""] * 3), versus.paired_p, versus.improvement] if versus else [""] * 5
            excess = data.excess.get(agent, {}).get(budget, math.nan)
            row.append("" if math.isnan(excess) else excess)
            rows.append(row + list(data.areas[agent][budget][:3] if agent in data.areas else [""] * 3))
    return csv_text(rows)


def _scores(result: BenchResult, agent: str, thesis: dict[int, tuple[float, float]]) -> dict[int, Score]:
    scores = {}
    for index, budget in enumerate(result.protocol.budgets):
        shares = result.success_rates(agent)[:, index]  # [seeds]
        (low, high), over = statistics.interval(shares, trials=result.protocol.evaluation_episodes), "seeds"
        if len(shares) == 1:
            checkpoint = result.of(agent)[0].checkpoints[index]
            (low, high), over = statistics.wilson(checkpoint.successes, checkpoint.test_episodes), "episodes"
        value, by_seed = statistics.iqm(shares), tuple(shares.tolist())
        scores[budget] = Score(value=value, low=low, high=high, over=over, by_seed=by_seed, thesis=thesis.get(budget))
    return scores


def _comparisons(result: BenchResult, thesis: dict[str, dict[int, float]]) -> dict[str, dict[int, Comparison]]:
    """Every learning agent against DQN, where DQN was run."""
    agents = result.protocol.agents
    if BASE_AGENT not in agents:
        return {}
    treated = [each for each in agents if each != BASE_AGENT and known_agent(each).learns]
    rates, budgets = {agent: result.success_rates(agent) for agent in (*treated, BASE_AGENT)}, result.protocol.budgets
    trials, cells = result.protocol.evaluation_episodes, [(agent, i) for agent in treated for i in range(len(budgets))]
    pairs = [(rates[agent][:, index], rates[BASE_AGENT][:, index]) for agent, index in cells]
    found = [statistics.difference(*pair, trials=trials) for pair in pairs]
    adjusted = statistics.holm([each.p for each in found]).tolist()
    alike = [_paired(result.of(agent), result.of(BASE_AGENT), index) for agent, index in cells]
    alike_p = statistics.holm([math.nan if each is None else each.p for each in alike]).tolist()
    count = trials * len(result.protocol.seeds)
    comparisons: dict[str, dict[int, Comparison]] = {agent: {} for agent in treated}
    every = zip(cells, pairs, found, adjusted, alike, alike_p, strict=True)
    for (agent, index), pair, difference, p_adjusted, paired, paired_p in every:
        comparisons[agent][budgets[index]] = Comparison(
            difference=difference,
            p_adjusted=p_adjusted,
            detectable=statistics.detectable(*pair, cells=len(cells), trials=trials),
            gain=statistics.gain(*pair, trials=trials),
            thesis_gain=thesis[agent].get(budgets[index]),
            paired=paired,
            paired_p=paired_p,
            paired_detectable=(
                math.nan if paired is None else statistics.detectable_paired(paired, count, cells=len(cells))
            ),
            improvement=statistics.probability_of_improvement(*pair),
        )
    return comparisons


def _paired(treated: tuple[RunResult, ...], base: tuple[RunResult, ...], index: int) -> statistics.PairedTests | None:
    texts = [[run.checkpoints[index].solved or "" for run in runs] for runs in (treated, base)]
    return statistics.mcnemar(*map("".join, texts)) if all(map(all, texts)) else None


def _excess(runs: tuple[RunResult, ...], spec: TaskSpec) -> dict[int, float]:
    fewest = functools.cache(lambda start: fewest_actions(spec.rules, start))

    def beyond(row: Checkpoint) -> list[int]:
        if row.kept is None:
            return []
        lengths, starts = row.kept.lengths[row.kept.success], row.kept.starts[row.kept.success]
        return [int(length) - fewest(tuple(start)) for length, start in zip(lengths, starts.tolist(), strict=True)]

    return {budget: float(np.mean(each)) if each else math.nan for budget, each in _by_budget(runs, beyond).items()}


def _by_budget(runs: Sequence[RunResult], values: Callable[[Checkpoint], Sequence[Value]]) -> dict[int, list[Value]]:
    """What the rows of the runs have, by budget."""
    tests = zip(*(run.checkpoints for run in runs), strict=True)
    return {rows[0].episodes: [value for row in rows for value in values(row)] for rows in tests}


def _acceptance(runs: tuple[RunResult, ...]) -> dict[int, float]:
    """Mean share of imagined transitions kept while training to each budget from the one before."""
    rates = _by_budget(runs, lambda row: [row.diagnostics.get("imagination/acceptance_rate", math.nan)])
    known = {budget: [rate for rate in each if np.isfinite(rate)] for budget, each in rates.items()}
    return {budget: float(np.mean(each)) for budget, each in known.items() if each}


def _open_loop(runs: tuple[RunResult, ...]) -> OpenLoop | None:
    """Mean over runs at the last budget; where the filter keeps nothing in any run, NaN."""
    loops = [run.checkpoints[-1].open_loop for run in runs]
    found = [loop for loop in loops if loop is not None]
    if not found:
        return None
    names = [name for name in OpenLoop.__dataclass_fields__ if name != "count"]
    means = {name: _nan_mean(np.stack([getattr(loop, name) for loop in found])) for name in names}
    return OpenLoop(count=np.sum([loop.count for loop in found], axis=0), **means)


def _nan_mean(table: np.ndarray) -> np.ndarray:
    """Mean over the first axis of what is known, boundless uncertainty included; NaN where nothing is."""
    known = ~np.isnan(table)
    count, total = known.sum(axis=0), np.where(known, table, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _reached(result: BenchResult, agent: str, threshold: float) -> tuple[int | None, ...]:
    budgets = result.protocol.budgets
    return tuple(statistics.first_lasting(budgets, rates, threshold) for rates in result.success_rates(agent))


def _areas(result: BenchResult, agent: str, chance_level: float) -> dict[int, statistics.Estimate]:
    budgets = result.protocol.budgets
    means = statistics.running_means(budgets, result.success_rates(agent), chance_level)  # [seeds, B]
    trials = result.protocol.evaluation_episodes
    return {
        budget: statistics.Estimate(statistics.iqm(column), *statistics.interval(column, trials=trials))
        for budget, column in zip(budgets, means.T, strict=True)
    }


def _timing(runs: tuple[RunResult, ...], *, learns: bool) -> Timing:
    """What runs of one agent cost; the one test of an agent that does not learn stands at every budget."""
    tests = [checkpoint for run in runs for checkpoint in (run.checkpoints if learns else run.checkpoints[:1])]
    last = [run.checkpoints[-1] for run in runs]
    return Timing(
        train_cpu_s=float(np.mean([checkpoint.train_cpu_s for checkpoint in last])),
        learner_cpu_s=float(np.mean([_learner_cpu_s(run) for run in runs])),
        eval_cpu_s=sum(checkpoint.eval_cpu_s for checkpoint in tests) / len(runs),
        env_steps=float(np.mean([checkpoint.env_steps for checkpoint in last])),
        test_steps=round(sum(checkpoint.mean_length * checkpoint.test_episodes for checkpoint in tests)),
        faults=sum(checkpoint.faults for checkpoint in tests),
    )


def _prices(runs: tuple[RunResult, ...]) -> dict[int, Price]:
    rows = zip(*(run.checkpoints for run in runs), strict=True)
    return {
        seeds[0].episodes: Price(
            env_steps=float(np.mean([row.env_steps for row in seeds])),
            updates=float(np.mean([row.diagnostics.get("gradient_updates", float("nan")) for row in seeds])),
            train_cpu_s=float(np.mean([row.train_cpu_s for row in seeds])),
        )
        for seeds in rows
    }


def _frames_before(result: BenchResult, agent: str) -> int | None:
    """Frames that the encoder of an agent was trained on, by its card; 0 for an agent that has none."""
    entry = known_agent(agent)
    if not entry.make or not entry.needs_encoder:
        return 0 if entry.make else None
    card = encoders.card(result.protocol.encoder_of(entry.encoder_kind))
    return None if card is None or card.get("offer") else int(card["recipe"]["frames"])


def _learner_cpu_s(run: RunResult) -> float:
    """CPU seconds in the agent's ``time/*_s`` diagnostics, which are means a real step since the last budget."""
    total, before = float("nan"), 0
    for checkpoint in run.checkpoints:
        parts = [value for name, value in checkpoint.diagnostics.items() if name.startswith("time/")]
        if parts:
            total = np.nansum([total, sum(parts) * (checkpoint.env_steps - before)])
        before = checkpoint.env_steps
    return float(total)
