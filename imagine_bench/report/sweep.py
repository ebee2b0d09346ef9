"""The pages of sweeps: of a study, its differences; of the benchmark suite, a radar chart and every level."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from imagine_bench.report import figures
from imagine_bench.report.data import agent_title
from imagine_bench.report.page import flat
from imagine_bench.report.tables import DASH, Cell, Page, Section, Table, count, estimate, percent, seconds
from imagine_bench.report.tables import signed_percent as points
from imagine_bench.statistics import Estimate, iqm
from imagine_bench.store.files import csv_text, json_text
from imagine_bench.sweep.grid import Experiment, Study
from imagine_bench.sweep.run import LevelResult, Line, SuiteResult

# Studies -----------------------------------------------------------------------------------------------------------


def study_page(study: Study, lines: Sequence[Line]) -> Page:
    """Success of every variant at every budget, and its difference from what it is compared with."""
    table = _variants(study, lines)
    compared = [line for line in lines if line.difference]
    caption = "Differences in points of success with 95 % intervals; green: better, orange: worse."
    image = figures.image("study", lambda: _differences_figure(study, compared), caption)
    seeds = ", ".join(map(str, study.seeds))
    return Page(
        title=study.question,
        subtitle=f"{study.execution} · {study.appearance} · tuning seeds {seeds} · {study.evaluation_episodes} tests",
        question="Interquartile means, differences with 95 % intervals over seeds, each alone: of many, some exclude "
        "zero by chance.",
        answers=[],
        sections=[Section("Variants", images=[image] if compared else [], tables=[table])],
        files={
            "seeds.csv": _seeds_csv(study, lines),
            "summary.csv": _variants_csv(study, lines),
            "runs.json": json_text([_origin(line) for line in lines]),
        },
        protocol=flat("", dataclasses.asdict(study)),
        summary=table.text,
    )


def _variants(study: Study, lines: Sequence[Line]) -> Table:
    budgets = [f"{budget:,}" for budget in study.budgets]
    rows: list[list[str | Cell]] = []
    for line in lines:
        one = line.variant
        reached = [percent(iqm(column)) for column in line.success.T]
        moved = [estimate(each, points) for each in line.difference or []] or [Cell(DASH)] * len(budgets)
        right = percent(float(line.imagined_right[:, -1].mean()))
        against = one.against or DASH
        rows.append([one.factor, one.name, one.agent, *reached, against, *moved, right, count(line.train_cpu_s)])
    header = ["factor", "variant", "agent", *budgets, "against", *budgets, "imagined right", "CPU s"]
    caption = "Solved (%) after so many episodes; difference (points); outcomes of one macro-action expected rightly."
    return Table("variants", header, rows, caption, "not compared, or no model to ask")


def _origin(line: Line) -> dict[str, object]:
    """Where a line's numbers come from."""
    variant = line.variant
    facts = {name: line.environment.get(name) for name in ("command", "commit", "versions", "machine")}
    changed = {"settings": dict(variant.settings), "world": dict(variant.world)}
    return {"variant": variant.name, **changed, "bench": line.folder.name, **facts}


def _seeds_csv(study: Study, lines: Sequence[Line]) -> str:
    columns = ("factor", "variant", "agent", "against", "protocol", "seed", "episodes", "success", "imagined_right")
    rows: list[list[object]] = [[*columns, "cpu_s"]]
    for line in lines:
        one = line.variant
        named = [one.factor, one.name, one.agent, one.against or "", line.folder.name.rpartition("-")[2]]
        cells = itertools.product(study.seeds, study.budgets)
        for cell, success, right in zip(cells, line.success.flat, line.imagined_right.flat, strict=True):
            known = "" if np.isnan(right) else f"{right:.4f}"
            rows.append([*named, *cell, f"{success:.6g}", known, f"{line.train_cpu_s:.1f}"])
    return csv_text(rows)


