"""A task of your own, without arm or MuJoCo: a corridor in which every tenth step slips. Run it: python own_task.py."""

from __future__ import annotations

import functools
import sys
from typing import Any

import gymnasium
import numpy as np

from imagine_bench.cli import main
from imagine_bench.interfaces import Outcome, TaskSpec
from imagine_bench.registry import TASKS, TaskEntry, register_env
from imagine_bench.rules import facts

CELLS, HORIZON, SLIP = 5, 10, 0.1
State = tuple[int, ...]


class Rules:
    """All that may happen, exactly: chance level, optimum and plan lengths are computed from it."""

    n_actions = 2
    states = tuple((cell,) for cell in range(CELLS))
    start_states = states[:3]

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        (cell,) = macrostate
        moved = (min(max(cell + (1 if action else -1), 0), CELLS - 1),)
        shares = {macrostate: 0.0, moved: 0.0}
        for reached, share in ((moved, 1.0 - SLIP), (macrostate, SLIP)):
            shares[reached] += share
        return tuple(self.judge(macrostate, action, reached, share) for reached, share in shares.items() if share)

    def judge(self, macrostate: State, action: int, reached: State, share: float = 1.0) -> Outcome:
        end = self.is_terminal(reached)
        return Outcome(share, reached, 10.0 if end else -1.0, terminated=end, success=end)

    def is_legal(self, macrostate: State) -> bool:
        return True

    def is_terminal(self, macrostate: State) -> bool:
        return macrostate == (CELLS - 1,)

    def optimal_action(self, macrostate: State) -> int:
        return 1


def frame(macrostate: Any) -> Any:
    picture = np.full((64, 64, 3), 40, dtype=np.uint8)
    picture[26:38, 2 + 12 * int(macrostate[0]) :][:, :12] = (230, 200, 60)
    return picture


def render_macrostates(macrostates: Any, appearance: str, rng: np.random.Generator) -> Any:
    return np.stack([frame(macrostate) for macrostate in macrostates])


class Corridor(gymnasium.Env):
    """Any Gymnasium environment that takes ``execution`` and ``appearance`` and whose info has these four."""

    def __init__(self, execution: str = "kinematic", appearance: str = "clean") -> None:
        self.observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(2)
        self.rules, self.macrostate = Rules(), Rules.start_states[0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        start = self.rules.start_states[int(self.np_random.integers(3))]
        self.macrostate = tuple(map(int, (options or {}).get("macrostate", start)))
        return frame(self.macrostate), self.info(success=False)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        outcomes = self.rules.outcomes(self.macrostate, int(action))
        chosen = outcomes[int(self.np_random.choice(len(outcomes), p=[each.probability for each in outcomes]))]
        self.macrostate = chosen.macrostate
        return frame(self.macrostate), chosen.reward, chosen.terminated, False, self.info(success=chosen.success)

    def info(self, *, success: bool) -> dict[str, Any]:
        return {"macrostate": np.array(self.macrostate), "is_success": success, "legal": True, "fault": False}


SPEC = TaskSpec(
    id="corridor", title="Corridor", description="A walk to the right end of a corridor.", env_id="own/Corridor-v0",
    horizon=HORIZON, action_names=("step left", "step right"), macrostate_names=("cell",),
    macrostate_values=(tuple(map(str, range(CELLS))),), preprocessing="small_rgb", encoder="corridor", rules=Rules(),
    facts=functools.partial(facts, Rules(), HORIZON), render_macrostates=render_macrostates,
    executions=("kinematic",),
)  # fmt: skip
TASKS["corridor"] = TaskEntry(spec="own_task:SPEC", env_id=SPEC.env_id, env="own_task:Corridor", horizon=HORIZON)
register_env(TASKS["corridor"])
BENCH = "bench --task corridor --preset smoke --agents random oracle dqn"

if __name__ == "__main__":  # dqn's encoder is trained on first use, in a minute
    main([*BENCH.split(), *sys.argv[1:]])
