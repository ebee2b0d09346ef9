"""The report of a bench of agents: its verdict, and the sections on success, gain and cost.

A section is a function from the numbers to a :class:`.Section`, or None where it has nothing to show; :data:`SECTIONS`
lists them in the order of the page.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imagine_bench import reference
from imagine_bench.report import exact, figures, imagination
from imagine_bench.report.data import (
    BASE_AGENT,
    Comparison,
    ReportData,
    Score,
    agent_title,
    collect,
    known_agent,
    learner_cpu_s,
    open_loop_csv,
    summary_csv,
)
from imagine_bench.report.page import made
from imagine_bench.report.tables import (
    DASH,
    Cell,
    Page,
    Section,
    Table,
    count,
    decimals,
    estimate,
    p_value,
    percent,
    seconds,
    signed_percent,
)
from imagine_bench.statistics import Estimate
from imagine_bench.store.archive import archive_files
from imagine_bench.store.results import BenchResult

V = TypeVar("V")
_NAMED = 4  # unfinished runs that are named; the others are counted
_DIAMONDS: dict[str, Any] = {
    "marker": "D", "markersize": 5, "markerfacecolor": "none", "linestyle": ":", "linewidth": 1.0, "label": "_"
}  # fmt: skip


def bench_page(result: BenchResult) -> Page:
    """The report. Everything comes from ``result`` and the encoder's card, so it is the same every time."""
    data = collect(result)
    protocol = result.protocol
    files = {**archive_files(result), "summary.csv": summary_csv(data)}
    if data.open_loop:
        files["open_loop.csv"] = open_loop_csv(result)
    found = [section(data) for section in SECTIONS]
    titles = {agent: agent_title(agent) for agent in data.agents}
    split = f"; tests start where training never does, {protocol.split}" if protocol.split else ""
    return Page(
        title=f"{data.spec.title}: does imagination save real experience?",
        subtitle=f"Preset {protocol.preset} · {protocol.execution} execution · appearance “{protocol.looks}”"
        f"{_dataset_words(data)}{split} · protocol {result.protocol_hash}",
        question="Does training on transitions that a learned world model imagines save real episodes? Every agent is "
        "tested without exploring, on the same new episodes, after each number of real training episodes.",
        answers=verdict(data),
        sections=[section for section in found if section is not None],
        files=files,
        colors={title: figures.color(agent) for agent, title in titles.items()},
        summary=terminal_text(data),
        **made(result, titles),
    )


# The verdict -------------------------------------------------------------------------------------------------------


def verdict(data: ReportData) -> list[str]:
    """What is missing, and a line a learner: whether it is better or worse than DQN, and where most clearly."""
    lines = [*_unfinished(data.result), *_not_installed(data)]
    lines += [_against_dqn(data, agent) for agent in data.comparisons]
    return lines or ["Nothing is compared: that needs dqn and another learner side by side."]


def _against_dqn(data: ReportData, agent: str) -> str:
    rows = data.comparisons[agent]
    budget = min(reversed(rows), key=lambda budget: rows[budget].p_adjusted)
    score, base = (percent(data.scores[name][budget].success.value) for name in (agent, BASE_AGENT))
    difference = rows[budget].difference
    clearest = f"after {budget:,} episodes {score} % of tests, DQN {base} %, difference "
    clearest += f"{estimate(difference, signed_percent)} points"
    if math.isnan(difference.low):
        return f"“{agent_title(agent)}” against DQN: {clearest}. One seed does not show which is better."
    shown = {"better": 1, "worse": -1}
    budgets = {word: [f"{b:,}" for b, each in rows.items() if each.shown == sign] for word, sign in shown.items()}
    words = [f"{word} after {', '.join(each)} real episodes" for word, each in budgets.items() if each]
    return (
        f"“{agent_title(agent)}” against DQN: {', '.join(words) or 'no difference is shown'} ({len(rows)} budgets). "
        f"Clearest {clearest} (95 % interval; {p_value(rows[budget].p_adjusted)}, Holm-corrected)."
    )


