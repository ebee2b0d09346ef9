"""The two tasks' own sections of a report.

The toy regression shows a number for every claim of thesis 4.5.1, figure 4.1 and equation 4.8. The robot shows table
4.1, and figures 4.2 and 4.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from imagine_bench import reference, statistics
from imagine_bench.arrays import Arrays, Floats
from imagine_bench.interfaces.regression import SCORES
from imagine_bench.regression.runner import PairResult, RegressionResult
from imagine_bench.report.figures import INK, image, small_multiples
from imagine_bench.report.page import DASH, Section, Table, decimals, estimate, mean_std, number

from .toy_regression import EDGE, FARTHEST, REGION

Cells = dict[str, str]
"""A row of a table, by column."""
_BLUE = "#0072b2"
_GRAY = "#8c8c8c"
_ORANGE = "#d55e00"
_KINDS = {"epistemic": 60, "modal": 60, "aleatoric": 20}
"""The kinds of uncertainty, and the top of each one's axis in figure 4.1."""


def in_words(name: str) -> str:
    """A name with spaces in place of underscores."""
    return name.replace("_", " ")


def toy_sections(result: RegressionResult) -> list[Section]:
    """The claims in numbers, figure 4.1, and the terms of equation 4.8."""
    claims = _claims(result)
    variants = result.protocol.variants
    return [
        Section(
            title="The thesis' claims, in numbers",
            words=(
                "Mean over the region [−10, 10] of the uncertainty of networks trained with little data (or much "
                "noise) there, divided by that of the base networks. Truth: the noise is 9 times as large in the noisy "
                "region. Rank correlation with distance: from the data, for x from 30 to 40. Values are the median "
                "over networks, in brackets the smallest and the largest. Little data and much noise are compared "
                "where base is run too.",
            ),
            tables=[Table.of("claims", claims)] if claims else [],
            answers=[
                f"{claim['network']}, {claim['claim']}: {claim['measured']}, asked {claim['asked']}; "
                f"{claim['networks that hold']} networks hold."
                for claim in claims
                if claim["asked"]
            ],
        ),
        Section(
            title="Figure 4.1: kinds of uncertainty",
            words=(
                "The first network of each dataset. Top: training data (gray) and predictions (blue). Below: standard "
                "deviation of each kind of uncertainty (blue) and its true value (black). Shaded: gray where the "
                "datasets differ, red where the networks extrapolate.",
            ),
            images=[
                image(
                    f"figure_4_1_{agent}",
                    partial(figure_4_1, {variant: result.pairs[agent, variant].first for variant in variants}),
                    result.pairs[agent, variants[0]].title,
                )
                for agent in result.protocol.agents
            ],
        ),
        Section(
            title="Equation 4.8: the squared error, cause by cause",
            words=(
                "The expected squared error of a value drawn from one weight sample's mixture is the sum of five: "
                "squared bias of the mean and its variance over weight samples (together equation 4.6), true noise, "
                "true distance of the branches, and the spread of the drawn values (estimated aleatoric and modal). "
                "Measured: against targets drawn anew; the rest is 0 but for sampling (95 %). Means over x, in y².",
            ),
            tables=(
                Table.of("decomposition", [row for pair in result.pairs.values() for row in _decomposition(pair)]),
            ),
        ),
    ]


_CLAIMS = (
    ("low_data", "epistemic", "little data: epistemic there, times base", "≥ 3"),
    ("low_data", "aleatoric", "little data: aleatoric there, times base", "≤ 2"),
    ("high_noise", "aleatoric", "much noise: aleatoric there, times base (truth 9)", "≥ 4"),
    ("high_noise", "epistemic", "much noise: epistemic there, times base", "≤ 2"),
    ("low_data", "stationarity", "little data: stationarity there, times base", ""),
    ("base", "epistemic", "extrapolation: rank correlation of epistemic with distance", "> 0"),
    ("base", "aleatoric", "extrapolation: rank correlation of aleatoric with distance", "> 0"),
)
"""The variant that a claim needs beside the base, the uncertainty it is about, its words, and the condition on it."""
_SIGNS = {"≥": np.greater_equal, "≤": np.less_equal, ">": np.greater}


def _claims(result: RegressionResult) -> list[Cells]:
    pairs = result.pairs
    rows = []
    for agent in result.protocol.agents:
        base = pairs.get((agent, "base"))
        for variant, kind, words, asked in _CLAIMS:
            pair = pairs.get((agent, variant))
            if base and pair:
                rows.append(claim(base.title, words, change(pair, base, kind), asked))
    return rows


