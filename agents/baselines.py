"""The floor and the ceiling: an agent that knows nothing, and one that is shown everything. Neither learns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import AgentContext, AgentState, Observation, Transition


class _FixedPolicy:
    """An agent that learns nothing and measures nothing."""

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Learn nothing."""

    def diagnostics(self) -> dict[str, float]:
        """Nothing is measured."""
        return {}

    def state(self) -> AgentState:
        """Nothing to remember."""
        return AgentState(arrays={}, values={})

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it is of another agent."""
        for name in sorted((set(state.values) ^ set(self.state().values)) | set(state.arrays)):
            raise ArtefactError(
                f"The snapshot differs from this agent's in {name!r}; it is of another agent or damaged."
            )


@dataclass
class RandomAgent(_FixedPolicy):
    """Uniformly random macro-actions, when it is tested too."""

    n_actions: int
    rng: np.random.Generator

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Any action, each equally likely."""
        return int(self.rng.integers(self.n_actions))

    def state(self) -> AgentState:
        """The generator's state."""
        return AgentState(arrays={}, values={"generator": self.rng.bit_generator.state})

    def restore(self, state: AgentState) -> None:
        """Take up a generator's state; ArtefactError if the snapshot is of another agent."""
        super().restore(state)
        self.rng.bit_generator.state = state.values["generator"]


class OracleAgent(_FixedPolicy):
    """An optimal action of the rules, given the coordinates that the frames of the episode have shown.

    It reads frames without error and remembers them, but it does not know coordinates that they hide or show late.
    """

    def __init__(self, optimal_policy: Callable[[tuple[int, ...], int], int]) -> None:
        self._optimal_policy = optimal_policy
        self._step = 0

    def begin_episode(self) -> None:
        """Forget the episode so far."""
        self._step = 0

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The optimal action; InvalidValueError if the observation does not show the macrostate."""
        shown = observation.macrostate if observation.shown is None else observation.shown
        if shown is None:
            raise InvalidValueError("The oracle was shown no macrostate; give it privileged observations.")
        self._step += 1
        return self._optimal_policy(tuple(int(value) for value in shown), self._step - 1)


def make_random(context: AgentContext) -> RandomAgent:
    """The ``random`` agent."""
    return RandomAgent(context.n_actions, context.seeds.child("exploration").generator())


def make_oracle(context: AgentContext) -> OracleAgent:
    """The ``oracle`` agent; InvalidValueError if the context has no rules to ask."""
    if context.optimal_policy is None:
        raise InvalidValueError("The oracle needs the rules' optimal policy in its context.")
    return OracleAgent(context.optimal_policy())
