"""The report of a bench of agents: its verdict, and the sections on success, gain and cost.

A section is a function from the numbers to a :class:`.Section`, or None where it has nothing to show; :data:`SECTIONS`
lists them in the order of the page.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
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
    by_budget,
    count,
    decimals,
    estimate,
    p_value,
    percent,
    seconds,
    signed_percent,
)
from imagine_bench.store.loading import archive_files
from imagine_bench.store.results import BenchResult

V = TypeVar("V")
_NAMED = 4  # unfinished runs that are named; the others are counted


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
        colors=figures.colors(data.agents),
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
    seeds = str(len(part.seeds))
    episodes = f"{part.budgets[-1]:,}"
    if result.whole:
        seeds += f" of {len(result.whole.seeds)}"
        episodes += f" of {result.whole.budgets[-1]:,}"
    which = "This bench" if result.whole else "One of these benches"
    named = "; ".join(result.missing[:_NAMED])
    return [
        f"{which} is not finished: shown are {seeds} seeds up to {episodes} real episodes. "
        f"Missing are {named}{'; …' if len(result.missing) > _NAMED else ''}. The same bench command goes on."
    ]


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


def _table(
    name: str, first: str, values: Mapping[str, Mapping[int, V]], words: Callable[[V], str | Cell], *texts: str
) -> Table:
    """A row an agent and a column a budget, each value put into words."""
    return by_budget(name, first, {agent_title(agent): row for agent, row in values.items()}, words, *texts)


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
        f"means over seeds (independent trainings); bands: {_interval_words(data)}; dashed: chance level and optimum; "
        "diamonds: the thesis, with standard deviations."
    )
    image = figures.plot("success", lambda: success_figure(data), caption)
    tables = [_scores(data), _prices(data), *_excess(data), *_thesis_only(data), _seeds(data)]
    return Section("Success against real experience", images=[image], tables=tables)


def _scores(data: ReportData) -> Table:
    caption = f"Columns: real training episodes; in brackets: {_interval_words(data)}."
    if data.thesis:
        caption += f" Thesis: {reference.success_source(str(data.spec.reference))}."
    table = _table("scores", "solved (%) after", data.scores, _score, caption)
    levels = {"chance level": data.facts.chance_level, "optimum": data.facts.optimum}
    more = [[name, *[percent(share)] * len(data.budgets)] for name, share in levels.items()]
    return dataclasses.replace(table, rows=[*table.rows, *more])


def _score(score: Score) -> Cell:
    return estimate(score.success, note=f"thesis {_thesis_text(score.thesis)}" if score.thesis else "")


def _thesis_text(printed: tuple[float, float] | None) -> str:
    """Mean and standard deviation as the thesis prints them; the mean alone where it gives no other."""
    if printed is None:
        return DASH
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
    return [_table("excess", first, data.excess, decimals, caption, "nothing was solved")]


def _thesis_only(data: ReportData) -> list[Table]:
    """The thesis at budgets that this run does not have."""
    budgets = sorted({budget for printed in data.thesis.values() for budget in printed} - set(data.budgets))
    if not budgets:
        return []
    printed = {agent: {budget: row.get(budget) for budget in budgets} for agent, row in data.thesis.items()}
    texts = ("At budgets that this run does not have.", "not tested in the thesis")
    return [_table("thesis", "the thesis, solved (%) after", printed, _thesis_text, *texts)]


def _seeds(data: ReportData) -> Table:
    rows = []
    for agent in data.agents:
        shares = data.result.success_rates(agent)
        for seed, each in zip(data.result.protocol.seeds, shares, strict=True):
            rows.append([agent_title(agent), str(seed), *map(percent, each)])
    header = ["agent", "seed", *(f"{budget:,}" for budget in data.budgets)]
    return Table("seeds", header, rows, folded="Every seed by itself")


def area(data: ReportData) -> Section | None:
    """Mean success up to each budget."""
    if not data.areas:
        return None
    words = (
        "Mean success (%) over all real episodes up to each budget: straight lines between the tests, from the chance "
        "level at episode 0. It is the area under the curve with a linear axis, so early learning counts."
    )
    table = _table("areas", "mean success (%) up to", data.areas, estimate)
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
    alone = "which tests were solved was not kept"
    tables = [
        _table("differences", "difference (points) after", found, _difference, shown),
        _table("gains", "gain (%) after", found, _gain, "", "DQN solved nothing to compare with"),
        _table("paired", "solved alone : by DQN alone, after", found, _alone, told, alone),
    ]
    return Section("Gain over DQN", [words], tables=tables)


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


def acceptance(data: ReportData) -> Section | None:
    """Imagined transitions that the filter kept."""
    if not data.acceptance:
        return None
    words = (
        "An imagined rollout is a chain of transitions that the agent's world model predicts, starting from a real "
        "image; depth counts its macro-actions. The uncertainty filter cuts a rollout at the first transition whose "
        "epistemic uncertainty (what the model does not know for want of data) is too high. Two other kinds are shown "
        "beside it: aleatoric (noise) and modal (several outcomes are possible)."
    )
    caption = (
        "Share of the transitions imagined while training, up to each budget, that went into the replay memory of "
        "imagined transitions. Mean over seeds."
    )
    curves = {}
    for agent, rates in data.acceptance.items():
        curves[agent_title(agent)] = {budget: 100.0 * rate for budget, rate in rates.items()}

    def draw() -> Figure:
        colors = figures.colors(data.agents)
        return figures.lines({"": curves}, colors, "real training episodes", "transitions kept (%)")

    return Section("Imagined transitions kept", [words], [figures.plot("acceptance", draw, caption)])


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


def success_figure(data: ReportData) -> Figure:
    """Success (%) by real training episodes, with 95 % intervals, chance level, optimum and the thesis' points."""
    figure, axes = figures.panel(max(4.9, 0.5 * len(data.agents)))
    ticks = set(data.budgets)
    for level in (data.facts.optimum, data.facts.chance_level):
        axes.axhline(100.0 * level, **figures.REFERENCE)
    for agent, rows in data.scores.items():
        color = figures.color(agent)
        curve = {budget: each.success for budget, each in rows.items()}
        figures.curve(axes, curve, scale=100.0, color=color, label=agent_title(agent))
        printed = data.thesis.get(agent, {})
        near = [budget for budget in printed if budget <= 2.0 * data.budgets[-1]]  # others would leave the run no room
        if near:
            means, stds = 100.0 * np.array([printed[budget] for budget in near]).T
            axes.errorbar(near, means, stds, fmt="D:", color=color, markerfacecolor="none", linewidth=1.0, label="_")
            ticks |= {near[0], near[-1]}
    figures.log_axis(axes, sorted(ticks))
    axes.set(ylabel="test episodes solved (%)", ylim=(-2, 108))
    figures.names_below(figure)
    return figure


SECTIONS: tuple[Callable[[ReportData], Section | None], ...] = (
    compared,
    success,
    exact.world,
    area,
    gain,
    exact.policies,
    exact.causes,
    acceptance,
    imagination.open_loop,
    imagination.sampled_rollouts,
    imagination.filmstrips,
    imagination.encoders_used,
    threshold,
    cost,
)
"""The sections of the page, in their order. A new one is a function and a line here."""