def claim(network: str, words: str, values: Floats, asked: str = "") -> Cells:
    """A row: median, smallest and largest over networks, (E,), and how many of them meet ``asked``, such as ``≥ 3``."""
    met = ""
    if asked:
        sign, limit = asked.split()
        met = f"{_SIGNS[sign](values, float(limit)).sum()} of {len(values)}"
    measured = f"{number(float(np.median(values)))} [{number(values.min())}, {number(values.max())}]"
    return {"network": network, "claim": words, "measured": measured, "asked": asked, "networks that hold": met}


def change(pair: PairResult, base: PairResult, kind: str) -> Floats:
    """Mean uncertainty in the region over that of the base networks; of the base, its rise with distance. Shape (E,).

    The rise is Spearman's correlation with the distance from the data, where x > 30.
    """
    x = pair.first["x"]
    if pair.variant == base.variant:
        beyond = x > EDGE
        return np.array([stats.spearmanr(x[beyond], row[beyond]).statistic for row in pair.arrays(kind)])
    inside = np.abs(x) <= REGION
    return pair.arrays(kind)[:, inside].mean(axis=1) / base.arrays(kind)[:, inside].mean(axis=1)


def squared_error_terms(pair: PairResult) -> dict[str, Floats]:
    """The terms of equation 4.8 by name, and ``measured``, their sum from draws of targets and values. (E, GRID) each.

    The thesis' first term, true epistemic uncertainty, is split into ``bias²`` and ``epistemic`` (equation 4.6).
    """
    epistemic = pair.arrays("epistemic")
    return {
        "bias²": pair.arrays("true_epistemic") - epistemic,
        "epistemic": epistemic,
        "true aleatoric": np.broadcast_to(pair.first["true_aleatoric"], epistemic.shape),
        "true modal": np.broadcast_to(pair.first["true_modal"], epistemic.shape),
        "spread": pair.arrays("aleatoric") + pair.arrays("modal"),
        "measured": pair.arrays("squared_error"),
    }


def _decomposition(pair: PairResult) -> list[Cells]:
    x = pair.first["x"]
    rows = []
    for words, here in (("data", np.abs(x) <= EDGE), ("region", np.abs(x) <= REGION), ("beyond", x > EDGE)):
        terms = {name: values[:, here] for name, values in squared_error_terms(pair).items()}
        rest = 2 * terms["measured"] - np.sum(list(terms.values()), axis=0)
        means = {name: number(float(values.mean())) for name, values in terms.items()}
        interval = f"{number(rest.mean())} ± {number(1.96 * rest.std() / np.sqrt(rest.size))}"
        rows.append({"": f"{pair.label}: {words}", **means, "measured − sum": interval})
    return rows


def figure_4_1(data: Mapping[str, Arrays]) -> Figure:
    """A column a dataset; four rows: data and predictions, epistemic, modal, aleatoric."""
    figure = Figure(figsize=(3.9 * len(data) + 0.4, 9.6), layout="constrained")
    grid = figure.subplots(4, len(data), squeeze=False, sharex=True, sharey="row")
    for (variant, found), (first, *others) in zip(data.items(), grid.T, strict=True):
        first.scatter(found["training_x"], found["training_y"], s=2, color=_GRAY)
        first.scatter(found["x"], found["prediction"][0], s=2.5, color=_BLUE)
        first.set(title=in_words(variant), ylim=(-120, 140))
        for axes, (kind, top) in zip(others, _KINDS.items(), strict=True):
            axes.plot(found["x"], np.sqrt(np.atleast_2d(found[f"true_{kind}"])[0]), color=INK)
            axes.plot(found["x"], np.sqrt(found[kind][0]), color=_BLUE)
            axes.set(ylim=(0, top), title=f"{kind} (std of y)")
        for axes in (first, *others):
            axes.axvspan(EDGE, FARTHEST, color=_ORANGE, alpha=0.15)
            axes.axvspan(-REGION, REGION, color=_GRAY, alpha=0.15)
    return figure


