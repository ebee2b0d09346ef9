"""The best policy with memory where frames hide something or are late: a machine of beliefs, and an agent in it.

A belief is the knowledge of an agent with memory before it acts: the distribution of the macrostate now, given every
frame and every action of the episode and that it has not ended (Kaelbling, Littman and Cassandra 1998, section 3).
Rewards are not shown. With a lag of k frames the belief is over the last k macrostates together, for the frames that
are still to come belong to them. Beliefs are a macrostate machine of their own, enumerated from the starts within the
horizon and solved as any other.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from typing import Any, cast

import numpy as np

from imagine_bench.errors import ImagineBenchError
from imagine_bench.interfaces import ObservationModel, Outcome, Rules, State, TaskSpec
from imagine_bench.rules import RuleTables, horizon_optimum, states_of_play, tabulate

Window = tuple[State, ...]
"""The macrostates whose frames are still to come, the newest last; without a lag the macrostate now."""
Belief = Any
"""``(step, ((window, probability), ...))``, sorted: macro-actions done, as far as they matter, and the possible
macrostates.
"""
_ENDED: Belief = (-1, ())
_DIGITS = 12
MOST = 60_000
"""Beliefs that are enumerated at most."""


class TooManyBeliefsError(ImagineBenchError):
    """There are too many beliefs to enumerate."""


def last_step_that_matters(sight: ObservationModel, states: Iterable[State], horizon: int) -> int:
    """The first step from which on frames show the same of a macrostate, whichever step it is."""
    states = tuple(states)
    final = [sight.seen(state, horizon) for state in states]
    for step in range(horizon - 1, -1, -1):
        if any(sight.seen(state, step) != known for state, known in zip(states, final, strict=True)):
            return step + 1
    return 0


class BeliefRules:
    """The machine of beliefs: its macrostates are :data:`Belief`, and its starts have shares of their own.

    Args:
        rules: The machine that is seen.
        sight: The content of frames.
        horizon: Macro-actions of an episode.
    """

    states = None

    def __init__(self, rules: Rules, sight: ObservationModel, horizon: int) -> None:
        self._rules = rules
        self._sight = sight
        self.n_actions = rules.n_actions
        self._horizon = horizon
        self.play = states_of_play(rules)
        """Macrostates of the seen machine that an episode may be in."""
        self._settled = last_step_that_matters(sight, self.play, horizon)
        self._met: set[Belief] = set()
        share = 1.0 / len(rules.start_states)
        #: probability and belief by the first frame
        self.starts = self._split(0, {(start,): share for start in rules.start_states}, shown_step=0)

    def tables(self) -> RuleTables | None:
        """All beliefs within the horizon as arrays; None if there are more than :data:`MOST`."""
        with suppress(TooManyBeliefsError):
            return tabulate(cast(Rules, self), depth=self._horizon)
        return None

    @property
    def start_states(self) -> tuple[Belief, ...]:
        """The possible beliefs after the first frame."""
        return tuple(belief for _, belief in self.starts.values())

    def outcomes(self, belief: Belief, action: int) -> tuple[Outcome, ...]:
        """One a frame that may follow, and one a way in which the episode may end; rewards are expected ones."""
        self._met.add(belief)
        if len(self._met) > MOST:
            raise TooManyBeliefsError(f"There are more than {MOST:,} beliefs within the horizon.")
        windows, ends, reward = self._advance(belief, action)
        total = sum(windows.values())
        return (
            *(Outcome(p, after, reward / total, False, False) for p, after in self._reach(belief, windows).values()),
            *(Outcome(p, _ENDED, reward, True, success) for (reward, success), p in ends.items()),
        )

    def follow(self, belief: Belief, action: int, shown: State) -> Belief | None:
        """The belief after an action, given the content of the next frame; None where that is impossible."""
        reached = self._reach(belief, self._advance(belief, action)[0])
        return reached.get(shown, reached.get(None, (0.0, None)))[1]

    def anything_like(self, seen: State, step: int) -> Belief:
        """Every macrostate whose frame may show this, each equally likely, as if it had stood there for long."""
        like = [s for s in self.play if any(what == seen for _, what in self._sight.seen(s, step))] or self.play
        return step, tuple(((state,) * max(self._sight.lag, 1), 1.0 / len(like)) for state in like)

    def _advance(
        self, belief: Belief, action: int
    ) -> tuple[dict[Window, float], dict[tuple[float, bool], float], float]:
        """Shares of windows where the episode goes on, of (reward, success) where it ends, and reward of the former."""
        step, windows = belief
        reached: dict[Window, float] = defaultdict(float)
        ends: dict[tuple[float, bool], float] = defaultdict(float)
        reward = 0.0
        for window, weight in windows:
            kept = window if self._sight.lag and step else ()  # of the start the frame was seen
            for outcome in self._rules.outcomes(window[-1], action):
                share = weight * outcome.probability
                if outcome.terminated:
                    ends[outcome.reward, outcome.success] += share
                else:
                    reached[(*kept, outcome.macrostate)] += share
                    reward += share * outcome.reward
        return reached, ends, reward

    def _reach(self, belief: Belief, windows: dict[Window, float]) -> dict[State | None, tuple[float, Belief]]:
        shown = belief[0] + 1 - self._sight.lag
        return self._split(belief[0] + 1, windows, shown_step=shown if shown >= 1 else None)

    def _split(
        self, step: int, windows: dict[Window, float], *, shown_step: int | None
    ) -> dict[State | None, tuple[float, Belief]]:
        """Share and belief by the content of the frame of the oldest macrostate; by None where no new frame comes."""
        groups: dict[State | None, dict[Window, float]] = {}
        for window, weight in windows.items():
            frames = ((1.0, None),) if shown_step is None else self._sight.seen(window[0], shown_step)
            kept = window[1:] if shown_step not in (None, 0) and self._sight.lag else window
            for share, what in frames:
                groups.setdefault(what, defaultdict(float))[kept] += weight * share
        step = min(step, self._settled + self._sight.lag + 1)
        return {what: (sum(group.values()), (step, _normal(group))) for what, group in groups.items()}


def _normal(group: dict[Window, float]) -> tuple[tuple[Window, float], ...]:
    total = sum(group.values())
    return tuple(sorted((window, round(weight / total, _DIGITS)) for window, weight in group.items()))


class OptimalPolicy:
    """The best agent that has memory and the rules but sees frames alone; it holds one episode.

    With more than :data:`MOST` beliefs none is solved for: it takes the action that is best in the most probable
    macrostates if all is seen from then on (Littman, Cassandra and Kaelbling 1995, QMDP).
    """

    def __init__(self, rules: Rules, sight: ObservationModel | None, horizon: int) -> None:
        self._rules = rules
        self._horizon = horizon
        self._tables = tabulate(rules)
        self._best = horizon_optimum(self._tables, horizon).actions
        self._beliefs: BeliefRules | None = None
        self._rows: dict[State, int] = {}
        if sight is not None:
            self._beliefs = BeliefRules(rules, sight, horizon)
            known = self._beliefs.tables()
            if known is not None:
                self._rows = known.index
                self._belief_best = horizon_optimum(known, horizon).actions
        self._episode: list[tuple[Belief, int]] = []
        """By step: the belief, and the action that was asked for then."""

    def __call__(self, seen: State, step: int) -> int:
        """The action after ``step`` macro-actions of an episode, each of which was asked for here, from step 0 on."""
        left = max(self._horizon - step, 1)
        if self._beliefs is None:
            row = self._tables.index.get(seen)
            return self._rules.optimal_action(seen) if row is None else int(self._best[left - 1, row])
        del self._episode[step:]
        if step == 0:
            belief = self._beliefs.starts.get(seen, (0.0, None))[1]
        else:
            belief = self._beliefs.follow(*self._episode[step - 1], seen) if step == len(self._episode) else None
        if belief is None:  # a macrostate that the rules call impossible: anything that would look so
            belief = self._beliefs.anything_like(seen, step)
        row = self._rows.get(belief)
        action = self._vote(belief, left) if row is None else int(self._belief_best[left - 1, row])
        self._episode.append((belief, action))
        return action

    def _vote(self, belief: Belief, left: int) -> int:
        votes = np.zeros(self._rules.n_actions)
        for window, weight in belief[1]:
            votes[self._best[left - 1, self._tables.index[window[-1]]]] += weight
        return int(votes.argmax())


def optimal_policy_of(spec: TaskSpec) -> Callable[[], OptimalPolicy]:
    """Makes a task's optimal policy when it is called: to enumerate beliefs takes a moment."""
    return partial(OptimalPolicy, spec.rules, spec.sight, spec.horizon)
