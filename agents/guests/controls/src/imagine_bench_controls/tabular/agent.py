"""The common part of agents with a table: how they see a state, explore, act in tests, and report."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from imagine_bench.agents import snapshot
from imagine_bench.agents.dqn import epsilon
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.meters import Meters
from imagine_bench.agents.settings import flatten
from imagine_bench_factored.perception import CodePerception, load_code_perception
from numpy.typing import NDArray

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, AgentState, Floats, Observation
from imagine_bench.seeding import SeedTree

from .counts import CountTable
from .settings import CountTableSettings

_TIE = 1e-9
_BITS = 6
_COORDINATES = 10

ReadState = Callable[[Observation], int]
"""From an observation to the number of a state."""


def read_codes(perception: CodePerception) -> ReadState:
    """Reads the frame's whole code, one number, from a perception that is not factored."""
    return functools.partial(_whole_code, perception)


def _whole_code(perception: CodePerception, observation: Observation) -> int:
    return perception.code(observation.frame)[0]


def read_macrostate(observation: Observation) -> int:
    """The true state, six bits a coordinate.

    Raises:
        InvalidValueError: The observation shows none, or one of more coordinates or values than fit a number.
    """
    values = [] if observation.macrostate is None else observation.macrostate.tolist()
    if not 0 < len(values) <= _COORDINATES or not all(0 <= value < 1 << _BITS for value in values):
        raise InvalidValueError(
            f"This agent reads the true state, of at most {_COORDINATES} coordinates in [0, {1 << _BITS}), and was "
            f"shown {values or 'none'}; register it as privileged, for a task of such states."
        )
    return sum(value << (_BITS * place) for place, value in enumerate(values))


def load_codes(context: AgentContext) -> CodePerception:
    """The perception of an agent whose state is the whole code; InvalidValueError if the encoder gives no codes."""
    prepare_torch(context.device)
    return load_code_perception(context, factored=False)


class TabularAgent(ABC):
    """Explores epsilon-greedily as the DQN, by chance among equals; in tests the lowest of the best actions."""

    directed = False  #: Whether its values alone decide its exploration

    def __init__(self, read: ReadState, n_actions: int, settings: CountTableSettings, seeds: SeedTree) -> None:
        self.read = read
        self.n_actions = n_actions
        self.settings = settings
        self.rng = seeds.child("exploration").generator()
        self.table = CountTable(n_actions)
        self.meters = Meters()
        self.steps = 0

    @abstractmethod
    def values(self, observation: Observation, *, explore: bool) -> Floats:
        """Values of every action (A,), in units of reward, as exploration or tests see them."""

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The action of the largest value; exploring, by chance among equals, and with epsilon any."""
        if not explore:
            return int(self.values(observation, explore=False).argmax())
        if not self.directed and self.rng.random() < epsilon(self.steps, self.settings.controller):
            return int(self.rng.integers(self.n_actions))
        values = self.values(observation, explore=True)
        return int(self.rng.choice(np.flatnonzero(values >= values.max() - _TIE)))

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        """Value of every macro-action, in units of reward. Shape (A,)."""
        return self.values(observation, explore=False).astype(np.float32)

    def diagnostics(self) -> dict[str, float]:
        """Means a real step since the last call, and the counters now."""
        counters = {"real_transitions": self.steps, "gradient_updates": 0}
        counters |= {"table/states": self.table.states, "table/pairs": self.table.pairs}
        now = {name: float(value) for name, value in counters.items()}
        return {**self.meters.read(), "epsilon": epsilon(self.steps, self.settings.controller), **now}

    def state(self) -> AgentState:
        """A snapshot: counts, the generator, counters, measurements."""
        values = {
            "steps": self.steps, "exploration": self.rng.bit_generator.state, "meters": self.meters.state(),
            "settings": snapshot.jsonable(flatten(self.settings)), "n_actions": self.n_actions,
        }  # fmt: skip
        return AgentState(arrays=snapshot.prefixed("table", self.table.arrays()), values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        snapshot.require_fit(state, self.state(), equal=("settings", "code_sizes", "n_actions", "directed"))
        self.table.load(snapshot.below("table", state.arrays))
        self.meters.restore(state.values["meters"])
        self.rng.bit_generator.state, self.steps = state.values["exploration"], state.values["steps"]