def _unfinished(result: BenchResult) -> list[str]:
    if not result.missing:
        return []
    part = result.protocol
    first = f"One of these benches is not finished: shown are {len(part.seeds)} seeds up to {part.budgets[-1]:,}"
    if result.whole is not None:
        seeds = f"{len(part.seeds)} of {len(result.whole.seeds)} seeds"
        first = f"This bench is not finished: shown are {seeds} up to {part.budgets[-1]:,} of "
        first += f"{result.whole.budgets[-1]:,}"
    more = len(result.missing) - _NAMED
    named = [*result.missing[:_NAMED], *([f"{more} more"] if more > 0 else [])]
    return [f"{first} real episodes. Missing are {'; '.join(named)}. The same bench command goes on."]


def _not_installed(data: ReportData) -> list[str]:
    names = [] if data.installed else [f"task {data.spec.id}"]
    names += [f"agent {agent}" for agent in data.agents if not known_agent(agent).make]
    return [f"Not installed here: {', '.join(names)}. What follows from their code is not shown."] if names else []


def terminal_text(data: ReportData) -> str:
    """Success (%) of every agent at every budget, chance level, optimum and thesis beside them; and the verdict."""
    protocol = data.result.protocol
    title = (
        f"{data.spec.title}: test episodes solved, % [{_interval_words(data)}]; preset {protocol.preset}, "
        f"{protocol.execution}, {protocol.looks}, {len(protocol.seeds)} seed(s) x "
        f"{protocol.evaluation_episodes} test episodes{_dataset_words(data)}"
    )
    tables = [table.text for table in (_scores(data), *_thesis_only(data))]
    return "\n\n".join([title, *tables, "\n".join(verdict(data))])


def _dataset_words(data: ReportData) -> str:
    dataset = data.result.protocol.dataset
    return f"; trained first on dataset {dataset}" if dataset else ""


def _interval_words(data: ReportData) -> str:
    if len(data.result.protocol.seeds) == 1:
        return "95 % interval over test episodes only (Wilson; one seed says nothing about the luck of training)"
    return "95 % interval over seeds (Student's, of the trimmed mean)"


# Tables ------------------------------------------------------------------------------------------------------------


def _by_budget(
    data: ReportData, name: str, first: str, values: Mapping[str, Mapping[int, V]], words: Callable[[V], str | Cell],
    caption: str = "", why_dash: str = "",
) -> Table:  # fmt: skip
    """A table of a row an agent and a column a budget, each value put into words."""
    rows = [[agent_title(agent), *map(words, row.values())] for agent, row in values.items()]
    return Table(name, [first, *_columns(data.budgets)], rows, caption, why_dash)


def _columns(budgets: Sequence[int]) -> list[str]:
    return [f"{budget:,}" for budget in budgets]


def compared(data: ReportData) -> Section:
    """The task and the agents."""
    spec = data.spec
    words = [spec.description]
    if data.installed:
        words.append(
            f"The robot sees a camera image and chooses among {spec.n_actions} macro-actions (whole movements of the "
            f"arm): {'; '.join(spec.action_names)}. An episode ends in success, in failure or after {spec.horizon} "
            f"macro-actions. Exact, from the rules: perfect play solves {percent(data.facts.optimum)} % of episodes in "
            f"{data.facts.mean_plan_length:.2f} macro-actions on average, blind choice "
            f"{percent(data.facts.chance_level)} %."
        )
    rows = [[agent_title(agent), known_agent(agent).description] for agent in data.agents]
    return Section("What was compared", words, tables=[Table("agents", ["agent", "what it does"], rows, prose=True)])


def success(data: ReportData) -> Section:
    """Success of every agent at every budget, with its price."""
    caption = (
        "Test episodes solved after so many real training episodes; the axis is logarithmic. Points are interquartile "
        f"means over seeds (independent trainings); bands: {_interval_words(data)}."
    )
    image = figures.plot("success", lambda: success_figure(data), caption)
    tables = [_scores(data), _prices(data), *_excess(data), *_thesis_only(data), _seeds(data)]
    return Section("Success against real experience", images=[image], tables=tables)


