"""The world model: dynamics and outcomes together, their predictions, and how much of these is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from imagine_bench.arrays import Floats

from .dynamics import Dynamics
from .factors import Code, Codes, CodeTransition, Memory, contradictions, remembering
from .outcomes import OutcomeModel
from .settings import FactoredSettings, LearnedSettings

_LEAST = 1e-3
"""No transition counts as less probable where models are compared."""
_ROUNDING = 1e-9
_FEWEST = 3
"""Values of a factor worth remembering: one that tells nothing, and two to tell apart."""
_NONE_SEEN = 1e6
"""Pseudo-count beside which no transition counts that was seen: it would explain a part of the same that a memory
explains.
"""


class Moves(NamedTuple):
    """Where actions would lead from N codes, as far as dynamics alone say; B branches each."""

    following: Codes  #: next codes. Shape (N, A, B, P).
    chance: Floats  #: probability of each branch. Shape (N, A, B).
    known: Floats  #: probability that nothing untested decides. Shape (N, A).


class Results(NamedTuple):
    """The results of these moves."""

    p_continues: Floats  #: probability that this branch comes about and the episode goes on. Shape (N, A, B).
    reward: Floats  #: expected reward. Shape (N, A), as of all that follow.
    p_terminated: Floats  #: probability that the episode ends
    unknown: Floats  #: probability that something untested decides the outcome


class FactoredModel:
    """Learns from transitions between codes and predicts them; ``sizes`` are the numbers of values of the P factors.

    With a ``memory`` the last factor is its memory of the others, which follows from their next values.
    """

    def __init__(
        self, sizes: tuple[int, ...], n_actions: int, settings: FactoredSettings, memory: Memory | None = None
    ) -> None:
        self.n_actions = n_actions
        self.sizes = sizes
        self.memory = memory
        self._planning = settings.planning
        self._moving = len(sizes) - (memory is not None)
        self.dynamics = Dynamics(sizes, n_actions, settings.dynamics, self._moving)
        self.outcomes = OutcomeModel(sizes, n_actions, settings.outcomes)

    def add(self, row: CodeTransition) -> None:
        """Take in a clear transition, as far as it shows the order of codes and their rewards; no other."""
        if not row.is_clear:
            return
        if row.has_dynamics:
            self.dynamics.add(np.array(row.code), row.action, np.array(row.following[: self._moving]))
        if row.has_reward:
            self.outcomes.add(row)
        if row.is_first:
            self.outcomes.add_start(row.code)

    def probabilities(self, rows: Sequence[CodeTransition]) -> tuple[Floats, Floats]:
        """Return the predicted probability of each of N transitions, and how much about it is unknown: (N,) and (N,).

        A transition whose outcome was never seen has probability 0 and is wholly unknown.
        """
        causes = self.outcomes.causes
        if causes is None or not rows:
            return np.zeros(len(rows)), np.ones(len(rows))
        codes, actions, following = (np.array([row[column] for row in rows]) for column in range(3))
        places = {outcome: place for place, outcome in enumerate(causes.outcomes)}
        outcome = np.array([places.get((row.reward, row.terminated), -1) for row in rows])
        each = np.arange(len(rows))
        brought, untested = self.outcomes.predict(codes, actions, following)
        moved = np.ones(len(rows))
        known = np.ones(len(rows))
        for factor, predicted in enumerate(self.dynamics.predict(codes)):
            moved = moved * predicted.expected[each, actions, following[:, factor]]
            known = known * (1.0 - predicted.unknown[each, actions])
        seen = outcome >= 0
        probability = np.where(seen, moved * brought[each, outcome], 0.0)
        return probability, np.where(seen, 1.0 - (1.0 - untested) * known, 1.0)

    def moves(self, codes: Codes) -> Moves:
        """Where each action would lead from ``codes`` (N, P)."""
        factors = self.dynamics.predict(codes)
        chance, following = self._branches([factor.expected for factor in factors])
        if self.memory is not None:
            before = np.broadcast_to(codes[:, None, None, -1], chance.shape)
            following = np.concatenate([following, self.memory.all_after(before, following)[..., None]], axis=-1)
        known = np.prod([1.0 - factor.unknown for factor in factors], axis=0)
        return Moves(following, chance, known)

    def results(self, codes: Codes, moves: Moves) -> Results:
        """The results of the moves of every action from ``codes`` (N, P)."""
        chance = moves.chance
        reward = np.zeros(chance.shape)
        ends = np.zeros(chance.shape)
        untested = np.zeros(chance.shape)
        count, action, branch = comes = np.nonzero(chance)
        outcomes, untested[comes] = self.outcomes.predict(codes[count], action, moves.following[count, action, branch])
        reward[comes] = (outcomes * self.outcomes.rewards).sum(axis=1)
        ends[comes] = (outcomes * self.outcomes.ends).sum(axis=1)
        return Results(
            p_continues=chance * (1.0 - ends),
            reward=(chance * reward).sum(axis=2),
            p_terminated=(chance * ends).sum(axis=2),
            unknown=1.0 - moves.known * (1.0 - (chance * untested).sum(axis=2)),
        )

    def likeliest(self, codes: Codes) -> tuple[Codes, Floats]:
        """Where every action most probably leads from ``codes`` (N, P), and how probably: (N, A, P) and (N, A).

        For an action of which nothing is known the probability is 0: a prior for staying is no knowledge.
        """
        factors = self.dynamics.predict(codes)
        following = np.stack([factor.expected.argmax(axis=2) for factor in factors], axis=2)
        sure = np.prod([factor.expected.max(axis=2) for factor in factors], axis=0)
        nothing = 1.0 - self.dynamics.settings.persistence - _ROUNDING
        untried = np.all([factor.unknown > nothing for factor in factors], axis=0)
        return following, np.where(untried, 0.0, sure)

    def untested(self, codes: Codes, following: Codes) -> Floats:
        """P(something untested decides the steps from ``codes`` (N, P) to codes (N, A, P)). Shape (N, A)."""
        count, actions, factors = following.shape
        before = np.repeat(codes, actions, axis=0)
        after = following.reshape(-1, factors)
        return self.outcomes.predict(before, np.tile(np.arange(actions), count), after)[1].reshape(count, actions)

    def sample(self, code: Code, action: int, rng: np.random.Generator) -> tuple[Code, float]:
        """Draw one next code of ``action`` in ``code`` as it was seen to happen; as expected where it never was.

        Returns the code, and the probability of the likeliest one.
        """
        following = []
        p_likeliest = 1.0
        for factor in self.dynamics.factors:
            (chance,), _ = factor.happens(np.array([code]), np.array([action]))
            following.append(int(rng.choice(len(chance), p=chance)))
            p_likeliest *= float(chance.max())
        if self.memory is not None:
            following.append(self.memory.after(code[-1], tuple(following)))
        return tuple(following), p_likeliest

    def _branches(self, factors: list[Floats]) -> tuple[Floats, Codes]:
        """The likeliest joint values of factors (N, A, K) each: probabilities (N, A, B) and codes (N, A, B, P)."""
        count, actions = factors[0].shape[:2]
        most = self._planning.branches
        pairs = np.arange(count * actions)[:, None]
        chance = np.ones((len(pairs), 1))
        numbers = np.zeros((len(pairs), 1), dtype=np.int64)
        for factor in factors:
            values = factor.shape[2]
            ways = chance.shape[1]
            joint = (chance[:, :, None] * factor.reshape(-1, 1, values)).reshape(len(pairs), -1)
            order = np.argsort(-joint, axis=1, kind="stable")[:, :most]
            chance = joint.ravel()[order + pairs * joint.shape[1]]
            before, value = np.divmod(order, values)
            numbers = numbers.ravel()[before + pairs * ways] * values + value
        spare = ((0, 0), (0, most - chance.shape[1]))
        shape = (count, actions, most)
        least = np.minimum(self._planning.least_probability, chance.max(axis=1, keepdims=True))
        chance = np.pad(np.where(chance < least, 0.0, chance), spare)
        codes = np.stack(np.unravel_index(np.pad(numbers, spare), self.sizes[: self._moving]), axis=-1)
        return (chance / chance.sum(axis=1, keepdims=True)).reshape(shape), codes.reshape(*shape, -1)


def choose(
    rows: Sequence[CodeTransition],
    begins: Sequence[bool],
    sizes: tuple[int, ...],
    n_actions: int,
    settings: LearnedSettings,
) -> Memory | None:
    """The memory that explains transitions between codes best; None unless it does so much better than none.

    Which factor is remembered, and which of its values tells nothing, is learned: where the same code and action have
    brought different outcomes, every such memory is tried. The model that is learned with it from every second episode
    predicts the others, and these the first. ``begins`` tells which transitions are the first of an episode.
    """
    if not contradictions(rows):
        return None
    half = np.cumsum(begins) % 2 == 0  # every second episode
    causes_alone = replace(settings, outcomes=replace(settings.outcomes, pseudo_seen=_NONE_SEEN, choice_decay=1.0))
    candidates = [Memory(f, hidden) for f, size in enumerate(sizes) if size >= _FEWEST for hidden in range(size)]
    likelihood: dict[Memory | None, float] = {}
    for memory in (None, *candidates):
        remembered = remembering(rows, begins, memory)
        of_codes = sizes if memory is None else (*sizes, sizes[memory.factor])
        likelihood[memory] = 0.0
        for learned in (half, ~half):
            model = FactoredModel(of_codes, n_actions, causes_alone, memory)
            for row in compress(remembered, learned):
                model.add(row)
            model.outcomes.fit()
            others = [row for row in compress(remembered, ~learned) if row.is_clear]
            chance, _ = model.probabilities(others)
            likelihood[memory] += float(np.log(np.maximum(chance, _LEAST)).sum())
    best = max(likelihood, key=lambda memory: likelihood[memory])
    return best if likelihood[best] > likelihood[None] + settings.memory_evidence else None
