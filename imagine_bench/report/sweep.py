"""The pages of sweeps: of a study, its differences; of the benchmark suite, a radar chart and every level."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

from imagine_bench.report import figures
from imagine_bench.report.data import agent_title
from imagine_bench.report.page import (
    DASH,
    Page,
    Section,
    Table,
    count,
    decimals,
    estimate,
    flat,
    percent,
    seconds,
    signed_percent,
)
from imagine_bench.statistics import Estimate, iqm
from imagine_bench.store.files import json_text, table_text, with_null
from imagine_bench.sweep.grid import Study
from imagine_bench.sweep.run import Line, SuiteResult

Row = dict[str, float | str]

# Studies -----------------------------------------------------------------------------------------------------------


def study_page(study: Study, lines: Sequence[Line]) -> Page:
    """Success of every variant at every budget, and its difference from what it is compared with."""
    table, summary = _variants(study, lines)
    seeds = ", ".join(map(str, study.seeds))
    return Page(
        title=study.question,
        subtitle=f"{study.execution} · {study.appearance} · tuning seeds {seeds} · {study.evaluation_episodes} tests",
        question="Interquartile means, differences with 95 % intervals over seeds, each alone: of many, some exclude "
        "zero by chance.",
        answers=[],
        sections=[Section("Variants", tables=[table])],
        files={
            "seeds.csv": _seeds_csv(study, lines),
            "summary.csv": summary,
            "runs.json": json_text([_origin(line) for line in lines]),
        },
        protocol=flat("", dataclasses.asdict(study)),
        summary=table.text,
    )


def _variants(study: Study, lines: Sequence[Line]) -> tuple[Table, str]:
    """A row a variant and budget, as a table and as CSV."""
    rows: list[dict[str, str]] = []
    records: list[Row] = []
    for line in lines:
        for place, budget in enumerate(study.budgets):
            one = line.variant
            solved = iqm(line.success[:, place])
            moved = line.difference[place] if line.difference else None
            named = {"factor": one.factor, "variant": one.name, "agent": one.agent}
            records.append(
                {
                    **named,
                    "episodes": budget,
                    "success_iqm": f"{solved:.6g}",
                    "against": one.against or "",
                    **dict(zip(("difference", "low_95", "high_95"), moved or [""] * 3, strict=False)),
                    "cpu_s": f"{line.train_cpu_s:.1f}",
                }
            )
            rows.append(
                {
                    **named,
                    "episodes": f"{budget:,}",
                    "solved (%)": percent(solved),
                    "against": one.against or DASH,
                    "difference": DASH if moved is None else estimate(moved, signed_percent),
                    "imagined right": percent(float(line.imagined_right[:, place].mean())),
                    "CPU s": count(line.train_cpu_s),
                }
            )
    caption = "Difference in points; imagined right: outcomes of one macro-action that are expected rightly (%)."
    return Table.of("variants", rows, caption, "not compared, or no model to ask"), table_text(records)


def _origin(line: Line) -> dict[str, object]:
    """Where a line's numbers come from."""
    variant = line.variant
    facts = {name: line.environment.get(name) for name in ("command", "commit", "versions", "machine")}
    changed = {"settings": dict(variant.settings), "world": dict(variant.world)}
    return {"variant": variant.name, **changed, "bench": line.folder.name, **facts}


def _seeds_csv(study: Study, lines: Sequence[Line]) -> str:
    rows: list[Row] = []
    for line in lines:
        one = line.variant
        cells = itertools.product(study.seeds, study.budgets)
        for (seed, budget), success, right in zip(cells, line.success.flat, line.imagined_right.flat, strict=True):
            rows.append(
                {
                    "factor": one.factor,
                    "variant": one.name,
                    "agent": one.agent,
                    "against": one.against or "",
                    "protocol": line.folder.name.rpartition("-")[2],
                    "seed": seed,
                    "episodes": budget,
                    "success": f"{success:.6g}",
                    "imagined_right": "" if math.isnan(right) else f"{right:.4f}",
                    "cpu_s": f"{line.train_cpu_s:.1f}",
                }
            )
    return table_text(rows)


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
        sections=[scores, _levels(result)],
        facts=[("suite", f"{suite.name}, {suite.hash}"), ("seeds", ", ".join(map(str, suite.seeds))), *made],
        protocol=flat("", dataclasses.asdict(suite)),
        files={
            "levels.csv": levels_csv(result),
            "scores.csv": scores_csv(result),
            "suite.json": json_text({**definition, "made": dict(made)}),
        },
        summary="\n".join([scores.tables[0].text, *result.failures]),
    )