def _scores(data: ReportData) -> Table:
    caption = f"Columns: real training episodes; in brackets: {_interval_words(data)}."
    if data.thesis:
        caption += f" Thesis: {reference.success_source(str(data.spec.reference))}."
    table = _by_budget(data, "scores", "solved (%) after", data.scores, _score, caption)
    levels = {"chance level": data.facts.chance_level, "optimum": data.facts.optimum}
    more = [[name, *[percent(share)] * len(data.budgets)] for name, share in levels.items()]
    return dataclasses.replace(table, rows=[*table.rows, *more])


def _score(score: Score) -> Cell:
    return estimate(score.success, note=f"thesis {_thesis_text(score.thesis)}" if score.thesis else "")


def _thesis_text(printed: tuple[float, float]) -> str:
    """Mean and standard deviation as the thesis prints them; the mean alone where it gives no other."""
    mean, std = printed
    return percent(mean) if math.isnan(std) else f"{percent(mean)} ({percent(std)})"


def _prices(data: ReportData) -> Table:
    """What each agent had had at the last budget."""
    last = data.budgets[-1]
    rows = []
    for agent in data.agents:
        frames = data.frames_before[agent]
        price = data.prices(agent)[last]
        counts = (price.env_steps, math.nan if frames is None else frames, price.updates)
        rows.append([agent_title(agent), *map(count, counts), seconds(price.train_cpu_s)])
    columns = ("real macro-actions", "frames its encoder saw before", "gradient updates", "training (CPU s)")
    caption = "Means over seeds. Frames before training are drawn from all macrostates alike."
    why = "not counted by the agent, or an encoder that is not bundled"
    return Table("prices", [f"price of {last:,} episodes", *columns], rows, caption, why)


def _excess(data: ReportData) -> list[Table]:
    """Macro-actions beyond the shortest plan, where test episodes were kept."""
    if all(math.isnan(value) for by_budget in data.excess.values() for value in by_budget.values()):
        return []
    caption = "Means over the solved tests; the shortest plan from each start is exact, from the rules."
    first = "macro-actions beyond the shortest plan, after"
    return [_by_budget(data, "excess", first, data.excess, decimals, caption, "nothing was solved")]


def _thesis_only(data: ReportData) -> list[Table]:
    """The thesis at budgets that this run does not have."""
    budgets = sorted({budget for printed in data.thesis.values() for budget in printed} - set(data.budgets))
    if not budgets:
        return []
    rows = [
        [agent_title(agent), *(_thesis_text(printed[b]) if b in printed else DASH for b in budgets)]
        for agent, printed in data.thesis.items()
    ]
    header = ["the thesis, solved (%) after", *_columns(budgets)]
    caption = "At budgets that this run does not have."
    return [Table("thesis", header, rows, caption, "not tested in the thesis")]


def _seeds(data: ReportData) -> Table:
    rows = [
        [agent_title(agent), str(seed), *map(percent, shares)]
        for agent in data.agents
        for seed, shares in zip(data.result.protocol.seeds, data.result.success_rates(agent), strict=True)
    ]
    return Table("seeds", ["agent", "seed", *_columns(data.budgets)], rows, folded="Every seed by itself")


def area(data: ReportData) -> Section | None:
    """Mean success up to each budget."""
    if not data.areas:
        return None
    words = (
        "Mean success (%) over all real episodes up to each budget: straight lines between the tests, from the chance "
        "level at episode 0. It is the area under the curve with a linear axis, so early learning counts."
    )
    table = _by_budget(data, "areas", "mean success (%) up to", data.areas, estimate)
    return Section("Area under the success curve", [words], tables=[table])


