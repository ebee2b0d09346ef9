"""The report of a bench of agents: its verdict, and the sections on success, gain and cost.

A section is a function from the numbers to a :class:`.Section`, or None where it has nothing to show; :data:`SECTIONS`
lists them in the order of the page.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from imagine_bench import reference
from imagine_bench.arrays import Floats
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.presets import PRESETS
from imagine_bench.registry.entries import FIRST
from imagine_bench.report import figures, sections
from imagine_bench.report.data import (
    BASE_AGENT,
    DIFFERENCE,
    GAIN,
    SCORE,
    Record,
    ReportData,
    card_of,
    collect,
    encoder_of,
    estimated,
    frames_before,
    known_agent,
    open_loop_csv,
    summary_csv,
)
from imagine_bench.report.page import (
    DASH,
    Page,
    Section,
    Table,
    count,
    estimate,
    made,
    over_seeds,
    p_level,
    percent,
    printed,
    seconds,
    seeds_note,
    signed_percent,
)
from imagine_bench.running.headlines import Headline
from imagine_bench.seeding import seeds_text
from imagine_bench.statistics import LEVEL, Estimate, first_lasting, more_seeds
from imagine_bench.store import encoders
from imagine_bench.store.loading import archive_files
from imagine_bench.store.results import BenchResult

_EQUAL_UPDATES = "dqn_more_updates"
_UNTIL = " --until-decided"
_SEEDS_OPTION = re.compile(r" --until-decided| --(?:most-)?seeds[ =]\d[\d-]*(?: \d[\d-]*)*")


def bench_page(result: BenchResult) -> Page:
    """The report. Everything comes from ``result`` and the encoder's card, so it is the same every time."""
    data = collect(result)
    protocol = result.protocol
    files = {**archive_files(result), "summary.csv": summary_csv(data)}
    if any(row.open_loop for _, row in result.rows):
        files["open_loop.csv"] = open_loop_csv(result)
    helped = "".join(f" · {words}" for words in _beyond_own_episodes(protocol))
    execution = ", ".join([f"{protocol.execution} execution", *(f"{name}={value}" for name, value in protocol.physics)])
    split = f" · tests start where training never does, {protocol.split}" if protocol.split else ""
    fewer = [f"{agent} {len(protocol.seeds_of(agent))}" for agent, _ in protocol.few_seeds]
    few = f" ({', '.join(fewer)})" if fewer else ""
    trials = protocol.evaluation_episodes
    interval = seeds_note(len(protocol.seeds))
    if len(protocol.seeds) == 1:
        interval = "95 % interval over test episodes only (Wilson; one seed says nothing about the luck of training)"
    subtitle = (
        f"Preset {protocol.preset} · {execution} · appearance “{protocol.appearance_in_words}” · "
        f"{len(protocol.seeds)} seed{'s' * (len(protocol.seeds) != 1)}{few}, "
        f"{trials} test episode{'s' * (trials != 1)}{helped}{split} · "
        f"{interval} · protocol {result.protocol_hash}"
    )
    return Page(
        title=f"{data.spec.title}: does imagination save real experience?",
        subtitle=subtitle,
        question="Does training on transitions that a learned world model imagines save real episodes? Every agent is "
        "tested without exploring, on the same new episodes, after each number of real training episodes.",
        table=_scores(data, protocol.budgets, short=True),
        sections=[section for make in SECTIONS if (section := make(data)) is not None],
        files=files,
        facts=made(result),
    )


def _beyond_own_episodes(protocol: Protocol) -> Iterator[str]:
    """The help that learners get beyond their own episodes on the task, in words."""
    if protocol.dataset:
        yield f"trained first on dataset {protocol.dataset}"
    if protocol.after:
        notice = ", without notice of a change" * protocol.unannounced
        yield f"trained before on {', '.join(protocol.after)}, {protocol.after_episodes:,} episodes each{notice}"
    if protocol.demonstrations:
        yield f"first training episodes demonstrated: {min(protocol.demonstrations, protocol.budgets[-1]):,}"
    if protocol.queries:
        yield f"up to {protocol.queries:,} oracle queries an episode"
    if protocol.feedback:
        yield f"a teacher's feedback of {protocol.feedback:g}, wrong in {percent(protocol.feedback_error)} %"


