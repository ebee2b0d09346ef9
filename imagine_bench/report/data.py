"""Every number of a bench's report, computed once from its result: tables, figures and CSV files all read these."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from imagine_bench import reference, registry, statistics
from imagine_bench.errors import SetupError, UnknownNameError
from imagine_bench.interfaces import RenderMacrostates, RuleFacts, Rules, TaskSpec
from imagine_bench.rules import facts as rule_facts
from imagine_bench.rules import fewest_actions
from imagine_bench.statistics import Estimate
from imagine_bench.store import encoders
from imagine_bench.store.files import csv_text
from imagine_bench.store.results import BenchResult, Checkpoint, OpenLoop, RunResult

V = TypeVar("V")
BASE_AGENT = "dqn"  # what gains are measured against, as in the thesis
_ABSENT = (UnknownNameError, SetupError)
_SUMMARY_COLUMNS = (
    *("agent", "episodes", "seeds", "success_iqm", "low_95", "high_95", "interval_over", "thesis_mean", "thesis_std"),
    *("difference_to_dqn", "difference_low_95", "difference_high_95", "p", "p_holm", "detectable_difference"),
    *("gain", "gain_low_95", "gain_high_95", "thesis_gain", "alone", "dqn_alone", "p_mcnemar", "p_mcnemar_holm"),
    *("probability_of_improvement", "excess_macro_actions", "area", "area_low_95", "area_high_95"),
)


def known_agent(name: str) -> registry.AgentEntry:
    """The registry line of an agent, or one for a learner whose package is not installed."""
    try:
        return registry.agent_entry(name)
    except _ABSENT:
        return registry.AgentEntry(make="", description="Its package is not installed here.")


def known_task(name: str) -> TaskSpec:
    """A task's spec, or one without macro-actions, rules and facts where its package is not installed."""
    try:
        return registry.task(name)
    except _ABSENT:
        return TaskSpec(
            id=name,
            title=name.replace("_", " "),
            description="Its package is not installed here.",
            env_id="",
            horizon=0,
            action_names=(),
            macrostate_names=(),
            macrostate_values=(),
            preprocessing="",
            encoder="",
            rules=cast(Rules, None),
            facts=_no_facts,
            render_macrostates=cast(RenderMacrostates, None),
        )


def _no_facts() -> RuleFacts:
    return RuleFacts(chance_level=math.nan, optimum=math.nan, optimal_return=math.nan, mean_plan_length=math.nan)


def agent_title(agent: str) -> str:
    """The agent's title from its registry line, or its name."""
    return known_agent(agent).title or agent.replace("_", " ")


class Score(NamedTuple):
    """Success of an agent at one budget, as shares in [0, 1]."""

    success: Estimate  # interquartile mean over the seeds
    thesis: tuple[float, float] | None  # mean and standard deviation of the thesis at this budget, or None


class Price(NamedTuple):
    """What one run had had until a budget, means over seeds."""

    env_steps: float  # real training macro-actions
    updates: float  # gradient updates of all networks; NaN where the agent counts none
    train_cpu_s: float  # CPU seconds of training


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """An agent against DQN at one budget; NaN where one seed allows no interval, or no test episodes were kept."""

    difference: Estimate  # of the interquartile means of the success shares
    p_adjusted: float  # of the difference, by Holm over all comparisons of the report
    detectable: float  # the smallest difference that this cell would have shown with probability 80 %
    gain: Estimate  # (P_aug - P_base) / P_base of the means over seeds
    thesis_gain: float | None  # the thesis' gain at this budget, or None
    paired: statistics.PairedTests | None  # of the same starts; None where it is not known which were solved
    paired_p: float  # of these, by Holm over all comparisons
    paired_detectable: float  # the smallest difference that they would have shown with probability 80 %
    improvement: float  # probability that a run of the agent scores more than one of DQN

    @property
    def shown(self) -> int:
        """1 where the agent is ahead, -1 where it is behind, 0 where no difference is shown."""
        return int(np.sign(self.difference.value)) if self.p_adjusted < 1.0 - statistics.LEVEL else 0


