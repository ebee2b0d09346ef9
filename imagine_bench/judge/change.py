"""Does a model notice that a rule changed, and does it know what another macro-action would have led to?

A change is noticed by the model's surprise, the negative logarithm of the probability that it gives to what came, as
its images are read. A CUSUM detector (Page, 1954) adds up how far surprise lies above its usual level and says so
above a threshold. Level and threshold come from streams of transitions of the unchanged world: of those, 1 % may raise
an alarm. A model's prediction of a transition does not depend on the world, so the predictions of single transitions
serve every stream.

Shapes: ``R`` streams of ``T`` transitions, ``S`` macrostates, ``A`` macro-actions, ``B`` branches.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats, Rules, State, TaskSpec
from imagine_bench.judge.predictions import Predictions
from imagine_bench.judge.questions import FRAMES, EvalSet
from imagine_bench.seeding import SeedTree

STREAMS = 1_000  # streams of random macro-actions of each world
LENGTH = 200  # transitions of each
SLIP = 0.2  # probability that a macro-action does nothing in the world that slips
FALSE_ALARMS = 0.01  # share of streams of the unchanged world that may raise an alarm
_ALLOWANCE = 0.5  # standard deviations above its mean that surprise may have
_LEAST = 0.01  # probability below which nothing is more surprising
_SLIVER = 1e-9  # of probability, which rounding may leave

Effect = tuple[float, State, bool]
"""Probability, next macrostate, and whether the episode ends there."""
Dynamics = Callable[[State, int], Sequence[Effect]]


@dataclass(frozen=True, kw_only=True)
class Streams:
    """Transitions of one world, as rows of the questions about single ones, and what came of them."""

    rows: NDArray[np.int64]  #: shape (R, T)
    reached: NDArray[np.int64]  #: index of the next macrostate. Shape (R, T).
    states: tuple[State, ...]  #: what is reached, by index


def unchanged(rules: Rules) -> Dynamics:
    """The rules as they are."""
    return lambda state, action: [(o.probability, o.macrostate, o.terminated) for o in rules.outcomes(state, action)]


def slipping(rules: Rules) -> Dynamics:
    """Every macro-action does nothing with probability :data:`SLIP`."""
    usual = unchanged(rules)

    def dynamics(state: State, action: int) -> list[Effect]:
        moved = [((1.0 - SLIP) * share, after, ends) for share, after, ends in usual(state, action)]
        return [*moved, (SLIP, state, False)]

    return dynamics


def coupled(rules: Rules, states: Sequence[State]) -> Dynamics:
    """One macro-action also does what another does: the pair that leads elsewhere in most macrostates."""
    usual = unchanged(rules)

    def both(state: State, first: int, then: int) -> list[Effect]:
        after = [(p * q, end) for p, middle, _ in usual(state, first) for q, end, _ in usual(middle, then)]
        return [(share, end, rules.judge(state, first, end).terminated) for share, end in after]

    def elsewhere(first: int, then: int) -> int:
        known = [{state, *(end for action in (first, then) for _, end, _ in usual(state, action))} for state in states]
        found = [{end for _, end, _ in both(state, first, then)} for state in states]
        return sum(found_.isdisjoint(known_) for found_, known_ in zip(found, known, strict=True))

    pairs = list(itertools.permutations(range(rules.n_actions), 2))
    one, other = max(pairs, key=lambda pair: elsewhere(*pair)) if pairs else (0, 0)
    return lambda state, action: both(state, one, other) if action == one else usual(state, action)


def streams_of(spec: TaskSpec, questions: EvalSet) -> dict[str, Streams] | None:
    """Streams of the usual world, and of those with one rule changed; None where not all of the world is asked about.

    The macro-actions are random, and so is the frame of each macrostate.
    """
    rules = spec.rules
    states = tuple(dict.fromkeys(questions.states))
    dynamics = {"usual": unchanged(rules), "slip": slipping(rules), "coupling": coupled(rules, states)}
    led_to = [o for state in states for action in range(spec.n_actions) for o in rules.outcomes(state, action)]
    if not {*rules.start_states, *(o.macrostate for o in led_to if not o.terminated)} <= set(states):
        return None
    seeds = SeedTree(0).child("evaluation", "judge", "change", spec.id)
    return {name: _walked(spec, questions, each, seeds.child(name).generator()) for name, each in dynamics.items()}


def _walked(spec: TaskSpec, questions: EvalSet, dynamics: Dynamics, rng: np.random.Generator) -> Streams:
    states = tuple(dict.fromkeys(questions.states))
    n_actions = spec.n_actions
    index = {state: row for row, state in enumerate(states)}
    effects = [[dynamics(state, action) for action in range(n_actions)] for state in states]
    shape = (len(states), n_actions, max(len(each) for row in effects for each in row))
    upto = np.ones(shape)
    following = np.zeros(shape, dtype=np.int64)
    over = np.ones(shape, dtype=np.bool_)
    for row, action in itertools.product(range(len(states)), range(n_actions)):
        each = effects[row][action]
        upto[row, action, : len(each) - 1] = np.cumsum([share for share, _, _ in each])[:-1]
        for branch, (_, after, ends) in enumerate(each):
            following[row, action, branch] = index.setdefault(after, len(index))
            over[row, action, branch] = ends or index[after] >= len(states)
    asked: dict[tuple[State, int], int] = {}
    for row, pair in enumerate(zip(questions.states, questions.first_actions, strict=True)):
        asked.setdefault(pair, row)  # the frames of a pair stand one behind another
    first = np.array([[asked[state, action] for action in range(n_actions)] for state in states])
    starts = np.array([index[state] for state in spec.rules.start_states])
    rows, reached = (np.zeros((STREAMS, LENGTH), dtype=np.int64) for _ in range(2))
    now = rng.choice(starts, STREAMS)
    done = np.zeros(STREAMS, dtype=np.int64)
    for step in range(LENGTH):
        chosen = rng.integers(n_actions, size=STREAMS)
        branch = (upto[now, chosen] <= rng.random((STREAMS, 1))).sum(axis=1)
        rows[:, step] = first[now, chosen] + rng.integers(FRAMES, size=STREAMS)
        reached[:, step] = following[now, chosen, branch]
        done += 1
        ended = over[now, chosen, branch] | (done == spec.horizon)
        now = np.where(ended, rng.choice(starts, STREAMS), reached[:, step])
        done = np.where(ended, 0, done)
    return Streams(rows=rows, reached=reached, states=tuple(index))


def change_detection_delay(streams: dict[str, Streams] | None, predictions: Predictions) -> dict[str, float]:
    """Mean transitions until a change is noticed, :data:`LENGTH` of a stream in which it is not; NaN without streams.

    The world has changed from the first transition on.
    """
    if streams is None:
        return dict.fromkeys(("notice_slip", "notice_coupling"), math.nan)
    _, *found = alarms([streams[name] for name in ("usual", "slip", "coupling")], predictions)
    means = [float(np.minimum(first, LENGTH).mean()) for first in found]
    return dict(zip(("notice_slip", "notice_coupling"), means, strict=True))


def alarms(streams: Sequence[Streams], predictions: Predictions) -> list[NDArray[np.int64]]:
    """Transitions until the first alarm of each of R streams, more than :data:`LENGTH` where there is none. Each (R,).

    Level and threshold are those of the first of ``streams``.
    """
    surprise = [_surprise(each, predictions) for each in streams]
    level = float(surprise[0].mean())
    spread = max(float(surprise[0].std()), _LEAST)
    evidence = [np.zeros(each.shape) for each in surprise]
    for each, found in zip(surprise, evidence, strict=True):
        total = np.zeros(len(each))
        for step in range(LENGTH):
            total = np.maximum(0.0, total + (each[:, step] - level) / spread - _ALLOWANCE)
            found[:, step] = total
    threshold = np.quantile(evidence[0].max(axis=1), 1.0 - FALSE_ALARMS, method="higher")
    raised = [np.pad(each > threshold, ((0, 0), (0, 1)), constant_values=True) for each in evidence]
    return [each.argmax(axis=1) + 1 for each in raised]


def _surprise(streams: Streams, predictions: Predictions) -> Floats:
    """Of every transition, in nats. Shape (R, T)."""
    codes, inverse = np.unique(streams.rows * len(streams.states) + streams.reached, return_inverse=True)
    found = [
        -math.log(max(predictions.distribution(int(row), 0).get(streams.states[state], 0.0), _LEAST))
        for row, state in zip(*np.divmod(codes, len(streams.states)), strict=True)
    ]
    return np.asarray(np.array(found)[inverse].reshape(streams.rows.shape))


def counterfactual_error(asked: Sequence[EvalSet], predictions: Sequence[Predictions]) -> float:
    """How much of what a model imagines of one macro-action cannot be where it imagines what it does of another.

    ``asked`` has the same macrostates for each macro-action, and the model imagined each with equal draws. In the truth
    equal draws are equal uniform numbers, which choose among the outcomes in the order of the rules.
    """
    wrong = []
    for one, other in itertools.combinations(range(len(asked)), 2):
        for row in range(len(asked[one].states)):
            both = [asked[index].truth[row][0] for index in (one, other)]
            possible = joint_outcomes(*([(state, share) for (state, _), (share, _) in each.items()] for each in both))
            imagined = joint_outcomes(*(_futures(predictions[index], row) for index in (one, other)))
            wrong.append(sum(share for pair, share in imagined.items() if pair not in possible))
    return float(np.mean(wrong)) if wrong else math.nan


def _futures(predictions: Predictions, row: int) -> list[tuple[State, float]]:
    states = map(tuple, predictions.states[row, :, 0].tolist())
    return list(zip(states, predictions.weights[row, :, 0].tolist(), strict=True))


def joint_outcomes(
    one: Sequence[tuple[State, float]], other: Sequence[tuple[State, float]]
) -> dict[tuple[State, State], float]:
    """Probabilities of pairs where one uniform number chooses from both distributions, each in its order."""
    found: dict[tuple[State, State], float] = {}
    ends = [np.cumsum([share for _, share in each]) for each in (one, other)]
    at = 0.0
    for upto in np.unique(np.concatenate(ends)).tolist():
        row, column = (int(np.searchsorted(each, upto)) for each in ends)
        if upto - at > _SLIVER and row < len(one) and column < len(other):
            pair = one[row][0], other[column][0]
            found[pair] = found.get(pair, 0.0) + upto - at
        at = upto
    return found
