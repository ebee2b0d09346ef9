"""The report of a regression bench: the task's own sections, calibration, costs; one page, Markdown, CSV and PNG."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from imagine_bench import registry
from imagine_bench.interfaces.regression import SCORES
from imagine_bench.regression.calibration import CRPS_POINTS
from imagine_bench.regression.results import RegressionResult
from imagine_bench.regression.scores import LEVELS
from imagine_bench.report.figures import image
from imagine_bench.report.page import made, write_page
from imagine_bench.report.regression import robot_ik, toy_regression
from imagine_bench.report.tables import Image, Page, Section, Table, mean_std, number
from imagine_bench.store.codec import table_text

SECTIONS: dict[str, Callable[[RegressionResult], list[Section]]] = {
    "toy_regression": toy_regression.sections,
    "robot_ik": robot_ik.sections,
}
"""Sections of the suite's own tasks; another package's task names the function that makes its own."""
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_DISTRIBUTIONS = {"": "predicts with", "pooled_": "all weight samples"}
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
    files = {"results.csv": table_text(rows)}
    for section in sections:
        files |= {f"{table.name}.csv": table.csv for table in section.tables}
    answers = [answer for section in sections for answer in section.answers]
    tables = [table.text for section in own[:1] for table in section.tables[:1]]
    return Page(
        title=f"{spec.title}: does the model know what it does not know?",
        subtitle=f"Preset {protocol.preset} · networks a dataset: {protocol.networks} · protocol {protocol.hash}",
        question=spec.description,
        answers=answers,
        sections=[_compared(result), *sections],
        files=files,
        summary="\n\n".join([*(section.title for section in own[:1]), *tables, "\n".join(answers)]),
        **made(result, {agent: result.title(agent) for agent in protocol.agents}),
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
    rows: list[list[str]] = []
    detectors: list[list[str]] = []
    for pair in result.pairs:
        for prefix, name in _DISTRIBUTIONS.items():
            inside = [f"{100 * result.values(pair, f'{prefix}coverage_{level:g}').mean():.1f}" for level in LEVELS]
            distance = number(float(result.values(pair, f"{prefix}transform_distance").mean()), 2)
            score = mean_std(result.values(pair, f"{prefix}crps_shared"))
            rows.append([f"{result.label(pair)}: {name}", *inside, distance, score])
        found = [_mean(result.values(pair, f"auroc_{name}")) for name in SCORES]
        wrong = f"{100 * result.values(pair, 'wrong').mean():.1f}"
        detectors.append([result.label(pair), wrong, *(number(each, 2) for each in found)])
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
        images=(_coverage_image(result),),
        tables=(
            Table(name="calibration", header=["", *levels, "PIT distance", "CRPS, mean (std)"], rows=rows),
            Table(name="auroc", header=["AUROC of", "wrong (%)", *names], rows=detectors),
        ),
    )


def _mean(values: np.ndarray) -> float:
    """Mean of those that are numbers; not a number where none is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else np.nan


def _coverage_image(result: RegressionResult) -> Image:
    caption = "Below the diagonal the network is surer than it may be, above it less sure than it could be."
    alt = "Share of outcomes inside each central predictive interval, beside the diagonal of perfect calibration."
    return image("coverage", lambda: coverage_figure(result), alt=alt, caption=caption)


def coverage_figure(result: RegressionResult) -> Figure:
    """Coverage of every central interval (%), a panel a variant: the diagonal is calibration."""
    variants = result.protocol.variants
    figure = Figure(figsize=(3.1 * len(variants) + 1.2, 3.4), layout="constrained")
    panels = dict(zip(variants, figure.subplots(1, len(variants), squeeze=False)[0], strict=True))
    levels = np.linspace(0, 100, 51)
    for variant, axes in panels.items():
        axes.plot(levels, levels, color="#8c8c8c", linewidth=1, linestyle="--")
        axes.set(title=variant, xlabel="central interval (%)")
    for pair in result.pairs:
        color = _COLORS[result.protocol.agents.index(pair[0]) % len(_COLORS)]
        for (prefix, name), style in zip(_DISTRIBUTIONS.items(), ("-", ":"), strict=True):
            transform = result.arrays(pair, f"calibration/{prefix}transform").ravel()
            needed = np.sort(200 * np.abs(transform - 0.5))  # the central interval that just holds each outcome, in %
            share = np.searchsorted(needed, levels, side="right") / len(needed)
            label = f"{result.title(pair[0])}, {name}"
            panels[pair[1]].plot(levels, 100 * share, style, color=color, label=label)
    figure.axes[0].set_ylabel("outcomes inside (%)")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _costs(result: RegressionResult) -> Section:
    rows = []
    for pair in result.pairs:
        costs = [float(result.values(pair, name).mean()) for name in ("train_cpu_s", "measure_cpu_s")]
        rows.append([result.label(pair), *map(number, costs)])
    table = Table(name="costs", header=["CPU seconds a network", "training", "measuring"], rows=rows)
    words = (
        "The networks of a run train together, as one batched computation; its CPU seconds are shared out among them. "
        f"The whole bench took {result.wall_s:,.0f} s of wall time."
    )
    return Section(title="What it cost", words=(words,), tables=(table,))
