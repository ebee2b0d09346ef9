"""Five cubes in a row, each of another color. A gripper swaps two neighbours; the row shall become a rainbow.

With probability 0.1 a swap fails and leaves both cubes where they are. In the covered world a cloth falls over the
last cube after the first frame.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any

import gymnasium
import numpy as np

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome, PerformanceTargets, State, TaskSpec
from imagine_bench.registry import TaskEntry, register_env
from imagine_bench.rules import facts

CUBES = 5
HORIZON = 15
FAILS = 0.1
HIDDEN = (4,)
COLORS = ("red", "yellow", "green", "blue", "violet")
GOAL = tuple(range(CUBES))
_RGB = np.array([(220, 40, 40), (230, 210, 50), (50, 170, 70), (50, 90, 220), (150, 60, 190)], dtype=np.uint8)
_TABLE = (90, 80, 70)
_CLOTH = (235, 235, 235)


class SortingRules:
    """Macrostate: the color of the cube at each place, from left to right."""

    n_actions = CUBES - 1
    states = tuple(itertools.permutations(range(CUBES)))

    @property
    def start_states(self) -> tuple[State, ...]:
        return tuple(state for state in self.states if 1 <= disorder(state) <= 4)

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        swapped = list(macrostate)
        swapped[action] = macrostate[action + 1]
        swapped[action + 1] = macrostate[action]
        done = self._outcome(1.0 - FAILS, tuple(swapped))
        failed = self._outcome(FAILS, macrostate)
        return (done, failed)

    def judge(self, macrostate: State, action: int, reached: State) -> Outcome:
        return self._outcome(1.0, reached)

    def is_legal(self, macrostate: State) -> bool:
        return sorted(macrostate) == list(GOAL)

    def is_terminal(self, macrostate: State) -> bool:
        return macrostate == GOAL

    def optimal_action(self, macrostate: State) -> int:
        wrong = [place for place in range(CUBES - 1) if macrostate[place] > macrostate[place + 1]]
        return wrong[0] if wrong else 0

    def _outcome(self, probability: float, reached: State) -> Outcome:
        sorted_now = reached == GOAL
        reward = 10.0 if sorted_now else -1.0
        return Outcome(probability, reached, reward, terminated=sorted_now, success=sorted_now)


class Cloth:
    """What frames show of the covered world: every cube at first, later all but the one under the cloth."""

    lag = 0

    def seen(self, macrostate: State, step: int) -> tuple[tuple[float, State], ...]:
        if step == 0:
            return ((1.0, macrostate),)
        shown = tuple(-1 if place in HIDDEN else color for place, color in enumerate(macrostate))
        return ((1.0, shown),)


def disorder(state: State) -> int:
    """Pairs of cubes in the wrong order: the swaps that sorting takes where none fails."""
    return sum(left > right for left, right in itertools.combinations(state, 2))


def frame(shown: Any) -> Any:
    """The image (64, 64, 3) of a row of cubes; a cube of color -1 is under the cloth."""
    image = np.empty((64, 64, 3), dtype=np.uint8)
    image[:] = _TABLE
    for place, color in enumerate(shown):
        left = 3 + 12 * place
        rgb = _CLOTH if color < 0 else _RGB[int(color)]
        image[27:37, left : left + 10] = rgb
        image[25:27, left + 2 : left + 10] = np.asarray(rgb) // 2
    return image


def render_macrostates(macrostates: Any, appearance: str, rng: np.random.Generator) -> Any:
    """Frames of macrostates; at ``mild`` and ``strong`` the light varies."""
    frames = np.stack([frame(macrostate) for macrostate in macrostates])
    spread = {"clean": 0.0, "mild": 0.1, "strong": 0.25}.get(appearance, 0.0)
    light = rng.uniform(1.0 - spread, 1.0, size=(len(frames), 1, 1, 1))
    return (frames * light).astype(np.uint8)


class FiveCubes(gymnasium.Env):
    """The environment of both worlds."""

    metadata = {"render_modes": []}

    def __init__(self, execution: str = "kinematic", appearance: str = "clean", covered: bool = False) -> None:
        if execution != "kinematic":
            raise InvalidValueError(f"The execution is {execution!r}; five cubes know 'kinematic' alone.")
        self.observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(CUBES - 1)
        self.appearance = appearance
        self.sight = Cloth() if covered else None
        self.rules = SortingRules()
        self.state = self.rules.start_states[0]
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        starts = self.rules.start_states
        start = starts[int(self.np_random.integers(len(starts)))]
        self.state = tuple(int(color) for color in (options or {}).get("macrostate", start))
        self.steps = 0
        return self._frame(), self._info(success=False)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        outcomes = self.rules.outcomes(self.state, int(action))
        drawn = self.np_random.choice(len(outcomes), p=[outcome.probability for outcome in outcomes])
        outcome = outcomes[int(drawn)]
        self.state = outcome.macrostate
        self.steps += 1
        return self._frame(), outcome.reward, outcome.terminated, False, self._info(success=outcome.success)

    def get_state(self) -> Any:
        return self.state, self.steps, self.np_random.bit_generator.state

    def set_state(self, state: Any) -> None:
        self.state, self.steps, self.np_random.bit_generator.state = state

    def _shown(self) -> State:
        if self.sight is None:
            return self.state
        return self.sight.seen(self.state, self.steps)[0][1]

    def _frame(self) -> Any:
        return render_macrostates([self._shown()], self.appearance, self.np_random)[0]

    def _info(self, *, success: bool) -> dict[str, Any]:
        return {
            "macrostate": np.array(self.state),
            "shown": np.array(self._shown()),
            "is_success": success,
            "legal": True,
            "fault": False,
        }


def spec(covered: bool = False) -> TaskSpec:
    """The task, with or without the cloth."""
    return TaskSpec(
        id="five_cubes_covered" if covered else "five_cubes",
        title="Five cubes under a cloth" if covered else "Five cubes",
        description="A gripper swaps neighbours in a row of five cubes. They shall stand in the order of the rainbow.",
        env_id="five_cubes/FiveCubesCovered-v0" if covered else "five_cubes/FiveCubes-v0",
        horizon=HORIZON,
        action_names=tuple(f"swap places {place} and {place + 1}" for place in range(CUBES - 1)),
        macrostate_names=tuple(f"place {place}" for place in range(CUBES)),
        macrostate_values=(COLORS,) * CUBES,
        preprocessing="small_rgb",
        encoder="five_cubes",
        rules=SortingRules(),
        facts=functools.partial(facts, SortingRules(), HORIZON),
        render_macrostates=render_macrostates,
        reference=None,
        config_group="chapter_5",
        presets={"smoke": {"budgets": (5, 20)}},
        success_threshold=0.9,
        targets=None,
        sight=Cloth() if covered else None,
        executions=("kinematic",),
    )


TARGETS = PerformanceTargets(
    objects=COLORS,
    as_ruled=1.0,
    other_objects_mm=1.0,
    physics_per_cpu_s=1.0,
    kinematic_per_cpu_s=1000.0,
    encoders={"clean": 0.99},
)
"""What this package would hold its world to; no scene of contact physics is measured yet."""

ENTRY = TaskEntry(
    spec="five_cubes:spec", env_id="five_cubes/FiveCubes-v0", env="five_cubes:FiveCubes", horizon=HORIZON
)
COVERED = TaskEntry(
    spec="five_cubes:spec",
    env_id="five_cubes/FiveCubesCovered-v0",
    env="five_cubes:FiveCubes",
    horizon=HORIZON,
    options={"covered": True},
)
register_env(ENTRY)
register_env(COVERED)
