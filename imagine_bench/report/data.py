"""Every number of a bench's report, computed once from its result: tables, figures and CSV files all read these."""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from imagine_bench import reference, registry, statistics
from imagine_bench.arrays import Arrays
from imagine_bench.errors import SetupError, UnknownNameError
from imagine_bench.exact.certificate import Certificate
from imagine_bench.interfaces import RenderMacrostates, RuleFacts, Rules, State, TaskSpec
from imagine_bench.report.page import estimate, percent
from imagine_bench.rules import fewest_actions
from imagine_bench.running.headlines import Headline, headlines
from imagine_bench.statistics import Estimate
from imagine_bench.store import encoders
from imagine_bench.store.files import csv_text
from imagine_bench.store.results import BenchResult, OpenLoop

Record = dict[str, Any]
"""An agent at one budget: columns of summary.csv, as far as they apply to it, and its costs until then."""
BASE_AGENT = "dqn"  # the agent that gains are measured against, as in the thesis
SCORE = ("success_iqm", "low_95", "high_95")
DIFFERENCE = ("difference_to_dqn", "difference_low_95", "difference_high_95", "p")
GAIN = ("gain", "gain_low_95", "gain_high_95")
AREA = ("area", "area_low_95", "area_high_95")
_PAIRED = ("alone", "dqn_alone", "p_mcnemar")
_SUMMARY_COLUMNS = (
    "agent",
    "episodes",
    "seeds",
    *SCORE,
    "interval_over",
    "thesis_mean",
    "thesis_std",
    *DIFFERENCE,
    "p_holm",
    "detectable_difference",
    *GAIN,
    "thesis_gain",
    *_PAIRED,
    "p_mcnemar_holm",
    "probability_of_improvement",
    "excess_macro_actions",
    *AREA,
)
_LOOP_COLUMNS = tuple(each.name for each in dataclasses.fields(OpenLoop))
_ABSENT = (UnknownNameError, SetupError)
_NO_FACTS = RuleFacts(chance_level=math.nan, optimum=math.nan, optimal_return=math.nan, mean_plan_length=math.nan)


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
            facts=lambda: _NO_FACTS,
            render_macrostates=cast(RenderMacrostates, None),
        )


@dataclass(frozen=True)
class ReportData:
    """The numbers of a bench."""

    result: BenchResult
    spec: TaskSpec  # the task
    facts: (
        RuleFacts | Certificate
    )  # chance level and optimum of the tests; the certificate knows which coordinates frames hide
    learners: list[str]  # the agents that learn
    compared: list[str]  # those that are compared with DQN, where it was run
    thesis: dict[str, dict[int, tuple[float, float]]]  # its mean and standard deviation of success by agent and budget
    #: One an agent and budget; p-values of headlines are corrected for these alone, all others for the others
    records: list[Record]
    headlines: list[Headline]  # the comparisons that the protocol declared

    @property
    def installed(self) -> bool:
        """Whether the task's package is here."""
        return bool(self.spec.action_names)

    @property
    def cells(self) -> int:
        """How many comparisons with DQN there are beside the headlines."""
        beside = [each for each in self.headlines if each.base == BASE_AGENT]
        return len(self.compared) * len(self.result.protocol.budgets) - len(beside)

    def of(self, agent: str) -> list[Record]:
        """The records of an agent, in the order of budgets."""
        return [record for record in self.records if record["agent"] == agent]


