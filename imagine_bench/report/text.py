"""The sentences of a report: what the agents are, and the short answer, computed from the numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from imagine_bench import statistics
from imagine_bench.report.data import BASE_AGENT, Comparison, ReportData, Score
from imagine_bench.report.missing import known_agent, missing
from imagine_bench.report.tables import DASH
from imagine_bench.statistics import Estimate

_NAMED = 4  # missing runs that are named; the others are counted


class AgentWords(NamedTuple):
    """How an agent is introduced."""

    title: str
    description: str


def agent_words(agent: str) -> AgentWords:
    """Title and description of an agent from its registry line; of one that is not here, its name."""
    entry = known_agent(agent)
    return AgentWords(entry.title or agent.replace("_", " "), entry.description)


def lasting(budgets: Sequence[int | None]) -> str:
    """Mean number of episodes; where some seeds never got there, how many did."""
    there = [budget for budget in budgets if budget is not None]
    if len(there) < len(budgets):
        return f"{DASH} ({len(there)} of {len(budgets)} seeds)"
    return f"{sum(there) / len(there):.0f}"


def origin(facts: Mapping[str, object]) -> str:
    """Where the figures of a page come from: ``protocol hash 6bf1d791349c; commit c9d5ec664788.`` and so on."""
    return "; ".join(f"{name.replace('_', ' ')} {value}" for name, value in facts.items()) + "."


def percent(share: float) -> str:
    """A share as a percentage with one decimal: ``0.6125`` as ``61.3``; not a number as a dash."""
    return DASH if math.isnan(share) else f"{100.0 * share:.1f}"


def signed_percent(share: float) -> str:
    """Like :func:`percent` with a sign, the minus a true one."""
    return DASH if math.isnan(share) else f"{100.0 * share:+.1f}".replace("-", "\u2212")


def mean_text(values: Sequence[float], words: Callable[[float], str] = percent) -> str:
    """Mean of a few runs with its 95 % interval; of one run the value alone, and a dash where one has none (NaN)."""
    if any(math.isnan(value) for value in values):
        return DASH
    mean = words(float(np.mean(values)))
    if len(values) == 1:
        return mean
    low, high = statistics.interval(values, trim=0.0, share=words is percent)
    return f"{mean} [{words(low)}, {words(high)}]"


def interval_text(low: float, high: float, words: Callable[[float], str] = percent) -> str:
    """``[55.0, 67.2]``; empty where there is no interval: one seed, or a boundless gain."""
    return "" if math.isnan(low) else f"[{words(low)}, {words(high)}]"


def score_text(score: Score | Estimate) -> str:
    """``61.3 [55.0, 67.2]``, or without the brackets where there is no interval."""
    return f"{percent(score.value)} {interval_text(score.low, score.high)}".strip()


def estimate_text(estimate: Estimate) -> str:
    """``+6.3 [−2.0, +14.1]``, or without the brackets where there is no interval."""
    return f"{signed_percent(estimate.value)} {interval_text(estimate.low, estimate.high, signed_percent)}".strip()


def question(data: ReportData) -> str:
    """What was asked."""
    protocol = data.result.protocol
    return (
        "Does imagination, training on transitions that a learned world model predicts, let a robot solve "
        f"“{data.spec.title}” with less real experience? {_count(len(protocol.agents), 'agent')} "
        f"{'was' if len(protocol.agents) == 1 else 'were'} trained from {_count(len(protocol.seeds), 'seed')} for up "
        f"to {protocol.budgets[-1]:,} real episodes and tested, without exploring, on {protocol.evaluation_episodes:,} "
        f"new episodes at each of {_count(len(protocol.budgets), 'budget')}."
    )


def answers(data: ReportData) -> list[str]:
    """The short answer, one sentence a finding, whatever the numbers say."""
    budget = data.decisive_budget
    sentences = [_unfinished(data)] if data.result.missing else []
    absent = missing(data.result.protocol, certified=data.result.certificate is not None)
    sentences += [absent] if absent else []
    if BASE_AGENT in data.scores:
        where = ", where the learners differ most," if data.spread(budget) > 0 and len(data.budgets) > 1 else ""
        sentences.append(
            f"After {budget:,} real episodes{where} DQN, which learns from real experience only, solves "
            f"{percent(data.scores[BASE_AGENT][budget].value)}\u00a0% of the test episodes "
            f"(chance {percent(data.facts.chance_level)}\u00a0%, optimum {percent(data.facts.optimum)}\u00a0%)."
        )
    sentences += [_verdict(data, agent) for agent in data.comparisons]
    if len(data.areas) > 1:
        sentences.append(_largest_area(data))
    if not data.comparisons:
        sentences.append(
            "Whether imagination helps cannot be said from this run: it needs dqn and an imagining agent side by side."
        )
    return sentences


def detectable_words(comparisons: Mapping[str, Mapping[int, Comparison]]) -> str:
    """How small a difference a table of comparisons could have shown; empty with one seed."""
    sizes = [each.detectable for by_budget in comparisons.values() for each in by_budget.values()]
    if not sizes or any(math.isnan(size) for size in sizes):
        return ""
    least, most = percent(min(sizes)), percent(max(sizes))
    return (
        f"Ahead or behind: p < 0.05 after Holm's correction for all {len(sizes)} comparisons. With these seeds the "
        f"smallest difference that would be shown with probability 80 % is {least} to {most} points, by cell."
    )


def paired_words(comparisons: Mapping[str, Mapping[int, Comparison]]) -> str:
    """What a table of tests from the same starts says, and how small a difference it could have shown."""
    every = [each for by_budget in comparisons.values() for each in by_budget.values()]
    sizes = [each.paired_detectable for each in every if each.paired is not None]
    if not sizes:
        return ""
    return (
        f"Of the same starts and seeds. p: McNemar's exact test after Holm's correction for all {len(every)} cells. It "
        "tells these trained agents apart, not two ways of training, which need the intervals over seeds above. A "
        f"difference of {percent(min(sizes))} to {percent(max(sizes))} points, by cell, would have been shown with "
        "probability 80 %. Below: how often a run of the agent is ahead of one of DQN, ties half."
    )


def paired_answers(data: ReportData) -> list[str]:
    """What tests from the same starts say of each agent beside DQN, at the budget of the short answer."""
    budget = data.decisive_budget
    said = [_paired_answer(agent, budget, each[budget]) for agent, each in data.comparisons.items()]
    excess = {agent: each[budget] for agent, each in data.excess.items() if not math.isnan(each[budget])}
    if excess:
        named = "; ".join(f"“{agent_words(agent).title}” {value:.2f}" for agent, value in excess.items())
        said.append(f"Macro-actions beyond the shortest plan, in the tests that were solved after {budget:,}: {named}.")
    return [each for each in said if each]


def _paired_answer(agent: str, budget: int, versus: Comparison) -> str:
    if versus.paired is None:
        return ""
    alone, dqn_alone = versus.paired.first, versus.paired.second
    verdict = "which of these trained agents is better is not shown"
    if versus.paired_p < 1.0 - statistics.LEVEL:
        verdict = f"these trained agents are {'better' if alone > dqn_alone else 'worse'} than those of DQN"
    return (
        f"From the same starts, after {budget:,} real episodes, “{agent_words(agent).title}” alone solves {alone:,} "
        f"tests and DQN alone {dqn_alone:,} ({chance_words(versus.paired_p)}, McNemar's exact test, corrected): "
        f"{verdict}; a difference of {percent(versus.paired_detectable)} points would have been shown with probability "
        f"80 %. A run of it is ahead of one of DQN in {percent(versus.improvement)} % of pairs."
    )


def _largest_area(data: ReportData) -> str:
    budget = data.budgets[-1]
    areas = {agent: by_budget[budget] for agent, by_budget in data.areas.items()}
    named = {agent: f"“{agent_words(agent).title}” ({score_text(area)} %)" for agent, area in areas.items()}
    ranked = sorted(areas, key=lambda agent: areas[agent].value, reverse=True)
    first = [named[agent] for agent in ranked if areas[agent].value == areas[ranked[0]].value]
    who = f"{_listing(first)} alike" if len(first) > 1 else f"{first[0]}; next is {named[ranked[1]]}"
    return f"Over all episodes up to {budget:,} the mean success is highest for {who}."


def _unfinished(data: ReportData) -> str:
    whole, part = data.result.whole, data.result.protocol
    missing, more = data.result.missing[:_NAMED], len(data.result.missing) - _NAMED
    others = f"; and {_count(more, 'more run')}" if more > 0 else ""
    if whole is None:  # several benches as one
        shown = f"One of these benches is not finished: shown are {_count(len(part.seeds), 'seed')} up to "
        shown += f"{part.budgets[-1]:,} real episodes."
    else:
        shown = f"This bench is not finished: shown are {len(part.seeds)} of {_count(len(whole.seeds), 'seed')} up to "
        shown += f"{part.budgets[-1]:,} of {whole.budgets[-1]:,} real episodes."
    return f"{shown} Missing are {'; '.join(missing)}{others}. The same bench command goes on."


def _verdict(data: ReportData, agent: str) -> str:
    budget, comparisons = data.decisive_budget, data.comparisons[agent]
    difference = comparisons[budget].difference
    score = percent(data.scores[agent][budget].value)
    head = f"“{agent_words(agent).title}” solves {score}\u00a0%, {_points(difference)}"
    if math.isnan(difference.low):
        return f"{head}; one seed says nothing about how much of that is luck."
    interval = f"95 % interval {signed_percent(difference.low)} to {signed_percent(difference.high)}"
    chance = chance_words(comparisons[budget].p_adjusted)
    verdict = {1: "it is ahead", -1: "it is behind", 0: "no difference is shown"}[comparisons[budget].shown]
    return f"{head} ({interval}; {chance}, corrected): at this budget {verdict}. {_over_budgets(comparisons)}"


def chance_words(p: float) -> str:
    """A p-value in words."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _over_budgets(comparisons: dict[int, Comparison]) -> str:
    if len(comparisons) < 2:
        return ""
    shown = {
        word: [f"{budget:,}" for budget, comparison in comparisons.items() if comparison.shown == sign]
        for word, sign in (("ahead", 1), ("behind", -1))
    }
    parts = [f"{word} at {_listing(budgets)}" for word, budgets in shown.items() if budgets]
    if not parts:
        return f"At none of the {len(comparisons)} budgets is a difference shown."
    most = max(comparisons, key=lambda budget: abs(comparisons[budget].difference.value))
    return (
        f"Over all budgets it is {' and '.join(parts)} real episodes (of {len(comparisons)} budgets); the largest "
        f"difference is {estimate_text(comparisons[most].difference)} points at {most:,}."
    )


def _points(difference: Estimate) -> str:
    if difference.value == 0:
        return "exactly as much as DQN"
    which = "less" if difference.value < 0 else "more"
    return f"{abs(100.0 * difference.value):.1f} percentage points {which} than DQN"


def _listing(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
