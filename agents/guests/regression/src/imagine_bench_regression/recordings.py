"""Recordings of chapter 4: the toy functions and a network's predictions of them, and the arm choosing and reaching."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from imagine_bench.arrays import Arrays
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import RegressionSpec
from imagine_bench.recording.stream import KINDS, ROOT, Recording, log_motion, log_shapes, recording_file

_BLUE = (0, 114, 178)
_GRAY = (150, 150, 150)
_RED = (200, 30, 60)
_INK = (28, 30, 34)
_ORANGE = (213, 94, 0)
_TICKS = 100
"""Steps of the timeline per unit of x: a timeline counts whole numbers."""
_TIMELINE = "x_hundredths"
CHOICES = 6
"""Decisions of the first network that are shown: the first ones, not the best."""
_STILL_S = 2.5
_HEIGHT_M = 0.02


def record_toy(evaluations: Mapping[str, Arrays], *, task: RegressionSpec, name: str, path: Path) -> Path:
    """Record the first network of every variant: data, predictions, each uncertainty beside its true value, along x.

    ``evaluations`` are by variant; ``name`` is the regressor's. ``path``, which is returned, ends in ``.rrd``. Timeline
    ``x_hundredths``, entities ``/<variant>/...``.
    """
    columns = [
        rrb.Vertical(
            *(
                rrb.TimeSeriesView(origin=f"/{variant}/{part}", name=f"{name}, {variant}: {part} over 100 x")
                for part in ("y", *KINDS)
            )
        )
        for variant in evaluations
    ]
    with recording_file(path, task.id, lambda _: rrb.Horizontal(*columns), timeline=_TIMELINE) as recording:
        for variant, data in evaluations.items():
            root = f"/{variant}"
            x = data["x"]
            order = data["training_x"].argsort()
            dots = rr.SeriesPoints(colors=_GRAY, marker_sizes=1.5, names="training")
            _curve(recording, f"{root}/y/training", dots, data["training_x"][order], data["training_y"][order])
            dots = rr.SeriesPoints(colors=_BLUE, marker_sizes=1.5, names="prediction")
            _curve(recording, f"{root}/y/prediction", dots, x, data["prediction"][0])
            for kind, color in KINDS.items():
                true = np.atleast_2d(data[f"true_{kind}"])[0]
                estimated = rr.SeriesLines(colors=color, names="estimated")
                _curve(recording, f"{root}/{kind}/estimated", estimated, x, np.sqrt(data[kind][0]))
                _curve(recording, f"{root}/{kind}/true", rr.SeriesLines(colors=_GRAY, names="true"), x, np.sqrt(true))
    return path


def _curve(recording: Recording, path: str, look: rr.AsComponents, x: Floats, y: Floats) -> None:
    recording.log(path, look, static=True)
    times = rr.TimeColumn(_TIMELINE, sequence=np.round(x * _TICKS).astype(np.int64))
    recording.stream.send_columns(path, indexes=[times], columns=rr.Scalars.columns(scalars=y), strict=True)


def record_robot(evaluations: Mapping[str, Arrays], *, task: RegressionSpec, name: str, path: Path) -> Path:
    """Record the first choices of the first network that learned from the last variant, and how the arm reaches.

    ``evaluations`` are by variant; ``name`` is the regressor's. ``path``, which is returned, ends in ``.rrd``.
    Timelines ``sim_time`` (the arm moves) and ``choice`` (one a decision), entities ``/scene/...``, ``/choice/...``.
    """
    assert task.scene is not None, "this recorder needs a scene"
    scene = task.scene()
    variant, data = list(evaluations.items())[-1]
    view = rrb.Spatial3DView(
        origin="/", contents=[f"{ROOT}/**", "/choice/**"], name="The arm, and where it could reach"
    )
    text = rrb.TextDocumentView(origin="/choice/text", name="Steps")
    curve = rrb.TimeSeriesView(origin="/choice/error", name="Error of each choice (m)")
    layout = rrb.Horizontal(view, rrb.Vertical(text, curve))
    with recording_file(path, task.id, lambda _: layout) as recording:
        log_shapes(recording, scene.shapes())
        for choice in range(CHOICES):
            scores = data["decision/epistemic"][0, choice]
            errors = data["decision/error"][0, choice]
            chosen = int(scores.argmin())
            words = (
                f"### Choice {choice + 1}\n\nA network ({name}) learned from {variant} random movements which joint "
                "angles lead to a place. Blue places it is surest of, orange ones least (epistemic uncertainty); it "
                f"reaches for the one in the ring, where its uncertainty is {scores[chosen]:.3g} rad²."
            )
            missed = (
                f"\n\n**It misses by {100 * errors[chosen]:.1f} cm** (red line). A random choice misses by "
                f"{100 * errors.mean():.1f} cm on average."
            )
            recording.set_clocks(choice=choice + 1)
            _show_candidates(recording, data["decision/points"][0, choice], scores)
            recording.text("/choice/text", words)
            motion = scene.movement(data["decision/joints"][0, choice, chosen], 25.0)
            recording.clock_s += float(motion.time_s[-1])
            log_motion(recording, motion, only_moved=False)
            recording.set_clocks()
            ends = _lifted(np.stack([data[f"decision/{end}"][0, choice, chosen] for end in ("reached", "points")]))
            recording.log("/choice/error_line", rr.LineStrips3D([ends], colors=_RED, radii=0.009))
            recording.curves("/choice", {"error": errors[chosen]})
            recording.text("/choice/text", words + missed)
            recording.clock_s += _STILL_S
    return path


def _lifted(points: Floats) -> Floats:
    """Places in the plane, (N, 2), as places above the table, (N, 3)."""
    return np.insert(points, 2, _HEIGHT_M, axis=1)


def _show_candidates(recording: Recording, points: Floats, scores: Floats) -> None:
    ranks = scores.argsort().argsort()[:, None] / (len(scores) - 1)  # 0 the surest
    colors = (1 - ranks) * _BLUE + ranks * _ORANGE
    recording.log("/choice/candidates", rr.Points3D(_lifted(points), colors=colors.astype(np.uint8), radii=0.022))
    angle = np.linspace(0, 2 * np.pi, 33)
    ring = points[scores.argmin()] + 0.05 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    recording.log("/choice/chosen", rr.LineStrips3D([_lifted(ring)], colors=_INK, radii=0.007))
    recording.clear("/choice/error_line")
