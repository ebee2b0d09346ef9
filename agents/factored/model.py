"""The world model: dynamics and outcomes together, what they imagine, and how much of it is unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .dynamics import Codes, Dynamics
from .experience import CodeTransition
from .outcomes import Floats, Outcomes
from .settings import ImagineSettings


@dataclass(frozen=True, slots=True)
class Futures:
    """What every action would lead to from N codes; B branches each.

    Attributes:
        following: Next codes. Shape (N, A, B, P).
        goes_on: Probability that this branch comes about and the episode goes on. Shape (N, A, B).
        reward: Expected reward. Shape (N, A).
        terminates: Probability that the episode ends. Shape (N, A).
        unknown: Probability that something untested decides what happens. Shape (N, A).
    """

    following: Codes
    goes_on: Floats
    reward: Floats
    terminates: Floats
    unknown: Floats


class StructuredModel:
    """Learns from transitions between codes and imagines their futures.

    Args:
        sizes: Values of each of the P parts.
        n_actions: A.
        settings: Priors, and how many branches are imagined.
    """

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: ImagineSettings) -> None:
        self.sizes, self.n_actions, self._planning = sizes, n_actions, settings.planning
        self.dynamics = Dynamics(sizes, n_actions, settings.dynamics)
        self.outcomes = Outcomes(sizes, n_actions, settings.outcomes)

    def add(self, row: CodeTransition) -> None:
        """Take in one transition, as far as it shows what follows what and what it brings."""
        if row.moves:
            self.dynamics.add(as_codes(row.code), row.action, as_codes(row.following))
        if row.pays:
            self.outcomes.add(row)

    def reset_for_new_task(self) -> None:
        """Keep the dynamics; begin the outcomes anew, with hints."""
        self.outcomes.reset_for_new_task()

    def expected(self, row: CodeTransition) -> tuple[float, float]:
        """How probable a transition is held to be, and how much about it is unknown."""
        code, action, following = as_codes(row.code), row.action, as_codes(row.following)
        kind = (row.reward, row.terminated)
        causes = self.outcomes.causes
        if causes is None or kind not in causes.kinds:
            return 0.0, 1.0
        parts = self.dynamics.predict(code[None])
        moved = float(np.prod([part.expected[0, action, value] for part, value in zip(parts, following, strict=True)]))
        outcome, doubt = self.outcomes.predict(code[None], np.array([action]), following[None])
        unknown = 1.0 - (1.0 - doubt[0]) * np.prod([1.0 - part.unknown[0, action] for part in parts])
        return moved * float(outcome[0, causes.kinds.index(kind)]), float(unknown)

    def futures(self, codes: Codes) -> Futures:
        """What every action would lead to from ``codes`` (N, P)."""
        parts = self.dynamics.predict(codes)
        chance, following = self._branches([part.expected for part in parts])
        shape = chance.shape
        start = np.repeat(codes, shape[1] * shape[2], axis=0)
        actions = np.tile(np.repeat(np.arange(shape[1]), shape[2]), shape[0])
        outcome, doubt = self.outcomes.predict(start, actions, following.reshape(-1, following.shape[-1]))
        reward = (outcome * self.outcomes.rewards).sum(axis=1).reshape(shape)
        ends = (outcome * self.outcomes.ends).sum(axis=1).reshape(shape)
        moves = np.prod([1.0 - part.unknown for part in parts], axis=0)  # [N, A]
        known = moves * (1.0 - (chance * doubt.reshape(shape)).sum(axis=2))
        return Futures(
            following=following,
            goes_on=chance * (1.0 - ends),
            reward=(chance * reward).sum(axis=2),
            terminates=(chance * ends).sum(axis=2),
            unknown=1.0 - known,
        )

    def sample(self, code: Codes, action: int, rng: np.random.Generator) -> tuple[Codes, float]:
        """Imagine one next code of ``action`` in ``code`` (P,) as it was seen to happen; expected where it never was.

        Returns:
            The code, and the probability of the likeliest one.
        """
        following, sure = np.empty_like(code), 1.0
        for index, part in enumerate(self.dynamics.predict(code[None])):
            seen = part.seen[0, action]
            chance = seen if seen.sum() > part.unknown[0, action] else part.expected[0, action]
            chance = chance / chance.sum()
            following[index] = rng.choice(len(chance), p=chance)
            sure *= float(chance.max())
        return following, sure

    def _branches(self, parts: list[Floats]) -> tuple[Floats, Codes]:
        """The likeliest joint values of parts (N, A, K) each: probabilities (N, A, B) and codes (N, A, B, P)."""
        count, actions = parts[0].shape[:2]
        most = self._planning.branches
        chance, codes = np.ones((count, actions, 1)), np.zeros((count, actions, 1, 0), dtype=np.int64)
        for part in parts:
            values = part.shape[2]
            joint = (chance[..., :, None] * part[:, :, None, :]).reshape(count, actions, -1)
            value = np.broadcast_to(np.tile(np.arange(values), chance.shape[2])[:, None], (*joint.shape, 1))
            codes = np.concatenate([np.repeat(codes, values, axis=2), value], axis=3)
            order = np.argsort(-joint, axis=2, kind="stable")[:, :, :most]
            chance, codes = (
                np.take_along_axis(joint, order, axis=2),
                np.take_along_axis(codes, order[..., None], axis=2),
            )
        spare = most - chance.shape[2]
        chance = np.pad(chance, ((0, 0), (0, 0), (0, spare)))
        codes = np.pad(codes, ((0, 0), (0, 0), (0, spare), (0, 0)))
        least = np.minimum(self._planning.least_probability, chance.max(axis=2, keepdims=True))
        chance = np.where(chance < least, 0.0, chance)
        return chance / chance.sum(axis=2, keepdims=True), codes


def as_codes(code: tuple[int, ...]) -> NDArray[np.int64]:
    """A code as an array (P,)."""
    return np.array(code, dtype=np.int64)
