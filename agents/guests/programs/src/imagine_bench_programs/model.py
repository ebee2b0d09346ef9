"""Programs, and laws that are written from data, as world models."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentContext, Frame, State
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined, imagined_outcomes
from imagine_bench.rules import Outcomes, outcomes_by_depth

from .program import Program
from .settings import HYPERPARAMETERS
from .symbol_rules import SymbolRules
from .symbols import Symbols
from .writing.delay import CodedRow
from .writing.laws import Laws


class SymbolModel:
    """Symbols and rules between them as a world model, which gives every outcome and its probability."""

    def __init__(self, symbols: Symbols, rules: SymbolRules) -> None:
        self.symbols = symbols
        self.rules = rules

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Learn no rules; only how symbols look."""
        del rng
        self.symbols.read(dataset.frames)

    def parameters(self) -> int:
        """None were fitted."""
        return 0

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        """Every outcome; see :class:`imagine_bench.interfaces.model.WorldModel`. Nothing is random."""
        del samples, rng
        history = frames.shape[1]
        shown = self.symbols.read(frames.reshape(-1, *frames.shape[2:]))
        starts = [shown[row * history : (row + 1) * history] for row in range(len(frames))]
        found = [self._by_depth(seen, row.tolist()) for seen, row in zip(starts, actions, strict=True)]
        drawn = list({state for steps in found for outcomes in steps for state, _ in outcomes})
        factors = len(self.symbols.sizes)
        images = dict(zip(drawn, self.symbols.images([state[:factors] for state in drawn]), strict=True))
        imagined = imagined_outcomes(found, images.__getitem__)
        says_rewards = all(not math.isnan(reward) for steps in found for each in steps for _, reward in each.values())
        return imagined if says_rewards else replace(imagined, rewards=None, p_ended=None)

    def _by_depth(self, seen: list[State], actions: list[int]) -> tuple[Outcomes, ...]:
        """The outcomes of the actions that come after a history of symbols and the actions between them."""
        state = self.rules.start(seen[0])
        for action, symbols in zip(actions, seen[1:], strict=False):
            state = self.rules.follow(state, action, symbols)
        return outcomes_by_depth(self.rules, state, actions[len(seen) - 1 :])


class WrittenModel(SymbolModel):
    """A model whose laws are written from the data; a macro-action that the data has not is said to change nothing."""

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Find the shortest laws; nothing is random."""
        symbols = self.symbols.read(dataset.frames)
        steps = np.concatenate([np.arange(length) for length in dataset.lengths])
        columns = (dataset.rows[0], dataset.actions, dataset.rewards, dataset.terminated, steps)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        found = [CodedRow(symbols[at], action, symbols[at + 1], *more) for at, action, *more in rows]
        self.rules = Laws(self.symbols.sizes, self.rules.n_actions, found)

    def parameters(self) -> int:
        """Laws."""
        rules = self.rules
        return rules.count if isinstance(rules, Laws) else 0


def make_program(context: AgentContext) -> SymbolModel:
    """The model ``program:FILE.py``; InvalidValueError as of :class:`.program.Program`."""
    symbols = Symbols(context, HYPERPARAMETERS.of(context).symbols)
    return SymbolModel(symbols, Program(context.argument, symbols.sizes, context.n_actions))


def make_laws(context: AgentContext) -> WrittenModel:
    """The model ``laws``, on the codes of the context's encoder."""
    symbols = Symbols(context, "codes")
    return WrittenModel(symbols, Laws(symbols.sizes, context.n_actions))
