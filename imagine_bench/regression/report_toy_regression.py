"""Sections of the toy regression's report: figure 4.1, and a number for every claim of the thesis (4.5.1)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from imagine_bench import registry
from imagine_bench.regression.results import RegressionResult
from imagine_bench.report.figures import image
from imagine_bench.report.tables import Image, Section, Table, number

_REGION, _EDGE = (-10.0, 10.0), 30.0
_SHADE = {"low_data": "#f0e442", "high_noise": "#e69f00"}
_KINDS = ("epistemic", "modal", "aleatoric")
_TITLES = {"base": "base", "low_data": "little data in the region", "high_noise": "much noise in the region"}

Values = NDArray[np.float64]


def sections(result: RegressionResult) -> list[Section]:
    """The claims of the thesis in numbers, and figure 4.1 for every regressor."""
    tables = [_claims(result, agent) for agent in result.protocol.agents]
    truth = [_against_truth(result, agent) for agent in result.protocol.agents]
    answers = [answer for agent in result.protocol.agents for answer in _answers(result, agent)]
    return [
        Section(
            title="The thesis' claims, in numbers",
            words=(
                "Mean over the region [−10, 10] of the uncertainty of networks trained with little data (or much "
                "noise) there, divided by that of the base networks. Truth: the noise is 9 times as large in the noisy "
                "region. "
                "Rank correlation: of epistemic uncertainty with the distance from the data, for x from 30 to 40. "
                "Values are the median over networks, in brackets the smallest and the largest.",
            ),
            tables=[table for table in tables if table.rows],
            answers=answers
            or ["What little data and much noise do is said against base: run low_data or high_noise beside it."],
        ),
        Section(
            title="Figure 4.1: what is uncertain, and why",
            words=("Shaded: yellow or orange where the datasets differ, red where the networks extrapolate.",),
            images=[_figure_4_1(result, agent) for agent in result.protocol.agents],
        ),
        Section(
            title="Estimates against the truth",
            words=(
                "Inside the training range [−30, 30]: medians over x of the estimated and of the true standard "
                "deviations, of the absolute difference between the two, and the rank correlation along x, each "
                "averaged over networks. True epistemic uncertainty is equation 4.6, the squared error of the mean "
                "plus its variance, which is the estimate itself: the rank correlation is with the error alone, and "
                "the difference can have one sign only.",
            ),
            tables=truth,
        ),
        Section(
            title="Equation 4.8: the squared error, cause by cause",
            words=(
                "The expected squared error of a value drawn from one weight sample's mixture is the sum of five: "
                "squared bias of the mean and its variance over weight samples (together equation 4.6), true noise, "
                "true distance of the branches, and the spread of what is drawn (estimated aleatoric and modal). "
                "Measured: against targets drawn anew; what remains is 0 but for sampling (95 %). Means over x, in y².",
            ),
            tables=[_decomposition(result, agent) for agent in result.protocol.agents],
        ),
    ]


def ratio(result: RegressionResult, agent: str, kind: str, variant: str) -> Values:
    """Mean uncertainty in the region over that of the base networks, network by network. Shape (E,)."""
    x = result.first(agent, variant)["x"]
    inside = (x >= _REGION[0]) & (x <= _REGION[1])
    changed, base = (result.arrays(agent, v, kind)[:, inside].mean(axis=1) for v in (variant, "base"))
    return changed / base


def rank_correlation(result: RegressionResult, agent: str, kind: str, variant: str) -> Values:
    """Spearman's correlation of an uncertainty with the distance from the data, where x > 30. Shape (E,)."""
    x = result.first(agent, variant)["x"]
    rows = result.arrays(agent, variant, kind)[:, x > _EDGE]
    return np.array([stats.spearmanr(x[x > _EDGE], row).statistic for row in rows])


