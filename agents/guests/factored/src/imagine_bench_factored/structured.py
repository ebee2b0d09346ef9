"""The structured model of the agent ``factored``: tables over discrete codes of a scene's factors."""

from __future__ import annotations

import numpy as np
from imagine_bench.agents.encoders.perception import prepare_torch

from imagine_bench.arrays import Floats, Frame, Ints, Pixels
from imagine_bench.interfaces import AgentContext
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined, LearnedGraph, until_the_end

from .factors import Codes, CodeTransition
from .model import FactoredModel
from .perception import CodePerception, load_code_perception
from .settings import HYPERPARAMETERS


class StructuredModel:
    """Codes, tables and decoder as a world model."""

    def __init__(self, perception: CodePerception, context: AgentContext) -> None:
        self.perception = perception
        self.sizes = perception.sizes
        self.n_actions = context.n_actions
        settings = HYPERPARAMETERS.resolve(context.hyperparameters, {}, context.config_group)
        self.model = FactoredModel(self.sizes, context.n_actions, settings)

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Count every transition; nothing is random."""
        del rng
        codes = self.perception.codes(dataset.frames)
        before = dataset.rows[0]
        rows = zip(before, dataset.actions.tolist(), dataset.rewards.tolist(), dataset.terminated.tolist(), strict=True)
        for row, action, reward, terminated in rows:
            self.model.add(CodeTransition(codes[row], action, codes[row + 1], reward, terminated))
        self.model.outcomes.fit()

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """Futures drawn code by code; see :class:`.interfaces.model.WorldModel`.

        ``epistemic`` is the probability that something untested decides, ``modal`` that the outcome is not the
        likeliest one.
        """
        asked = actions[:, frames.shape[1] - 1 :]
        rows, depth = asked.shape
        shape = (rows, samples, depth)
        codes = np.repeat(np.array(self.perception.codes(frames[:, -1])), samples, axis=0)
        steps = []
        for action in asked.repeat(samples, axis=0).T:
            steps.append(self._step(codes, action, rng))
            codes = steps[-1][0]
        drawn, rewards, ends, unknown, other = (np.stack(each, axis=1) for each in zip(*steps, strict=True))
        pictures = self._pictures(drawn)
        counted, p_ended = until_the_end(rewards.reshape(shape), ends.reshape(shape))
        return Imagined(
            pictures=pictures.reshape(*shape, *pictures.shape[1:]), rewards=counted, p_ended=p_ended,
            epistemic=unknown.reshape(shape).mean(axis=1), modal=other.reshape(shape).mean(axis=1),
        )  # fmt: skip

    def _step(
        self, codes: Codes, action: Ints, rng: np.random.Generator
    ) -> tuple[Codes, Floats, Floats, Floats, Floats]:
        """Next codes (R, P), and of each row reward, P(end), P(untested) and P(other), (R,)."""
        following = np.zeros_like(codes)
        known = np.ones(len(codes))
        likeliest = np.ones(len(codes))
        for index, factor in enumerate(self.model.dynamics.factors):
            chance, unknown = factor.happens(codes, action)
            following[:, index] = (chance.cumsum(axis=1) < rng.random((len(codes), 1))).sum(axis=1)
            known = known * (1.0 - unknown)
            likeliest = likeliest * chance.max(axis=1)
        following = np.minimum(following, np.array(self.sizes) - 1)
        outcomes, untested = self.model.outcomes.predict(codes, action, following)
        reward = outcomes @ self.model.outcomes.rewards
        ends = outcomes @ self.model.outcomes.ends
        return following, reward, ends, 1.0 - known * (1.0 - untested), 1.0 - likeliest

    def _pictures(self, codes: Codes) -> Pixels:
        """Pictures of codes (..., P), each different code drawn once. Shape (rows, H, W) or (rows, H, W, 3)."""
        different, which = np.unique(codes.reshape(-1, codes.shape[-1]), axis=0, return_inverse=True)
        drawn = self.perception.images(different)
        return (drawn * 255.0).round().astype(np.uint8)[which.ravel()]

    def factor_graph(self, frames: Frame) -> LearnedGraph:
        """Of each factor the likeliest structure after each macro-action; see :class:`.interfaces.model.GraphLearner`.

        A factor that changes by itself decides its own change.
        """
        factors = self.model.dynamics.factors
        edges = np.zeros((self.n_actions, len(factors), len(factors)), dtype=bool)
        for child, factor in enumerate(factors):
            for action, parents in enumerate(factor.likeliest_parents()):
                edges[action, child, list(parents)] = True
        return LearnedGraph(values=np.array(self.perception.codes(frames), dtype=np.int64), edges=edges)

    def parameters(self) -> int:
        """Entries of the tables of the dynamics."""
        return sum(factor.counts.size for factor in self.model.dynamics.factors)


def make(context: AgentContext) -> StructuredModel:
    """The model for a task; InvalidValueError if the context's encoder gives no codes."""
    prepare_torch(context.device)
    return StructuredModel(load_code_perception(context, factored=True), context)
