"""A task of another package: four lamps on a board, no arm. A press switches a lamp and both of its neighbours."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import gymnasium
import mujoco
import numpy as np
from imagine_bench.tasks.rendering import Renderer, View

from imagine_bench.interfaces import Outcome, TaskSpec
from imagine_bench.registry import TaskEntry
from imagine_bench.rules import facts

HORIZON = 8
_PLACES = ((-1, 1), (1, 1), (1, -1), (-1, -1))
_SCENE = f"""
<mujoco>
  <default><geom type="box" size=".8 .8 .2"/></default>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0"/></visual>
  <worldbody>
    <camera name="above" pos="0 0 5" fovy="45"/>
    <geom type="plane" size="3 3 1" rgba=".2 .2 .3 1"/>
    {"".join(f'<geom name="lamp_{i}" pos="{x} {y} .2"/>' for i, (x, y) in enumerate(_PLACES))}
  </worldbody>
</mujoco>
"""


class LightsOutRules:
    n_actions = 4
    states = tuple(itertools.product((0, 1), repeat=4))
    start_states = tuple(state for state in states if any(state))

    def outcomes(self, macrostate: tuple[int, ...], action: int) -> tuple[Outcome, ...]:
        switched = {action, (action - 1) % 4, (action + 1) % 4}
        after = tuple(lamp ^ (index in switched) for index, lamp in enumerate(macrostate))
        return (self.judge(macrostate, action, after),)

    def judge(self, macrostate: tuple[int, ...], action: int, reached: tuple[int, ...]) -> Outcome:
        out = not any(reached)
        return Outcome(1.0, reached, 10.0 if out else -1.0, terminated=out, success=out)

    def is_legal(self, macrostate: tuple[int, ...]) -> bool:
        return True

    def is_terminal(self, macrostate: tuple[int, ...]) -> bool:
        return not any(macrostate)

    def optimal_action(self, macrostate: tuple[int, ...]) -> int:
        presses = itertools.product((0, 1), repeat=4)
        pressed = min((p for p in presses if self._switches(p) == macrostate), key=sum)
        return pressed.index(1) if 1 in pressed else 0

    def _switches(self, pressed: tuple[int, ...]) -> tuple[int, ...]:
        return tuple((pressed[i] + pressed[i - 1] + pressed[(i + 1) % 4]) % 2 for i in range(4))


class Board:
    """The scene: lamps shine or do not."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(_SCENE)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self._camera = Renderer(self.model, View(camera="above"))

    def frame(self, macrostate: Any) -> Any:
        for index, shines in enumerate(macrostate):
            self.model.geom(f"lamp_{index}").rgba[:3] = (1.0, 0.9, 0.2) if shines else (0.35, 0.35, 0.35)
        return self._camera.frame(self.data)

    def close(self) -> None:
        self._camera.close()


class LightsOutEnv(gymnasium.Env):
    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, execution: str = "kinematic", appearance: str = "clean") -> None:
        self.observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(4)
        self._rules, self._board, self._state = LightsOutRules(), Board(), LightsOutRules.start_states[0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        starts = self._rules.start_states
        self._state = tuple(map(int, (options or {}).get("macrostate", starts[self.np_random.integers(len(starts))])))
        return self._board.frame(self._state), self._info(success=False)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        (outcome,) = self._rules.outcomes(self._state, int(action))
        self._state = outcome.macrostate
        info = self._info(success=outcome.success)
        return self._board.frame(self._state), outcome.reward, outcome.terminated, False, info

    def close(self) -> None:
        self._board.close()

    def _info(self, *, success: bool) -> dict[str, Any]:
        return {"macrostate": np.array(self._state), "is_success": success, "legal": True, "fault": False}


@functools.cache
def _board() -> Board:
    return Board()


def render_macrostates(macrostates: Any, appearance: str, rng: np.random.Generator) -> Any:
    return np.stack([_board().frame(state) for state in macrostates.tolist()])


SPEC = TaskSpec(
    id="lights_out",
    title="Lights out",
    description="Four lamps on a board; a press switches a lamp and its neighbours. All must go out.",
    env_id="lights_out/LightsOut-v0",
    horizon=HORIZON,
    action_names=tuple(f"press lamp {index}" for index in range(4)),
    macrostate_names=tuple(f"lamp {index}" for index in range(4)),
    macrostate_values=(("off", "on"),) * 4,
    preprocessing="small_rgb",
    encoder="lights_out",
    rules=LightsOutRules(),
    facts=functools.partial(facts, LightsOutRules(), HORIZON),
    render_macrostates=render_macrostates,
    config_group="chapter_5",
)
ENTRY = TaskEntry(
    spec="lights_out:SPEC", env_id="lights_out/LightsOut-v0", env="lights_out:LightsOutEnv", horizon=HORIZON
)
