"""Rerun recordings of continuous control: the hand's target, forces, events, and the images of its cameras.

Timelines: ``sim_time`` and ``env_step``, one a control period. Entities: ``/scene/...``, ``/motion/...``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from imagine_bench.tasks.continuous.env import MotionEnv

from imagine_bench.arrays import Array, Info, Observed
from imagine_bench.recording.stream import ROOT, Recording, recording_file, scene_view

_TARGET_M = 0.012
_YELLOW = (240, 180, 0)


@contextmanager
def motion_recording(path: Path, env: MotionEnv) -> Iterator[Callable[[Array | None, Observed, float, Info], None]]:
    """A recording of an environment, made of the values that are handed to it.

    Yields:
        The call after each period with the command, the observation, the reward and ``info``; and at the
        start of an episode with None, the observation, 0 and ``info``.

    Raises:
        SetupError: The folder cannot be written.
    """
    with recording_file(path, env.task.id, _layout, env=env) as recording:
        yield _MotionRecorder(recording, env).log


class _MotionRecorder:
    """Logs one period after another."""

    def __init__(self, recording: Recording, env: MotionEnv) -> None:
        self._recording = recording
        self._env = env
        self._events: list[str] = []

    def log(self, action: Array | None, seen: Observed, reward: float, info: Info) -> None:
        """Log a period that is over."""
        recording = self._recording
        env = self._env
        if action is None:
            self._events = []
        else:
            recording.clock_s += env.period_s
        recording.show()
        ball = rr.Ellipsoids3D(
            centers=[env.hand_target_m()], half_sizes=[[_TARGET_M] * 3], colors=_YELLOW, fill_mode="solid"
        )
        recording.log(f"{ROOT}/hand_target", ball)
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
    )
    top = rrb.Horizontal(scene_view(recording), side, column_shares=[1.3, 1.0])
    return rrb.Vertical(top, rrb.Horizontal(*curves), row_shares=[1.7, 1.0])
