"""Agents for tests of the code around agents: they act at random from a seed, and imagine frames that a test can
recognise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentState, Frame, Observation, Transition
from imagine_bench.interfaces.capabilities import ImaginedRollout

N_ACTIONS = 6


class FakeAgent:
    """Acts from its own generator and learns nothing."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)

    def act(self, observation: Observation, *, explore: bool) -> int:
        return int(self.rng.integers(N_ACTIONS))

    def observe(self, transition: Transition, *, episode: int) -> None: ...

    def diagnostics(self) -> dict[str, float]:
        return {}

    def state(self) -> AgentState:
        return AgentState(arrays={}, values={})

    def restore(self, state: AgentState) -> None: ...


class FakeImaginer(FakeAgent):
    """Imagines depth ``d`` as the real frame in gray, one step darker each, uncertain by ``d``, cut at depth 4."""

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        return np.arange(N_ACTIONS, dtype=np.float32)

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        chosen = rng.integers(N_ACTIONS, size=depth) if actions is None else actions
        steps = np.arange(len(chosen), dtype=np.float32)
        gray = frame.mean(axis=2).astype(np.float32) / 255.0
        return ImaginedRollout(
            actions=chosen.astype(np.int64),
            frames=np.stack([gray * 0.9**step for step in steps]),
            start_frame=gray,
            rewards=-steps,
            p_terminated=steps / 10,
            q_values=np.zeros((len(chosen), N_ACTIONS), dtype=np.float32),
            epistemic=0.1 * steps,
            aleatoric=0.05 * steps,
            modal=0.01 * steps,
            accepted=steps < 4,
            macrostates=np.zeros((len(chosen), 4), dtype=np.int64),
        )
