"""Sections on what was compared, how well it went and what it cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from imagine_bench import statistics
from imagine_bench.report import figures
from imagine_bench.report.data import Comparison, ReportData, Score
from imagine_bench.report.tables import DASH, Cell, Section, Table, seconds
from imagine_bench.report.text import (
    agent_words,
    chance_words,
    detectable_words,
    interval_text,
    lasting,
    paired_answers,
    paired_words,
    percent,
    signed_percent,
)


def compared(data: ReportData) -> Section:
    """Task and agents in words."""
    spec, facts = data.spec, data.facts
    outcome = (
        "Every macro-action is planned and carried out in contact physics, and what happened is read back from the "
        "simulated objects."
        if data.result.protocol.execution == "physics"
        else "In kinematic execution the outcome of a macro-action is set directly, without contact physics."
    )
    rows = [agent_words(agent) for agent in data.scores]
    return Section(
        title="What was compared",
        words=(spec.description,)
        if not spec.action_names
        else (
            spec.description,
            f"The robot sees a 64×64 camera image and chooses among {spec.n_actions} macro-actions, whole movements of "
            f"the arm: {'; '.join(spec.action_names)}. An episode ends in success, in failure or after {spec.horizon} "
            f"macro-actions. {outcome} The optimum ({percent(facts.optimum)} %) is what perfect play reaches, in "
            f"{facts.mean_plan_length:.2f} macro-actions on average; the chance level ({percent(facts.chance_level)} "
            "%) is what blind choice reaches. Both are computed exactly from the rules.",
        ),
        tables=(Table(name="agents", header=["agent", "what it does"], rows=rows, prose=True),),
    )


def success(data: ReportData, interval_words: str) -> Section:
    """Success of every agent at every budget, with its price."""
    protocol = data.result.protocol
    seeds = f"{len(protocol.seeds)} seed{'' if len(protocol.seeds) == 1 else 's'}"
    near = any(figures.near(data, printed) for printed in data.thesis.values())
    thesis = f" Diamonds: the thesis ({data.thesis_source})." if near else ""
    figure = figures.image(
        "success", lambda: figures.success_figure(data), svg=True, dpi=180,
        alt=f"Success against real training episodes in {data.spec.title}, one curve an agent.",
        caption="Test episodes solved after so many real training episodes; the axis is logarithmic. Points: "
        f"interquartile mean over {seeds} (independent trainings, the same {protocol.evaluation_episodes:,} test "
        f"starts for all); bands: {interval_words}.{thesis}",
    )  # fmt: skip
    tables = (_scores(data, interval_words), _prices(data), *_excess(data), *_thesis_only(data), _seeds(data))
    return Section(title="Success against real experience", images=(figure,), tables=tables)


def _scores(data: ReportData, interval_words: str) -> Table:
    rows: list[list[str | Cell]] = [
        [
            agent_words(agent).title,
            *(_score(score, agent, budget, data.thesis.get(agent, {})) for budget, score in scores.items()),
        ]
        for agent, scores in data.scores.items()
    ]
    for name, share in (("chance level", data.facts.chance_level), ("optimum", data.facts.optimum)):
        rows.append([name, *[percent(share)] * len(data.budgets)])
    return Table(
        name="scores", header=_heads("solved (%) after", data), rows=rows,
        caption=f"Columns: real training episodes; in brackets: {interval_words}.", notes=paired_answers(data),
    )  # fmt: skip


def _prices(data: ReportData) -> Table:
    """What each agent had had at the last budget."""
    rows = []
    for agent, by_budget in data.prices.items():
        price, frames = by_budget[data.budgets[-1]], data.frames_before[agent]
        counts = (price.env_steps, math.nan if frames is None else frames, price.updates)
        cells = [DASH if math.isnan(count) else f"{count:,.0f}" for count in counts]
        rows.append([agent_words(agent).title, *cells, seconds(price.train_cpu_s)])
    return Table(
        name="prices", rows=rows,
        header=[
            f"price of {data.budgets[-1]:,} episodes", "real macro-actions", "frames its encoder saw before",
            "gradient updates", "training (CPU s)",
        ],
        caption="Means over seeds. Frames before training are drawn from all macrostates alike.",
        why_dash="not counted by the agent, or an encoder that is not bundled",
    )  # fmt: skip


def _score(score: Score, agent: str, budget: int, thesis: Mapping[int, tuple[float, float]]) -> Cell:
    return Cell(
        text=percent(score.value),
        interval=interval_text(score.low, score.high),
        note=f"thesis {thesis_text(thesis[budget])}" if budget in thesis else "",
        data={"agent": agent, "episodes": budget},
    )


def thesis_text(printed: tuple[float, float]) -> str:
    """Mean and standard deviation as the thesis prints them; the mean alone where it gives no other."""
    mean, std = printed
    return percent(mean) if math.isnan(std) else f"{percent(mean)} ({percent(std)})"


def thesis_only(data: ReportData) -> list[int]:
    """Budgets of the thesis that this run does not have, ascending."""
    return sorted({budget for printed in data.thesis.values() for budget in printed} - set(data.budgets))


def _thesis_only(data: ReportData) -> list[Table]:
    budgets = thesis_only(data)
    if not budgets:
        return []
    chance = "" if data.thesis_random is None else f" Its random agent solved {percent(data.thesis_random)} %."
    rows = [
        [agent_words(agent).title, *(thesis_text(printed[b]) if b in printed else DASH for b in budgets)]
        for agent, printed in data.thesis.items()
    ]
    table = Table(
        name="thesis", header=["the thesis, solved (%) after", *(f"{budget:,}" for budget in budgets)], rows=rows,
        caption=f"At budgets that this run does not have: {data.thesis_source}.{chance} These come from the thesis' "
        "own images and training settings; where those differ from this preset's, compare shapes, not digits.",
        why_dash="not tested in the thesis",
    )  # fmt: skip
    return [table]


def _seeds(data: ReportData) -> Table:
    rows: list[list[str | Cell]] = [
        [
            agent_words(agent).title,
            str(seed),
            *(
                Cell(text=percent(score.by_seed[index]), data={"agent": agent, "seed": seed, "episodes": budget})
                for budget, score in scores.items()
            ),
        ]
        for agent, scores in data.scores.items()
        for index, seed in enumerate(data.result.protocol.seeds)
    ]
    header = ["agent", "seed", *(f"{budget:,}" for budget in data.budgets)]
    return Table(name="seeds", header=header, rows=rows, folded="Every seed by itself")


def area(data: ReportData) -> Section:
    """Mean success up to each budget."""
    rows: list[list[str | Cell]] = [
        [
            agent_words(agent).title,
            *(_estimate(area, percent, {"agent": agent, "area": budget}) for budget, area in areas.items()),
        ]
        for agent, areas in data.areas.items()
    ]
    return Section(
        title="Area under the success curve",
        words=(
            "Mean success (%) over all real episodes up to each budget: straight lines between the tests, from the "
            "chance level at episode 0. It is the area under the curve with a linear axis, so early learning counts.",
        ),
        tables=(Table(name="areas", header=_heads("mean success (%) up to", data), rows=rows),),
    )


def _estimate(
    estimate: statistics.Estimate, words: Callable[[float], str], data: dict[str, object], note: str = ""
) -> Cell:
    interval = interval_text(estimate.low, estimate.high, words)
    return Cell(text=words(estimate.value), interval=interval, note=note, data=data)


def _heads(first: str, data: ReportData) -> list[str]:
    return [first, *(f"{budget:,}" for budget in data.budgets)]


def gain(data: ReportData) -> Section:
    """Every learner against DQN, beside the thesis' gains."""
    near = any(figures.near(data, printed) for printed in data.thesis_gains.values())
    figure = figures.image(
        "gain", lambda: figures.gain_figure(data), svg=True, dpi=180,
        alt="Gain over DQN against real training episodes, with the thesis' gains.",
        caption="Gain of the means over seeds; bands: 95 % interval over seeds (Fieller). Diamonds: the thesis (its "
        "means alone).",
    ) if near else None  # fmt: skip
    why_dash = "DQN solved nothing to compare with"
    differences: list[list[str | Cell]] = [[agent_words(agent).title] for agent in data.comparisons]
    gains: list[list[str | Cell]] = [[agent_words(agent).title] for agent in data.comparisons]
    for difference, relative, (agent, rows) in zip(differences, gains, data.comparisons.items(), strict=True):
        for budget, row in rows.items():
            note = "" if row.thesis_gain is None else f"thesis {signed_percent(row.thesis_gain)}"
            difference.append(_estimate(row.difference, signed_percent, {"agent": agent, "difference": budget}))
            relative.append(_estimate(row.gain, signed_percent, {"agent": agent, "gain": budget}, note))
    return Section(
        title="Gain over DQN",
        words=(
            "Difference: percentage points of test episodes solved. Gain: the same relative to DQN, (agent − DQN) / "
            "DQN, the thesis' measure. One seed has no interval, nor has a gain over a DQN that may have solved "
            "nothing. Runs of one seed are not paired: what training makes of them does not agree.",
        ),
        images=[figure] if figure else [],
        tables=(
            Table(
                name="differences",
                header=_heads("difference (points) after", data),
                rows=differences,
                caption=detectable_words(data.comparisons),
            ),
            Table(name="gains", header=_heads("gain (%) after", data), rows=gains, why_dash=why_dash),
            _paired(data),
        ),
    )


