"""Sections of the robot's report: table 4.1, and the maps of figures 4.2 and 4.3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imagine_bench import reference, statistics
from imagine_bench.arrays import Arrays, Floats
from imagine_bench.interfaces.regression import SCORES
from imagine_bench.regression.results import PairResult, RegressionResult
from imagine_bench.report.figures import image
from imagine_bench.report.tables import DASH, Image, Section, Table, decimals, estimate, mean_std

_INTERVALS = "In brackets: 95 % interval over networks (Fieller). Below 1 a criterion beats chance."
_HINDSIGHT = ("min", "max", "random")
_ARM = "#d55e00"
ByCriterion = dict[str, Floats]
"""Cumulated errors of every network, (E,), by criterion of choice."""
Rows = Sequence[list[str]]


def sections(result: RegressionResult) -> list[Section]:
    """The decisions, the same among places out of reach, the maps."""
    return [_decisions(result), _beyond_reach(result), _maps(result)]


def by_criterion(pair: PairResult, part: str, measure: str) -> ByCriterion:
    """A measure of the chosen candidates, summed over the choices of each network.

    Each score chooses the candidate of which it is least. ``min`` and ``max`` are the best and the worst choice in
    hindsight, and ``random`` the mean over the candidates, which a choice by chance may expect.

    Args:
        pair: Regressor and dataset.
        part: ``"decision"``, whose candidates are within reach, or ``"disc"``, whose candidates need not be.
        measure: ``"error"`` or ``"outside_m"``, in metres.
    """
    values = pair.arrays(f"{part}/{measure}")  # [E, choices, candidates]
    chosen = {"min": values.min(axis=-1), "max": values.max(axis=-1), "random": values.mean(axis=-1)}
    for name in SCORES:
        pick = pair.arrays(f"{part}/{name}").argmin(axis=-1)
        chosen[name] = np.take_along_axis(values, pick[..., None], axis=-1)[..., 0]
    return {name: each.sum(axis=1) for name, each in chosen.items()}


def ratio_to_random(values: Floats, random: Floats) -> statistics.Estimate:
    """Ratio of mean cumulated errors (E,) to those of a random choice (E,) by the same networks, with its interval."""
    return statistics.ratio(values, random, paired=True)


def _decisions(result: RegressionResult) -> Section:
    errors = {}
    answers = []
    for pair in result.pairs:
        found = by_criterion(pair, "decision", "error")
        ratios = {name: ratio_to_random(found[name], found["random"]).value for name in SCORES}
        best = min(ratios, key=lambda name: ratios[name])
        answers.append(
            f"{pair.label} samples: choosing the least epistemic uncertainty leaves {ratios['epistemic']:.2f} of "
            f"the error of a random choice; best is {_words(best)} with {ratios[best]:.2f}."
        )
        errors[pair.label] = found | {"mink": pair.arrays("decision/mink_error").sum(axis=1)}
    columns = (*SCORES, *_HINDSIGHT, "mink")
    thesis_sums = []
    thesis_ratios = []
    printed = reference.load("robot_ik")["cumulative_error"]["criteria"]
    for variant in (each for each in result.protocol.variants if each in printed["random"]):
        means = {name: rows[variant][0] for name, rows in printed.items() if variant in rows}
        texts = {name: "{:.2f} ({:.2f})".format(*printed[name][variant]) for name in means}
        ratios = {name: mean / means["random"] for name, mean in means.items()}
        thesis_sums.append([f"thesis, {variant}", *(texts.get(name, DASH) for name in columns)])
        thesis_ratios.append([f"thesis, {variant}", *(decimals(ratios.get(name, np.nan)) for name in SCORES)])
    return Section(
        title="Table 4.1: which place can the robot trust itself to reach?",
        words=(
            "The robot is shown 20 places and reaches for the one with the least uncertainty; the distance by which it "
            "misses is cumulated over 50 choices. Mean (standard deviation) over networks, in metres; lower is better. "
            "Random is the expectation of a choice by chance, min and max are the best and the worst choice in "
            "hindsight, mink is the error of inverse kinematics with a known model of the arm.",
            "The simulated arm carries out every predicted configuration, and the place its tip comes to rest at is "
            "measured. Here no place outside of the workspace is asked for; the maps below show where it ends.",
        ),
        tables=(
            _sums("table_4_1", errors, columns, thesis_sums),
            _ratios("ratio_to_random", errors, thesis_ratios),
        ),
        answers=answers,
    )


def _beyond_reach(result: RegressionResult) -> Section:
    errors = {pair.label: by_criterion(pair, "disc", "error") for pair in result.pairs}
    answers = []
    for pair in result.pairs:
        outside_m = by_criterion(pair, "disc", "outside_m")
        answers.append(
            f"{pair.label} samples, any place on the disc of the stretched arm: choosing the least epistemic "
            f"uncertainty asks for {outside_m['epistemic'].mean():.2f} m beyond reach in 50 choices (by chance "
            f"{outside_m['random'].mean():.2f} m)."
        )
    return Section(
        title="The same among places that may be out of reach",
        words=(
            "Here the 20 places lie anywhere on the disc of the stretched arm, whose left part no configuration "
            "reaches. A place out of reach is missed by its distance from the workspace at least: does the robot know "
            "which places it cannot reach? The thesis draws its points 'over the workspace' and does not say how.",
        ),
        tables=(_sums("disc", errors, (*SCORES, *_HINDSIGHT)), _ratios("disc_ratio_to_random", errors)),
        answers=answers,
    )


def _sums(name: str, errors: Mapping[str, ByCriterion], columns: Sequence[str], more: Rows = ()) -> Table:
    """Cumulated errors, a row a regressor and dataset, then more rows."""
    rows = [[label, *(mean_std(found[column]) for column in columns)] for label, found in errors.items()]
    header = ["cumulated error (m)", *map(_words, columns)]
    return Table(name=name, header=header, rows=[*rows, *more], why_dash="not in the thesis")


def _ratios(name: str, errors: Mapping[str, ByCriterion], more: Rows = ()) -> Table:
    """Their ratios to those of a random choice."""
    rows = []
    for label, found in errors.items():
        ratios = [ratio_to_random(found[score], found["random"]) for score in SCORES]
        rows.append([label, *(str(estimate(each, decimals)) for each in ratios)])
    header = ["ratio to random", *map(_words, SCORES)]
    return Table(name=name, header=header, rows=[*rows, *more], caption=_INTERVALS, why_dash="not in the thesis")


def _words(name: str) -> str:
    return name.replace("_", " ")


def _maps(result: RegressionResult) -> Section:
    outside_m = result.pairs[0].first["map/outside_m"]
    return Section(
        title="Figures 4.2 and 4.3: the workspace",
        words=(
            f"{int((outside_m > 0).sum())} of the {len(outside_m)} places of the maps are unreachable, the farthest by "
            f"{outside_m.max():.2f} m: the arm is not sent there (white in the error map), and the uncertainties show "
            "what the networks would say of them.",
        ),
        images=[image for pair in result.pairs for image in _maps_of(pair)],
    )


def _maps_of(pair: PairResult) -> list[Image]:
    label = f"{pair.label} samples (first network)"
    return [
        image(
            f"figure_4_2_{pair.agent}_{pair.variant}",
            lambda: figure_4_2(pair.first),
            f"{label}, after figure 4.2: where the arm's tip was while babbling, how far it misses a place that it "
            "reaches for, and the stationarity score.",
        ),
        image(
            f"figure_4_3_{pair.agent}_{pair.variant}",
            lambda: figure_4_3(pair.first),
            f"{label}, after figure 4.3: standard deviation of each joint by cause, in radians. No place outside of "
            "the line can be reached.",
        ),
    ]


def figure_4_2(data: Arrays) -> Figure:
    """Where the training data lies; how far the arm misses; how sure it is."""
    figure = Figure(figsize=(11.0, 3.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    left.scatter(*data["babbling"].T, s=2.5, color="#0072b2", linewidths=0)
    _arena(left, data, "training data")
    _field(middle, data, data["map/error"][0], "error of reaching (m)", top=0.6)
    _field(right, data, data["map/stationarity"][0], "stationarity (nats)")
    return figure


def figure_4_3(data: Arrays) -> Figure:
    """Three rows, a kind of uncertainty each; three columns, a joint each."""
    figure = Figure(figsize=(11.0, 9.8))  # its layout by rule would take longer than the figure
    figure.subplots_adjust(left=0.05, right=0.96, bottom=0.06, top=0.96)
    inside = data["map/outside_m"] == 0
    for row, kind in zip(
        figure.subplots(3, 3, sharex=True, sharey=True), ("epistemic", "modal", "aleatoric"), strict=True
    ):
        for joint, axes in enumerate(row):
            field = np.sqrt(data[f"map/{kind}"][0, :, joint])
            top = float(np.percentile(field[inside], 99))
            _field(axes, data, field, f"{kind}, q{joint + 1} (rad)", top=top)
    return figure


def _field(axes: Axes, data: Arrays, values: Floats, title: str, top: float | None = None) -> None:
    """Values (G,) over the map, in colors up to ``top``."""
    x, y = _grid(data)
    half = 0.5 * (x[0, 1] - x[0, 0])
    edges = (x.min() - half, x.max() + half, y.min() - half, y.max() + half)
    shades = axes.imshow(values.reshape(x.shape), vmin=0, vmax=top, origin="lower", extent=edges)
    axes.figure.colorbar(shades, ax=axes, shrink=0.8, extend="neither" if top is None else "max")
    _arena(axes, data, title)


def _arena(axes: Axes, data: Arrays, title: str) -> None:
    """The edge of the workspace, the arm's base, equal axes."""
    x, y = _grid(data)
    axes.contour(x, y, data["map/outside_m"].reshape(x.shape), levels=[1e-3], colors=_ARM, linewidths=1.1)
    axes.plot(0, 0, marker="o", color=_ARM, markersize=4)
    axes.set(title=title, aspect="equal", xlim=(-1.1, 1.1), ylim=(-1.1, 1.1), xlabel="x1 (m)")
    axes.grid(visible=False)


def _grid(data: Arrays) -> Floats:
    """Places of the map. Shape (2, side, side)."""
    side = round(len(data["map/points"]) ** 0.5)
    return data["map/points"].reshape(side, side, 2).transpose(2, 0, 1)