@dataclass(frozen=True)
class ReportData:
    """The numbers; dictionaries are keyed by agent, inner ones by budget (real episodes)."""

    result: BenchResult

    @property
    def agents(self) -> tuple[str, ...]:
        """All agents, in the protocol's order."""
        return self.result.protocol.agents

    @property
    def budgets(self) -> tuple[int, ...]:
        """Real episodes at which agents were tested."""
        return self.result.protocol.budgets

    @cached_property
    def spec(self) -> TaskSpec:
        """The task."""
        return known_task(self.result.protocol.task)

    @property
    def installed(self) -> bool:
        """Whether the task's package is here."""
        return bool(self.spec.action_names)

    @cached_property
    def facts(self) -> RuleFacts:
        """Chance level and optimum of the tests; the bench's certificate knows what frames hide."""
        facts = self.spec.facts()
        protocol = self.result.protocol
        if protocol.split is not None and self.installed:
            facts = rule_facts(protocol.spec(testing=True).rules, self.spec.horizon)
        known = self.result.certificate
        if known is None:
            return facts
        exact = {name: getattr(known, name) for name in ("chance_level", "optimum", "optimal_return")}
        return dataclasses.replace(facts, **exact)

    @cached_property
    def learners(self) -> tuple[str, ...]:
        """The agents that learn; none where the task is not installed."""
        return tuple(agent for agent in self.agents if self.installed and known_agent(agent).learns)

    @cached_property
    def scores(self) -> dict[str, dict[int, Score]]:
        """Success of every agent; with one seed, the interval is over test episodes (Wilson)."""
        found = {}
        for agent in self.agents:
            means = self._estimates(self.result.success_rates(agent))
            (run, *others) = self.result.of(agent)
            if not others:
                for row in run.checkpoints:
                    ends = statistics.wilson(row.successes, row.test_episodes)
                    means[row.episodes] = Estimate(means[row.episodes].value, *ends)
            printed = self.thesis.get(agent, {})
            found[agent] = {budget: Score(each, printed.get(budget)) for budget, each in means.items()}
        return found

    @cached_property
    def areas(self) -> dict[str, dict[int, Estimate]]:
        """Mean success of each learner from episode 0, where it is at the chance level, to each budget."""
        found = {}
        for agent in self.learners:
            shares = self.result.success_rates(agent)
            means = statistics.running_means(self.budgets, shares, self.facts.chance_level)
            found[agent] = self._estimates(means)
        return found

    def _estimates(self, shares: NDArray[np.float64]) -> dict[int, Estimate]:
        """Interquartile means over seeds of shares (seeds, budgets), with intervals."""
        trials = self.result.protocol.evaluation_episodes
        columns = zip(self.budgets, shares.T, strict=True)
        return {b: Estimate(statistics.iqm(each), *statistics.interval(each, trials=trials)) for b, each in columns}

    @cached_property
    def reached(self) -> dict[str, tuple[int | None, ...]]:
        """Of each learner's seeds, the first budget from which on success stays at the task's threshold, or None."""
        threshold = self.spec.success_threshold
        return {
            agent: tuple(
                statistics.first_lasting(self.budgets, rates, threshold) for rates in self.result.success_rates(agent)
            )
            for agent in self.learners
        }

    @cached_property
    def comparisons(self) -> dict[str, dict[int, Comparison]]:
        """Every learner against DQN, where DQN was run."""
        if BASE_AGENT not in self.agents:
            return {}
        treated = [agent for agent in self.agents if agent != BASE_AGENT and known_agent(agent).learns]
        cells = [(agent, index) for agent in treated for index in range(len(self.budgets))]
        found = [self._compared(agent, index, len(cells)) for agent, index in cells]
        adjusted = statistics.holm([each.p_adjusted for each in found]).tolist()
        paired = statistics.holm([each.paired_p for each in found]).tolist()
        comparisons: dict[str, dict[int, Comparison]] = {agent: {} for agent in treated}
        for (agent, index), each, p_adjusted, paired_p in zip(cells, found, adjusted, paired, strict=True):
            corrected = dataclasses.replace(each, p_adjusted=p_adjusted, paired_p=paired_p)
            comparisons[agent][self.budgets[index]] = corrected
        return comparisons

    def _compared(self, agent: str, index: int, cells: int) -> Comparison:
        """One cell of a table of so many, its p-values not yet corrected."""
        result = self.result
        trials = result.protocol.evaluation_episodes
        shares, base = (result.success_rates(name)[:, index] for name in (agent, BASE_AGENT))
        difference = statistics.difference(shares, base, trials=trials)
        tests = trials * len(result.protocol.seeds)
        paired = _paired(result.of(agent), result.of(BASE_AGENT), index)
        return Comparison(
            difference=difference,
            p_adjusted=difference.p,
            detectable=statistics.detectable(shares, base, cells=cells, trials=trials),
            gain=statistics.gain(shares, base, trials=trials),
            thesis_gain=self.thesis_gains.get(agent, {}).get(self.budgets[index]),
            paired=paired,
            paired_p=paired.p if paired else math.nan,
            paired_detectable=statistics.detectable_paired(paired, tests, cells=cells) if paired else math.nan,
            improvement=statistics.probability_of_improvement(shares, base),
        )

    @cached_property
    def excess(self) -> dict[str, dict[int, float]]:
        """Mean macro-actions of solved tests beyond the fewest that the rules allow; NaN where none was kept."""
        if not self.installed:
            return {}
        fewest = functools.cache(lambda start: fewest_actions(self.spec.rules, start))

        def beyond(row: Checkpoint) -> list[float]:
            if row.kept is None:
                return []
            solved = np.flatnonzero(row.kept.success)
            return [int(row.kept.lengths[test]) - fewest(tuple(row.kept.starts[test].tolist())) for test in solved]

        return {agent: self.means(agent, beyond) for agent in self.agents}

    def said(self, agent: str, name: str) -> dict[int, float]:
        """Mean of one of the agent's diagnostics, by budget."""
        return self.means(agent, lambda row: [row.diagnostics.get(name, math.nan)])

    @property
    def acceptance(self) -> dict[str, dict[int, float]]:
        """Share of imagined transitions that were kept while training to each budget from the one before."""
        found = {agent: self.said(agent, "imagination/acceptance_rate") for agent in self.agents}
        return {agent: rates for agent, rates in found.items() if not all(map(math.isnan, rates.values()))}

    def means(self, agent: str, values: Callable[[Checkpoint], Sequence[float]]) -> dict[int, float]:
        """Mean of the finite values of all seeds, by budget; NaN where there is none."""
        found = {}
        for rows in zip(*(run.checkpoints for run in self.result.of(agent)), strict=True):
            known = [value for row in rows for value in values(row) if math.isfinite(value)]
            found[rows[0].episodes] = float(np.mean(known)) if known else math.nan
        return found

    def prices(self, agent: str) -> dict[int, Price]:
        """What an agent had had, by budget."""
        steps = self.means(agent, lambda row: [row.env_steps])
        updates = self.said(agent, "gradient_updates")
        cpu_s = self.means(agent, lambda row: [row.train_cpu_s])
        return {budget: Price(steps[budget], updates[budget], cpu_s[budget]) for budget in self.budgets}

    @cached_property
    def open_loop(self) -> dict[str, OpenLoop]:
        """Quality of imagination by depth at the last budget, mean over runs."""
        found = {agent: _open_loop(self.result.of(agent)) for agent in self.agents}
        return {agent: loop for agent, loop in found.items() if loop is not None}

    @cached_property
    def frames_before(self) -> dict[str, int | None]:
        """Frames that an agent's encoder was trained on, by its card; 0 without an encoder, None where not known."""
        return {agent: self._frames_before(agent) for agent in self.agents}

    def _frames_before(self, agent: str) -> int | None:
        entry = known_agent(agent)
        if not entry.make:
            return None
        if not entry.needs_encoder:
            return 0
        card = encoders.card(self.result.protocol.encoder_of(entry.encoder_kind))
        return None if card is None or card.get("offer") else int(card["recipe"]["frames"])

    @cached_property
    def thesis(self) -> dict[str, dict[int, tuple[float, float]]]:
        """Mean and standard deviation of success in the thesis."""
        return self._printed(reference.success)

    @cached_property
    def thesis_gains(self) -> dict[str, dict[int, float]]:
        """Gains over DQN in the thesis."""
        return self._printed(reference.gain)

    def _printed(self, lookup: Callable[[str, str], dict[int, V]]) -> dict[str, dict[int, V]]:
        source = self.spec.reference
        found = {agent: lookup(source, agent) for agent in self.agents} if source else {}
        return {agent: rows for agent, rows in found.items() if rows}


