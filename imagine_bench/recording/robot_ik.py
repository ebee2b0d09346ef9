"""The arm choosing and reaching: targets colored by uncertainty, the chosen one marked, the error drawn.

Timelines: ``sim_time`` (the arm moves), ``choice`` (one a decision). Entities: ``/scene/...``, ``/choice/...``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from imagine_bench.arrays import Arrays
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import RegressionSpec
from imagine_bench.recording.scene import ROOT, log_motion, log_shapes
from imagine_bench.recording.stream import Recording, recording_file

CHOICES = 6  # decisions of the first network that are shown: the first ones, not the best
_HZ, _STILL_S, _LOOK_S = 25.0, 1.5, 1.0
_SURE, _UNSURE = np.array([0, 158, 115]), np.array([213, 94, 0])  # Okabe-Ito green and vermilion
_CHOSEN, _ERROR, _OUTSIDE = (0, 90, 200), (200, 30, 60), (120, 120, 120)
_HEIGHT_M = 0.02


def record(evaluations: Mapping[str, Arrays], *, task: RegressionSpec, name: str, path: Path) -> Path:
    """Record the first choices of the first network that learned from the last variant.

    ``evaluations`` are by variant; ``name`` is the regressor's. ``path``, which is returned, ends in ``.rrd``.
    """
    assert task.scene is not None, "this recorder needs a scene"
    scene, variant = task.scene(), list(evaluations)[-1]
    data = evaluations[variant]
    with recording_file(path, task.id, _layout(variant)) as recording:
        log_shapes(recording, scene.shapes())
        clock_s = 0.0
        for choice in range(CHOICES):
            number = choice + 1
            points, scores = (data[f"decision/{key}"][0, choice] for key in ("points", "epistemic"))
            chosen = int(scores.argmin())
            recording.set_clocks(clock_s, choice=number)
            _show_candidates(recording, data, points, scores, chosen)
            _describe(recording, name, variant, data, choice, chosen, arrived=False)
            motion = scene.movement(data["decision/joints"][0, choice, chosen], _HZ)
            still = dataclasses.replace(motion, time_s=motion.time_s[:1], poses_in_world=motion.poses_in_world[:1])
            log_motion(recording, still, end_s=clock_s, sequences={"choice": number}, only_moved=False)
            clock_s += _LOOK_S + float(motion.time_s[-1])
            log_motion(recording, motion, end_s=clock_s, sequences={"choice": number}, only_moved=False)
            recording.set_clocks(clock_s, choice=number)
            _show_error(recording, data["decision/reached"][0, choice, chosen], points[chosen])
            error_m = float(data["decision/error"][0, choice, chosen])
            recording.scalar("/choice/error", error_m)
            _describe(recording, name, variant, data, choice, chosen, arrived=True)
            clock_s += _STILL_S
    return path


def _layout(variant: str) -> rrb.Blueprint:
    scene = rrb.Spatial3DView(
        origin="/", contents=[f"{ROOT}/**", "/choice/**"], name="The arm, and 20 places it could reach for",
        eye_controls=rrb.EyeControls3D(position=[0.1, -1.35, 1.9], look_target=[0.1, 0.05, 0.0], eye_up=[0, 0, 1]),
        background=[232, 236, 240], line_grid=False,
    )  # fmt: skip
    text = rrb.TextDocumentView(origin="/choice/text", name="What happens")
    errors = rrb.TimeSeriesView(origin="/choice/error", name="Error of each choice (m)")
    layout = rrb.Horizontal(scene, rrb.Vertical(text, errors, row_shares=[2, 1]), column_shares=[1.6, 1.0])
    time = rrb.TimePanel(state="collapsed", timeline="sim_time", fps=25.0)
    return rrb.Blueprint(layout, rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"), time)


def _lifted(points: Floats) -> Floats:
    """Places in the plane as places above the table."""
    return np.concatenate([points, np.full((*points.shape[:-1], 1), _HEIGHT_M)], axis=-1)


def _show_candidates(recording: Recording, data: Arrays, points: Floats, scores: Floats, chosen: int) -> None:
    ranks = scores.argsort().argsort() / (len(scores) - 1)  # 0 the surest
    colors = (_SURE + ranks[:, None] * (_UNSURE - _SURE)).astype(np.uint8)
    recording.log("/choice/candidates", rr.Points3D(_lifted(points), colors=colors, radii=0.022))
    angle = np.linspace(0, 2 * np.pi, 33)
    ring = points[chosen] + 0.05 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    recording.log("/choice/chosen", rr.LineStrips3D([_lifted(ring)], colors=_CHOSEN, radii=0.007))
    outside_m = data["map/outside_m"]
    in_view = (outside_m < 0.2) & (data["map/points"][:, 0] > 0)
    far = int(np.where(in_view, outside_m, 0).argmax())
    label, place = f"unreachable: {outside_m[far]:.2f} m outside", _lifted(data["map/points"][far])
    recording.log("/choice/outside", rr.Points3D(place, colors=_OUTSIDE, radii=0.022, labels=label))
    recording.clear("/choice/error_line")


def _show_error(recording: Recording, tip_m: Floats, target_m: Floats) -> None:
    """A line from where the tip came to rest to where it should be."""
    line = _lifted(np.stack([tip_m, target_m]))
    recording.log("/choice/error_line", rr.LineStrips3D([line], colors=_ERROR, radii=0.009))


def _describe(
    recording: Recording, name: str, variant: str, data: Arrays, choice: int, chosen: int,
    *, arrived: bool,
) -> None:  # fmt: skip
    error, scores = data["decision/error"][0, choice], data["decision/epistemic"][0, choice]
    words = [
        f"### Choice {choice + 1}\n\nA network ({name}) learned from {variant} random movements which joint angles "
        "lead to a place. Green places it is surest of, orange ones least (epistemic uncertainty); it reaches for "
        f"the one in the ring.\n\nIts uncertainty there is {scores[chosen]:.3g} rad², the largest of the 20 is "
        f"{scores.max():.3g} rad². The gray place lies outside of what the arm can reach and is never asked for."
    ]
    if arrived:
        words.append(
            f"**It misses by {100 * error[chosen]:.1f} cm** (red line). A random choice misses by "
            f"{100 * error.mean():.1f} cm on average, the best by {100 * error.min():.1f} cm, the worst by "
            f"{100 * error.max():.1f} cm."
        )
    recording.text("/choice/text", "\n\n".join(words))
