"""The agent ``factored:given``: its perception is an encoder of discrete codes, which it is given.

So it can also show people what it imagines, be read by a probe, and ask an oracle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentContext, Frame, Observation
from imagine_bench.interfaces.capabilities import ExpectedOutcomes, ImaginedRollout, Label, planned_actions

from ..encoders.perception import prepare_torch
from .agent import CodeAgent
from .exploration import last_step, query
from .factors import Code, CodeTransition
from .perception import CodePerception, ImaginedCode, load_code_perception
from .settings import HYPERPARAMETERS

_TERMINAL = 0.5
"""Predicted probability above which an imagined episode ends."""


class GivenPerceptionAgent(CodeAgent[CodePerception]):
    """Sees with an encoder, and so can show what it imagines, be read by a probe, and ask an oracle."""

    def query(self, observation: Observation) -> NDArray[np.int64] | None:
        """What to ask; see :class:`.capabilities.QueryingAgent` and :mod:`.exploration`."""
        with self.meters.cpu_time("time/model_s"):
            code = self.perception.code(observation.frame)
            return query(self.model, code, self.settings.planning, without=self.replay.without_label)

    def learn_label(self, observation: Observation, actions: NDArray[np.int64], label: Label | None) -> None:
        """Learn the outcome of an imagined transition, and nothing of the dynamics, or that it has no label."""
        code, action, following = last_step(self.model, self.perception.code(observation.frame), actions)
        reward, terminated = (0.0, False) if label is None else (label.reward, label.terminated)
        asked = CodeTransition(code, action, following, reward, terminated, has_dynamics=False)
        self.replay.add(asked._replace(has_reward=label is not None))
        with self.meters.cpu_time("time/model_s"):
            self.learn()

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        """Imagine up to ``depth`` transitions from ``frame``; see :class:`.capabilities.Imaginer`.

        ``epistemic`` is the probability that something untested decides the transition, ``modal`` that it does not
        lead where it most probably leads; a categorical model knows no Gaussian noise, so ``aleatoric`` is 0.
        InvalidValueError if there is no depth to imagine, or actions are none.
        """
        planned = planned_actions(actions, depth, self.n_actions)
        start = code = self.perception.code(frame)
        steps: list[ImaginedCode] = []
        for index in range(depth if planned is None else len(planned)):
            steps.append(self._imagined(code, None if planned is None else planned[index], rng))
            if planned is None and steps[-1].p_terminated > _TERMINAL:
                break
            code = steps[-1].code
        return self.perception.rollout(start, steps)

    def _imagined(self, code: Code, action: int | None, rng: np.random.Generator) -> ImaginedCode:
        """One imagined step of ``action``, or of the greedy one."""
        values = self._values(code)
        chosen = int(values.argmax()) if action is None else action
        if not self._ready:
            return ImaginedCode(chosen, code, reward=0.0, p_terminated=0.0, values=values, unknown=1.0, p_other=0.0)
        following, p_likeliest = self.model.sample(code, chosen, rng)
        reward, p_terminated, unknown = (float(each[chosen]) for each in self.planner.outcome(code))
        return ImaginedCode(chosen, following, reward, p_terminated, values, unknown, 1.0 - p_likeliest)

    def read_frames(self, frames: Frame) -> NDArray[np.int64]:
        """What a probe reads; see :class:`.capabilities.FrameReader`."""
        return self.perception.macrostates(self.perception.codes(frames))

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        """What its planner plans with; see :class:`.capabilities.OutcomePredictor`."""
        codes = self.perception.codes(frames)
        if not self._ready:
            nothing = np.zeros((len(codes), self.n_actions))
            where = np.repeat(self.perception.macrostates(codes)[:, None, None], self.n_actions, axis=1)
            return ExpectedOutcomes(macrostates=where, p_continues=nothing[..., None], reward=nothing)
        where = np.array(codes, dtype=np.int64)
        moves = self.model.moves(where)
        found = self.model.results(where, moves)
        branches = moves.following.reshape(-1, where.shape[1]).tolist()
        read = self.perception.macrostates([tuple(code) for code in branches])
        return ExpectedOutcomes(
            macrostates=read.reshape(*found.p_continues.shape, -1), p_continues=found.p_continues, reward=found.reward
        )


def make(context: AgentContext) -> GivenPerceptionAgent:
    """The agent ``factored:given``; InvalidValueError if the context's encoder gives no codes."""
    settings = HYPERPARAMETERS.resolve(context.hyperparameters, context.overrides, context.config_group)
    prepare_torch(context.device)
    perception = load_code_perception(context, factored=settings.dynamics.factored)
    return GivenPerceptionAgent(perception, context.n_actions, settings, context.seeds)
