"""What a frame hides and an earlier one showed: the value that one factor had when it last told anything.

Which factor is remembered, and which of its values tells nothing, is not told but learned: where the same code and
action have brought different outcomes, every such *memory* is tried on all transitions, and the one that explains them
best is kept if it explains them much better than none (model comparison, Kass & Raftery 1995). A code that remembers is
Markovian where the human asks only once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .factors import Code, CodeTransition
from .model import FactoredModel
from .settings import OwnSettings

_FEWEST = 3
"""Values of a factor worth remembering: one that tells nothing, and two to tell apart."""


@dataclass(frozen=True, slots=True)
class Memory:
    """The last value of a factor in an episode but one, which tells nothing and stands for never."""

    factor: int
    hidden: int

    def after(self, remembered: int, code: Code) -> int:
        """What is remembered once a code was seen."""
        value = code[self.factor]
        return remembered if value == self.hidden else value


def candidates(sizes: Sequence[int]) -> list[Memory]:
    """Every memory of factors that have so many values."""
    return [Memory(f, hidden) for f, size in enumerate(sizes) if size >= _FEWEST for hidden in range(size)]


def remembering(rows: Sequence[CodeTransition], begins: Sequence[bool], memory: Memory | None) -> list[CodeTransition]:
    """Transitions whose codes end with what is remembered; ``begins`` tells which are the first of an episode."""
    if memory is None:
        return list(rows)
    found, remembered = [], memory.hidden
    for row, first in zip(rows, begins, strict=True):
        before = memory.after(memory.hidden if first else remembered, row.code)
        remembered = memory.after(before, row.following)
        found.append(row._replace(code=(*row.code, before), following=(*row.following, remembered)))
    return found


def contradict(rows: Sequence[CodeTransition]) -> bool:
    """Whether the same codes and action have brought different outcomes."""
    seen: dict[tuple[Code, int, Code], tuple[float, bool]] = {}
    return any(
        seen.setdefault((row.code, row.action, row.following), outcome) != outcome
        for row in rows for outcome in [(row.reward, row.terminated)]
    )  # fmt: skip


def choose(
    rows: Sequence[CodeTransition], begins: Sequence[bool], sizes: tuple[int, ...], n_actions: int,
    settings: OwnSettings,
) -> Memory | None:  # fmt: skip
    """The memory that explains transitions between codes best; None unless it does so much better than none."""
    if not contradict(rows):
        return None
    evidence: dict[Memory | None, float] = {}
    for memory in (None, *candidates(sizes)):
        more = () if memory is None else (sizes[memory.factor],)
        model = FactoredModel((*sizes, *more), n_actions, settings)
        for row in remembering(rows, begins, memory):
            model.add(row)
        model.outcomes.fit()
        evidence[memory] = model.log_evidence(len(sizes))
    best = max(evidence, key=lambda memory: evidence[memory])
    return best if evidence[best] > evidence[None] + settings.memory_evidence else None
