"""How a recording looks when it is opened: everything is seen without a click."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from imagine_bench.recording.scene import ROOT

_CAMERA_FROM_TARGET_M = np.array([0.62, -0.62, 0.52])  # beside the human's hand: no arm hides the objects from there


def scene_view(target_m: NDArray[np.float64]) -> rrb.Spatial3DView:
    """The 3D scene, seen from beside the human's hand."""
    eye = rrb.EyeControls3D(position=target_m + _CAMERA_FROM_TARGET_M, look_target=target_m, eye_up=[0.0, 0.0, 1.0])
    name = "The scene: the arm acts, a human gestures"
    return rrb.Spatial3DView(origin=ROOT, name=name, eye_controls=eye, background=[214, 222, 230], line_grid=False)


def sheet_view(origin: str, name: str) -> rrb.Spatial2DView:
    """A large image on white."""
    return rrb.Spatial2DView(origin=origin, name=name, background=[255, 255, 255])


def blueprint(
    *, target_m: NDArray[np.float64], values: bool, imagines: bool, several: bool, sees: bool, explores: bool
) -> rrb.Blueprint:
    """The layout: the scene large, beside it what the agent sees and predicts, below it what it imagines.

    ``target_m`` (3,) is what the 3D view looks at; ``several`` rollouts may be imagined from each frame; ``sees``: it
    shows how it learned to see; ``explores``: it tells how unknown each macro-action is.
    """
    frame = rrb.Spatial2DView(origin="/real/frame", name="Agent's view, 64 x 64")
    text = rrb.TextDocumentView(origin="/real/text", name="What happens")
    side: list[rrb.Container | rrb.View] = [rrb.Horizontal(text, frame)]
    if values:
        side.append(rrb.TextDocumentView(origin="/real/q_table", name="Q-values: return expected of each macro-action"))
    top = rrb.Horizontal(scene_view(target_m), rrb.Vertical(*side), column_shares=[1.1, 1.0])
    pages: list[rrb.Container | rrb.View] = [_over_time(values=values, explores=explores)]
    if imagines:
        futures = [sheet_view("/imagined/sampled_rollouts", "Several futures from the current frame")]
        pages = [_imagined_now(), *(futures if several else []), *pages, _by_depth()]
    if sees:
        name = "What it has learned to see: a color a factor, and beside it a look of each of its values"
        pages = [sheet_view("/seen/factors", name), *pages]
    bottom = rrb.Tabs(*pages, active_tab=0)
    return playing(rrb.Vertical(top, bottom, row_shares=[1.45, 1.0]))


def playing(layout: rrb.Container) -> rrb.Blueprint:
    """A layout with nothing around it but the time, which runs over and over."""
    return rrb.Blueprint(
        layout,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"),
    )


def _imagined_now() -> rrb.Horizontal:
    name = "The agent's own plan from here: what would really happen (above), what it imagines (below)"
    strip = sheet_view("/imagined/filmstrip", name)
    name = "Uncertainty by depth: epistemic pink, aleatoric blue, modal green"
    hidden = rrb.PlotLegend(visible=False)
    bars = rrb.BarChartView(origin="/imagined/uncertainty", name=name, plot_legend=hidden)
    return rrb.Horizontal(strip, bars, column_shares=[1.9, 1.0], name="Imagination from the current frame")


def _over_time(*, values: bool, explores: bool) -> rrb.Horizontal:
    views = [rrb.TimeSeriesView(origin="/real/reward", name="Reward of each real macro-action")]
    if values:
        views.append(rrb.TimeSeriesView(origin="/real/q_values", name="Q-value of each macro-action"))
    if explores:
        views.append(rrb.TimeSeriesView(origin="/real/novelty", name="What is unknown of each macro-action"))
    return rrb.Horizontal(*views, name="Rewards and values over time")


def _by_depth() -> rrb.Horizontal:
    """For the timeline ``imagined_depth``: the rollout from the first episode's first frame, step by step."""
    root = "/imagined/episode_1"
    return rrb.Horizontal(
        rrb.Spatial2DView(origin=f"{root}/real_frame", name="Real"),
        rrb.Spatial2DView(origin=f"{root}/frame", name="Imagined"),
        rrb.TimeSeriesView(origin=f"{root}/uncertainty", name="Uncertainty by depth"),
        rrb.TimeSeriesView(origin=f"{root}/prediction", name="Predicted reward and P(end) by depth"),
        column_shares=[1, 1, 2, 2],
        name="Episode 1 by depth (choose the timeline imagined_depth below)",
    )
