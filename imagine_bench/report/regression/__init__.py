"""The report of a regression bench: the task's own sections, calibration, costs; one page, Markdown, CSV and PNG."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from imagine_bench import registry
from imagine_bench.interfaces.regression import SCORES
from imagine_bench.regression.calibration import CRPS_POINTS
from imagine_bench.regression.results import PairResult, RegressionResult
from imagine_bench.regression.scores import LEVELS
from imagine_bench.report.figures import REFERENCE, color, image, small_multiples
from imagine_bench.report.page import made, write_page
from imagine_bench.report.regression import robot_ik, toy_regression
from imagine_bench.report.tables import Page, Section, Table, mean_std, number, percent
from imagine_bench.store.files import table_text

SECTIONS: dict[str, Callable[[RegressionResult], list[Section]]] = {
    "toy_regression": toy_regression.sections,
    "robot_ik": robot_ik.sections,
}
"""Sections of the suite's own tasks; another package's task names the function that makes its own."""
_DISTRIBUTIONS = {"": "predicts with", "pooled_": "all weight samples"}
_LINES = {"": "-", "pooled_": ":"}
_COMPARED = (
    "Every model is a Bayesian mixture density network: it predicts a mixture of Gaussians, and its weights are "
    "uncertain, so that each weight sample predicts another mixture. The spread of their means is epistemic "
    "uncertainty (too little data), the mean variance of the Gaussians is aleatoric (noise), the spread of the "
    "Gaussians of one mixture is modal (several outcomes are possible); the three add up to the whole predictive "
    "variance. Stationarity is a second epistemic measure: how much the predicted distribution itself changes from "
    "weight sample to weight sample (Jensen-Shannon divergence, in nats). Two more are about the one value that was "
    "predicted: the variance of the sampled component, the Gaussian it was sampled from, noise and weights together; "
    "and its negative log-likelihood (nll) under all weight samples."
)


def report_page(result: RegressionResult) -> Page:
    """The page, with results.csv and a CSV a table beside it."""
    spec = registry.regression(result.protocol.task)
    protocol = result.protocol
    own = _of_task(result)
    sections = [*own, _calibration(result), _costs(result)]
    rows = [{"agent": run.agent, "seed": run.seed, **row} for run in result.runs for row in run.rows]
    tables = [table for section in sections for table in section.tables]
    answers = [answer for section in sections for answer in section.answers]
    first = [part for section in own[:1] for part in (section.title, *(table.text for table in section.tables[:1]))]
    return Page(
        title=f"{spec.title}: does the model know what it does not know?",
        subtitle=f"Preset {protocol.preset} · networks a dataset: {protocol.networks} · protocol {protocol.hash}",
        question=spec.description,
        answers=answers,
        sections=[_compared(result), *sections],
        files={"results.csv": table_text(rows), **{f"{table.name}.csv": table.csv for table in tables}},
        summary="\n\n".join([*first, "\n".join(answers)]),
        **made(result, result.titles),
    )


def write_report(result: RegressionResult) -> Path:
    """Write index.html, report.md, results.csv, a CSV a table, the figures below ``report``; the path of index.html.

    Raises:
        SetupError: The folder cannot be written.
    """
    return write_page(result.folder / "report", report_page(result))


def _of_task(result: RegressionResult) -> list[Section]:
    spec = registry.regression(result.protocol.task)
    sections = registry.load(spec.sections) if spec.sections else SECTIONS.get(spec.id)
    return sections(result) if sections else []


def _compared(result: RegressionResult) -> Section:
    """The models, and the meaning of their uncertainties."""
    entries = [registry.regressor_entry(agent) for agent in result.protocol.agents]
    rows = [[entry.title, entry.description] for entry in entries]
    table = Table(name="models", header=["model", "origin of its weight samples"], rows=rows, prose=True)
    return Section(title="What was compared", words=(_COMPARED,), tables=(table,))


def _calibration(result: RegressionResult) -> Section:
    spec = registry.regression(result.protocol.task)
    points = result.protocol.test_points
    levels = [f"in {100 * level:g} % interval (%)" for level in LEVELS]
    names = [name.replace("_", " ") for name in SCORES]
    return Section(
        title="Calibration: as sure as it may be?",
        words=(
            f"Each network is asked about {points} unseen points. An interval that is said to hold 80 % "
            "of the outcomes should hold 80 %; the probability integral transform should be uniform (its distance "
            "from that is given, 0 is best); the CRPS is a distance between prediction and outcome, lower is better, "
            f"computed at the first {min(CRPS_POINTS, points)} of the points. "
            "Two distributions are judged: the one that predictions are sampled from, and all weight samples pooled.",
            f"A prediction is called wrong where its error, the {spec.error_name}, is above {spec.wrong_above:g}. The "
            "second table says how well each uncertainty finds the wrong ones: the probability that a wrong "
            "prediction has the higher uncertainty of two (AUROC; 0.5 is chance, 1 is perfect).",
        ),
        images=(
            image(
                "coverage",
                lambda: coverage_figure(result),
                "Share of outcomes inside each central predictive interval. Below the diagonal the network is surer "
                "than it may be, above it less sure than it could be.",
            ),
        ),
        tables=(
            Table(
                name="calibration",
                header=["", *levels, "PIT distance", "CRPS, mean (std)"],
                rows=[_calibration_row(pair, prefix) for pair in result.pairs for prefix in _DISTRIBUTIONS],
            ),
            Table(
                name="auroc",
                header=["AUROC of", "wrong (%)", *names],
                rows=[[pair.label, percent(pair.mean("wrong")), *_detection(pair)] for pair in result.pairs],
            ),
        ),
    )


def _calibration_row(pair: PairResult, prefix: str) -> list[str]:
    inside = [percent(pair.mean(f"{prefix}coverage_{level:g}")) for level in LEVELS]
    distance = number(pair.mean(f"{prefix}transform_distance"), 2)
    return [f"{pair.label}: {_DISTRIBUTIONS[prefix]}", *inside, distance, mean_std(pair.values(f"{prefix}crps_shared"))]


def _detection(pair: PairResult) -> list[str]:
    return [number(pair.mean(f"auroc_{name}"), 2) for name in SCORES]


def coverage_figure(result: RegressionResult) -> Figure:
    """Coverage of every central interval (%), a panel a variant: the diagonal is calibration."""
    variants = result.protocol.variants
    figure, panels = small_multiples(len(variants), len(variants), width=3.1, height=2.9)
    levels = np.linspace(0, 100, 51)
    for axes, variant in zip(panels, variants, strict=True):
        axes.plot(levels, levels, **REFERENCE)
        axes.set(title=variant, xlabel="central interval (%)")
        for agent, title in result.titles.items():
            pair = result.by_variant(agent)[variant]
            for prefix, name in _DISTRIBUTIONS.items():
                transform = pair.arrays(f"calibration/{prefix}transform").ravel()
                needed = np.sort(200 * np.abs(transform - 0.5))  # the interval that just holds each outcome, in %
                share = np.searchsorted(needed, levels, side="right") / len(needed)
                shade = color(agent, registry.regressors())
                axes.plot(levels, 100 * share, _LINES[prefix], color=shade, label=f"{title}, {name}")
    panels[0].set_ylabel("outcomes inside (%)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _costs(result: RegressionResult) -> Section:
    costs = ("train_cpu_s", "measure_cpu_s")
    rows = [[pair.label, *(number(pair.mean(name)) for name in costs)] for pair in result.pairs]
    table = Table(name="costs", header=["CPU seconds a network", "training", "measuring"], rows=rows)
    words = (
        "The networks of a run train together, as one batched computation; its CPU seconds are shared out among them. "
        f"The whole bench took {result.wall_s:,.0f} s of wall time."
    )
    return Section(title="What it cost", words=(words,), tables=(table,))