# The verdict -------------------------------------------------------------------------------------------------------


def verdict(data: ReportData) -> list[str]:
    """The verdict: headlines first, a line an agent; then every other learner against DQN; then the faults."""
    amiss = list(_amiss(data))
    by_agent: dict[str, list[str]] = {}
    for headline in data.headlines:
        by_agent.setdefault(headline.agent, []).append(_of_headline(data, headline))
    pairs = {(each.agent, each.base) for each in data.headlines}
    for agent in data.compared:
        if (agent, BASE_AGENT) not in pairs:
            by_agent.setdefault(agent, []).append(_against_dqn(data, agent))
    lines = [f"{agent}: {'; '.join(found)}." for agent, found in by_agent.items()]
    lines = lines or [f"Nothing is compared, as {BASE_AGENT} or another learner is missing; name both with --agents."]
    return [*amiss, *lines] if data.result.missing else [*lines, *amiss]


def _of_headline(data: ReportData, headline: Headline) -> str:
    """The verdict on one headline, the better one first where a gain vanishes."""
    base = headline.base
    if base == _EQUAL_UPDATES:
        base += " (as many gradient updates)"
    budget = data.result.protocol.budgets[-1]
    found = headline.found
    size = f"{estimate(found, signed_percent)} points at {budget:,}"
    if headline.decided:
        word = "better" if found.value > 0.0 else "worse"
        return f"{word} than {base}, {size} ({p_level(found.p)})"
    undecided = _undecided(data, headline.agent, headline.base, headline.more)
    if math.isnan(found.p):
        return f"{size} against {base}, {undecided}"
    return f"no gain over {base} is shown, {size}, {undecided}"


def _against_dqn(data: ReportData, agent: str) -> str:
    """One verdict on an agent against DQN, of all budgets together."""
    rows = data.of(agent)
    parts = []
    for word, sign in (("better", 1), ("worse", -1)):
        there = [row for row in rows if shown(row) == sign]
        if there:
            budgets = [f"{row['episodes']:,}" for row in there]
            listed = " and ".join(filter(None, [", ".join(budgets[:-1]), budgets[-1]]))
            parts.append(f"{word} than {BASE_AGENT} at {listed} ({p_level(max(row['p_holm'] for row in there))})")
    if parts:
        return ", ".join(parts)
    last = rows[-1]
    shares, base = (data.result.success_rates(name)[:, -1] for name in (agent, BASE_AGENT))
    more = more_seeds(shares, base, cells=data.cells, trials=data.result.protocol.evaluation_episodes)
    points = signed_percent(last["difference_to_dqn"])
    return f"{points} points against {BASE_AGENT} at {last['episodes']:,}, {_undecided(data, agent, BASE_AGENT, more)}"


def _undecided(data: ReportData, agent: str, base: str, more: int) -> str:
    """How many seeds two agents have, and the command that would about decide, of a headline that adds seeds itself."""
    protocol = data.result.protocol
    fewer, other = sorted((agent, base), key=lambda name: len(protocol.seeds_of(name)))
    seeds = protocol.seeds_of(fewer)
    others = len(protocol.seeds_of(other))
    words = f"undecided with {len(seeds)} seed{'s' if len(seeds) > 1 else ''}"
    if others > len(seeds):
        words += f" of {fewer} and {others} of {other}"
    if not more:
        return words
    words += f"; about {more} more would decide"
    command = str(data.result.environment.get("command", ""))
    if not command.startswith("imagine-bench bench ") or ";" in command:
        return words
    if (agent, base) in protocol.headlines and " --agents " not in command:
        return f"{words}: {command.replace(_UNTIL, '')}{_UNTIL}"
    command = _SEEDS_OPTION.sub("", command)
    if fewer in dict(protocol.few_seeds):
        command += f" --agents {base} {agent}"
    for name, now in PRESETS.get(protocol.preset, {}).items():  # an earlier version's preset may have been another
        was = getattr(protocol, name)
        if name in ("agents", "budgets") and f" --{name} " not in command and set(was) != set(now):
            command += f" --{name} {' '.join(map(str, was))}"
    return f"{words}: {command} --seeds {seeds_text((*seeds, *range(seeds[-1] + 1, seeds[-1] + 1 + more)))}"


