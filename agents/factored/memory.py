"""What a frame hides and an earlier one showed: the value that one factor had when it last told anything.

Which factor is remembered, and which of its values tells nothing, is not told but learned: where the same code and
action have brought different outcomes, every such *memory* is tried. What is learned with it from every second episode
predicts the others, and these the first. The memory that predicts best is kept if it predicts much better than none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from .factors import Code, CodeTransition, Memory
from .model import FactoredModel
from .settings import LearnedSettings

_FEWEST = 3
"""Values of a factor worth remembering: one that tells nothing, and two to tell apart."""
_NONE_SEEN = 1e6
"""Pseudo-count beside which no transition counts that was seen: it would explain a part of what a memory explains."""


def candidates(sizes: Sequence[int]) -> list[Memory]:
    """Every memory of factors that have so many values."""
    return [Memory(f, hidden) for f, size in enumerate(sizes) if size >= _FEWEST for hidden in range(size)]


def remembering(rows: Sequence[CodeTransition], begins: Sequence[bool], memory: Memory | None) -> list[CodeTransition]:
    """Transitions whose codes end with what is remembered; ``begins`` tells which are the first of an episode."""
    if memory is None:
        return list(rows)
    found = []
    remembered = memory.hidden
    for row, first in zip(rows, begins, strict=True):
        before = memory.after(memory.hidden if first else remembered, row.code)
        remembered = memory.after(before, row.following)
        found.append(row._replace(code=(*row.code, before), following=(*row.following, remembered)))
    return found


def contradictions(rows: Sequence[CodeTransition]) -> int:
    """How many transitions brought another outcome than the first of the same codes and action."""
    first: dict[tuple[Code, int, Code], tuple[float, bool]] = {}
    return sum(
        first.setdefault((row.code, row.action, row.following), outcome) != outcome
        for row in rows for outcome in [(row.reward, row.terminated)]
    )  # fmt: skip


def choose(
    rows: Sequence[CodeTransition], begins: Sequence[bool], sizes: tuple[int, ...], n_actions: int,
    settings: LearnedSettings,
) -> Memory | None:  # fmt: skip
    """The memory that explains transitions between codes best; None unless it does so much better than none."""
    if not contradictions(rows):
        return None
    half = np.cumsum(begins) % 2 == 0  # every second episode
    causes_alone = replace(settings, outcomes=replace(settings.outcomes, pseudo_seen=_NONE_SEEN))
    likelihood: dict[Memory | None, float] = {}
    for memory in (None, *candidates(sizes)):
        more = () if memory is None else (sizes[memory.factor],)
        remembered = remembering(rows, begins, memory)
        likelihood[memory] = 0.0
        for learned in (half, ~half):
            model = FactoredModel((*sizes, *more), n_actions, causes_alone, memory)
            for row in compress(remembered, learned):
                model.add(row)
            model.outcomes.fit()
            likelihood[memory] += model.log_likelihood(list(compress(remembered, ~learned)))
    best = max(likelihood, key=lambda memory: likelihood[memory])
    return best if likelihood[best] > likelihood[None] + settings.memory_evidence else None