def gain(data: ReportData) -> Section | None:
    """Every learner against DQN, beside the thesis' gains."""
    found = data.comparisons
    if not found:
        return None
    every = [each for by_budget in found.values() for each in by_budget.values()]
    shown = _detectable([each.detectable for each in every])
    told = _detectable([each.paired_detectable for each in every])
    words = (
        "Difference: percentage points of test episodes solved. Gain: the same relative to DQN, (agent − DQN) / DQN, "
        "the thesis' measure. One seed has no interval, nor has a gain over a DQN that may have solved nothing. "
        "Solved alone: tests that one of two agents solved and the other did not, from the same starts and seeds, with "
        "McNemar's exact test (Holm-corrected); it compares these trained agents, not two ways of training."
    )
    caption = "Gain of the means over seeds; bands: 95 % interval over seeds (Fieller). Diamonds: the thesis' means."
    image = figures.plot("gain", lambda: gain_figure(data), caption)
    alone = "which tests were solved was not kept"
    tables = [
        _by_budget(data, "differences", "difference (points) after", found, _difference, shown),
        _by_budget(data, "gains", "gain (%) after", found, _gain, why_dash="DQN solved nothing to compare with"),
        _by_budget(data, "paired", "solved alone : by DQN alone, after", found, _alone, told, alone),
    ]
    drawn = any(_near(data, printed) for printed in data.thesis_gains.values())
    return Section("Gain over DQN", [words], [image] if drawn else [], tables)


def _detectable(sizes: Sequence[float]) -> str:
    """How small a difference the cells of a table could have shown; empty where that is not known."""
    known = [size for size in sizes if not math.isnan(size)]
    if not known:
        return ""
    return (
        f"p-values are Holm-corrected for {len(sizes)} cells. The smallest difference that would be shown with "
        f"probability 80 % is {percent(min(known))} to {percent(max(known))} points, by cell."
    )


def _difference(versus: Comparison) -> Cell:
    return estimate(versus.difference, signed_percent)


def _gain(versus: Comparison) -> Cell:
    printed = versus.thesis_gain
    return estimate(versus.gain, signed_percent, "" if printed is None else f"thesis {signed_percent(printed)}")


def _alone(versus: Comparison) -> Cell:
    note = f"ahead in {percent(versus.improvement)} % of pairs of runs"
    if versus.paired is None:
        return Cell(DASH, note=note)
    text = f"{versus.paired.first:,} : {versus.paired.second:,}"
    return Cell(text, f"({p_value(versus.paired_p)})", note)


def threshold(data: ReportData) -> Section | None:
    """Real episodes until the task counts as solved."""
    if not data.reached:
        return None
    asked = f"{100 * data.spec.success_threshold:g}\u00a0%"
    rows = []
    for agent, seeds in data.reached.items():
        there = [budget for budget in seeds if budget is not None]
        mean = f"{DASH} ({len(there)} of {len(seeds)} seeds)"
        if len(there) == len(seeds):
            mean = f"{sum(there) / len(there):.0f}"
        rows.append([agent_title(agent), mean, ", ".join(count(math.nan if b is None else b) for b in seeds)])
    known = data.result.certificate
    lowest = known.floor.episodes if known and known.floor else None
    caption = (
        "Points are seeds, bars medians, triangles seeds that did not reach it by the last test. A dashed line "
        "shows the cost of a cautious learner that knows the factor graph and nothing else."
    )
    image = figures.plot("ladder", lambda: figures.ladder_figure(data.reached, data.budgets[-1], lowest), caption)
    words = (
        f"The first tested budget from which on every test is solved to at least {asked}, this task's success "
        f"threshold. {DASH}: the last test is not."
    )
    table = Table("reached", ["agent", "mean", "by seed"], rows)
    return Section(f"Real episodes to {asked}", [words], [image], [table])


def cost(data: ReportData) -> Section:
    """CPU seconds and faults."""
    header = ["one run, mean over seeds; CPU s", "real macro-actions", "training", "of which learning"]
    header += ["the rest: environment, seeing, acting", "all tests", "faults in all tests"]
    caption = (
        "A fault is a macro-action whose physical outcome was not what the rules say; it is counted, never hidden. The "
        f"whole bench took {data.result.wall_s:,.0f} s of wall time."
    )
    rows = [_cost_row(data, agent) for agent in data.agents]
    table = Table("cost", header, rows, caption, "the agent does not report its learning by itself")
    return Section("What it cost, and what went wrong", tables=[table])


