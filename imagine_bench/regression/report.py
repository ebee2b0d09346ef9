"""The report of a regression bench: the task's own sections, calibration, costs; one page, Markdown, CSV and PNG."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from imagine_bench import registry
from imagine_bench.interfaces.regression import SCORES
from imagine_bench.judge.calibration import LEVELS
from imagine_bench.regression.calibration import CRPS_POINTS
from imagine_bench.regression.results import RegressionResult
from imagine_bench.report.figures import image
from imagine_bench.report.page import aligned, made, write_page
from imagine_bench.report.tables import Image, Page, Section, Table, mean_std, number
from imagine_bench.store.codec import table_text
from imagine_bench.store.files import csv_text

_SHADES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


def write_report(result: RegressionResult) -> Path:
    """Write index.html, report.md, results.csv, a CSV a table, the figures below ``report``; the path of index.html.

    Raises:
        SetupError: The folder cannot be written.
    """
    spec, protocol = registry.regression(result.protocol.task), result.protocol
    sections = [*_own(result), _calibration(result), _costs(result)]
    tables = [table for section in sections for table in section.tables]
    rows = [{"agent": run.agent, "seed": run.seed, **row} for run in result.runs for row in run.rows]
    networks = f"{protocol.networks} network{'' if protocol.networks == 1 else 's'} a dataset"
    page = Page(
        title=f"{spec.title}: does the model know what it does not know?",
        subtitle=f"Preset {protocol.preset} · {networks} · protocol {protocol.hash}",
        question=spec.description,
        answers=[answer for section in sections for answer in section.answers],
        sections=[_compared(result), *sections],
        files={"results.csv": table_text(rows), **{f"{t.name}.csv": csv_text([t.header, *t.rows]) for t in tables}},
        **made(result, {agent: _title(agent) for agent in protocol.agents}),
    )
    return write_page(result.folder / "report", page)


def summary_table(result: RegressionResult) -> str:
    """The task's first table, if there is one, and the short answer, as plain text."""
    own = _own(result)
    lines = [own[0].title, ""]
    for first in own[0].tables[:1]:
        lines += [*aligned([list(first.header), *([str(cell) for cell in row] for row in first.rows)]), ""]
    return "\n".join([*lines, *(answer for section in own for answer in section.answers)])


def _title(agent: str) -> str:
    return registry.regressor_entry(agent).title


def _compared(result: RegressionResult) -> Section:
    """The models, and what their uncertainties mean."""
    rows = [[_title(agent), registry.regressor_entry(agent).description] for agent in result.protocol.agents]
    return Section(
        title="What was compared",
        words=(
            "Every model is a Bayesian mixture density network: it predicts a mixture of Gaussians, and its weights "
            "are uncertain, so that each weight sample predicts another mixture. The spread of their means is "
            "epistemic uncertainty (too little data), the mean variance of the Gaussians is aleatoric (noise), the "
            "spread of the Gaussians of one mixture is modal (several outcomes are possible); the three add up to the "
            "whole predictive variance. Stationarity is a second epistemic measure: how much the predicted "
            "distribution itself changes from weight sample to weight sample (Jensen-Shannon divergence, in nats). "
            "Two more are about the one value that was predicted: the variance of the sampled component, the Gaussian "
            "it was sampled from, noise and weights together; and its negative log-likelihood (nll) under all weight "
            "samples.",
        ),
        tables=(Table(name="models", header=["model", "origin of its weight samples"], rows=rows, prose=True),),
    )


def _own(result: RegressionResult) -> list[Section]:
    return registry.load(registry.regression(result.protocol.task).sections)(result)


def _calibration(result: RegressionResult) -> Section:
    spec, protocol = registry.regression(result.protocol.task), result.protocol
    rows, detectors = [], []
    for agent, variant in result.pairs:
        label, measured = f"{_title(agent)}, {variant}", partial(result.values, agent, variant)
        for prefix, kind in (("", "predicts with"), ("pooled_", "all weight samples")):
            inside = [f"{100 * measured(f'{prefix}coverage_{level:g}').mean():.1f}" for level in LEVELS]
            distance = number(float(measured(f"{prefix}transform_distance").mean()), 2)
            rows.append([f"{label}: {kind}", *inside, distance, mean_std(measured(f"{prefix}crps_shared"))])
        found = [measured(f"auroc_{name}") for name in SCORES]
        aurocs = [number(float(np.nanmean(f)) if np.isfinite(f).any() else np.nan, 2) for f in found]
        detectors.append([label, f"{100 * measured('wrong').mean():.1f}", *aurocs])
    levels = [f"in {100 * level:g} % interval (%)" for level in LEVELS]
    names = [name.replace("_", " ") for name in SCORES]
    return Section(
        title="Calibration: as sure as it may be?",
        words=(
            f"Each network is asked about {protocol.test_points} unseen points. An interval that is said to hold 80 % "
            "of the outcomes should hold 80 %; the probability integral transform should be uniform (its distance "
            "from that is given, 0 is best); the CRPS is a distance between prediction and outcome, lower is better, "
            f"computed at the first {min(CRPS_POINTS, protocol.test_points)} of the points. "
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


def _coverage_image(result: RegressionResult) -> Image:
    """Coverage of every central interval: the diagonal is calibration."""

    def draw() -> Figure:
        variants, agents = result.protocol.variants, result.protocol.agents
        figure = Figure(figsize=(3.1 * len(variants) + 1.2, 3.4), layout="constrained")
        levels = np.linspace(0.02, 0.98, 49)
        for axes, variant in zip(figure.subplots(1, len(variants), squeeze=False)[0], variants, strict=True):
            axes.plot([0, 100], [0, 100], color="#8c8c8c", linewidth=1, linestyle=(0, (4, 3)))
            for shade, agent in zip(_SHADES, agents, strict=False):
                for prefix, line, label in (("", "-", "predicts with"), ("pooled_", ":", "all samples")):
                    values = np.abs(result.arrays(agent, variant, f"calibration/{prefix}transform").ravel() - 0.5)
                    share = [(values <= level / 2).mean() * 100 for level in levels]
                    axes.plot(100 * levels, share, color=shade, linestyle=line, label=f"{_title(agent)}, {label}")
            axes.set(title=variant, xlabel="central interval (%)", xlim=(0, 100), ylim=(0, 100))
        figure.axes[0].set_ylabel("outcomes inside (%)")
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8.5)
        return figure

    alt = "Share of outcomes inside each central predictive interval, beside the diagonal of perfect calibration."
    caption = "Below the diagonal the network is surer than it may be, above it less sure than it could be."
    return image("coverage", draw, alt=alt, caption=caption)


def _costs(result: RegressionResult) -> Section:
    rows = []
    for agent, variant in result.pairs:
        costs = [result.values(agent, variant, name).mean() for name in ("train_cpu_s", "measure_cpu_s")]
        rows.append([f"{_title(agent)}, {variant}", *(number(float(cost)) for cost in costs)])
    table = Table(name="costs", header=["CPU seconds a network", "training", "measuring"], rows=rows)
    words = (
        "The networks of a run train together, as one batched computation; its CPU seconds are shared out among them. "
        f"The whole bench took {result.wall_s:,.0f} s of wall time."
    )
    return Section(title="What it cost", words=(words,), tables=(table,))
