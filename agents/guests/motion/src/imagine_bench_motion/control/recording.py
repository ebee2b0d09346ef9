"""Rerun recordings of continuous control: the hand's target, forces, events, and the images of its cameras.

Timelines: ``sim_time`` and ``env_step``, one a control period. Entities: ``/scene/...``, ``/motion/...``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from imagine_bench.tasks.continuous.env import MotionEnv

from imagine_bench.arrays import Array, Floats, Info, Observed
from imagine_bench.recording.stream import ROOT, Recording, recording_file, scene_view

_TARGET_M = 0.012
_YELLOW = (240, 180, 0)
_BLUE = (0, 114, 178)


@contextmanager
def motion_recording(
    path: Path, env: MotionEnv, *, expert_m: Floats | None = None
) -> Iterator[Callable[[Array | None, Observed, float, Info], None]]:
    """A recording of an environment, made of the values that are handed to it.

    Args:
        path: The file to write.
        env: The environment.
        expert_m: Where the expert's hand was commanded to be in each period from the same start, to compare with, in
            the world. After its last period it stays there. Shape (N, 3).

    Yields:
        The call after each period with the command, the observation, the reward and ``info``; and at the
        start of an episode with None, the observation, 0 and ``info``.

    Raises:
        SetupError: The folder cannot be written.
    """
    with recording_file(path, env.task.id, _layout, env=env) as recording:
        yield _MotionRecorder(recording, env, expert_m).log


class _MotionRecorder:
    """Logs one period after another."""

    def __init__(self, recording: Recording, env: MotionEnv, expert_m: Floats | None) -> None:
        self._recording = recording
        self._env = env
        self._expert_m = expert_m
        self._periods = 0
        self._events: list[str] = []

    def log(self, action: Array | None, seen: Observed, reward: float, info: Info) -> None:
        """Log a period that is over."""
        recording = self._recording
        env = self._env
        if action is None:
            self._events = []
            self._periods = 0
        else:
            recording.clock_s += env.period_s
            self._periods += 1
        recording.show()
        recording.log(f"{ROOT}/hand_target", _ball(env.hand_target_m(), _YELLOW))
        if self._expert_m is not None and action is not None:
            self._log_expert(self._expert_m)
        for name, part in seen.items() if isinstance(seen, dict) else ():
            if part.ndim == 3:
                recording.log(f"/motion/{name}", rr.Image(part))
        *joints_nm, left_n, right_n = env.servo_forces().tolist()
        recording.curves("/motion/fingers", {"left finger, N": left_n, "right finger, N": right_n})
        recording.curves("/motion/joints", {f"joint {index}, N m": each for index, each in enumerate(joints_nm)})
        recording.curves("/motion", {"reward": reward})
        if action is not None:
            recording.curves("/motion/command", dict(zip(env.control_names, action.tolist(), strict=True)))
        self._log_words(reward, info)

    def _log_expert(self, expert_m: Floats) -> None:
        """The expert's hand in the same period, and its distance."""
        there_m = expert_m[min(self._periods, len(expert_m)) - 1]
        self._recording.log(f"{ROOT}/expert_hand_target", _ball(there_m, _BLUE))
        apart_mm = 1e3 * float(np.linalg.norm(self._env.hand_target_m() - there_m))
        self._recording.curves("/motion/distance", {"distance from the expert's hand, mm": apart_mm})

    def _log_words(self, reward: float, info: Info) -> None:
        env = self._env
        if info["event"]:
            action = int(info["macro_action"])
            done = env.task.action_names[action] if action >= 0 else info["fault_reason"]
            self._events.append(f"- {env.elapsed_s:.2f} s: {done}; reward {reward:+g}")
        limited = f"The command was limited: {info['limited']}." if info["limited"] else ""
        success = "**Success.**" if info["is_success"] else ""
        events = "\n".join(self._events) or "No event so far."
        heading = f"*{env.instruction}*\n\n{env.elapsed_s:.2f} s"
        self._recording.text("/motion/text", f"{heading}\n\n{events}\n\n{limited} {success}")


def _ball(center_m: Floats, color: tuple[int, int, int]) -> rr.Ellipsoids3D:
    return rr.Ellipsoids3D(centers=[center_m], half_sizes=[[_TARGET_M] * 3], colors=color, fill_mode="solid")


def _layout(recording: Recording) -> rrb.Vertical:
    """The scene and the images of the cameras above, curves below."""
    cameras = recording.shown(
        rrb.Spatial2DView(origin="/motion/hand", name="Hand camera"),
        rrb.Spatial2DView(origin="/motion/front", name="Front camera"),
    )
    words = rrb.TextDocumentView(origin="/motion/text", name="Instruction and events")
    side = rrb.Vertical(words, *([rrb.Horizontal(*cameras)] if cameras else []))
    curves = recording.shown(
        rrb.TimeSeriesView(origin="/motion/fingers", name="Force of each finger (closing is negative)"),
        rrb.TimeSeriesView(origin="/motion/joints", name="Torque of each joint"),
        rrb.TimeSeriesView(origin="/motion/command", name="Command"),
        rrb.TimeSeriesView(origin="/motion/reward", name="Reward"),
        rrb.TimeSeriesView(origin="/motion/distance", name="Distance from the expert's hand"),
    )
    top = rrb.Horizontal(scene_view(recording), side, column_shares=[1.3, 1.0])
    return rrb.Vertical(top, rrb.Horizontal(*curves), row_shares=[1.7, 1.0])