def shown(record: Record) -> int:
    """1 where an agent is ahead of DQN, -1 where it is behind, 0 where no difference is shown."""
    return int(np.sign(record["difference_to_dqn"])) if record["p_holm"] < 1.0 - LEVEL else 0


def _amiss(data: ReportData) -> Iterator[str]:
    """A sentence on everything that the numbers lack, and on each agent whose encoder reads few frames right."""
    result = data.result
    part = result.protocol
    if result.missing:
        whole = result.whole or part
        named = "; ".join(result.missing[:4]) + ("; …" if len(result.missing) > 4 else "")
        then = "The same bench command goes on."
        if whole.agent_names == FIRST:
            then = "Its agents had other names when it was begun: today's command begins a new bench in another folder."
        yield (
            f"This bench is not finished: shown are {len(part.seeds)} of {len(whole.seeds)} seeds up to "
            f"{part.budgets[-1]:,} of {whole.budgets[-1]:,} real episodes. Missing are {named}. {then}"
        )
    if result.left_out:
        yield f"Left out, for some agent has not been run with that seed or one before: {', '.join(result.left_out)}."
    absent = [] if data.installed else [f"task {data.spec.id}"]
    absent += [f"agent {agent}" for agent in part.agents if not known_agent(agent).make]
    if absent:
        yield f"Not installed here: {', '.join(absent)}. Numbers that need missing code are not shown."
    for agent in part.agents:
        words = encoders.reading_warning((encoder_of(data, agent) or "").partition("@")[0], card_of(data, agent))
        if words:
            yield f"“{agent}” sees through {words}."


# Tables ------------------------------------------------------------------------------------------------------------


def compared(data: ReportData) -> Section:
    """The task, the agents and the verdict on them."""
    rows = [[agent, known_agent(agent).description] for agent in data.result.protocol.agents]
    table = Table("agents", ["agent", "description"], rows, prose=True)
    return Section("Task and agents", [data.spec.description], tables=[table], answers=verdict(data))


def success(data: ReportData) -> Section:
    """Success of every agent at every budget, and of every seed."""
    caption = (
        "Test episodes solved after so many real training episodes; the axis is logarithmic. Points are interquartile "
        "means over seeds (independent trainings), and thin lines the seeds. Bands are 95 % intervals, or the range of "
        "seeds where these are too few. Dashed: chance level and optimum; diamonds: the thesis, with standard "
        "deviations."
    )
    image = figures.image("success", lambda: success_figure(data), caption)
    budgets = set(data.result.protocol.budgets).union(*data.thesis.values())
    tables = [_scores(data, sorted(budgets)), _seeds(data)]
    return Section("Success against real experience", images=[image], tables=tables)


def _scores(data: ReportData, budgets: Sequence[int], *, short: bool = False) -> Table:
    """Ours at these budgets, the thesis' below it where it has any of them, and the exact ends of the scale.

    In short, as on a terminal, scores are whole percent, and the thesis' are left out.
    """
    cell = _in_short if short else _solved
    rows: list[tuple[str, Mapping[int, str]]] = []
    for agent in data.result.protocol.agents:
        title = agent + encoders.mark(encoders.low_share(card_of(data, agent)))
        rows.append((title, {each["episodes"]: cell(data, each) for each in data.of(agent)}))
        if not short and not data.thesis[agent].keys().isdisjoint(budgets):
            cells = {budget: _mean_std(*each) for budget, each in data.thesis[agent].items()}
            rows.append((f"{agent}, thesis", cells))
    for name, share in (("chance level", data.facts.chance_level), ("optimum", data.facts.optimum)):
        rows.append((name, dict.fromkeys(budgets, printed(100.0 * share, ".0f" if short else ".1f"))))
    header = ["solved (%) after", *(f"{budget:,}" for budget in budgets)]
    lines = [[title, *(cells.get(budget, DASH) for budget in budgets)] for title, cells in rows]
    caption = "Columns: real training episodes."
    if any(title.endswith(", thesis") for title, _ in rows):
        caption += f" Thesis: {reference.success_source(str(data.spec.reference))}."
    return Table("scores", header, lines, caption, "not tested")


