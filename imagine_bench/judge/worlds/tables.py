"""The outcomes of every single macro-action as one table, and worlds that differ from it in one rule.

A world model and the rules fill the same kind of table, and every question about the whole world is answered from it:
with the rules' table exactly, with a model's table as that model would answer.

Shapes: ``S`` macrostates in which an episode goes on, ``A`` macro-actions, ``F`` frames of each macrostate, ``T``
macrostates, of which the first S are those; ``N`` transitions or questions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from imagine_bench.arrays import Floats, Ints, State
from imagine_bench.exact.changed_rules import SLIP
from imagine_bench.exact.values import TIE
from imagine_bench.rules import Rules, every_outcome

LIKELY = 0.5  # probability from which something counts as reached


@dataclass(frozen=True, kw_only=True)
class TransitionTable:
    """Probabilities of the next macrostate."""

    #: By macrostate, macro-action and the frame that was shown; the last column is of whatever is none of the T
    #: macrostates. Shape (S, A, F, T + 1).
    by_frame: Floats
    #: Futures that were drawn for each; 0 where probabilities are given. Shape (S, A, F).
    drawn: Ints

    @cached_property
    def mean(self) -> Floats:
        """The mean over frames. Shape (S, A, T + 1)."""
        return self.by_frame.mean(axis=2)


@dataclass(frozen=True, kw_only=True)
class Transitions:
    """Single macro-actions that were carried out; all arrays have one shape."""

    states: Ints  #: rows of S
    actions: Ints  #: in [0, A)
    frames: Ints  #: which frame of the macrostate was shown, in [0, F)
    reached: Ints  #: rows of T


ChangedWorld = Callable[[TransitionTable, Transitions], Floats]
"""The distribution of the next macrostate of each transition in some world. Shape (N, T + 1)."""


def exact_table(rules: Rules, states: tuple[State, ...], frames: int) -> tuple[tuple[State, ...], TransitionTable]:
    """The rules as a table.

    Args:
        rules: The rules.
        states: The macrostates in which an episode goes on. Length S.
        frames: F.

    Returns:
        All macrostates, those of ``states`` first and behind them the others that are reached, and the table.
    """
    found = every_outcome(states, rules.n_actions, rules.outcomes, follow=False)
    shares = np.zeros((len(states), rules.n_actions, len(found.index) + 1))
    np.add.at(shares, (found.before, found.action, found.after), found.probability)
    return tuple(found.index), _of_all_frames(shares, frames)


def copying_table(like: TransitionTable) -> TransitionTable:
    """The table of a model that says that nothing ever changes."""
    n_states, n_actions, frames, columns = like.by_frame.shape
    stays = np.eye(n_states, columns)[:, None].repeat(n_actions, axis=1)
    return _of_all_frames(stays, frames)


def _of_all_frames(shares: Floats, frames: int) -> TransitionTable:
    by_frame = shares[:, :, None].repeat(frames, axis=2)
    return TransitionTable(by_frame=by_frame, drawn=np.zeros(by_frame.shape[:3], dtype=np.int64))


# Worlds ------------------------------------------------------------------------------------------------------------


def usual(table: TransitionTable, asked: Transitions) -> Floats:
    """The world of the table."""
    return table.by_frame[asked.states, asked.actions, asked.frames]


def with_slips(table: TransitionTable, asked: Transitions) -> Floats:
    """Every macro-action does nothing with probability :data:`.exact.changed_rules.SLIP`."""
    found = (1.0 - SLIP) * usual(table, asked)
    np.put_along_axis(found, asked.states[..., None], SLIP + _at(found, asked.states)[..., None], axis=-1)
    return found


def other_action(table: TransitionTable, asked: Transitions) -> Floats:
    """Another macro-action than the one that is named was carried out, any of them equally likely."""
    every = table.by_frame[asked.states, :, asked.frames]
    named = usual(table, asked)
    return (every.sum(axis=-2) - named) / (every.shape[-2] - 1)


def with_coupling(one: int, other: int) -> ChangedWorld:
    """Macro-action ``one`` also has the effect of ``other``, unless it ends the episode."""

    def outcomes(table: TransitionTable, asked: Transitions) -> Floats:
        found = usual(table, asked).copy()
        changed = asked.actions == one
        found[changed] = found[changed] @ _onward(table, other)
        return found

    return outcomes


def coupled_pair(table: TransitionTable) -> tuple[int, int]:
    """The pair of macro-actions that, one with the effect of the other, leads elsewhere from most macrostates."""
    n_states, n_actions = table.by_frame.shape[:2]
    stays = np.eye(n_states, table.by_frame.shape[3]) > 0.0
    best = (0, 0)
    most = -1
    for other in range(n_actions):
        both = table.mean[:, :, :n_states] @ table.mean[:, other]  # [S, A, T + 1]
        both[:, :, n_states:] += table.mean[:, :, n_states:]
        for one in range(n_actions):
            alone = (table.mean[:, one] > 0.0) | (table.mean[:, other] > 0.0) | stays
            elsewhere = int((~((both[:, one] > 0.0) & alone).any(axis=1)).sum())
            if one != other and elsewhere > most:
                best = (one, other)
                most = elsewhere
    return best


def _onward(table: TransitionTable, action: int) -> Floats:
    """Where a macro-action leads from each column; where no episode goes on, nothing changes. Shape (T + 1, T + 1)."""
    found = np.eye(table.by_frame.shape[3])
    found[: len(table.mean)] = table.mean[:, action]
    return found


# Probabilities -----------------------------------------------------------------------------------------------------


def likelihood(table: TransitionTable, asked: Transitions, world: ChangedWorld = usual) -> Floats:
    """The probability of each transition in a world.

    Of futures that were drawn only shares are known: a macrostate that none of S futures shows is not impossible. One
    more future is spread evenly over all macrostates. Given probabilities are taken as they are.
    """
    shares = _at(world(table, asked), asked.reached)
    drawn = table.drawn[asked.states, asked.actions, asked.frames]
    smoothed = (drawn * shares + 1.0 / table.by_frame.shape[3]) / (drawn + 1.0)
    return np.where(drawn > 0, smoothed, shares)


def drawn_from(world: ChangedWorld, table: TransitionTable, asked: Transitions, rng: np.random.Generator) -> Ints:
    """Rows of macrostates that are drawn as the next ones, one for each transition."""
    ends = world(table, asked).cumsum(axis=-1)
    chosen = rng.random(asked.states.shape)[..., None] * ends[..., -1:]
    return (ends <= chosen).sum(axis=-1)


def reaching(table: TransitionTable, goals: Ints, depth: int) -> Floats:
    """The best probability that a goal has come up within 1 to D macro-actions. Shape (D, S, G).

    It is that of the best policy for each goal, which looks at every macrostate on the way. Where no episode goes on
    nothing else comes up.
    """
    n_states, n_actions, columns = table.mean.shape
    outcomes = table.mean.reshape(-1, columns)
    each = np.arange(len(goals))
    values = np.zeros((columns, len(goals)))
    found = np.empty((depth, n_states, len(goals)))
    for step in range(depth):
        values[goals, each] = 1.0
        found[step] = (outcomes @ values).reshape(n_states, n_actions, -1).max(axis=1)
        values[:n_states] = found[step]
    return found


def fewest(reached: Floats) -> Ints:
    """The fewest macro-actions, of (D, ...) probabilities, after which one is likely; 0 where none is. Shape (...)."""
    likely = reached >= LIKELY - TIE
    return np.where(likely.any(axis=0), 1 + likely.argmax(axis=0), 0)


def normalised(weights: Floats) -> Floats:
    """Probabilities in proportion to weights (..., C); equal ones where all are 0."""
    total = weights.sum(axis=-1, keepdims=True)
    even = 1.0 / weights.shape[-1]
    return np.where(total > 0.0, weights / np.where(total > 0.0, total, 1.0), even)


def _at(shares: Floats, columns: Ints) -> Floats:
    """The share of one column of each row of (..., T + 1). Shape (...)."""
    return np.take_along_axis(shares, columns[..., None], axis=-1)[..., 0]