def collect(result: BenchResult) -> ReportData:
    """The numbers of a report; each is computed when it is first asked for."""
    return ReportData(result)


def learner_cpu_s(run: RunResult) -> float:
    """CPU seconds in the agent's ``time/*_s`` diagnostics, which are means a real step since the last budget."""
    total = math.nan
    before = 0
    for row in run.checkpoints:
        parts = [value for name, value in row.diagnostics.items() if name.startswith("time/")]
        if parts:
            total = np.nansum([total, sum(parts) * (row.env_steps - before)])
        before = row.env_steps
    return float(total)


def open_loop_csv(result: BenchResult) -> str:
    """One row an imagining agent, seed, budget and imagined depth, with and without the filter."""
    names = [field.name for field in dataclasses.fields(OpenLoop)]
    rows: list[list[object]] = [["agent", "seed", "episodes", "depth", *names]]
    for run, checkpoint in result.rows:
        loop = checkpoint.open_loop
        for index in range(0 if loop is None else len(loop.count)):
            values = [getattr(loop, name)[index] for name in names]
            rows.append([run.agent, run.seed, checkpoint.episodes, index + 1, *values])
    return csv_text(rows)


def summary_csv(data: ReportData) -> str:
    """One row an agent and budget: score, interval, thesis, difference to DQN, gain."""
    rows = [_summary_row(data, agent, budget) for agent in data.agents for budget in data.budgets]
    return csv_text([_SUMMARY_COLUMNS, *rows])