def collect(result: BenchResult) -> ReportData:
    """The numbers of a report."""
    protocol = result.protocol
    spec = known_task(protocol.task)
    learners = [agent for agent in protocol.agents if known_agent(agent).learns]
    compared = [agent for agent in learners if agent != BASE_AGENT and BASE_AGENT in learners]
    thesis = {agent: reference.success(spec.reference, agent) if spec.reference else {} for agent in protocol.agents}
    declared = headlines(result)
    data = ReportData(result, spec, _facts(result, spec), learners, compared, thesis, [], declared)
    fewest = functools.cache(functools.partial(fewest_actions, spec.rules))
    for agent in protocol.agents:
        for place in range(len(protocol.budgets)):
            data.records.append(_record(data, agent, place, fewest))
    tested = [record for record in data.records if record["agent"] in compared]
    declared_p = {(each.agent, protocol.budgets[-1]): each.found.p for each in declared if each.base == BASE_AGENT}
    others = [record for record in tested if (record["agent"], record["episodes"]) not in declared_p]
    for name, family in (("p", others), ("p_mcnemar", tested)):
        adjusted = statistics.holm([record.get(name, math.nan) for record in family])
        for record, p in zip(family, adjusted.tolist(), strict=True):
            record[f"{name}_holm"] = p
    for record in tested:
        record["p_holm"] = declared_p.get((record["agent"], record["episodes"]), record.get("p_holm"))
    return data


def _facts(result: BenchResult, spec: TaskSpec) -> RuleFacts | Certificate:
    if result.certificate is not None:
        return result.certificate
    return _NO_FACTS if result.protocol.split else spec.facts()  # a task's own are of all its starts


def _record(data: ReportData, agent: str, place: int, fewest: Callable[[State], int]) -> Record:
    """An agent at the budget of this place; p-values are not corrected yet."""
    result = data.result
    protocol = result.protocol
    budget = protocol.budgets[place]
    trials = protocol.evaluation_episodes
    rows = [run.checkpoints[place] for run in result.of(agent)]
    shares = result.success_rates(agent)
    ends = statistics.interval(shares[:, place], trials=trials)
    if len(rows) == 1:
        ends = statistics.wilson(rows[0].successes, rows[0].test_episodes)
    record: Record = {
        "agent": agent,
        "episodes": budget,
        "seeds": len(rows),
        **dict(zip(SCORE, (statistics.iqm(shares[:, place]), *ends), strict=True)),
        "interval_over": "episodes" if len(rows) == 1 else "too few seeds" if math.isnan(ends[0]) else "seeds",
        "env_steps": mean(row.env_steps for row in rows),
        "train_cpu_s": mean(row.train_cpu_s for row in rows),
        "gradient_updates": mean(row.diagnostics.get("gradient_updates", math.nan) for row in rows),
    }
    if budget in data.thesis[agent]:
        record["thesis_mean"], record["thesis_std"] = data.thesis[agent][budget]
    beyond = []
    for kept in (row.kept for row in rows if row.kept is not None and data.installed):
        for test in np.flatnonzero(kept.success):
            beyond.append(int(kept.lengths[test]) - fewest(tuple(kept.starts[test].tolist())))
    if beyond:
        record["excess_macro_actions"] = mean(beyond)
    if agent in data.learners and data.installed and not math.isnan(data.facts.chance_level):
        areas = statistics.running_means(protocol.budgets, shares, data.facts.chance_level)[:, place]
        area = (statistics.iqm(areas), *statistics.interval(areas, trials=trials))
        record |= zip(AREA, area, strict=True)
    if agent in data.compared:
        record |= _against_dqn(data, agent, place)
    return record


def _against_dqn(data: ReportData, agent: str, place: int) -> Record:
    """An agent compared with DQN; NaN where too few seeds allow no test."""
    result = data.result
    protocol = result.protocol
    trials = protocol.evaluation_episodes
    shares, base = (result.success_rates(name)[:, place] for name in (agent, BASE_AGENT))
    found: Record = {
        **dict(zip(DIFFERENCE, statistics.difference(shares, base, trials=trials), strict=True)),
        "detectable_difference": statistics.detectable(shares, base, cells=data.cells, trials=trials),
        **dict(zip(GAIN, statistics.gain(shares, base, trials=trials)[:3], strict=True)),
        "probability_of_improvement": statistics.probability_of_improvement(shares, base),
    }
    if data.spec.reference:
        found["thesis_gain"] = reference.gain(data.spec.reference, agent).get(protocol.budgets[place])
    seeds = set(protocol.seeds_of(agent)) & set(protocol.seeds_of(BASE_AGENT))
    runs = [[run for run in result.of(name) if run.seed in seeds] for name in (agent, BASE_AGENT)]
    solved = [[run.checkpoints[place].solved or "" for run in each] for each in runs]
    if all(map(all, solved)):  # it is known which tests were solved
        found |= zip(_PAIRED, statistics.mcnemar(*map("".join, solved)), strict=True)
    return found


