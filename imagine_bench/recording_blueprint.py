"""How a recording looks when it is opened: the story without a click."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from imagine_bench.recording_scene import ROOT

_EYE_FROM_TARGET_M = np.array([0.62, -0.62, 0.52])
"""Beside the human's hand, across the table from the arm: neither hides the objects."""


def blueprint(*, target_m: NDArray[np.float64], values: bool, imagines: bool, episodes: int) -> rrb.Blueprint:
    """The layout: the scene large, beside it what the agent sees, says and expects, below it what it imagines.

    Args:
        target_m: What the 3D view looks at. Shape (3,).
        values: Whether the agent has Q-values.
        imagines: Whether the agent imagines.
        episodes: Real episodes in the recording.
    """
    scene = rrb.Spatial3DView(
        origin=ROOT,
        name="The scene: the arm turns cubes, a human points",
        eye_controls=rrb.EyeControls3D(
            position=target_m + _EYE_FROM_TARGET_M, look_target=target_m, eye_up=[0.0, 0.0, 1.0]
        ),
        background=[214, 222, 230],
        line_grid=False,
    )
    frame = rrb.Spatial2DView(origin="/real/frame", name="What the agent sees (64 x 64 pixels)")
    story = rrb.TextDocumentView(origin="/real/story", name="What happens")
    side = [rrb.Horizontal(story, frame)]
    if values:
        side.append(rrb.TextDocumentView(origin="/real/q_table", name="Q-values: return expected of each macro-action"))
    top = rrb.Horizontal(scene, rrb.Vertical(*side), column_shares=[1.1, 1.0])
    pages = [_over_time(values=values)]
    if imagines:
        pages = [_imagined_now(), *pages, _by_depth(episodes)]
    bottom = rrb.Tabs(*pages, active_tab=0)
    return rrb.Blueprint(
        rrb.Vertical(top, bottom, row_shares=[1.45, 1.0]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"),
    )


def _imagined_now() -> rrb.Horizontal:
    strip = rrb.Spatial2DView(
        origin="/imagined/strip",
        name="The agent's own plan from here: what would really happen (above), what it imagines (below)",
        background=[255, 255, 255],
    )
    bars = rrb.BarChartView(
        origin="/imagined/uncertainty",
        name="Variance by depth: epistemic pink, aleatoric blue, modal green",
        plot_legend=rrb.PlotLegend(visible=False),
    )
    return rrb.Horizontal(strip, bars, column_shares=[1.9, 1.0], name="Imagination from the current frame")


def _over_time(*, values: bool) -> rrb.Horizontal:
    views = [rrb.TimeSeriesView(origin="/real/reward", name="Reward of each real macro-action")]
    if values:
        views.append(rrb.TimeSeriesView(origin="/real/q_values", name="Q-value of each macro-action"))
    return rrb.Horizontal(*views, name="Rewards and values over time")


def _by_depth(episodes: int) -> rrb.Vertical:
    """For the timeline ``imagined_depth``: the rollout from each episode's first frame, imagined step by step."""
    rows = []
    for episode in range(1, 1 + min(episodes, 3)):
        root = f"/imagined/episode_{episode}"
        rows.append(
            rrb.Horizontal(
                rrb.Spatial2DView(origin=f"{root}/real_frame", name=f"Episode {episode}: really"),
                rrb.Spatial2DView(origin=f"{root}/frame", name=f"Episode {episode}: imagined"),
                rrb.TimeSeriesView(origin=f"{root}/uncertainty", name="Uncertainty by depth"),
                rrb.TimeSeriesView(origin=f"{root}/prediction", name="Predicted reward and P(end) by depth"),
                column_shares=[1, 1, 2, 2],
            )
        )
    return rrb.Vertical(*rows, name="By depth (choose the timeline imagined_depth below)")