def _paired(data: ReportData) -> Table:
    """Tests of the same starts, solved by one of two agents alone."""
    rows: list[list[str | Cell]] = []
    for agent, by_budget in data.comparisons.items():
        cells = [_alone(each, {"agent": agent, "paired": budget}) for budget, each in by_budget.items()]
        rows.append([agent_words(agent).title, *cells])
    return Table(
        name="paired", header=_heads("solved alone : by DQN alone, after", data), rows=rows,
        caption=paired_words(data.comparisons), why_dash="which tests were solved was not kept",
    )  # fmt: skip


def _alone(versus: Comparison, data: dict[str, object]) -> Cell:
    note = f"ahead in {percent(versus.improvement)} % of pairs of runs"
    if versus.paired is None:
        return Cell(text=DASH, note=note, data=data)
    text, p = f"{versus.paired.first:,} : {versus.paired.second:,}", chance_words(versus.paired_p)
    return Cell(text=text, interval=f"({p})", note=note, data=data)


def _excess(data: ReportData) -> list[Table]:
    """Macro-actions beyond the shortest plan, where test episodes were kept."""
    if not any(not math.isnan(value) for by_budget in data.excess.values() for value in by_budget.values()):
        return []
    rows = [[agent_words(a).title, *map("{:.2f}".format, each.values())] for a, each in data.excess.items()]
    rows = [[DASH if cell == "nan" else cell for cell in row] for row in rows]
    return [Table(
        name="excess", header=_heads("macro-actions beyond the shortest plan, after", data), rows=rows,
        caption="Means over the tests that were solved; the shortest plan from each start is exact, from the rules.",
        why_dash="nothing was solved",
    )]  # fmt: skip


