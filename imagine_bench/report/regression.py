"""The page of a regression bench: the task's own sections, then calibration.

A task names the function that makes its sections.
"""

from __future__ import annotations

from imagine_bench import registry
from imagine_bench.interfaces.regression import SCORES
from imagine_bench.regression.runner import RegressionResult
from imagine_bench.report.page import Page, Section, Table, made, mean_std
from imagine_bench.store.files import table_text

_CALIBRATION = {
    "coverage_0.5": "in 50 % interval",
    "coverage_0.8": "in 80 % interval",
    "coverage_0.95": "in 95 % interval",
    "log_score": "negative log-likelihood",
    "wrong": "wrong",
    **{f"auroc_{name}": f"AUROC of {name.replace('_', ' ')}" for name in SCORES},
}
"""Measures of calibration, and their columns."""
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
    protocol = result.protocol
    spec = registry.regression(protocol.task)
    own = registry.load(spec.sections)(result) if spec.sections else []
    sections = [*own, _calibration(result)]
    rows = [{"agent": run.agent, "seed": run.seed, **row} for run in result.runs for row in run.rows]
    tables = [table for section in sections for table in section.tables]
    return Page(
        title=f"{spec.title}: does the model know what it does not know?",
        subtitle=f"Preset {protocol.preset} · networks a dataset: {protocol.networks} · protocol {protocol.hash}",
        question=spec.description,
        table=tables[0],
        sections=[Section("Task and regressors", (_COMPARED,)), *sections],
        files={"results.csv": table_text(rows), **{f"{table.name}.csv": table.csv for table in tables}},
        facts=made(result),
    )


def _calibration(result: RegressionResult) -> Section:
    spec = registry.regression(result.protocol.task)
    rows = [
        {"": pair.label, **{title: mean_std(pair.values(name)) for name, title in _CALIBRATION.items()}}
        for pair in result.pairs.values()
    ]
    return Section(
        title="Calibration: as sure as it may be?",
        words=(
            f"Each network is asked about {result.protocol.test_points} unseen points. An interval that is said to "
            "hold 80 % of the outcomes should hold 80 %, and the negative log-likelihood of the outcomes (nats) is "
            "lower for better predictive distributions. The distribution is the one that predictions are sampled from.",
            f"A prediction is called wrong where its error, the {spec.error_name}, is above {spec.wrong_above:g}. The "
            "other columns say how well each uncertainty finds the wrong ones: the probability that a wrong "
            "prediction has the higher uncertainty of two (AUROC; 0.5 is chance, 1 is perfect). Means (standard "
            "deviations) over networks.",
        ),
        tables=(Table.of("calibration", rows, why_dash="all predictions of a network are wrong, or none"),),
    )
