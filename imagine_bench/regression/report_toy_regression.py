"""Sections of the toy regression's report: figure 4.1, and a number for every claim of the thesis (4.5.1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from imagine_bench import registry
from imagine_bench.regression.results import RegressionResult
from imagine_bench.report.plots import image
from imagine_bench.report.sections import Image, Section, Table, number

_REGION, _EDGE = (-10.0, 10.0), 30.0
_SHADE = {"low_data": "#f0e442", "high_noise": "#e69f00"}
_KINDS = (("epistemic", "true_epistemic"), ("modal", "true_modal"), ("aleatoric", "true_aleatoric"))
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
    ]


def ratio(result: RegressionResult, agent: str, kind: str, variant: str) -> Values:
    """Mean uncertainty in the region over that of the base networks, network by network. Shape (E,)."""
    x = result.first(agent, variant)["x"]
    inside = (x >= _REGION[0]) & (x <= _REGION[1])
    changed, base = (result.arrays(agent, v, kind)[:, inside].mean(axis=1) for v in (variant, "base"))
    found: Values = changed / base
    return found


def rank_correlation(result: RegressionResult, agent: str, kind: str, variant: str) -> Values:
    """Spearman's correlation of an uncertainty with the distance from the data, where x > 30. Shape (E,)."""
    x = result.first(agent, variant)["x"]
    beyond = x > _EDGE
    rows = result.arrays(agent, variant, kind)[:, beyond]
    return np.array([stats.spearmanr(x[beyond], row).statistic for row in rows])


_CLAIMS: tuple[tuple[str, str, Callable[[RegressionResult, str], Values], str], ...] = (
    ("low_data", "little data: epistemic there, times base", lambda r, a: ratio(r, a, "epistemic", "low_data"), "≥ 3"),
    ("low_data", "little data: aleatoric there, times base", lambda r, a: ratio(r, a, "aleatoric", "low_data"), "≤ 2"),
    (
        "high_noise", "much noise: aleatoric there, times base (truth 9)",
        lambda r, a: ratio(r, a, "aleatoric", "high_noise"), "≥ 4",
    ),
    ("high_noise", "much noise: epistemic there, times base",
     lambda r, a: ratio(r, a, "epistemic", "high_noise"), "≤ 2"),
    ("low_data", "little data: stationarity there, times base",
     lambda r, a: ratio(r, a, "stationarity", "low_data"), ""),
    ("base", "extrapolation: rank correlation of epistemic with distance",
     lambda r, a: rank_correlation(r, a, "epistemic", "base"), "> 0"),
    ("base", "extrapolation: rank correlation of aleatoric with distance",
     lambda r, a: rank_correlation(r, a, "aleatoric", "base"), "> 0"),
)  # fmt: skip
"""The variant a claim needs beside the base, its words, its measure, and what is asked of it."""


def holds(values: Values, asked: str) -> NDArray[np.bool_]:
    """Whether each network meets what is asked, such as ``"≥ 3"``."""
    sign, _, limit = asked.partition(" ")
    above = {"≥": values >= float(limit), "≤": values <= float(limit), ">": values > float(limit)}
    return above[sign]


def _claims(result: RegressionResult, agent: str) -> Table:
    rows = []
    for variant, words, measure, asked in _CLAIMS:
        if {variant, "base"} <= set(result.protocol.variants):
            values = measure(result, agent)
            met = f"{int(holds(values, asked).sum())} of {len(values)}" if asked else ""
            spread = f"[{number(values.min())}, {number(values.max())}]"
            rows.append([words, f"{number(float(np.median(values)))} {spread}", asked, met])
    title = registry.regressor_entry(agent).title
    return Table(name=f"claims_{agent}", header=[title, "measured", "asked", "networks that hold"], rows=rows)


def _answers(result: RegressionResult, agent: str) -> list[str]:
    title, variants = registry.regressor_entry(agent).title, set(result.protocol.variants)
    sentences = []
    if {"base", "low_data"} <= variants:
        low = [float(np.median(ratio(result, agent, kind, "low_data"))) for kind in ("epistemic", "aleatoric")]
        sentences.append(
            f"{title}: where data is scarce, epistemic uncertainty is {number(low[0])} times that of the base networks "
            f"and aleatoric {number(low[1])} times (medians over networks)."
        )
    if {"base", "high_noise"} <= variants:
        noisy = [float(np.median(ratio(result, agent, kind, "high_noise"))) for kind in ("aleatoric", "epistemic")]
        sentences.append(
            f"{title}: where noise is high, aleatoric uncertainty is {number(noisy[0])} times that of the base "
            f"networks (truth 9) and epistemic {number(noisy[1])} times."
        )
    return sentences


def _against_truth(result: RegressionResult, agent: str) -> Table:
    rows = []
    for variant in result.protocol.variants:
        first = result.first(agent, variant)
        inside = np.abs(first["x"]) <= _EDGE
        for kind, name in _KINDS:
            estimate = np.sqrt(result.arrays(agent, variant, kind)[:, inside])
            known = first[name] if first[name].ndim == 1 else result.arrays(agent, variant, name)
            truth = np.broadcast_to(np.sqrt(known[..., inside]), estimate.shape)
            # equation 4.6 contains the estimate, which would agree with itself: the rest is the error of the mean
            target = truth**2 - estimate**2 if kind == "epistemic" else truth
            varies = np.ptp(target, axis=1).max() > 0
            along = (
                np.mean([stats.spearmanr(*pair).statistic for pair in zip(estimate, target, strict=True)])
                if varies
                else np.nan
            )
            off = np.median(np.abs(estimate - truth), axis=1).mean()
            cells = [np.median(estimate, axis=1).mean(), np.median(truth, axis=1).mean(), off, along]
            rows.append([f"{_TITLES[variant]}: {kind}", *(number(float(cell)) for cell in cells)])
    title = registry.regressor_entry(agent).title
    header = [title, "estimated (y)", "true (y)", "difference (y)", "rank correlation"]
    return Table(name=f"truth_{agent}", header=header, rows=rows)


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
        for axes, (kind, truth) in zip(column[1:], _KINDS, strict=True):
            known = data[truth] if data[truth].ndim == 1 else data[truth][0]
            axes.plot(x, np.sqrt(known), color="#2b2b2f", linewidth=1.2, label="true")
            axes.plot(x, np.sqrt(data[kind][0]), color="#0072b2", linewidth=1.3, label="estimated")
        for axes in column:
            _shade(axes, variant)
        column[3].set_xlabel("x")
    _label_rows(grid)
    return figure


def _shade(axes: Axes, variant: str) -> None:
    if variant in _SHADE:
        axes.axvspan(*_REGION, color=_SHADE[variant], alpha=0.25, linewidth=0)
    axes.axvspan(_EDGE, 40.0, color="#d55e00", alpha=0.15, linewidth=0)
    axes.set_xlim(-30, 40)


def _label_rows(grid: NDArray[np.object_]) -> None:
    for row, words in zip(grid, ("y", "epistemic (std of y)", "modal (std of y)", "aleatoric (std of y)"), strict=True):
        row[0].set_ylabel(words)
    for row, top in zip(grid[1:], (60, 60, 20), strict=True):
        row[0].set_ylim(0, top)
    grid[1][0].legend(loc="upper left", fontsize=8.5)