def robot_sections(result: RegressionResult) -> list[Section]:
    """Table 4.1, and figures 4.2 and 4.3."""
    pairs = result.pairs.values()
    rows = [row for pair in pairs for part in ("decision", "disc") for row in choices(pair, part)]
    printed = reference.load("robot_ik")["cumulative_error"]["criteria"]
    for variant in (each for each in result.protocol.variants if each in printed["random"]):
        thesis = {in_words(name): "{:.2f} ({:.2f})".format(*values[variant]) for name, values in printed.items()}
        rows.append({**dict.fromkeys(rows[0], DASH), "measure": "thesis", "network": variant, **thesis})
    return [
        Section(
            "Table 4.1: which place can the robot trust itself to reach?",
            (
                "The robot is shown 20 places and reaches for the one with the least uncertainty; the distance by "
                "which it misses is cumulated over 50 choices: mean (standard deviation) over networks, in metres. "
                "Random is the expectation of a choice by chance, min and max are the best and the worst choice in "
                "hindsight. Ratios are to the random choice by the same networks, in brackets their 95 % interval "
                "(Fieller): below 1 a criterion beats chance. The simulated arm carries out every predicted "
                "configuration, and the place its tip comes to rest at is measured.",
                "Rows named disc: the 20 places lie anywhere on the disc of the stretched arm, whose left part no "
                "configuration reaches. A place out of reach is missed by its distance from the workspace at least: "
                "does the robot know which places it cannot reach? In the other rows no place outside of the workspace "
                "is asked for. The thesis draws its points 'over the workspace' and does not say how.",
            ),
            tables=(Table.of("choices", rows, why_dash="not measured there"),),
            answers=[
                f"{row['network']} samples, the least uncertain of 20 places "
                f"{'anywhere on the disc' if row['measure'].startswith('disc') else 'within reach'}: misses times "
                f"those of a random choice {row['epistemic']} by epistemic uncertainty, {row['nll']} by negative "
                "log-likelihood."
                for row in rows
                if "ratio" in row["measure"]
            ],
        ),
        Section(
            "Figures 4.2 and 4.3: the workspace",
            (
                "Of the first network: where the arm's tip was while babbling, how far it misses a place that it "
                "reaches for, stationarity, and the standard deviation of each joint by cause. The line is the edge of "
                "the workspace: the arm is not sent to places outside (white in the error map), and the uncertainties "
                "show the network's predictions of them.",
            ),
            [image(f"figures_4_2_4_3_{p.agent}_{p.variant}", partial(workspace, p.first), p.label) for p in pairs],
        ),
    ]


def choices(pair: PairResult, part: str) -> list[Cells]:
    """Two rows: the errors of the chosen candidates by criterion of choice, and their ratios to a random choice's.

    Each score chooses the candidate of which it is least. ``min`` and ``max`` are the best and the worst choice in
    hindsight, and ``random`` the mean over the candidates, which a choice by chance may expect. Errors are summed over
    the choices of each network, in metres. ``part`` is ``"decision"``, whose candidates are within reach, or
    ``"disc"``, whose candidates need not be.
    """
    errors = pair.arrays(f"{part}/error")  # [E, choices, candidates]
    found = {}
    for name in SCORES:
        pick = pair.arrays(f"{part}/{name}").argmin(axis=-1)
        found[in_words(name)] = np.take_along_axis(errors, pick[..., None], axis=-1)[..., 0]
    found |= {"min": errors.min(axis=-1), "max": errors.max(axis=-1), "random": errors.mean(axis=-1)}
    sums = {name: each.sum(axis=1) for name, each in found.items()}
    prefix = "" if part == "decision" else f"{part}_"
    means = {"measure": f"{prefix}error_m", "network": pair.label}
    ratios = {"measure": f"{prefix}ratio_to_random", "network": pair.label, **dict.fromkeys(sums, DASH)}
    means |= {name: mean_std(each) for name, each in sums.items()}
    for name in map(in_words, SCORES):
        ratios[name] = estimate(statistics.ratio(sums[name], sums["random"], paired=True), decimals)
    return [means, ratios]


def workspace(data: Arrays) -> Figure:
    """Figures 4.2 and 4.3: values over the map, a panel each, in colors up to the 99th percentile within reach."""
    points = data["map/points"]
    side = round(len(points) ** 0.5)
    x, y = points.T.reshape(2, side, side)
    outside_m = data["map/outside_m"]
    tips = data["babbling"]
    square = [[x.min(), x.max()], [y.min(), y.max()]]
    density = np.histogram2d(tips[:, 0], tips[:, 1], bins=side, range=square)[0]
    fields = {
        "training data (places)": density.T.ravel(),
        "error of reaching (m)": data["map/error"][0],
        "stationarity (nats)": data["map/stationarity"][0],
    }
    for kind in _KINDS:
        for joint, variances in enumerate(data[f"map/{kind}"][0].T, 1):
            fields[f"{kind}, q{joint} (rad)"] = np.sqrt(variances)
    figure, panels = small_multiples(len(fields), 3, width=3.4, height=3.0)
    for axes, (title, values) in zip(panels, fields.items(), strict=True):
        top = np.percentile(values[outside_m == 0], 99)
        shades = axes.pcolormesh(x, y, values.reshape(side, side), vmin=0, vmax=top)
        figure.colorbar(shades, ax=axes, extend="max")
        axes.contour(x, y, outside_m.reshape(side, side), levels=[1e-3], colors=_ORANGE)
        axes.set(title=title, aspect="equal")
    return figure