def mean(values: Iterable[float]) -> float:
    """Mean of the finite values; NaN where there is none."""
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def encoder_of(data: ReportData, agent: str) -> str | None:
    """The identity of the encoder that an agent sees through."""
    entry = known_agent(agent)
    return data.result.protocol.encoder_of(entry.encoder_kind) if entry.make and entry.needs_encoder else None


def card_of(data: ReportData, agent: str) -> Record | None:
    """The card of the encoder that an agent sees through, also of one's own file, which is kept with the bench."""
    used = encoder_of(data, agent)
    if used is None:
        return None
    return encoders.card(used) or _kept_cards(data.result.environment).get(used)


def _kept_cards(facts: Any) -> dict[str, Record]:
    """The cards of encoders that a bench keeps, by identity; of a merged one those of its benches."""
    cards = dict(facts.get("encoders", {}))
    for name, each in facts.items():
        if name.startswith("bench "):
            cards |= _kept_cards(each)
    return cards


def frames_before(data: ReportData, agent: str) -> float:
    """Frames that an agent's encoder was trained on, by its card; 0 without an encoder, NaN where not known."""
    entry = known_agent(agent)
    if entry.make and not entry.needs_encoder:
        return 0
    card = card_of(data, agent)
    return math.nan if card is None or card.get("offer") else int(card["recipe"]["frames"])


def open_loop_means(result: BenchResult) -> dict[str, Arrays]:
    """Quality of imagination by depth at the last budget, by agent: means over runs, and the sum of counts.

    NaN where a measure is known in no run: the filter keeps nothing, or none or all are wrong.
    """
    found = {}
    for agent in result.protocol.agents:
        loops = [run.checkpoints[-1].open_loop for run in result.of(agent)]
        if known := [loop for loop in loops if loop is not None]:
            with warnings.catch_warnings(action="ignore"):  # of a measure that is NaN in every run
                columns = ((name, [getattr(loop, name) for loop in known]) for name in _LOOP_COLUMNS)
                found[agent] = {name: np.nanmean(column, axis=0) for name, column in columns}
            found[agent]["count"] *= len(known)
    return found


def open_loop_csv(result: BenchResult) -> str:
    """One row an imagining agent, seed, budget and imagined depth, with and without the filter."""
    rows: list[list[object]] = [["agent", "seed", "episodes", "depth", *_LOOP_COLUMNS]]
    for run, checkpoint in result.rows:
        if checkpoint.open_loop is not None:
            columns = [getattr(checkpoint.open_loop, name) for name in _LOOP_COLUMNS]
            for depth, values in enumerate(zip(*columns, strict=True), start=1):
                rows.append([run.agent, run.seed, checkpoint.episodes, depth, *values])
    return csv_text(rows)


def summary_csv(data: ReportData) -> str:
    """One row an agent and budget: score, interval, thesis, difference to DQN, gain."""
    rows = [[record.get(name, "") for name in _SUMMARY_COLUMNS] for record in data.records]
    return csv_text([_SUMMARY_COLUMNS, *rows])


def estimated(record: Record, columns: Sequence[str], words: Callable[[float], str] = percent) -> str:
    """An estimate from its columns, with its interval."""
    return estimate(Estimate(*(record[column] for column in columns)), words)
