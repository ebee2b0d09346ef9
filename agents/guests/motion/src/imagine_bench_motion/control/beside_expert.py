"""A recording of a clone and the scripted expert: both carry out one macro-action from the same start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from imagine_bench.tasks.continuous.controls import Motion
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench.tasks.scenes.constants import FRAME_PX

from imagine_bench.arrays import Floats

from ..cloning import Clone
from ..skills import begin, skill_env
from ..trials import MOST_PERIODS
from .recording import motion_recording

Watch = Callable[..., None]


@dataclass(frozen=True, kw_only=True)
class Played:
    """One of the two motions, until its first event."""

    done: bool  #: whether the event was the macro-action that was asked for
    periods: int
    hand_m: Floats  #: commanded places of the hand at the end of each period. Shape (periods, 3).


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Both motions."""

    clone: Played
    expert: Played

    @property
    def apart_m(self) -> Floats:
        """Distance of the commanded places of both hands in each period that both motions have."""
        both = min(self.clone.periods, self.expert.periods)
        apart: Floats = np.linalg.norm(self.clone.hand_m[:both] - self.expert.hand_m[:both], axis=1)
        return apart


def record_beside_expert(
    path: Path, clone: Clone, macro_action: int, *, seed: int, appearance: str = "clean", **options: Any
) -> Compared:
    """Let the expert carry out a macro-action, then the clone from the same start, and record the clone.

    Args:
        path: The recording to write, ``.rrd``.
        clone: The policy.
        macro_action: The macro-action that both are asked for.
        seed: Of the start.
        appearance: How much the scene varies.
        **options: Of :func:`..skills.skill_env`, such as ``placement``.

    Raises:
        SetupError: The folder cannot be written.
        InvalidValueError: An option out of its range.
    """
    size = clone.about.get("size_px", FRAME_PX)
    env = skill_env(clone.observation, appearance, **{"size": size, **options})
    seen = begin(env, macro_action, np.random.default_rng(seed))
    start = env.get_state()
    expert = Expert(env)
    expert.begin(macro_action)
    of_expert = _play(env, macro_action, lambda _: None if expert.is_done else expert.act(), seen)
    env.set_state(start)
    clone.begin(env.task.action_names[macro_action])
    with motion_recording(path, env, expert_m=of_expert.hand_m) as watch:
        of_clone = _play(env, macro_action, clone.act, seen, watch)
    env.close()
    return Compared(clone=of_clone, expert=of_expert)


def _play(
    env: MotionEnv, macro_action: int, act: Callable[[Any], Motion | None], seen: Any, watch: Watch | None = None
) -> Played:
    """Follow a policy until an event, its end, or the longest time of a try."""
    hand_m: list[Floats] = []
    done = over = False
    while len(hand_m) < MOST_PERIODS and not over:
        command = act(seen)
        if command is None:
            break
        seen, reward, terminated, truncated, info = env.step(command)
        hand_m.append(env.hand_target_m())
        if watch is not None:
            watch(command, seen, float(reward), info)
        over = bool(info["event"]) or terminated or truncated
        done = bool(info["event"]) and int(info["macro_action"]) == macro_action
    return Played(done=done, periods=len(hand_m), hand_m=np.array(hand_m))
