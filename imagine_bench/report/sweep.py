"""The pages of sweeps: of a study, its differences; of the benchmark suite, its scores."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

from imagine_bench.appearance import appearance_typed
from imagine_bench.report.page import (
    DASH,
    Page,
    Section,
    Table,
    count,
    decimals,
    estimate,
    percent,
    seconds,
    signed_percent,
)
from imagine_bench.statistics import iqm
from imagine_bench.store.files import json_text, table_text, with_null
from imagine_bench.sweep.grid import Study, Variant
from imagine_bench.sweep.run import Line, SuiteResult
from imagine_bench.values import Json

Row = dict[str, float | str]

# Studies -----------------------------------------------------------------------------------------------------------


def study_page(study: Study, lines: Sequence[Line]) -> Page:
    """Success of every variant at every budget, and its difference from the variant that it is compared with."""
    rows: list[dict[str, str]] = []
    for line in lines:
        for place, budget in enumerate(study.budgets):
            moved = estimate(line.difference[place], signed_percent) if line.difference else DASH
            right = percent(float(line.imagined_right[:, place].mean()))
            solved = percent(iqm(line.success[:, place]))
            found = {"solved (%)": solved, "difference": moved, "imagined right": right}
            rows.append({**_named(line.variant), "episodes": f"{budget:,}", **found, "CPU s": count(line.train_cpu_s)})
    caption = "Difference in points; imagined right: outcomes of one macro-action that are expected rightly (%)."
    table = Table.of("variants", rows, caption, "not compared, or no model to ask")
    made = {**lines[0].environment, "study": dataclasses.asdict(study)}
    seeds = ", ".join(map(str, study.seeds))
    looks = appearance_typed(study.appearance)
    return Page(
        title=study.question,
        subtitle=f"{study.execution} · {looks} · tuning seeds {seeds} · {study.evaluation_episodes} tests",
        question="Interquartile means, differences with 95 % intervals over seeds, each alone: of many, some exclude "
        "zero by chance. Fewer than five seeds have none.",
        table=table,
        sections=[Section("Variants", tables=[table])],
        files={"seeds.csv": _seeds_csv(study, lines), "study.json": json_text(made)},
        facts=made,
    )


def _named(variant: Variant) -> dict[str, str]:
    against = variant.against or ""
    return {"factor": variant.factor, "variant": variant.name, "agent": variant.agent, "against": against}


def _seeds_csv(study: Study, lines: Sequence[Line]) -> str:
    rows: list[Row] = []
    for line in lines:
        cells = itertools.product(study.seeds, study.budgets)
        for (seed, budget), success, right in zip(cells, line.success.flat, line.imagined_right.flat, strict=True):
            rows.append(
                {
                    **_named(line.variant),
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
    """The page of the variants that were run."""
    suite = result.suite
    environments = [each.environment for levels in result.levels.values() for each in levels if each.environment]
    commits = sorted({str(each.get("commit")) for each in environments})
    made = {**(environments[0] if environments else {}), "commits of all benches": ", ".join(commits)}
    definition: dict[str, Json] = {
        "suite": dataclasses.asdict(suite),
        "hash": suite.hash,
        "agents": list(result.agents),
    }
    table = _scores(result)
    questions = [f"{each.name}: {each.question}" for each in suite.experiments]
    return Page(
        title="The benchmark suite: what can each agent do?",
        subtitle=f"Suite {suite.name} {suite.hash} · {suite.execution} execution · {len(suite.seeds)} "
        f"seed{'s' * (len(suite.seeds) != 1)} · "
        f"{suite.evaluation_episodes} tests a level",
        question="Each experiment changes one parameter of a world of arrows. Where is an agent between blind choice "
        "(0) and perfect play (1), which are exact?",
        table=table,
        sections=[Section("Scores", questions, tables=[table], answers=result.failures)],
        facts=made,
        files={
            "levels.csv": levels_csv(result),
            "scores.csv": scores_csv(result),
            "suite.json": json_text({**definition, "made": made}),
        },
    )


def _scores(result: SuiteResult) -> Table:
    experiments = result.suite.experiments
    rows = []
    for each in experiments:
        scores = (estimate(result.score(each, agent), decimals) for agent in result.agents)
        rows.append([f"{each.name}: {each.parameter}", *scores])
    prices = ["training of all levels and seeds (CPU s)"]
    for agent in result.agents:
        trained = (level.train_cpu_s for each in experiments for level in result.levels[each.name, agent])
        prices.append(seconds(len(result.suite.seeds) * sum(trained)))
    words = (
        "(success − chance) / (optimum − chance), mean over the levels of each experiment, with 95 % intervals: "
        "Student's over seeds, and at least that of the tests; two to six seeds are too few. 0 is chance, 1 the exact "
        "optimum, with memory where frames hide something or are late. Uncertainty is scored by the AUROC with which "
        "epistemic uncertainty tells wrong imagined transitions from right ones, from 0.5 to 1; an agent that does not "
        "say has 0.5."
    )
    header = ["experiment: parameter", *result.agents]
    return Table("suite", header, [*rows, prices], words, "not run, or no imagined transition was wrong")


def levels_csv(result: SuiteResult) -> str:
    """One row an experiment, level, agent and seed."""
    rows: list[Row] = []
    for (experiment, agent), levels in result.levels.items():
        for found in (each for each in levels if each.scale is not None):
            for seed, value, bench in zip(result.suite.seeds, found.values.tolist(), found.benches, strict=True):
                rows.append(
                    {
                        "experiment": experiment,
                        "level": found.level.name,
                        "task": found.level.task,
                        "episodes": found.level.episodes,
                        "agent": agent,
                        "seed": seed,
                        "value": "" if math.isnan(value) else value,
                        **vars(found.scale),
                        "cpu_s": round(found.train_cpu_s, 1),
                        "bench": bench,
                    }
                )
    return table_text(rows)


def scores_csv(result: SuiteResult) -> str:
    """One row an experiment and agent."""
    rows: list[Row] = []
    for each, agent in itertools.product(result.suite.experiments, result.agents):
        ends = dict(zip(("score", "low_95", "high_95"), result.score(each, agent), strict=False))
        rows.append({"experiment": each.name, "agent": agent, **with_null(ends)})
    return table_text(rows)