_LOW, _HIGH, _FAR = "little data", "much noise", "extrapolation: rank correlation of"
_CLAIMS = (
    ("low_data", ratio, "epistemic", f"{_LOW}: epistemic there, times base", "≥ 3"),
    ("low_data", ratio, "aleatoric", f"{_LOW}: aleatoric there, times base", "≤ 2"),
    ("high_noise", ratio, "aleatoric", f"{_HIGH}: aleatoric there, times base (truth 9)", "≥ 4"),
    ("high_noise", ratio, "epistemic", f"{_HIGH}: epistemic there, times base", "≤ 2"),
    ("low_data", ratio, "stationarity", f"{_LOW}: stationarity there, times base", ""),
    ("base", rank_correlation, "epistemic", f"{_FAR} epistemic with distance", "> 0"),
    ("base", rank_correlation, "aleatoric", f"{_FAR} aleatoric with distance", "> 0"),
)
"""The variant a claim needs beside the base, its measure of which uncertainty, its words, and what is asked of it."""


def holds(values: Values, asked: str) -> NDArray[np.bool_]:
    """Whether each network meets what is asked, such as ``"≥ 3"``."""
    sign, _, limit = asked.partition(" ")
    above = {"≥": values >= float(limit), "≤": values <= float(limit), ">": values > float(limit)}
    return above[sign]


def _claims(result: RegressionResult, agent: str) -> Table:
    rows = []
    for variant, measure, kind, words, asked in _CLAIMS:
        if {variant, "base"} <= set(result.protocol.variants):
            values = measure(result, agent, kind, variant)
            met = f"{int(holds(values, asked).sum())} of {len(values)}" if asked else ""
            spread = f"[{number(values.min())}, {number(values.max())}]"
            rows.append([words, f"{number(float(np.median(values)))} {spread}", asked, met])
    title = registry.regressor_entry(agent).title
    return Table(name=f"claims_{agent}", header=[title, "measured", "asked", "networks that hold"], rows=rows)


def _answers(result: RegressionResult, agent: str) -> list[str]:
    title, variants = registry.regressor_entry(agent).title, set(result.protocol.variants)

    def times(kind: str, variant: str) -> str:
        return f"{number(float(np.median(ratio(result, agent, kind, variant))))} times"

    sentences = []
    if {"base", "low_data"} <= variants:
        sentences.append(
            f"{title}: where data is scarce, epistemic uncertainty is {times('epistemic', 'low_data')} that of the "
            f"base networks and aleatoric {times('aleatoric', 'low_data')} (medians over networks)."
        )
    if {"base", "high_noise"} <= variants:
        sentences.append(
            f"{title}: where noise is high, aleatoric uncertainty is {times('aleatoric', 'high_noise')} that of the "
            f"base networks (truth 9) and epistemic {times('epistemic', 'high_noise')}."
        )
    return sentences


def _against_truth(result: RegressionResult, agent: str) -> Table:
    rows = []
    for variant in result.protocol.variants:
        first = result.first(agent, variant)
        inside = np.abs(first["x"]) <= _EDGE
        for kind in _KINDS:
            estimate = np.sqrt(result.arrays(agent, variant, kind)[:, inside])
            name = f"true_{kind}"
            known = first[name] if first[name].ndim == 1 else result.arrays(agent, variant, name)
            truth = np.broadcast_to(np.sqrt(known[..., inside]), estimate.shape)
            # equation 4.6 contains the estimate, which would agree with itself: the rest is the error of the mean
            target = truth**2 - estimate**2 if kind == "epistemic" else truth
            varies, pairs = np.ptp(target, axis=1).max() > 0, zip(estimate, target, strict=True)
            along = np.mean([stats.spearmanr(*pair).statistic for pair in pairs]) if varies else np.nan
            off = np.median(np.abs(estimate - truth), axis=1).mean()
            cells = [np.median(estimate, axis=1).mean(), np.median(truth, axis=1).mean(), off, along]
            rows.append([f"{_TITLES[variant]}: {kind}", *(number(float(cell)) for cell in cells)])
    header = [registry.regressor_entry(agent).title, "estimated (y)", "true (y)", "difference (y)", "rank correlation"]
    return Table(name=f"truth_{agent}", header=header, rows=rows)


