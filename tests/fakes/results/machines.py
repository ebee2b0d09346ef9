"""Macrostate machines without a scene, for computations from rules alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

from imagine_bench.interfaces import Outcome, TaskSpec
from imagine_bench.rules import facts


@dataclass(frozen=True, kw_only=True)
class Wheels:
    """``n`` wheels of four digits and a finger at one of them; each action turns a wheel one digit forth or back.

    The pointed wheel at 0 is a success, two neighbours alike end the episode if that is forbidden. No state is listed.
    """

    n: int = 3
    forbid: bool = True
    slip: float = 0.0  #: nothing turns
    goal_change: float = 0.0  #: the finger then points at the next wheel

    @property
    def n_actions(self):
        return 2 * self.n

    @cached_property
    def start_states(self):
        everything = product(*[range(4)] * self.n, range(self.n))
        return tuple(state for state in everything if self.is_legal(state) and state[state[-1]] != 0)

    def is_legal(self, state):
        return not self.forbid or all(state[i] != state[i + 1] for i in range(self.n - 1))

    def is_terminal(self, state):
        return not self.is_legal(state) or state[state[-1]] == 0

    def outcomes(self, state, action):
        wheel, back = divmod(action, 2)
        turned = tuple((v + (3 if back else 1)) % 4 if i == wheel else v for i, v in enumerate(state[:-1]))
        shares = {}
        for p, wheels in ((self.slip, state[:-1]), (1 - self.slip, turned)):
            for q, finger in ((self.goal_change, (state[-1] + 1) % self.n), (1 - self.goal_change, state[-1])):
                after = (*wheels, finger)
                shares[after] = shares.get(after, 0.0) + p * q
        return tuple(self.judge(state, action, after, share) for after, share in shares.items() if share)

    def judge(self, state, action, reached, share=1.0):
        if not self.is_legal(reached):
            return Outcome(share, reached, -5.0, terminated=True, success=False)
        done = reached[reached[-1]] == 0
        return Outcome(share, reached, 50.0 if done else -1.0, terminated=done, success=done)


@dataclass(frozen=True, kw_only=True)
class Glimpse:
    """The observation model of :class:`Wheels`: the finger always, in the first frame only, or with a probability."""

    finger: str | float = "always"
    lag: int = 0

    def seen(self, macrostate, step):
        hidden = (*macrostate[:-1], -1)
        if self.finger in ("always", "first"):
            return ((1.0, macrostate if self.finger == "always" or step == 0 else hidden),)
        return ((self.finger, macrostate), (1 - self.finger, hidden))


def spec_of(rules, horizon, sight=None):
    """A task of such a machine, for tests without a scene."""
    wheels = [f"wheel {i}" for i in range(rules.n)]
    return TaskSpec(
        id="wheels",
        title="Wheels",
        description="Wheels.",
        env_id="none",
        horizon=horizon,
        action_names=tuple(f"turn {name} {way}" for name in wheels for way in ("forth", "back")),
        macrostate_names=(*wheels, "finger"),
        macrostate_values=(*[tuple("0123")] * rules.n, tuple(map(str, range(rules.n)))),
        preprocessing="gray_strips",
        encoder="none",
        rules=rules,
        facts=lambda: facts(rules, horizon),
        render_macrostates=None,
        sight=sight,
    )