def _variants_csv(study: Study, lines: Sequence[Line]) -> str:
    columns = ("factor", "variant", "agent", "episodes", "success_iqm", "against", "difference", "low_95", "high_95")
    rows: list[list[object]] = [[*columns, "cpu_s"]]
    for line in lines:
        one = line.variant
        for index, budget in enumerate(study.budgets):
            moved = line.difference[index][:3] if line.difference else [""] * 3
            named = [one.factor, one.name, one.agent, budget, f"{iqm(line.success[:, index]):.6g}", one.against or ""]
            rows.append([*named, *moved, f"{line.train_cpu_s:.1f}"])
    return csv_text(rows)


def _differences_figure(study: Study, compared: Sequence[Line]) -> Figure:
    """Differences in points with their intervals, a panel a budget, a row a variant."""
    usual = Counter(line.variant.against for line in compared).most_common(1)[0][0]
    budgets = len(study.budgets)
    height = 1.0 + 0.27 * len(compared)
    figure, panels = figures.small_multiples(budgets, budgets, width=9.0 / budgets, height=height, sharey=True)
    for index, (axes, budget) in enumerate(zip(panels, study.budgets, strict=True)):
        rungs = []
        for line in compared:
            one = line.variant
            name = f"{one.factor}: {one.name}" if one.against == usual else f"{one.name} – {one.against}"
            value, low, high = (100.0 * end for end in line.difference[index][:3]) if line.difference else (0, 0, 0)
            color = "#009e73" if low > 0 else "#d55e00" if high < 0 else figures.GRAY
            rungs.append(figures.Rung(name, color, value, low, high))
        axes.axvline(0.0, **figures.REFERENCE)
        figures.rungs(axes, rungs)
        axes.set_title(f"{budget:,} episodes")
    figure.supxlabel(f"points of success, against {usual} where nothing else is named", fontsize="medium")
    return figure


# The suite ---------------------------------------------------------------------------------------------------------


def suite_page(result: SuiteResult) -> Page:
    """The page of what was run."""
    suite = result.suite
    made = _made(result)
    definition = {"suite": dataclasses.asdict(suite), "hash": suite.hash, "agents": list(result.agents)}
    scores = _scores(result)
    return Page(
        title="The benchmark suite: what can each agent do?",
        subtitle=f"Suite {suite.name} {suite.hash} · {suite.execution} execution · {len(suite.seeds)} seed(s) · "
        f"{suite.evaluation_episodes} tests a level",
        question="Each experiment changes one parameter of a world of arrows. Where is an agent between blind choice "
        "(0) and perfect play (1), which are exact?",
        answers=result.failures,
        sections=[scores, _levels(result), _prices(result)],
        facts=[("suite", f"{suite.name}, {suite.hash}"), ("seeds", ", ".join(map(str, suite.seeds))), *made],
        protocol=flat("", dataclasses.asdict(suite)),
        files={
            "levels.csv": levels_csv(result),
            "scores.csv": scores_csv(result),
            "suite.json": json_text({**definition, "made": dict(made)}),
        },
        colors=figures.colors(result.agents),
        summary="\n".join([scores.tables[0].text, *result.failures]),
    )


def _score(result: SuiteResult, experiment: Experiment) -> list[Estimate]:
    return [result.score(experiment, agent) for agent in result.agents]


def _two(value: float) -> str:
    return DASH if math.isnan(value) else f"{value:.2f}"


def _scores(result: SuiteResult) -> Section:
    experiments = result.suite.experiments
    found = [_score(result, each) for each in experiments]
    by_agent = dict(zip(result.agents, zip(*found, strict=True), strict=True))
    spokes = [each.name for each in experiments]
    caption = (
        "(success − chance) / (optimum − chance), mean over the levels of each experiment. The middle is blind choice, "
        "the rim is perfect play. Lines across: 95 % intervals."
    )
    image = figures.plot("radar", lambda: figures.radar_figure(spokes, by_agent), caption)
    rows = [
        [f"{each.name}: {each.dial}", *(str(estimate(score, _two)) for score in scores)]
        for each, scores in zip(experiments, found, strict=True)
    ]
    words = (
        "Scores with 95 % intervals: Student's over seeds, and at least that of the tests. 0 is chance, 1 the exact "
        "optimum, with memory where frames hide something or are late. Uncertainty is scored by the AUROC with which "
        "epistemic uncertainty tells wrong imagined transitions from right ones, from 0.5 to 1; an agent that does not "
        "say has 0.5."
    )
    header = ["experiment: dial", *map(agent_title, result.agents)]
    table = Table("suite", header, rows, words, "not run, or no imagined transition was wrong")
    return Section("Scores", images=[image], tables=[table])