def threshold(data: ReportData) -> Section:
    """Real episodes until the task counts as solved."""
    asked = f"{100 * data.spec.success_threshold:g}\u00a0%"
    rows = [
        [agent_words(agent).title, lasting(seeds), ", ".join(DASH if s is None else f"{s:,}" for s in seeds)]
        for agent, seeds in data.reached.items()
    ]
    known = data.result.certificate
    floor = None if known is None or known.floor is None else known.floor.episodes
    figure = figures.image(
        "ladder", lambda: figures.ladder_figure(data.reached, data.budgets[-1], floor), svg=True, dpi=180,
        alt=f"Real episodes until {asked} of tests are solved, one rung an agent.",
        caption="Points: seeds; bars: medians; triangles: not by the last test."
        + ("" if floor is None else " Dashed: what a learner needs that knows the factor graph, and nothing else."),
    )  # fmt: skip
    return Section(
        title=f"Real episodes to {asked}",
        images=(figure,),
        words=(
            f"The first tested budget from which on every test is solved to at least {asked}, this task's success "
            f"threshold. {DASH}: the last test is not.",
        ),
        tables=(Table(name="reached", header=["agent", "mean", "by seed"], rows=rows),),
    )


def cost(data: ReportData) -> Section:
    """CPU seconds and faults."""
    rows = [
        [
            agent_words(agent).title, f"{t.env_steps:,.0f}", seconds(t.train_cpu_s), seconds(t.learner_cpu_s),
            seconds(t.train_cpu_s - t.learner_cpu_s), seconds(t.eval_cpu_s), f"{t.faults} of {t.test_steps:,}",
        ]
        for agent, t in data.timing.items()
    ]  # fmt: skip
    header = [
        "one run, mean over seeds; CPU s", "real macro-actions", "training", "of which learning",
        "the rest: environment, seeing, acting", "all tests", "faults in all tests",
    ]  # fmt: skip
    return Section(
        title="What it cost, and what went wrong",
        tables=(
            Table(
                name="cost", header=header, rows=rows, why_dash="the agent does not report its learning by itself",
                caption="A fault is a macro-action whose physical outcome was not what the rules say; it is counted, "
                f"never hidden. The whole bench took {data.result.wall_s:,.0f} s of wall time.",
            ),
        ),
    )  # fmt: skip
