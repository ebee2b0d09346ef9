"""What to ask a teacher: the imagined outcome that is most in doubt, where it is sure what would be reached.

Of all that the dynamics surely lead to, through ends of episodes too, the transition whose outcome is most probably
decided by something untested: uncertainty sampling (Lewis & Gale 1994) on what was only imagined.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .dynamics import Codes
from .model import StructuredModel, as_codes
from .outcomes import Floats

_SURE = 0.5
"""Probability with which each macro-action of a question must lead where it is imagined to."""
_ROUNDING = 1e-9

Code = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Reached:
    """A code, and the actions that lead to it."""

    code: Code
    actions: tuple[int, ...]


def question(
    model: StructuredModel, start: Code, *, depth: int, codes: int, least: float, without: Collection[tuple[Code, int]]
) -> NDArray[np.int64] | None:
    """The macro-actions whose last one is most in doubt; the fewest among equals.

    Args:
        model: Imagines.
        start: The code seen.
        depth: Most macro-actions.
        codes: Most codes that are looked at.
        least: Doubt below which nothing is asked.
        without: Codes and actions that are not asked about.

    Returns:
        Shape (D,), or None.
    """
    if model.outcomes.causes is None:
        return None
    best, chosen = least, None
    front, seen = [_Reached(start, ())], {start}
    while front and len(front[0].actions) < depth and len(seen) <= codes:
        following, sure = likeliest(model, np.array([each.code for each in front], dtype=np.int64))
        doubt = _doubt(model, front, following)
        further: list[_Reached] = []
        for row, each in enumerate(front):
            for action in range(model.n_actions):
                if sure[row, action] < _SURE:
                    continue
                after = tuple(following[row, action].tolist())
                if doubt[row, action] > best and (each.code, action) not in without:
                    best, chosen = float(doubt[row, action]), (*each.actions, action)
                if after not in seen:
                    seen.add(after)
                    further.append(_Reached(after, (*each.actions, action)))
        front = further
    return None if chosen is None else np.array(chosen, dtype=np.int64)


def last_step(model: StructuredModel, start: Code, actions: NDArray[np.int64]) -> tuple[Code, int, Code]:
    """The imagined transition that the last of ``actions`` (D,) would be: code, action and code after."""
    code, after = start, start
    for action in actions.tolist():
        following, _ = likeliest(model, as_codes(after)[None])
        code, after = after, tuple(following[0, action].tolist())
    return code, int(actions[-1]), after


def likeliest(model: StructuredModel, codes: Codes) -> tuple[Codes, Floats]:
    """Where every action most probably leads from ``codes`` (N, P), and how probably: (N, A, P) and (N, A).

    Of an action of which nothing is known, probability 0: a prior for staying is no knowledge.
    """
    parts = model.dynamics.predict(codes)
    following = np.stack([part.expected.argmax(axis=2) for part in parts], axis=2)
    sure = np.prod([part.expected.max(axis=2) for part in parts], axis=0)
    nothing = 1.0 - model.dynamics.parts[0].settings.persistence - _ROUNDING
    untried = np.all([part.unknown > nothing for part in parts], axis=0)
    return following, np.where(untried, 0.0, sure)


def _doubt(model: StructuredModel, front: list[_Reached], following: Codes) -> Floats:
    """Probability that something untested decides the outcome of every action. Shape (N, A)."""
    count, actions, parts = following.shape
    before = np.repeat(np.array([each.code for each in front], dtype=np.int64), actions, axis=0)
    _, doubt = model.outcomes.predict(before, np.tile(np.arange(actions), count), following.reshape(-1, parts))
    return doubt.reshape(count, actions)