def _scores(result: SuiteResult) -> Section:
    by_agent: dict[str, list[Estimate]] = {agent: [] for agent in result.agents}
    rows = []
    for each in result.suite.experiments:
        for agent, found in by_agent.items():
            found.append(result.score(each, agent))
        rows.append([f"{each.name}: {each.dial}", *(estimate(found[-1], decimals) for found in by_agent.values())])
    rows.append(["training of all levels and seeds (CPU s)", *(_cpu_s(result, agent) for agent in result.agents)])
    spokes = [each.name for each in result.suite.experiments]
    caption = (
        "(success − chance) / (optimum − chance), mean over the levels of each experiment. The middle is blind choice, "
        "the rim is perfect play. Lines across: 95 % intervals."
    )
    image = figures.image("radar", lambda: figures.radar_figure(spokes, by_agent), caption)
    words = (
        "Scores with 95 % intervals: Student's over seeds, and at least that of the tests. 0 is chance, 1 the exact "
        "optimum, with memory where frames hide something or are late. Uncertainty is scored by the AUROC with which "
        "epistemic uncertainty tells wrong imagined transitions from right ones, from 0.5 to 1; an agent that does not "
        "say has 0.5."
    )
    header = ["experiment: dial", *map(agent_title, result.agents)]
    table = Table("suite", header, rows, words, "not run, or no imagined transition was wrong")
    return Section("Scores", images=[image], tables=[table])


def _cpu_s(result: SuiteResult, agent: str) -> str:
    levels = [level for each in result.suite.experiments for level in result.levels[each.name, agent]]
    return seconds(len(result.suite.seeds) * sum(level.train_cpu_s for level in levels))


def _levels(result: SuiteResult) -> Section:
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for (experiment, agent), levels in result.levels.items():
        for found in levels:
            level = found.level
            row = rows.setdefault((experiment, level.name), {"experiment": experiment, "level": level.name})
            row |= {"world": level.task, "real episodes": f"{level.episodes:,}"}
            for end in ("chance", "optimum"):
                known = percent(getattr(found.scale, end, math.nan))
                row[end] = row.get(end, DASH) if known == DASH else known
            row[agent] = percent(float(found.values.mean()))
    caption = "Test episodes solved, or AUROC, in %: means over seeds."
    header = ["experiment", "level", "world", "real episodes", "chance, %", "optimum, %"]
    cells = [list(row.values()) for row in rows.values()]
    table = Table("levels", [*header, *map(agent_title, result.agents)], cells, caption, "not run")
    questions = [f"{each.name}: {each.question}" for each in result.suite.experiments]
    return Section("Level by level", questions, tables=[table])


def _made(result: SuiteResult) -> list[tuple[str, str]]:
    """What made the first bench, and the commits of all."""
    found = [each.environment for levels in result.levels.values() for each in levels if each.environment]
    commits = sorted({str(each.get("commit")) for each in found})
    return [*flat("", found[0] if found else {}), ("commits of all benches", ", ".join(commits))]


def levels_csv(result: SuiteResult) -> str:
    """One row an experiment, level, agent and seed."""
    rows: list[Row] = []
    for (experiment, agent), levels in result.levels.items():
        for found in levels:
            for seed, value, bench in zip(result.suite.seeds, found.values.tolist(), found.benches, strict=True):
                if found.scale is not None:
                    rows.append(
                        {
                            "experiment": experiment,
                            "level": found.level.name,
                            "task": found.level.task,
                            "episodes": found.level.episodes,
                            "agent": agent,
                            "seed": seed,
                            "value": "" if math.isnan(value) else value,
                            **dataclasses.asdict(found.scale),
                            "cpu_s": round(found.train_cpu_s, 1),
                            "bench": bench,
                        }
                    )
    return table_text(rows)


def scores_csv(result: SuiteResult) -> str:
    """One row an experiment and agent."""
    rows: list[Row] = []
    for each in result.suite.experiments:
        for agent in result.agents:
            ends = dict(zip(("score", "low_95", "high_95"), result.score(each, agent), strict=False))
            rows.append({"experiment": each.name, "agent": agent, **with_null(ends)})
    return table_text(rows)
