"""Values of many policies in a model and in the truth, by enumeration, and how far the two agree.

Shapes: ``N`` policies, ``S`` macrostates, ``A`` macro-actions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from imagine_bench.arrays import Floats
from imagine_bench.exact.values import TIE, Model


class DenseModel(NamedTuple):
    """A model with a probability for every macrostate; a sum of them below 1 is an end."""

    onward: Floats  # probability that the episode goes on in each macrostate. Shape (S, A, S).
    reward: Floats  # expected reward. Shape (S, A).


def dense(model: Model) -> DenseModel:
    """The same model, its outcomes added up by macrostate. A state that is no macrostate is an end."""
    n_states, n_actions = model.reward.shape
    pairs = np.arange(n_states * n_actions)[:, None]
    onward = np.zeros((len(pairs), n_states + 1))
    shape = (len(pairs), -1)
    np.add.at(onward, (pairs, model.following.reshape(shape)), model.p_continues.reshape(shape))
    return DenseModel(onward[:, :-1].reshape(n_states, n_actions, n_states), model.reward)


def of_actions(model: DenseModel, values: Floats) -> Floats:
    """The expected return of each macro-action, where ``values`` (..., S) are those of the next ones. (..., S, A)."""
    return model.reward + np.tensordot(values, model.onward, axes=(-1, 2))


def values_of(model: DenseModel, policies: Floats, horizon: int) -> Floats:
    """The expected return of policies (N, S, A) within a horizon, from each macrostate. Shape (N, S)."""
    values = np.zeros(policies.shape[:2])
    for _ in range(horizon):
        values = (policies * of_actions(model, values)).sum(axis=2)
    return values


def pearson(one: Floats, other: Floats) -> float:
    """The correlation r of two rows of N values, in [-1, 1]; NaN where all values of one are equal."""
    if min(np.ptp(one), np.ptp(other)) <= TIE:
        return math.nan
    return float(np.corrcoef(one, other)[0, 1])


def kendall(one: Floats, other: Floats) -> float:
    """Kendall's rank correlation tau-b of two rows of N values, in [-1, 1]; NaN where all values of one are equal.

    Of all pairs that are tied in neither row, those ordered alike less those ordered otherwise, divided by the
    geometric mean of the numbers of pairs that are not tied in the one and in the other row (Kendall, 1945).
    """
    gaps = [row[:, None] - row for row in (one, other)]
    first, second = (np.sign(gap) * (np.abs(gap) > TIE) for gap in gaps)
    untied = math.sqrt((first**2).sum() * (second**2).sum())
    return float((first * second).sum() / untied) if untied else math.nan
