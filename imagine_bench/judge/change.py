"""Does a model notice that a rule changed, and does it know the outcome of another macro-action?

A change is noticed by the model's surprise, the negative logarithm of the probability that it gives to the next frame,
as its images are read. A CUSUM detector (Page, 1954) adds up how far surprise lies above its usual level and says so
above a threshold. Level and threshold come from streams of transitions of the unchanged world: of those, 1 % may raise
an alarm. A model's prediction of a transition does not depend on the world, so the predictions of single transitions
serve every stream.

Shapes: ``R`` streams of ``T`` transitions, ``S`` macrostates, ``A`` macro-actions, ``B`` branches.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from imagine_bench.arrays import Floats, Ints, State
from imagine_bench.exact.changed_rules import coupled, slipping
from imagine_bench.exact.values import branches
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.predictions import Predictions
from imagine_bench.judge.questions import FRAMES, EvalSet
from imagine_bench.judge.truth import added_up
from imagine_bench.rules import Dynamics
from imagine_bench.seeding import SeedTree

STREAMS = 1_000  # streams of random macro-actions of each world
LENGTH = 200  # transitions of each
FALSE_ALARMS = 0.01  # share of streams of the unchanged world that may raise an alarm
_ALLOWANCE = 0.5  # standard deviations above its mean that surprise may have
_LEAST = 0.01  # probability below which nothing is more surprising
_SLIVER = 1e-9  # of probability, which rounding may leave


@dataclass(frozen=True, kw_only=True)
class Streams:
    """Transitions of one world, as rows of the questions about single ones, and their results."""

    rows: Ints  #: shape (R, T)
    reached: Ints  #: index of the next macrostate. Shape (R, T).
    states: tuple[State, ...]  #: the macrostates that are reached, by index


def streams_of(spec: TaskSpec, questions: EvalSet) -> dict[str, Streams] | None:
    """Streams of the usual world, and of those with one rule changed; None where not all of the world is asked about.

    The macro-actions are random, and so is the frame of each macrostate.
    """
    rules = spec.rules
    states = questions.macrostates
    going_on = {o.macrostate for pair in questions.pairs for o in rules.outcomes(*pair) if not o.terminated}
    if not going_on | {*rules.start_states} <= set(states):
        return None
    seeds = SeedTree(0).child("evaluation", "judge", "change", spec.id)
    dynamics = {"usual": rules.outcomes, "slip": slipping(rules), "coupling": coupled(rules, states)}
    return {name: _walked(spec, states, each, seeds.child(name).generator()) for name, each in dynamics.items()}


def _walked(spec: TaskSpec, states: Sequence[State], dynamics: Dynamics, rng: np.random.Generator) -> Streams:
    """Random walks; a step out of these macrostates ends an episode."""
    n_actions = spec.n_actions
    found = branches(states, n_actions, dynamics)
    upto = found.probability.cumsum(axis=2)
    upto[upto > 1.0 - _SLIVER] = 1.0
    over = found.terminated | (found.following >= len(states))
    starts = np.array([states.index(state) for state in spec.rules.start_states])
    rows = np.zeros((STREAMS, LENGTH), dtype=np.int64)
    reached = np.zeros_like(rows)
    now = rng.choice(starts, STREAMS)
    done = np.zeros(STREAMS, dtype=np.int64)
    for step in range(LENGTH):
        chosen = rng.integers(n_actions, size=STREAMS)
        branch = (upto[now, chosen] <= rng.random((STREAMS, 1))).sum(axis=1)
        rows[:, step] = (now * n_actions + chosen) * FRAMES + rng.integers(FRAMES, size=STREAMS)
        reached[:, step] = found.following[now, chosen, branch]
        done += 1
        ended = over[now, chosen, branch] | (done == spec.horizon)
        now = np.where(ended, rng.choice(starts, STREAMS), reached[:, step])
        done = np.where(ended, 0, done)
    return Streams(rows=rows, reached=reached, states=found.states)


def change_detection_delay(streams: Mapping[str, Streams] | None, predictions: Predictions) -> dict[str, float]:
    """Mean transitions until a change is noticed, :data:`LENGTH` of a stream in which it is not; NaN without streams.

    The world has changed from the first transition on.
    """
    names = ("notice_slip", "notice_coupling")
    if streams is None:
        return dict.fromkeys(names, math.nan)
    found = alarms([streams[name] for name in ("usual", "slip", "coupling")], predictions)
    return dict(zip(names, np.minimum(found[1:], LENGTH).mean(axis=1).tolist(), strict=True))


def alarms(streams: Sequence[Streams], predictions: Predictions) -> Ints:
    """Transitions until the first alarm, more than :data:`LENGTH` where there is none. Shape (W, R) for W worlds.

    Level and threshold are those of the first of ``streams``.
    """
    surprise = np.stack([_surprise(each, predictions) for each in streams])  # [W, R, T]
    level = float(surprise[0].mean())
    spread = max(float(surprise[0].std()), _LEAST)
    evidence = np.zeros((len(streams), STREAMS, 1 + LENGTH))
    for step in range(LENGTH):
        so_far = evidence[..., step] + (surprise[..., step] - level) / spread - _ALLOWANCE
        evidence[..., step + 1] = np.maximum(0.0, so_far)
    threshold = np.quantile(evidence[0].max(axis=1), 1.0 - FALSE_ALARMS, method="higher")
    raised = evidence > threshold
    return np.where(raised.any(axis=2), raised.argmax(axis=2), LENGTH + 1)


def _surprise(streams: Streams, predictions: Predictions) -> Floats:
    """Of every transition, in nats. Shape (R, T)."""
    index = {state: row for row, state in enumerate(streams.states)}
    likely = np.zeros((len(predictions.states), len(index)))
    for row in range(len(likely)):
        for state, share in predictions.distribution(row, 0).items():
            if state in index:
                likely[row, index[state]] = share
    return -np.log(np.maximum(likely, _LEAST))[streams.rows, streams.reached]


def counterfactual_error(asked: Sequence[EvalSet], predictions: Sequence[Predictions]) -> float:
    """How much of a model's imagination of one macro-action is impossible, given its imagination of another.

    ``asked`` has the same macrostates for each macro-action, and the model imagined each with equal draws. In the truth
    equal draws are equal uniform numbers, which choose among the outcomes in the order of the rules.
    """
    wrong = []
    for one, other in itertools.combinations(range(len(asked)), 2):
        for row in range(len(asked[one].states)):
            real = [asked[action].truth[row][0] for action in (one, other)]
            possible = joint_outcomes(*([(state, p) for (state, _), (p, _) in each.items()] for each in real))
            imagined = joint_outcomes(*(predictions[action].futures(row, 0) for action in (one, other)))
            wrong.append(sum(share for pair, share in imagined.items() if pair not in possible))
    return float(np.mean(wrong)) if wrong else math.nan


def joint_outcomes(
    one: Sequence[tuple[State, float]], other: Sequence[tuple[State, float]]
) -> dict[tuple[State, State], float]:
    """Probabilities of pairs where one uniform number chooses from both distributions, each in its order."""
    ends = [np.cumsum([share for _, share in each]) for each in (one, other)]
    found = []
    at = 0.0
    for upto in np.unique(np.concatenate(ends)).tolist():
        row, column = (int(np.searchsorted(each, upto)) for each in ends)
        if upto - at > _SLIVER and row < len(one) and column < len(other):
            found.append(((one[row][0], other[column][0]), upto - at))
        at = upto
    return added_up(found)