def _in_short(data: ReportData, record: Record) -> str:
    """``96 [91, 99]``: a score and its interval, or in parentheses its lowest and highest seed, in whole percent."""
    found = _band(data, record)
    value, low, high = (printed(each, ".0f") for each in found[:3])
    ends = f"({low} to {high})" if math.isnan(record["low_95"]) else f"[{low}, {high}]"
    return value if low == high else f"{value} {ends}"


def _solved(data: ReportData, record: Record) -> str:
    """Of one seed with the interval over its tests."""
    if record["seeds"] == 1:
        return estimated(record, SCORE)
    trials = data.result.protocol.evaluation_episodes
    return over_seeds(_shares(data, record).tolist(), trials=trials, share=True)


def _shares(data: ReportData, record: Record) -> Floats:
    place = data.result.protocol.budgets.index(record["episodes"])
    return data.result.success_rates(record["agent"])[:, place]


def _mean_std(mean: float, std: float) -> str:
    """Mean and standard deviation as the thesis prints them; the mean alone where it gives no other."""
    return percent(mean) if math.isnan(std) else f"{percent(mean)} ({percent(std)})"


def _seeds(data: ReportData) -> Table:
    """Every seed, and the first budget from which on every test is solved to the task's threshold."""
    protocol = data.result.protocol
    asked = data.spec.success_threshold
    rows = []
    for agent in protocol.agents:
        for seed, shares in zip(protocol.seeds_of(agent), data.result.success_rates(agent), strict=True):
            lasting = first_lasting(protocol.budgets, shares, asked)
            rows.append([agent, str(seed), *map(percent, shares), count(lasting or math.nan)])
    header = ["agent", "seed", *(f"{budget:,}" for budget in protocol.budgets), f"{percent(asked)} % from"]
    return Table("seeds", header, rows, why_dash="the last test is not solved so far", folded="Every seed by itself")


def gain(data: ReportData) -> Section | None:
    """Every learner against DQN, beside the thesis' gains."""
    if not data.compared:
        return None
    words = (
        "Difference: percentage points of test episodes solved. Gain: the same relative to DQN, (agent − DQN) / DQN, "
        "the thesis' measure. Both the interquartile means and the means of all seeds must show a difference. Too few "
        "seeds have no interval, nor has a gain over a DQN that may have solved nothing."
    )
    records = [record for record in data.records if record["agent"] in data.compared]
    sizes = [size for record in records if not math.isnan(size := record["detectable_difference"])]
    detectable = f"Too few seeds to say: none of {len(records)} cells can show a difference."
    if sizes:
        families = f"{data.cells} cells"
        if data.headlines:
            families += f", those of the {len(data.headlines)} headlines for one another alone"
        detectable = (
            f"p-values are Holm-corrected for {families}. The smallest difference that would be shown with "
            f"probability 80 % is {percent(min(sizes))} to {percent(max(sizes))} points, by cell."
        )
    rows = [
        {
            "against dqn": record["agent"],
            "real episodes": f"{record['episodes']:,}",
            "difference (points)": estimated(record, DIFFERENCE, signed_percent),
            "p": printed(record["p_holm"], ".3f"),
            "gain (%)": estimated(record, GAIN, signed_percent),
            "thesis (%)": DASH if record.get("thesis_gain") is None else signed_percent(record["thesis_gain"]),
        }
        for record in records
    ]
    why = "not said by the thesis, too few seeds, or DQN solved nothing to compare with"
    tables = [Table.of("gains", rows, detectable, why), *_on_the_same_starts(records)]
    return Section("Gain over DQN", [words], tables=tables)


