"""A macrostate machine with its ends, as arrays: what factor graphs and the cost of learning are computed from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats, Rules, State

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Class = tuple[float, bool, bool]
"""What a macro-action gave: the reward, whether the episode ended, whether as a success."""


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Every macro-action out of every macrostate of play that is reached from the starts, and each of its outcomes.

    Shapes: ``S`` macrostates, those of play first, ``P`` of play, ``A`` actions, ``N`` outcomes, ``M`` coordinates.
    """

    coordinates: Ints  #: Shape (S, M).
    n_play: int  #: P
    n_actions: int  #: A
    starts: Ints  #: Rows an episode may start in.
    classes: tuple[Class, ...]
    pair: Ints  #: ``action * P + row`` of each outcome, ascending. Shape (N,).
    after: Ints  #: Row of its macrostate. Shape (N,).
    probability: Floats  #: Shape (N,).
    class_: Ints  #: Index in ``classes``. Shape (N,).

    @property
    def action(self) -> Ints:
        """The action of each outcome. Shape (N,)."""
        return self.pair // self.n_play

    @property
    def before(self) -> Ints:
        """The row that each outcome comes from. Shape (N,)."""
        return self.pair % self.n_play


def machine(rules: Rules) -> Machine:
    """Follow the rules from their starts."""
    index = {state: row for row, state in enumerate(dict.fromkeys(rules.start_states))}
    play: list[State] = list(index)
    ends: dict[State, int] = {}
    classes: dict[Class, int] = {}
    rows: list[tuple[int, int, State, float, int]] = []
    for row, state in enumerate(play):  # grows
        for action in range(rules.n_actions):
            for o in rules.outcomes(state, action):
                kind = classes.setdefault((o.reward, o.terminated, o.success), len(classes))
                rows.append((action, row, o.macrostate, o.probability, kind))
                if not o.terminated and o.macrostate not in index:
                    index[o.macrostate] = len(play)
                    play.append(o.macrostate)
    for _, _, after, _, _ in rows:
        if after not in index:
            ends.setdefault(after, len(play) + len(ends))
    index.update(ends)
    action_of = np.array([each[0] for each in rows])
    pair = action_of * len(play) + np.array([each[1] for each in rows])
    order = np.argsort(pair, kind="stable")
    return Machine(
        coordinates=np.array([*play, *ends], dtype=np.int64),
        n_play=len(play),
        n_actions=rules.n_actions,
        starts=np.array([index[state] for state in rules.start_states]),
        classes=tuple(classes),
        pair=pair[order],
        after=np.array([index[each[2]] for each in rows])[order],
        probability=np.array([each[3] for each in rows])[order],
        class_=np.array([each[4] for each in rows])[order],
    )
