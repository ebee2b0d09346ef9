"""Sections of the toy regression's report: figure 4.1, and a number for every claim of the thesis (4.5.1)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from imagine_bench.arrays import Arrays, Floats
from imagine_bench.regression.results import PairResult, RegressionResult
from imagine_bench.report.figures import INK, image
from imagine_bench.report.tables import Image, Section, Table, number

_EDGE = 30.0
"""Where the data ends; beyond, networks extrapolate."""
_REGION = 10.0
"""Half the width of the region around 0 where the datasets differ."""
_SHADE = {"low_data": "#f0e442", "high_noise": "#e69f00"}
_BLUE = "#0072b2"
_TOPS = {"epistemic": 60, "modal": 60, "aleatoric": 20}
"""The kinds of uncertainty, and the top of each one's axis in figure 4.1."""
Pairs = dict[str, PairResult]
"""One regressor's networks by variant."""
_TITLES = {"base": "base", "low_data": "little data in the region", "high_noise": "much noise in the region"}


def sections(result: RegressionResult) -> list[Section]:
    """The claims of the thesis in numbers, figure 4.1 for every regressor, estimates and errors against the truth."""
    by_title = {title: result.by_variant(agent) for agent, title in result.titles.items()}
    claims = [_claims(title, pairs) for title, pairs in by_title.items()]
    answers = [answer for title, pairs in by_title.items() for answer in _answers(title, pairs)]
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
            tables=[table for table in claims if table.rows],
            answers=answers or ["Little data and much noise are compared with base: run low_data or high_noise too."],
        ),
        Section(
            title="Figure 4.1: what is uncertain, and why",
            words=("Shaded: yellow or orange where the datasets differ, red where the networks extrapolate.",),
            images=[_figure_4_1(title, pairs) for title, pairs in by_title.items()],
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
            tables=[_against_truth(title, pairs) for title, pairs in by_title.items()],
        ),
        Section(
            title="Equation 4.8: the squared error, cause by cause",
            words=(
                "The expected squared error of a value drawn from one weight sample's mixture is the sum of five: "
                "squared bias of the mean and its variance over weight samples (together equation 4.6), true noise, "
                "true distance of the branches, and the spread of what is drawn (estimated aleatoric and modal). "
                "Measured: against targets drawn anew; what remains is 0 but for sampling (95 %). Means over x, in y².",
            ),
            tables=[_decomposition(title, pairs) for title, pairs in by_title.items()],
        ),
    ]


def ratio(pairs: Pairs, kind: str, variant: str) -> Floats:
    """Mean uncertainty in the region over that of the base networks, network by network. Shape (E,)."""
    inside = np.abs(pairs[variant].first["x"]) <= _REGION
    changed, base = (pairs[each].arrays(kind)[:, inside].mean(axis=1) for each in (variant, "base"))
    return changed / base


def rank_correlation(pairs: Pairs, kind: str, variant: str) -> Floats:
    """Spearman's correlation of an uncertainty with the distance from the data, where x > 30. Shape (E,)."""
    x = pairs[variant].first["x"]
    rows = pairs[variant].arrays(kind)[:, x > _EDGE]
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
"""The variant a claim needs beside the base, its measure of which uncertainty, its words, and the condition on it."""


_SIGNS = {"≥": np.greater_equal, "≤": np.less_equal, ">": np.greater}


def holds(values: Floats, asked: str) -> int:
    """How many networks meet a condition, such as ``"≥ 3"``."""
    sign, _, limit = asked.partition(" ")
    return int(_SIGNS[sign](values, float(limit)).sum())


def _claims(title: str, pairs: Pairs) -> Table:
    rows = []
    for variant, measure, kind, words, asked in _CLAIMS:
        if {variant, "base"} <= pairs.keys():
            values = measure(pairs, kind, variant)
            met = f"{holds(values, asked)} of {len(values)}" if asked else ""
            spread = f"[{number(values.min())}, {number(values.max())}]"
            rows.append([words, f"{number(float(np.median(values)))} {spread}", asked, met])
    return _table("claims", pairs, [title, "measured", "asked", "networks that hold"], rows)


def _table(name: str, pairs: Pairs, header: list[str], rows: list[list[str]]) -> Table:
    agent = next(iter(pairs.values())).agent
    return Table(name=f"{name}_{agent}", header=header, rows=rows)


def _answers(title: str, pairs: Pairs) -> list[str]:
    sentences = []
    for variant, where in (("low_data", "data is scarce"), ("high_noise", "noise is high (truth 9 times)")):
        if {"base", variant} <= pairs.keys():
            epistemic, aleatoric = (np.median(ratio(pairs, kind, variant)) for kind in ("epistemic", "aleatoric"))
            sentences.append(
                f"{title}: where {where}, epistemic uncertainty is {number(float(epistemic))} times that "
                f"of the base networks and aleatoric {number(float(aleatoric))} times (medians over networks)."
            )
    return sentences


def _truth(pair: PairResult, kind: str) -> Floats:
    """True variance by cause, of every network. Shape (E, GRID)."""
    if kind == "epistemic":
        return pair.arrays("true_epistemic")
    return np.broadcast_to(pair.first[f"true_{kind}"], pair.arrays(kind).shape)