def squared_error_terms(result: RegressionResult, agent: str, variant: str) -> dict[str, Values]:
    """The terms of equation 4.8 by name, and ``measured``, their sum from draws of targets and values. (E, GRID) each.

    The thesis' first term, true epistemic uncertainty, is split into ``bias²`` and ``epistemic`` (equation 4.6).
    """
    first = result.first(agent, variant)
    estimated = {name: result.arrays(agent, variant, name) for name in _KINDS}
    return {
        "bias²": result.arrays(agent, variant, "true_epistemic") - estimated["epistemic"],
        "epistemic": estimated["epistemic"],
        "aleatoric": np.broadcast_to(first["true_aleatoric"], estimated["epistemic"].shape),
        "modal": np.broadcast_to(first["true_modal"], estimated["epistemic"].shape),
        "spread": estimated["aleatoric"] + estimated["modal"],
        "measured": result.arrays(agent, variant, "squared_error"),
    }


def _decomposition(result: RegressionResult, agent: str) -> Table:
    rows = []
    for variant in result.protocol.variants:
        terms, x = squared_error_terms(result, agent, variant), result.first(agent, variant)["x"]
        for words, here in (("data", np.abs(x) <= _EDGE), ("region", np.abs(x) <= _REGION[1]), ("beyond", x > _EDGE)):
            *causes, measured = (values[:, here] for values in terms.values())
            rest = measured - np.sum(causes, axis=0)
            interval = f"{number(rest.mean())} ± {number(1.96 * rest.std() / np.sqrt(rest.size))}"
            cells = [number(float(values.mean())) for values in (*causes, measured)]
            rows.append([f"{_TITLES[variant]}: {words}", *cells, interval])
    header = [registry.regressor_entry(agent).title, "bias²", "epistemic", "true aleatoric", "true modal", "spread"]
    header += ["measured", "measured − sum"]
    return Table(name=f"decomposition_{agent}", header=header, rows=rows)


def _figure_4_1(result: RegressionResult, agent: str) -> Image:
    title = registry.regressor_entry(agent).title
    caption = (
        f"{title}, the first network of each dataset, after figure 4.1 of the thesis. Top: training data (gray) and "
        "predictions (blue). Below: standard deviation of each kind of uncertainty (blue) and its true value (black)."
    )
    alt = "Predictions and epistemic, modal and aleatoric uncertainty along x for three datasets, with true values."
    return image(f"figure_4_1_{agent}", lambda: figure_4_1(result, agent), alt=alt, caption=caption)


def figure_4_1(result: RegressionResult, agent: str) -> Figure:
    """Three columns, a dataset each; four rows: predictions, epistemic, modal, aleatoric."""
    variants = result.protocol.variants
    figure = Figure(figsize=(3.9 * len(variants) + 0.4, 9.6), layout="constrained")
    grid = figure.subplots(4, len(variants), squeeze=False, sharex=True, sharey="row")
    for column, variant in zip(grid.T, variants, strict=True):
        data = result.first(agent, variant)
        x = data["x"]
        column[0].scatter(data["training_x"], data["training_y"], s=2, color="#a8a8a8", linewidths=0)
        column[0].scatter(x, data["prediction"][0], s=2.5, color="#0072b2", linewidths=0)
        column[0].set(title=_TITLES[variant], ylim=(-120, 140))
        for axes, kind in zip(column[1:], _KINDS, strict=True):
            truth = data[f"true_{kind}"]
            known = truth if truth.ndim == 1 else truth[0]
            axes.plot(x, np.sqrt(known), color="#2b2b2f", linewidth=1.2, label="true")
            axes.plot(x, np.sqrt(data[kind][0]), color="#0072b2", linewidth=1.3, label="estimated")
        for axes in column:
            if variant in _SHADE:
                axes.axvspan(*_REGION, color=_SHADE[variant], alpha=0.25, linewidth=0)
            axes.axvspan(_EDGE, 40.0, color="#d55e00", alpha=0.15, linewidth=0)
            axes.set_xlim(-30, 40)
        column[3].set_xlabel("x")
    for row, words in zip(grid, ("y", *(f"{kind} (std of y)" for kind in _KINDS)), strict=True):
        row[0].set_ylabel(words)
    for row, top in zip(grid[1:], (60, 60, 20), strict=True):
        row[0].set_ylim(0, top)
    grid[1][0].legend(loc="upper left", fontsize=8.5)
    return figure
