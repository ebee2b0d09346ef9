"""Sections of the robot's report: table 4.1, and the maps of figures 4.2 and 4.3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from imagine_bench import reference, registry, statistics
from imagine_bench.interfaces.regression import SCORES
from imagine_bench.regression.results import RegressionResult
from imagine_bench.report.figures import image
from imagine_bench.report.tables import DASH, Image, Section, Table, mean_std

Values = NDArray[np.float64]
Pair = tuple[str, str]
"""A regressor and its dataset."""
Ratios = dict[str, statistics.Estimate]
"""Error as a ratio to a random choice, by criterion."""
_JOINTS = ("q1", "q2", "q3")
_UNPRINTED = "not in the thesis"
_INTERVALS = "In brackets: 95 % interval over networks (Fieller)."
_KINDS = ("epistemic", "modal", "aleatoric")


def sections(result: RegressionResult) -> list[Section]:
    """The decisions, the same among places out of reach, the maps."""
    return [_decisions(result), _beyond(result), _maps(result)]


def totals(result: RegressionResult, agent: str, variant: str) -> dict[str, Values]:
    """Error cumulated over the choices by each criterion, network by network: criterion to (E,), in metres.

    ``random`` is what a choice by chance may expect, the mean over the candidates; ``mink`` reaches a candidate by
    inverse kinematics of the true arm.
    """
    mink = result.arrays(agent, variant, "decision/mink_error").sum(axis=1)
    return {**by_criterion(result, agent, variant, "decision", "error"), "mink": mink}


def by_criterion(result: RegressionResult, agent: str, variant: str, part: str, what: str) -> dict[str, Values]:
    """``what`` (``error``, ``outside_m``) of the chosen candidates, cumulated over choices, by criterion: (E,) each.

    The candidates of ``part`` ``decision`` are within reach, those of ``disc`` need not be.
    """
    values = result.arrays(agent, variant, f"{part}/{what}")  # [E, choices, candidates]
    picks = {name: result.arrays(agent, variant, f"{part}/{name}").argmin(axis=-1) for name in SCORES}
    by = {name: np.take_along_axis(values, pick[..., None], axis=-1)[..., 0] for name, pick in picks.items()}
    by |= {"min": values.min(axis=-1), "max": values.max(axis=-1), "random": values.mean(axis=-1)}
    return {name: values.sum(axis=1) for name, values in by.items()}


def ratio_to_random(values: Values, random: Values) -> statistics.Estimate:
    """Ratio of mean cumulated errors (E,) to those of a random choice (E,) by the same networks, with its interval."""
    return statistics.ratio(values, random, paired=True)


def _decisions(result: RegressionResult) -> Section:
    protocol, columns = result.protocol, (*SCORES, "min", "max", "random", "mink")
    printed = reference.load("robot_ik")["cumulative_error"]["criteria"]
    found = {pair: totals(result, *pair) for pair in result.pairs}
    against, errors, ratios = _rows(found, columns)
    answers = []
    for (agent, variant), estimates in against.items():
        known = variant in printed["random"]
        thesis = f" (thesis {printed['epistemic'][variant][0] / printed['random'][variant][0]:.2f})" if known else ""
        least, best = min((estimate.value, name) for name, estimate in estimates.items())
        answers.append(
            f"{_label(agent, variant)} samples: choosing the least epistemic uncertainty leaves "
            f"{estimates['epistemic'].value:.2f} of the error of a random choice{thesis}; best is "
            f"{best.replace('_', ' ')} with {least:.2f}."
        )
    for variant in protocol.variants:
        if variant in printed["random"]:
            cells = {name: rows[variant] for name, rows in printed.items() if variant in rows}
            texts = {name: f"{mean:.2f} ({std:.2f})" for name, (mean, std) in cells.items()}
            errors.append([f"thesis, {variant}", *(texts.get(name, DASH) for name in columns)])
            shares = {name: f"{mean / cells['random'][0]:.2f}" for name, (mean, _) in cells.items()}
            ratios.append([f"thesis, {variant}", *(shares.get(name, DASH) for name in SCORES)])
    header, scores = _headers(columns)
    caption = f"{_INTERVALS} Below 1 a criterion beats chance."
    return Section(
        title="Table 4.1: which place can the robot trust itself to reach?",
        words=(
            "The robot is shown 20 places and reaches for the one with the least uncertainty; the distance by which it "
            "misses is cumulated over 50 choices. Mean (standard deviation) over networks, in metres; lower is better. "
            "Random is the expectation of a choice by chance, min and max are the best and the worst choice in "
            "hindsight, mink is the error of inverse kinematics with a known model of the arm, the ceiling.",
            "Every predicted configuration is carried out by the simulated arm, and the place its tip comes to rest at "
            "is measured. Here no place outside of the workspace is asked for; the maps below show where it ends.",
        ),
        images=(_ratio_image(result, against),),
        tables=(
            Table(name="table_4_1", header=header, rows=errors, why_dash=_UNPRINTED),
            Table(name="ratio_to_random", header=scores, rows=ratios, caption=caption, why_dash=_UNPRINTED),
        ),
        answers=answers,
    )


def _beyond(result: RegressionResult) -> Section:
    """The same choices among points of the whole disc of the stretched arm."""
    columns = (*SCORES, "min", "max", "random")
    found = {pair: by_criterion(result, *pair, "disc", "error") for pair in result.pairs}
    against, errors, ratios = _rows(found, columns)
    answers = []
    for (agent, variant), estimates in against.items():
        outside = by_criterion(result, agent, variant, "disc", "outside_m")
        answers.append(
            f"{_label(agent, variant)} samples, any place on the disc of the stretched arm: choosing the least "
            f"epistemic uncertainty leaves {estimates['epistemic'].value:.2f} of the error of a random choice, and "
            f"asks for {outside['epistemic'].mean():.2f} m beyond reach in 50 choices (by chance "
            f"{outside['random'].mean():.2f} m)."
        )
    header, scores = _headers(columns)
    return Section(
        title="The same among places that may be out of reach",
        words=(
            "Here the 20 places lie anywhere on the disc of the stretched arm, whose left part no configuration "
            "reaches. A place out of reach is missed by its distance from the workspace at least: does the robot know "
            "what it cannot reach? The thesis draws its points 'over the workspace' and does not say how.",
        ),
        tables=(
            Table(name="disc", header=header, rows=errors),
            Table(name="disc_ratio_to_random", header=scores, rows=ratios, caption=_INTERVALS),
        ),
        answers=answers,
    )


def _headers(columns: Sequence[str]) -> tuple[list[str], list[str]]:
    """Of the table of errors and of that of ratios."""
    errors, ratios = ([name.replace("_", " ") for name in names] for names in (columns, SCORES))
    return ["cumulated error (m)", *errors], ["ratio to random", *ratios]


def _label(agent: str, variant: str) -> str:
    return f"{registry.regressor_entry(agent).title}, {variant}"


def _rows(
    found: Mapping[Pair, Mapping[str, Values]], columns: Sequence[str]
) -> tuple[dict[Pair, Ratios], list[list[str]], list[list[str]]]:
    """Ratios of errors to a random choice; rows of the errors and of these, one a regressor and dataset."""
    against = {pair: {name: ratio_to_random(by[name], by["random"]) for name in SCORES} for pair, by in found.items()}
    errors = [[_label(*pair), *(mean_std(by[name].tolist()) for name in columns)] for pair, by in found.items()]
    ratios = [[_label(*pair), *(_interval(by[name]) for name in SCORES)] for pair, by in against.items()]
    return against, errors, ratios


def _interval(estimate: statistics.Estimate) -> str:
    value = f"{estimate.value:.2f}"
    return value if np.isnan(estimate.low) else f"{value} [{estimate.low:.2f}, {estimate.high:.2f}]"


def _ratio_image(result: RegressionResult, against: Mapping[Pair, Ratios]) -> Image:
    printed = reference.load("robot_ik")["cumulative_error"]["criteria"]

    def draw() -> Figure:
        protocol = result.protocol
        figure = Figure(figsize=(9.2, 3.6), layout="constrained")
        axes = figure.add_subplot()
        places, shades = np.arange(len(SCORES), dtype=float), ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")
        for index, ((agent, variant), estimates) in enumerate(against.items()):
            values = np.array([estimates[name][:3] for name in SCORES])
            off = places + 0.8 * ((index + 0.5) / len(against) - 0.5)
            marker = "osDv^"[protocol.agents.index(agent) % 5]
            shade = shades[protocol.variants.index(variant) % 5]
            bars = np.nan_to_num(np.abs(values[:, 1:].T - values[:, 0]))
            style: dict[str, Any] = {"fmt": marker, "markersize": 5, "color": shade, "capsize": 2}
            axes.errorbar(off, values[:, 0], yerr=bars, label=_label(agent, variant), **style)
        for index, name in enumerate(SCORES):
            ratios = [
                c[0] / printed["random"][v][0] for v, c in printed.get(name, {}).items() if v in protocol.variants
            ]
            if ratios:
                label = "thesis" if index == 0 else ""
                axes.hlines(ratios, index - 0.42, index + 0.42, color="#2b2b2f", linewidth=0.9, label=label)
        axes.axhline(1.0, color="#8c8c8c", linewidth=1, linestyle=(0, (4, 3)))
        axes.set_xticks(places, [name.replace("_plus_", " +\n").replace("_", "\n") for name in SCORES])
        axes.set(ylabel="error, as a share of\na random choice's", ylim=(0, None))
        figure.legend(loc="outside right upper", fontsize=8.5)
        return figure

    alt = "Cumulated error of every criterion relative to a random choice, with intervals and the thesis' ratios."
    return image("ratio_to_random", draw, alt=alt, caption="Below 1 a criterion beats chance; bars: 95 % intervals.")


def _maps(result: RegressionResult) -> Section:
    images = []
    for pair in result.pairs:
        name, samples = "_".join(pair), f"{_label(*pair)} samples (first network)"
        alt = "Places visited while babbling, error of reaching, and stationarity over the workspace."
        caption = (
            f"{samples}, after figure 4.2: where the arm's tip was while babbling, how far it misses a place that it "
            "reaches for, and the stationarity score."
        )
        images.append(image(f"figure_4_2_{name}", partial(figure_4_2, result, *pair), alt=alt, caption=caption))
        alt = "Epistemic, modal and aleatoric uncertainty of each joint over the workspace."
        caption = (
            f"{samples}, after figure 4.3: standard deviation of each joint by cause, in radians. Outside of the line "
            "no place can be reached."
        )
        images.append(image(f"figure_4_3_{name}", partial(figure_4_3, result, *pair), alt=alt, caption=caption))
    outside = result.first(*result.pairs[0])["map/outside_m"]
    words = (
        f"{int((outside > 0).sum())} of the {len(outside)} places of the maps are unreachable, the farthest by "
        f"{outside.max():.2f} m: nothing is asked of the arm there (white in the error map), and the uncertainties "
        "show what the networks would say of them."
    )
    return Section(title="Figures 4.2 and 4.3: the workspace", words=(words,), images=images)


def figure_4_2(result: RegressionResult, agent: str, variant: str) -> Figure:
    """Babbling density, error, stationarity."""
    data = result.first(agent, variant)
    figure = Figure(figsize=(11.0, 3.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    left.scatter(*data["babbling"].T, s=2.5, color="#0072b2", linewidths=0)
    _arena(left, data, "training data")
    _field(figure, middle, data, data["map/error"][0], "error of reaching (m)", top=0.6)
    _field(figure, right, data, data["map/stationarity"][0], "stationarity (nats)")
    return figure


def figure_4_3(result: RegressionResult, agent: str, variant: str) -> Figure:
    """Three rows, a kind of uncertainty each; three columns, a joint each."""
    data = result.first(agent, variant)
    figure = Figure(figsize=(11.0, 9.8), layout="constrained")
    for row, kind in zip(figure.subplots(3, 3), _KINDS, strict=True):
        values = np.sqrt(data[f"map/{kind}"][0])  # [G, joints]
        inside = data["map/outside_m"] == 0
        for axes, joint, field in zip(row, _JOINTS, values.T, strict=True):
            _field(figure, axes, data, field, f"{kind}, {joint} (rad)", top=float(np.percentile(field[inside], 99)))
    return figure


def _field(
    figure: Figure, axes: Axes, data: dict[str, Values], values: Values, title: str, top: float | None = None
) -> None:
    grid = _grid(data)
    style: dict[str, Any] = {"cmap": "viridis", "vmin": 0, "vmax": top, "shading": "nearest", "rasterized": True}
    shown = axes.pcolormesh(*grid, values.reshape(grid.shape[1:]), **style)
    figure.colorbar(shown, ax=axes, shrink=0.85, extend="max" if top is not None else "neither")
    _arena(axes, data, title)


def _arena(axes: Axes, data: dict[str, Values], title: str) -> None:
    """The edge of the workspace, the arm's base, equal axes."""
    grid = _grid(data)
    axes.contour(*grid, data["map/outside_m"].reshape(grid.shape[1:]), levels=[1e-3], colors="#d55e00", linewidths=1.1)
    axes.plot(0, 0, marker="o", color="#d55e00", markersize=4)
    axes.set(title=title, aspect="equal", xlim=(-1.1, 1.1), ylim=(-1.1, 1.1), xlabel="x1 (m)")
    axes.grid(visible=False)


def _grid(data: dict[str, Values]) -> Values:
    """Places of the map. Shape (2, side, side)."""
    side = round(len(data["map/points"]) ** 0.5)
    return data["map/points"].reshape(side, side, 2).transpose(2, 0, 1)