def _against_truth(title: str, pairs: Pairs) -> Table:
    rows = []
    for variant, pair in pairs.items():
        inside = np.abs(pair.first["x"]) <= _EDGE
        for kind in _TOPS:
            estimated = np.sqrt(pair.arrays(kind)[:, inside])
            true = np.sqrt(_truth(pair, kind)[:, inside])
            # equation 4.6 contains the estimate, which would agree with itself: the rest is the error of the mean
            target = true**2 - estimated**2 if kind == "epistemic" else true
            medians = [np.median(each, axis=1).mean() for each in (estimated, true, np.abs(estimated - true))]
            cells = [number(float(cell)) for cell in (*medians, _agreement(estimated, target))]
            rows.append([f"{_TITLES[variant]}: {kind}", *cells])
    header = [title, "estimated (y)", "true (y)", "difference (y)", "rank correlation"]
    return _table("truth", pairs, header, rows)


def _agreement(estimated: Floats, target: Floats) -> float:
    """Mean rank correlation along x over networks, rows of both; not a number where the target is constant."""
    if np.ptp(target, axis=1).max() == 0:
        return np.nan
    return float(np.mean([stats.spearmanr(*rows).statistic for rows in zip(estimated, target, strict=True)]))


def squared_error_terms(pair: PairResult) -> dict[str, Floats]:
    """The terms of equation 4.8 by name, and ``measured``, their sum from draws of targets and values. (E, GRID) each.

    The thesis' first term, true epistemic uncertainty, is split into ``bias²`` and ``epistemic`` (equation 4.6).
    """
    epistemic = pair.arrays("epistemic")
    return {
        "bias²": _truth(pair, "epistemic") - epistemic,
        "epistemic": epistemic,
        "true aleatoric": _truth(pair, "aleatoric"),
        "true modal": _truth(pair, "modal"),
        "spread": pair.arrays("aleatoric") + pair.arrays("modal"),
        "measured": pair.arrays("squared_error"),
    }


def _decomposition(title: str, pairs: Pairs) -> Table:
    rows = []
    terms: dict[str, Floats] = {}
    for variant, pair in pairs.items():
        terms = squared_error_terms(pair)
        x = pair.first["x"]
        for words, here in (("data", np.abs(x) <= _EDGE), ("region", np.abs(x) <= _REGION), ("beyond", x > _EDGE)):
            *causes, measured = (values[:, here] for values in terms.values())
            rest = measured - np.sum(causes, axis=0)
            interval = f"{number(rest.mean())} ± {number(1.96 * rest.std() / np.sqrt(rest.size))}"
            cells = [number(float(values.mean())) for values in (*causes, measured)]
            rows.append([f"{_TITLES[variant]}: {words}", *cells, interval])
    return _table("decomposition", pairs, [title, *terms, "measured − sum"], rows)


def _figure_4_1(title: str, pairs: Pairs) -> Image:
    data = {variant: pair.first for variant, pair in pairs.items()}
    caption = (
        f"{title}, the first network of each dataset, after figure 4.1 of the thesis. Top: training data "
        "(gray) and predictions (blue). Below: standard deviation of each kind of uncertainty (blue) and its true "
        "value (black)."
    )
    agent = next(iter(pairs.values())).agent
    return image(f"figure_4_1_{agent}", lambda: figure_4_1(data), caption)


def figure_4_1(data: dict[str, Arrays]) -> Figure:
    """A column a dataset; four rows: predictions, epistemic, modal, aleatoric."""
    figure = Figure(figsize=(3.9 * len(data) + 0.4, 9.6), layout="constrained")
    grid = figure.subplots(4, len(data), squeeze=False, sharex=True, sharey="row")
    for column, (variant, found) in zip(grid.T, data.items(), strict=True):
        column[0].scatter(found["training_x"], found["training_y"], s=2, color="#a8a8a8", linewidths=0)
        column[0].scatter(found["x"], found["prediction"][0], s=2.5, color=_BLUE, linewidths=0)
        column[0].set(title=_TITLES[variant], ylim=(-120, 140), ylabel="y")
        column[0].label_outer()
        for axes, (kind, top) in zip(column[1:], _TOPS.items(), strict=True):
            true = np.atleast_2d(found[f"true_{kind}"])[0]
            axes.plot(found["x"], np.sqrt(true), color=INK, linewidth=1.2, label="true")
            axes.plot(found["x"], np.sqrt(found[kind][0]), color=_BLUE, linewidth=1.3, label="estimated")
            axes.set(ylim=(0, top), ylabel=f"{kind} (std of y)")
            axes.label_outer()
        for axes in column:
            if variant in _SHADE:
                axes.axvspan(-_REGION, _REGION, color=_SHADE[variant], alpha=0.25, linewidth=0)
            axes.axvspan(_EDGE, 40.0, color="#d55e00", alpha=0.15, linewidth=0)
        column[3].set(xlabel="x", xlim=(-30, 40))
    grid[1][0].legend(loc="upper left", fontsize=8.5)
    return figure