def _on_the_same_starts(records: Sequence[Record]) -> list[Table]:
    """These trained agents against these trained DQNs, by the tests that one alone solved; nothing where that was not
    kept.
    """
    rows = [
        {
            "against DQN": record["agent"],
            "real episodes": f"{record['episodes']:,}",
            "tests it alone solved": f"{record['alone']:,}",
            "DQN alone": f"{record['dqn_alone']:,}",
            "p (McNemar)": printed(record["p_mcnemar_holm"], ".3f"),
        }
        for record in records
        if "alone" in record
    ]
    words = (
        "The verdict says whether other trainings of the two methods would differ, so each seed counts once. This "
        "table compares these trained agents on the same starts, all seeds together: a small p-value says that they "
        "differ on such starts, and nothing of the next training."
    )
    table = Table.of("starts", rows, words)
    return [replace(table, folded="These trained agents on the same starts")] if rows else []


def cost(data: ReportData) -> Section:
    """The experience of each agent at the last budget, its CPU seconds and faults."""
    rows = []
    for agent in data.result.protocol.agents:
        last = data.of(agent)[-1]
        tested = None if known_agent(agent).learns else 1  # the one test of others stands at every budget
        tests = [row for run in data.result.of(agent) for row in run.checkpoints[:tested]]
        played = round(sum(row.mean_length * row.test_episodes for row in tests))
        rows.append(
            {
                "one run, mean over seeds": agent,
                "real macro-actions": count(last["env_steps"]),
                "frames its encoder saw before": count(frames_before(data, agent)),
                "gradient updates": count(last["gradient_updates"]),
                "training (CPU s)": seconds(last["train_cpu_s"]),
                "faults in all tests": f"{sum(row.faults for row in tests)} of {played:,}",
            }
        )
    caption = (
        "Frames before training are drawn from all macrostates alike. A fault is a macro-action whose physical outcome "
        f"was not as the rules say. The whole bench took {data.result.wall_s:,.0f} s of wall time."
    )
    table = Table.of("cost", rows, caption, "not counted by the agent, or an encoder of which no card is here")
    return Section("Costs and faults", tables=[table])


def success_figure(data: ReportData) -> Figure:
    """Success (%) by real training episodes, with 95 % intervals, chance level, optimum and the thesis' points."""
    agents = data.result.protocol.agents
    ticks = sorted(data.result.protocol.budgets)
    curves = {}
    for agent in agents:
        rows = data.of(agent)
        curves[agent] = {row["episodes"]: _band(data, row) for row in rows}
    figure = figures.lines({"": curves}, figures.line_styles(agents), "real training episodes (logarithmic)")
    (axes,) = figure.axes
    for agent in agents:
        seeds = 100.0 * data.result.success_rates(agent).T  # [budgets, seeds]
        axes.plot(data.result.protocol.budgets, seeds, color=figures.color(agent), linewidth=0.6, alpha=0.5)
    for level in (data.facts.optimum, data.facts.chance_level):
        axes.axhline(100.0 * level, **figures.REFERENCE)
    for agent, by_budget in data.thesis.items():
        near = [budget for budget in by_budget if budget <= 2.0 * max(ticks)]  # others would leave the run no room
        if near:
            means, stds = 100.0 * np.array([by_budget[budget] for budget in near]).T
            axes.errorbar(near, means, stds, fmt="D:", color=figures.color(agent), fillstyle="none", linewidth=1.0)
    axes.set_xscale("log")
    labels: dict[int, str] = {}
    for tick in reversed(ticks):
        if 1.25 * tick <= min(labels, default=np.inf):
            labels[tick] = f"{tick:,}"
    axes.set_xticks(ticks, [labels.get(tick, "") for tick in ticks])
    axes.minorticks_off()
    axes.set(ylabel="test episodes solved (%)", ylim=(-2, 108))
    return figure


def _band(data: ReportData, record: Record) -> Estimate:
    """A score, %, with its interval, or with the lowest and the highest of seeds that are too few for one."""
    found = Estimate(*(100.0 * record[column] for column in SCORE))
    shares = _shares(data, record)
    ends = {"low": 100.0 * float(shares.min()), "high": 100.0 * float(shares.max())}
    return found._replace(**ends) if math.isnan(found.low) else found


SECTIONS: tuple[Callable[[ReportData], Section | None], ...] = (
    sections.episodes,
    compared,
    success,
    gain,
    sections.causes,
    sections.open_loop,
    sections.rollouts,
    cost,
)
"""The sections of the page, in their order. A new one is a function and a line here."""
