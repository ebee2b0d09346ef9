"""Macro-actions that a cloned skill carries out, not the planner: options (Sutton et al. 1999) with learned policies.

Agents of macro-actions, their rules and their frames stay as they are; only the execution is another one, and it fails
now and then.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from imagine_bench.tasks.rendering.cameras import agent_camera_view
from imagine_bench.tasks.scenes.constants import FRAME_PX

from imagine_bench.arrays import Observed
from imagine_bench.errors import InvalidValueError, brief
from imagine_bench.interfaces import Frame

from .cloning import Clone
from .instruction import GO_BACK
from .skills import HOME_COMMAND, Command, skill_env
from .trials import MOST_PERIODS

Info = dict[str, Any]
BUNDLED = Path(str(files(__package__) / "skills_3_cubes.pt"))
"""The clone that comes with this package: three arrow cubes."""
_BACK_PERIODS = 12
"""Control periods in which the skill lifts the hand, before the arm goes home along its joints."""
_HOME_PERIODS = 25
"""The most control periods of the way home."""
_AT_HOME_RAD = 2e-3
"""An arm nearer to its observation pose, at each joint, is there."""


_DECIDED = ("control", "family", "observation", "told")
"""Options of continuous control that macro-actions of a clone do not have."""


class ControlPeriod(NamedTuple):
    """What a control period ends with."""

    seen: Observed
    event: bool  #: whether the macrostate changed, or a fault happened
    over: bool  #: whether no further period is to follow


def carry_out(
    clone: Clone, instruction: str, seen: Observed, period: Callable[[Command], ControlPeriod]
) -> ControlPeriod:
    """Let a clone follow an instruction, then lift the hand, and bring the arm home along its joints.

    Args:
        clone: The skill.
        instruction: The macro-action in words.
        seen: The newest observation.
        period: Makes one control period with a command. After one that says that it is over, none follows.

    Returns:
        The last period.
    """
    latest = ControlPeriod(seen, event=False, over=False)
    clone.begin(instruction)
    for _ in range(MOST_PERIODS):
        latest = period(clone.act(latest.seen))
        if latest.over:
            return latest
        if latest.event:
            break
    clone.begin(GO_BACK)
    for _ in range(_BACK_PERIODS):
        latest = period(clone.act(latest.seen))
        if latest.over:
            return latest
    for _ in range(_HOME_PERIODS):
        latest = period(HOME_COMMAND)
        if latest.over or _is_home(latest.seen):
            break
    return latest


def _is_home(seen: Any) -> bool:
    joints_rad = seen["proprio"][: len(HOME_COMMAND) - 1]
    return bool(np.abs(joints_rad - HOME_COMMAND[:-1]).max() < _AT_HOME_RAD)


class _Event(NamedTuple):
    """A change of the macrostate under way."""

    reward: float
    terminated: bool
    success: bool
    macro_action: int  #: that it amounts to, or -1
    fault: str


class CloneExecutedEnv(gymnasium.Env[Frame, np.int64]):
    """The arrow puzzle by macro-actions, each carried out by a clone at 25 Hz.

    Action Space: ``Discrete(6)``, the macro-actions of the arrow puzzle.

    Observation Space: ``Box(0, 255, (64, 64, 3), uint8)``: the frame of the arrow puzzle, with the arm back at its
    observation pose.

    Rewards: those of the rules for the macrostate that was read back. A macro-action after which no arrow has turned
    counts as a turn that slipped; a change that is no macro-action ends the episode with -5.

    Starting State: one of the rules' start states, or ``reset(options={"macrostate": ...})``.

    Episode End: where the rules say so, or at a fault; truncated by the registered time limit, or where the simulation
    blew up.

    Info: ``macrostate``, ``is_success``, ``legal``, ``fault``, ``fault_reason``, ``sim_time_s`` (of the latest
    macro-action, the way back included), ``done`` (whether the latest macro-action was the one that was asked for).

    Args:
        execution: ``"physics"``; there is no other.
        appearance: How much the scene varies.
        clone: The skill, or a file of one; None is the one of this package.
        **options: Options of :func:`imagine_bench.tasks.continuous.spec.make_arrows`, such as ``slip``.

    Raises:
        ArtefactError: No such file.
        InvalidValueError: Another execution, a clone that does not see proprio and something more, a world whose images
            hide something or are late, a dense reward, or an option that the clone decides.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own declaration

    def __init__(
        self,
        execution: str = "physics",
        appearance: str = "clean",
        clone: Clone | str | Path | None = None,
        **options: Any,
    ) -> None:
        if execution != "physics":
            raise InvalidValueError(f"A clone executes macro-actions in physics; execution={brief(execution)} is none.")
        for name in _DECIDED:
            if name in options:
                raise InvalidValueError(
                    f"The clone decides what it sees and does, and frames show the goal; leave out {name}."
                )
        self.clone = clone if isinstance(clone, Clone) else Clone.load(Path(clone or BUNDLED))
        sees = self.clone.observation.split(",")
        if "proprio" not in sees or len(sees) < 2:  # one part alone has no name
            raise InvalidValueError(f"The clone sees {self.clone.observation}; give one that sees proprio, and more.")
        size = self.clone.about.get("size_px", FRAME_PX)
        self.motion = skill_env(self.clone.observation, appearance, **{"time_limit_s": 1e9, "size": size, **options})
        if self.motion.task.sight is not None:
            raise InvalidValueError("A clone acts by what it sees now; leave out gesture and lag.")
        if self.motion.reward != "sparse":
            raise InvalidValueError("A macro-action is rewarded as the rules say; leave out reward.")
        self.action_names = self.motion.task.action_names
        self.action_space = gymnasium.spaces.Discrete(len(self.action_names))
        view = agent_camera_view()
        self.observation_space = gymnasium.spaces.Box(0, 255, (view.height, view.width, 3), np.uint8)
        self._camera = self.motion.camera(view)
        self._seen: Any = None
        self._latest: Info = {}
        self._periods = 0
        self._events: list[_Event] = []

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Frame, Info]:
        """Start an episode; see :meth:`imagine_bench.tasks.continuous.env.MotionEnv.reset`."""
        self.motion.require_limit(self.spec)
        super().reset(seed=seed)
        self._seen, self._latest = self.motion.reset(seed=seed, options=options)
        self._periods = 0
        self._events = []
        return self._frame(), self._info(self._latest)

    def step(self, action: np.int64 | int) -> tuple[Frame, float, bool, bool, Info]:
        """Let the clone carry out one macro-action, and bring the arm back."""
        if not self.action_space.contains(action):
            raise InvalidValueError(
                f"Action {brief(action)} does not exist; give an integer from 0 to {len(self.action_names) - 1}."
            )
        if self._seen is None:
            raise InvalidValueError("There is no episode to go on with; call reset() first.")
        chosen = int(action)
        rules = self.motion.task.rules
        before = self.motion.episode.macrostate
        self._periods = 0
        self._events = []
        blew_up = carry_out(self.clone, self.action_names[chosen], self._seen, self._period).over
        if not self._events:  # the fingers turned nothing, as where a turn slips
            outcome = rules.judge(before, chosen, before)
            self._events = [_Event(outcome.reward, outcome.terminated, outcome.success, -1, "")]
        first, last = self._events[0], self._events[-1]
        info = {
            **self._info({**self._latest, "is_success": np.bool_(last.success)}),
            "legal": np.bool_(last.success or not last.terminated),
            "fault": np.bool_(bool(last.fault)),
            "fault_reason": last.fault,
            "done": np.bool_(len(self._events) == 1 and first.macro_action == chosen),
        }
        return self._frame(), sum(each.reward for each in self._events), last.terminated, blew_up, info

    def close(self) -> None:
        """Free the environment of continuous control."""
        self.motion.close()

    # --- details -------------------------------------------------------------------------------------------------

    def _period(self, command: Command) -> ControlPeriod:
        """One control period; keeps its event unless the episode is over. It is the last if the simulation blew up."""
        self._seen, reward, terminated, blew_up, info = self.motion.step(command)
        self._periods += 1
        self._latest = info
        over = bool(self._events) and self._events[-1].terminated
        if (info["event"] or blew_up) and not over:
            event = _Event(
                float(reward), terminated, bool(info["is_success"]), int(info["macro_action"]), info["fault_reason"]
            )
            self._events.append(event)
        return ControlPeriod(self._seen, bool(info["event"]), blew_up)

    def _frame(self) -> Frame:
        return self.motion.world.composite(self._camera.frame(self.motion.data))

    def _info(self, info: Info) -> Info:
        names = ("macrostate", "is_success", "legal", "fault", "fault_reason")
        sim_time_s = np.float64(self._periods * self.motion.period_s)
        return {**{name: info[name] for name in names}, "sim_time_s": sim_time_s, "done": np.bool_(False)}
