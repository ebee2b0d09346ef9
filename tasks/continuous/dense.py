"""A dense reward by choice: potential-based shaping, which changes no optimal policy (Ng, Harada and Russell, 1999)."""

from __future__ import annotations

import math

import numpy as np

from imagine_bench.arrays import State
from imagine_bench.interfaces import Rules
from imagine_bench.rules import shortest_plans, tabulate

from ..scenes.arm import TCP_SITE
from ..world import World

_REACH_M = 0.10
"""A hand so far from the object that it needs has 1/e of the potential for being near."""
_NEAR = 0.3
_TURNED = 0.6
"""Most potential for being near the object, and for its progress; together less than a macro-action that is done."""


def macro_actions_to_go(rules: Rules) -> dict[State, int]:
    """The fewest macro-actions after which a success is possible, by macrostate; -1 where none is."""
    tables = tabulate(rules)
    return dict(zip(tables.index, shortest_plans(tables).tolist(), strict=True))


class Potential:
    """How far an episode has come, in macro-actions: minus those to go, plus a share of the one under way.

    The share grows as the hand comes near the object that the next macro-action moves, and as that object comes nearer
    to where it shall be. The next macro-action is the optimal policy's; those to go are the fewest that can succeed.

    Args:
        world: The scene.
        rules: Its task's.
    """

    def __init__(self, world: World, rules: Rules) -> None:
        self._world = world
        self._rules = rules
        self._to_go = macro_actions_to_go(rules)
        self._tcp = world.model.site(TCP_SITE).id

    def __call__(self, macrostate: State) -> float:
        """The potential of the scene as it stands, which is in a macrostate; 0 where episodes end."""
        to_go = self._to_go.get(macrostate, 0)
        if to_go <= 0 or self._rules.is_terminal(macrostate):
            return 0.0
        then = self._rules.outcomes(macrostate, self._rules.optimal_action(macrostate))[0].macrostate
        moved = [index for index, (now, next_) in enumerate(zip(macrostate[:-1], then, strict=False)) if now != next_]
        if not moved:
            return -float(to_go)
        (index,) = moved
        pose = self._world.object_poses()[index].tolist()
        away_m = math.dist(pose[:3], self._world.data.site_xpos[self._tcp].tolist())
        done = self._world.progress(index, pose, macrostate[index], then[index])
        share = _NEAR * math.exp(-away_m / _REACH_M) + _TURNED * float(np.clip(done, 0.0, 1.0))
        return share - to_go
