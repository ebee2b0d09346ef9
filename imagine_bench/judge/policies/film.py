"""A model's belief beside the truth: the likeliest episodes of the policy that it overrates most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from imagine_bench.arrays import Arrays, Frame, Ints, State
from imagine_bench.interfaces import TaskSpec
from imagine_bench.values import Json


class Expected(NamedTuple):
    """The likeliest outcome of a macro-action."""

    reached: State
    reward: float  # the expected one
    over: bool  # whether the episode is more likely over than not


class Step(NamedTuple):
    """A macro-action and its outcome."""

    action: int
    outcome: Expected


def course(
    start: State, plan: Ints, states: Sequence[State], outcome: Callable[[State, int], Expected]
) -> tuple[Step, ...]:
    """The likeliest course of an episode in which a plan (H, S) is followed; ``states`` are its macrostates."""
    rows = {state: row for row, state in enumerate(states)}
    steps: list[Step] = []
    state = start
    for decisions in plan[::-1]:
        if state not in rows or (steps and steps[-1].outcome.over):
            break
        action = int(decisions[rows[state]])
        steps.append(Step(action, outcome(state, action)))
        state = steps[-1].outcome.reached
    return tuple(steps)


@dataclass(frozen=True, kw_only=True)
class Film:
    """The rollouts from the start where the model's return and the true one differ most."""

    start: State
    returns: tuple[float, float]  #: expected in the model and in the truth
    believed: Sequence[Step]
    real: Sequence[Step]

    def told(self, spec: TaskSpec) -> dict[str, Json]:
        """Its words and numbers: of each step the macro-action, the reward, and whether the episode is over."""
        told: dict[str, Json] = {
            "start": ", ".join(spec.value_names(self.start)),
            "returns": list(self.returns),
        }
        for name, steps in (("believed", self.believed), ("real", self.real)):
            told[name] = [[step.action, step.outcome.reward, step.outcome.over] for step in steps]
        return told

    def images(self, frame_of: Callable[[State], Frame]) -> Arrays:
        """A frame of the start and of each macrostate that is reached, black where an image showed nothing."""
        found: Arrays = {}
        first = frame_of(self.start)
        for name, steps in (("film_believed", self.believed), ("film_real", self.real)):
            reached = [step.outcome.reached for step in steps]
            frames = [frame_of(state) if state[0] >= 0 else np.zeros_like(first) for state in reached]
            found[name] = np.array([first, *frames])
        return found
