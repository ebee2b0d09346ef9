"""The toy functions and what a network says about them, along x.

Timeline ``x_hundredths``, entities ``/<variant>/...``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from imagine_bench.arrays import Arrays
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import RegressionSpec
from imagine_bench.recording.stream import Recording, recording_file

_KINDS = {"epistemic": (204, 121, 167), "modal": (0, 158, 115), "aleatoric": (86, 180, 233)}
_PREDICTION, _TRAINING, _TRUE = (0, 114, 178), (150, 150, 150), (190, 190, 196)
_SHOWN = (-30, 40)
_TICKS = 100  # steps of the timeline per unit of x: a timeline counts whole numbers
_TIMELINE = "x_hundredths"


def record(evaluations: Mapping[str, Arrays], *, task: RegressionSpec, name: str, path: Path) -> Path:
    """Record the first network of every variant: data, predictions, each uncertainty beside its true value.

    ``evaluations`` are by variant; ``name`` is the regressor's. ``path``, which is returned, ends in ``.rrd``.
    """
    with recording_file(path, task.id, _layout(list(evaluations), name)) as recording:
        for variant, data in evaluations.items():
            x, order = data["x"], data["training_x"].argsort()
            dots = {"training": (data["training_x"][order], data["training_y"][order], _TRAINING)}
            dots["prediction"] = (x, data["prediction"][0], _PREDICTION)
            for dot, (places, values, color) in dots.items():
                look = rr.SeriesPoints(colors=color, marker_sizes=1.5)
                _curve(recording, f"/{variant}/y/{dot}", look, places, values)
            for kind, color in _KINDS.items():
                truth = np.atleast_2d(data[f"true_{kind}"])[0]
                for line, variance, shade in (("estimated", data[kind][0], color), ("true", truth, _TRUE)):
                    _curve(recording, f"/{variant}/{kind}/{line}", rr.SeriesLines(colors=shade), x, np.sqrt(variance))
    return path


def _layout(variants: list[str], name: str) -> rrb.Blueprint:
    ends = [rrb.TimeRangeBoundary.absolute(seq=x * _TICKS) for x in _SHOWN]
    axis = rrb.TimeAxis(view_range=rrb.TimeRange(start=ends[0], end=ends[1]))

    def view(variant: str, part: str, words: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=f"/{variant}/{part}", name=f"{variant}: {words}", axis_x=axis)

    columns = [
        rrb.Vertical(
            view(variant, "y", f"data and predictions ({name}), over 100 x"),
            *(view(variant, kind, f"{kind} (std of y), over 100 x") for kind in _KINDS),
        )
        for variant in variants
    ]
    panels = (rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"))
    return rrb.Blueprint(rrb.Horizontal(*columns), *panels, rrb.TimePanel(state="collapsed", timeline=_TIMELINE))


def _curve(recording: Recording, path: str, look: rr.AsComponents, x: Floats, y: Floats) -> None:
    recording.log(path, look, static=True)
    times = rr.TimeColumn(_TIMELINE, sequence=np.round(x * _TICKS).astype(np.int64))
    recording.stream.send_columns(path, indexes=[times], columns=rr.Scalars.columns(scalars=y), strict=True)