def _levels(result: SuiteResult) -> Section:
    rows = []
    for each in result.suite.experiments:
        for found in zip(*(result.levels[each.name, agent] for agent in result.agents), strict=True):
            level = found[0].level
            scale = next((one.scale for one in found if one.scale is not None), None)
            ends = (math.nan, math.nan) if scale is None else (scale.chance, scale.optimum)
            reached = [percent(float(one.values.mean())) for one in found]
            rows.append([each.name, level.name, level.task, f"{level.episodes:,}", *map(percent, ends), *reached])
    header = ["experiment", "level", "world", "real episodes", "chance, %", "optimum, %"]
    caption = "Test episodes solved, or AUROC, in %: means over seeds."
    table = Table("levels", [*header, *map(agent_title, result.agents)], rows, caption, "not run")
    panels = {}
    for each in result.suite.experiments:
        by_agent = {agent: result.levels[each.name, agent] for agent in result.agents}
        curves = {agent_title(agent): {one.level.name: _mean(one) for one in by_agent[agent]} for agent in by_agent}
        panels[f"{each.name}: {each.dial}"] = curves
    caption = "Scores by level: 0 is chance, 1 the optimum."
    image = figures.plot(
        "levels", lambda: figures.lines(panels, figures.colors(result.agents), "level", columns=4), caption
    )
    questions = [f"{each.name}: {each.question}" for each in result.suite.experiments]
    return Section("Level by level", questions, [image], [table])


def _mean(found: LevelResult) -> float:
    return math.nan if found.scale is None else float(found.scale.normalised(found.values).mean())


def _prices(result: SuiteResult) -> Section:
    seeds = len(result.suite.seeds)
    rows = []
    for each in result.suite.experiments:
        spent = [sum(level.train_cpu_s for level in result.levels[each.name, agent]) for agent in result.agents]
        rows.append([each.name, *(seconds(seeds * cpu_s) for cpu_s in spent)])
    header = ["training, CPU s", *map(agent_title, result.agents)]
    table = Table("prices", header, rows, "Of all levels and seeds of an experiment.", "not run")
    return Section("What it cost", tables=[table])


def _made(result: SuiteResult) -> list[tuple[str, str]]:
    """What made the first bench, and how many others were made with something else."""
    found = [each.environment for levels in result.levels.values() for each in levels if each.environment]
    if not found:
        return []
    commits = sorted({str(each.get("commit")) for each in found})
    return [*flat("", {**found[0], "sessions": len(found)}), ("commits of all benches", ", ".join(commits))]


def levels_csv(result: SuiteResult) -> str:
    """One row an experiment, level, agent and seed."""
    columns = ("experiment", "level", "task", "episodes", "agent", "seed", "value", "chance", "optimum", "cpu_s")
    rows: list[list[object]] = [[*columns, "bench"]]
    for (experiment, agent), levels in result.levels.items():
        for found in levels:
            if found.scale is not None:
                level = found.level
                tail = [found.scale.chance, found.scale.optimum, round(found.train_cpu_s, 1)]
                for seed, value, bench in zip(result.suite.seeds, found.values.tolist(), found.benches, strict=True):
                    known = "" if math.isnan(value) else value
                    head = [experiment, level.name, level.task, level.episodes, agent, seed]
                    rows.append([*head, known, *tail, bench])
    return csv_text(rows)


def scores_csv(result: SuiteResult) -> str:
    """One row an experiment and agent."""
    rows: list[list[object]] = [["experiment", "agent", "score", "low_95", "high_95"]]
    for each in result.suite.experiments:
        for agent, score in zip(result.agents, _score(result, each), strict=True):
            rows.append([each.name, agent, *("" if math.isnan(number) else number for number in score[:3])])
    return csv_text(rows)
