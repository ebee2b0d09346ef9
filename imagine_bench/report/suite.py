"""The page of a suite: a radar chart, a table of scores, and every level with its chance and optimum."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from imagine_bench.report import figures
from imagine_bench.report.page import aligned, flat, write_page
from imagine_bench.report.radar import radar_figure
from imagine_bench.report.tables import DASH, Cell, Page, Section, Table, seconds
from imagine_bench.report.text import agent_words, percent
from imagine_bench.statistics import Estimate
from imagine_bench.store.files import csv_text, json_text
from imagine_bench.sweep.grid import Experiment
from imagine_bench.sweep.run import LevelResult, SuiteResult

_COLUMNS = 4


def write_suite(result: SuiteResult, root: Path) -> Path:
    """Write the page below ``root``, the folder of all benches; returns the path of its index.html.

    Raises:
        SetupError: The folder cannot be written.
    """
    suite = result.suite
    return write_page(root / "suite" / f"{suite.name}-{suite.hash}" / "report", suite_page(result))


def suite_table(result: SuiteResult) -> str:
    """Every score with its interval as plain text."""
    rows = [["experiment", *(agent_words(agent).title for agent in result.agents)]]
    rows += [[name, *(_text(score) for score in scores)] for name, scores in _scores(result).items()]
    return "\n".join([*aligned(rows), *result.failures])


def suite_page(result: SuiteResult) -> Page:
    """The page of what was run."""
    suite, titles = result.suite, [agent_words(agent).title for agent in result.agents]
    return Page(
        title="The ladder: what can each agent do?",
        subtitle=f"Suite {suite.name} {suite.hash} · {suite.execution} execution · {len(suite.seeds)} seed(s) · "
        f"{suite.evaluation_episodes} tests a level",
        question="Each experiment turns one dial of a world of arrows. How far is an agent on its way from blind "
        "choice to perfect play, which the world's certificate states exactly?",
        answers=_answers(result),
        sections=[_overview(result), _levels(result), _prices(result)],
        facts=[("suite", f"{suite.name}, {suite.hash}"), ("seeds", ", ".join(map(str, suite.seeds))), *_made(result)],
        settings={},
        protocol=flat("", dataclasses.asdict(suite)),
        recordings=(),
        files={"levels.csv": levels_csv(result), "scores.csv": scores_csv(result), "suite.json": _definition(result)},
        colors=dict(zip(titles, map(figures.color, result.agents), strict=True)),
    )


def _scores(result: SuiteResult) -> dict[str, list[Estimate]]:
    return {each.name: [result.score(each, agent) for agent in result.agents] for each in result.suite.experiments}


def _text(score: Estimate) -> str:
    interval = "" if math.isnan(score.low) else f" [{score.low:.2f}, {score.high:.2f}]"
    return DASH if math.isnan(score.value) else f"{score.value:.2f}{interval}"


def _answers(result: SuiteResult) -> list[str]:
    said, scores = list(result.failures), _scores(result)
    for index, agent in enumerate(result.agents):
        known = {name: row[index].value for name, row in scores.items() if not math.isnan(row[index].value)}
        if known:
            best, worst = max(known, key=known.__getitem__), min(known, key=known.__getitem__)
            said.append(
                f"{agent_words(agent).title}: {np.mean(list(known.values())):.2f} on average of {len(known)} of "
                f"{len(scores)} experiments; most in {best} ({known[best]:.2f}), least in {worst} ({known[worst]:.2f})."
            )
    return said


def _overview(result: SuiteResult) -> Section:
    scores = _scores(result)
    by_agent = {agent: [row[index] for row in scores.values()] for index, agent in enumerate(result.agents)}
    radar = figures.image(
        "radar", lambda: radar_figure(list(scores), by_agent), svg=True, dpi=180,
        alt="Radar chart: a spoke an experiment, an outline an agent, from 0 in the middle to 1 at the rim.",
        caption="(success − chance) / (optimum − chance), mean over the levels of each experiment. The middle is blind "
        "choice, the rim is perfect play. Lines across: 95 % intervals.",
    )  # fmt: skip
    rows: list[list[str | Cell]] = [
        [f"{each.name}: {each.dial}", *(Cell(text=_text(score)) for score in scores[each.name])]
        for each in result.suite.experiments
    ]
    table = Table(
        name="suite", header=["experiment: dial", *(agent_words(agent).title for agent in result.agents)], rows=rows,
        caption="Score [95 % interval: Student's over seeds, and at least that of the tests]. 0 is chance, 1 the "
        "optimum of the certificate, with memory where frames hide something or are late. Uncertainty is scored by the "
        "AUROC with which epistemic uncertainty tells wrong imagined transitions from right ones, from 0.5 to 1; an "
        "agent that does not say has 0.5.",
        why_dash="not run, or no imagined transition was wrong",
    )  # fmt: skip
    return Section(title="Scores", images=(radar,), tables=(table,))


def _levels(result: SuiteResult) -> Section:
    figure = figures.image(
        "levels", lambda: _levels_figure(result), svg=True, dpi=160,
        alt="Scores by level, a panel an experiment, a line an agent.",
        caption="Scores by level: 0 is chance, 1 the optimum (dashed).",
    )  # fmt: skip
    rows = []
    for each in result.suite.experiments:
        by_agent = [result.levels[each.name, agent] for agent in result.agents]
        for index, level in enumerate(each.levels):
            scale = next((levels[index].scale for levels in by_agent if levels[index].scale is not None), None)
            ends = [DASH, DASH] if scale is None else [percent(scale.chance), percent(scale.optimum)]
            values = [levels[index].values for levels in by_agent]
            reached = [DASH if np.isnan(each).any() else percent(float(each.mean())) for each in values]
            rows.append([each.name, level.name, level.task, f"{level.episodes:,}", *ends, *reached])
    heads = ["experiment", "level", "world", "real episodes", "chance, %", "optimum, %"]
    table = Table(
        name="levels", header=[*heads, *(agent_words(agent).title for agent in result.agents)], rows=rows,
        caption="Test episodes solved, or AUROC, in %: means over seeds.", why_dash="not run",
    )  # fmt: skip
    questions = [f"{each.name}: {each.question}" for each in result.suite.experiments]
    return Section(title="Level by level", words=(" ".join(questions),), images=(figure,), tables=(table,))


def _levels_figure(result: SuiteResult) -> Figure:
    experiments = result.suite.experiments
    columns = min(_COLUMNS, len(experiments))
    rows = math.ceil(len(experiments) / columns)
    figure = Figure(figsize=(2.6 * columns + 0.6, 2.1 * rows + 0.4), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for axes, each in zip(panels, experiments, strict=False):
        names = [level.name for level in each.levels]
        for height in (0.0, 1.0):
            axes.axhline(height, color="#8c8c8c", linewidth=0.8, linestyle=(0, (4, 3)))
        for agent in result.agents:
            found = [_mean(level) for level in result.levels[each.name, agent]]
            axes.plot(names, found, marker="o", markersize=4, color=figures.color(agent))
        axes.set(title=each.name, xlabel=each.dial, ylim=(-0.15, 1.1))
    for axes in panels[len(experiments) :]:
        axes.set_axis_off()
    return figure


def _mean(found: LevelResult) -> float:
    return math.nan if found.scale is None else float(found.scale.normalised(found.values).mean())


def _prices(result: SuiteResult) -> Section:
    rows = [
        [each.name, *(seconds(_cpu_s(result, each, agent)) for agent in result.agents)]
        for each in result.suite.experiments
    ]
    table = Table(
        name="prices", header=["training, CPU s", *(agent_words(agent).title for agent in result.agents)], rows=rows,
        caption="Of all levels and seeds of an experiment.", why_dash="not run",
    )  # fmt: skip
    return Section(title="What it cost", tables=(table,))


def _cpu_s(result: SuiteResult, experiment: Experiment, agent: str) -> float:
    return len(result.suite.seeds) * sum(each.train_cpu_s for each in result.levels[experiment.name, agent])


def _made(result: SuiteResult) -> list[tuple[str, str]]:
    """What made the first bench, and how many others were made with something else."""
    found = [each.environment for levels in result.levels.values() for each in levels if each.environment]
    if not found:
        return []
    commits = sorted({str(each.get("commit")) for each in found})
    return [*flat("", {**found[0], "sessions": len(found)}), ("commits of all benches", ", ".join(commits))]


def _definition(result: SuiteResult) -> str:
    suite = result.suite
    return json_text({"suite": dataclasses.asdict(suite), "hash": suite.hash, "agents": list(result.agents),
                      "made": dict(_made(result))})  # fmt: skip


def levels_csv(result: SuiteResult) -> str:
    """One row an experiment, level, agent and seed."""
    rows: list[list[Any]] = [
        ["experiment", "level", "task", "episodes", "agent", "seed", "value", "chance", "optimum", "cpu_s", "bench"]
    ]
    for (experiment, agent), levels in result.levels.items():
        for found in levels:
            if found.scale is not None:
                head = [experiment, found.level.name, found.level.task, found.level.episodes, agent]
                tail = [found.scale.chance, found.scale.optimum, round(found.train_cpu_s, 1)]
                rows += [
                    [*head, seed, "" if math.isnan(value) else value, *tail, bench]
                    for seed, value, bench in zip(result.suite.seeds, found.values.tolist(), found.benches, strict=True)
                ]
    return csv_text(rows)


def scores_csv(result: SuiteResult) -> str:
    """One row an experiment and agent."""
    rows: list[list[Any]] = [["experiment", "agent", "score", "low_95", "high_95"]]
    for name, scores in _scores(result).items():
        for agent, score in zip(result.agents, scores, strict=True):
            rows.append([name, agent, *("" if math.isnan(number) else number for number in score[:3])])
    return csv_text(rows)
