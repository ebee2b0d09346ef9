"""Which imagined outcome to ask an oracle about: the most uncertain one among transitions that are surely reached.

Of all that the dynamics surely lead to, through ends of episodes too, the transition whose outcome is most probably
decided by something untested: uncertainty sampling (Lewis & Gale 1994) on imagined transitions.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats

from .factors import Code, Codes, as_codes
from .model import FactoredModel
from .settings import PlanningSettings

_SURE = 0.5
"""Probability with which each macro-action of a query must lead where it is imagined to."""
_ROUNDING = 1e-9


def query(
    model: FactoredModel, start: Code, settings: PlanningSettings, without: Collection[tuple[Code, int]]
) -> NDArray[np.int64] | None:
    """The macro-actions (D,) whose last one has the most uncertain outcome; the fewest among equals.

    Codes and actions in ``without`` are not asked about. None where nothing is uncertain enough.
    """
    if model.outcomes.causes is None:
        return None
    best = settings.exploration_threshold
    chosen = None
    front: list[tuple[Code, tuple[int, ...]]] = [(start, ())]  # codes, and the actions that lead to them
    seen = {start}
    for _ in range(settings.depth):
        if not front or len(seen) > settings.states:
            break
        codes = np.array([code for code, _ in front], dtype=np.int64)
        following, sure = likeliest(model, codes)
        uncertainty = _uncertainty(model, codes, following)
        further: list[tuple[Code, tuple[int, ...]]] = []
        for row, action in np.argwhere(sure >= _SURE).tolist():
            code, actions = front[row]
            if uncertainty[row, action] > best and (code, action) not in without:
                best = float(uncertainty[row, action])
                chosen = (*actions, action)
            after = tuple(following[row, action].tolist())
            if after not in seen:
                seen.add(after)
                further.append((after, (*actions, action)))
        front = further
    return None if chosen is None else np.array(chosen, dtype=np.int64)


def last_step(model: FactoredModel, start: Code, actions: NDArray[np.int64]) -> tuple[Code, int, Code]:
    """The imagined transition that the last of ``actions`` (D,) would be: code, action and code after."""
    code = start
    after = start
    for action in actions.tolist():
        following, _ = likeliest(model, as_codes(after)[None])
        code = after
        after = tuple(following[0, action].tolist())
    return code, int(actions[-1]), after


def likeliest(model: FactoredModel, codes: Codes) -> tuple[Codes, Floats]:
    """Where every action most probably leads from ``codes`` (N, P), and how probably: (N, A, P) and (N, A).

    For an action of which nothing is known the probability is 0: a prior for staying is no knowledge.
    """
    factors = model.dynamics.predict(codes)
    following = np.stack([factor.expected.argmax(axis=2) for factor in factors], axis=2)
    sure = np.prod([factor.expected.max(axis=2) for factor in factors], axis=0)
    nothing = 1.0 - model.dynamics.factors[0].settings.persistence - _ROUNDING
    untried = np.all([factor.unknown > nothing for factor in factors], axis=0)
    return following, np.where(untried, 0.0, sure)


def _uncertainty(model: FactoredModel, codes: Codes, following: Codes) -> Floats:
    """Probability that something untested decides the outcome of every action in ``codes`` (N, P). Shape (N, A)."""
    count, actions, factors = following.shape
    before = np.repeat(codes, actions, axis=0)
    _, unknown = model.outcomes.predict(before, np.tile(np.arange(actions), count), following.reshape(-1, factors))
    return unknown.reshape(count, actions)
