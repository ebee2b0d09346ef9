"""What tables take for a state, the frame's code or (privileged) the macrostate, and how their agents explore."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, Floats, Observation, State

from ..encoders.perception import prepare_torch
from ..factored.perception import CodePerception, load_code_perception

_TIE = 1e-9

ReadState = Callable[[Observation], State]
"""From an observation to a key of the table."""


def read_codes(perception: CodePerception) -> ReadState:
    """Reads the frame's whole code, one number: a tuple of length 1 for a perception that is not factored."""
    return lambda observation: perception.code(observation.frame)


def read_macrostate(observation: Observation) -> State:
    """The true state, of length M; InvalidValueError if the observation does not show it."""
    if observation.macrostate is None:
        raise InvalidValueError("This agent reads the true state and was shown none; register it as privileged.")
    return tuple(int(value) for value in observation.macrostate)


def load_codes(context: AgentContext) -> CodePerception:
    """The perception of an agent whose state is the whole code; InvalidValueError if the encoder gives no codes."""
    prepare_torch(context.device)
    return load_code_perception(context, factored=False)


def epsilon_greedy(values: Callable[[], Floats], n_actions: int, epsilon: float, rng: np.random.Generator) -> int:
    """Any action with probability ``epsilon``, else one of the largest value, by chance among equals.

    ``values()`` gives those of all actions (A,); it is called only where they decide.
    """
    if epsilon > 0.0 and rng.random() < epsilon:
        return int(rng.integers(n_actions))
    found = values()
    return int(rng.choice(np.flatnonzero(found >= found.max() - _TIE)))