def _cost_row(data: ReportData, agent: str) -> list[str]:
    """The one test of an agent that does not learn stands at every budget, and counts once."""
    runs = data.result.of(agent)
    price = data.prices(agent)[data.budgets[-1]]
    tested = None if known_agent(agent).learns else 1
    tests = [row for run in runs for row in run.checkpoints[:tested]]
    learning = float(np.mean([learner_cpu_s(run) for run in runs]))
    testing = sum(row.eval_cpu_s for row in tests) / len(runs)
    times = (price.train_cpu_s, learning, price.train_cpu_s - learning, testing)
    played = round(sum(row.mean_length * row.test_episodes for row in tests))
    faults = sum(row.faults for row in tests)
    return [agent_title(agent), count(price.env_steps), *map(seconds, times), f"{faults} of {played:,}"]


# Figures -----------------------------------------------------------------------------------------------------------


def success_figure(data: ReportData) -> Figure:
    """Success (%) by real training episodes, with 95 % intervals, chance level, optimum and the thesis' points."""
    levels = {"optimum": data.facts.optimum, "chance level": data.facts.chance_level}
    curves = {agent: {b: each.success for b, each in row.items()} for agent, row in data.scores.items()}
    figure, axes = _against_episodes(data, curves, data.thesis, levels)
    axes.set(ylabel="test episodes solved (%)", ylim=(-2, 108))
    return figure


def gain_figure(data: ReportData) -> Figure:
    """Gain over DQN (%) by real training episodes, beside the thesis' (figures 5.5 and 5.7).

    Only agents of which the thesis gives a gain are shown: others' may be tens of times as large.
    """
    printed = {agent: {b: (gain, 0.0) for b, gain in rows.items()} for agent, rows in data.thesis_gains.items()}
    curves = {agent: {b: each.gain for b, each in data.comparisons[agent].items()} for agent in printed}
    figure, axes = _against_episodes(data, curves, printed, {"as DQN": 0.0})
    axes.set(ylabel="gain over DQN (%)")
    return figure


def _against_episodes(
    data: ReportData, curves: Mapping[str, Mapping[int, Estimate]],
    printed: Mapping[str, Mapping[int, tuple[float, float]]], levels: Mapping[str, float],
) -> tuple[Figure, Axes]:  # fmt: skip
    """Curves in percent by real episodes, the thesis' points near them, and lines at some levels."""
    figure, axes = figures.panel(max(4.9, 0.5 * len(curves)))
    for level in levels.values():
        axes.axhline(100.0 * level, **figures.REFERENCE)
    marks = {"this run, band: 95 % interval": {"marker": "o"}}
    marks[" and ".join(levels)] = figures.REFERENCE
    ticks = set(data.budgets)
    for agent, values in curves.items():
        figures.curve(axes, values, scale=100.0, color=figures.color(agent), label=agent_title(agent))
        if shown := _near(data, printed.get(agent, {})):
            means, stds = 100.0 * np.array([printed[agent][budget] for budget in shown]).T
            axes.errorbar(shown, means, stds, color=figures.color(agent), elinewidth=0.8, capsize=2, **_DIAMONDS)
            marks["thesis, bar: standard deviation"] = _DIAMONDS
            ticks |= {shown[0], shown[-1]}
    figures.log_axis(axes, sorted(ticks))
    figures.names_right(figure, axes)
    figures.meanings(axes, marks)
    return figure, axes


def _near(data: ReportData, printed: Mapping[int, object]) -> list[int]:
    """Budgets of the thesis' values that stand near those of this run; further ones would leave it no room."""
    return [budget for budget in printed if budget <= 2.0 * data.budgets[-1]]


SECTIONS: tuple[Callable[[ReportData], Section | None], ...] = (
    compared,
    success,
    exact.world,
    area,
    gain,
    exact.policies,
    exact.causes,
    imagination.acceptance,
    imagination.open_loop,
    imagination.sampled_rollouts,
    imagination.filmstrips,
    imagination.encoders_used,
    threshold,
    cost,
)
"""The sections of the page, in their order. A new one is a function and a line here."""