def _summary_row(data: ReportData, agent: str, budget: int) -> list[object]:
    seeds = len(data.result.protocol.seeds)
    success, thesis = data.scores[agent][budget]
    excess = data.excess.get(agent, {}).get(budget, math.nan)
    areas = data.areas.get(agent)
    versus = data.comparisons.get(agent, {}).get(budget)
    compared: list[object] = [""] * 15
    if versus is not None:
        compared = [*versus.difference, versus.p_adjusted, versus.detectable, *versus.gain[:3], versus.thesis_gain]
        compared += [*(versus.paired or [""] * 3), versus.paired_p, versus.improvement]
    return [
        *(agent, budget, seeds),
        *success[:3],
        "episodes" if seeds == 1 else "seeds",
        *(thesis or ["", ""]),
        *compared,
        "" if math.isnan(excess) else excess,
        *(areas[budget][:3] if areas else [""] * 3),
    ]


def _paired(treated: tuple[RunResult, ...], base: tuple[RunResult, ...], index: int) -> statistics.PairedTests | None:
    texts = [[run.checkpoints[index].solved or "" for run in runs] for runs in (treated, base)]
    return statistics.mcnemar(*map("".join, texts)) if all(map(all, texts)) else None


def _open_loop(runs: tuple[RunResult, ...]) -> OpenLoop | None:
    """Mean over runs at the last budget; NaN where the filter keeps nothing in any run."""
    loops = [run.checkpoints[-1].open_loop for run in runs]
    found = [loop for loop in loops if loop is not None]
    if not found:
        return None
    names = [field.name for field in dataclasses.fields(OpenLoop) if field.name != "count"]
    means = {name: _nan_mean(np.stack([getattr(loop, name) for loop in found])) for name in names}
    return OpenLoop(count=np.sum([loop.count for loop in found], axis=0), **means)


def _nan_mean(table: np.ndarray) -> np.ndarray:
    """Mean over the first axis of the known values, infinite uncertainty included; NaN where there are none."""
    known = ~np.isnan(table)
    total = np.where(known, table, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)
