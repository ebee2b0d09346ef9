"""Rewards and ends of episodes: causes among conjunctions of values, and which of them are untested.

An *outcome* is a pair (reward, whether the episode ended) that was seen. One of them is the default; each other has
causes: conjunctions of a few values of the next code, or of an action and values of the code before it. Any active
cause brings its outcome about: a noisy-OR (Pearl 1988, 4.3.2), whose causes are learned by expectation maximisation
with sparse Beta priors. How likely a conjunction of each order is a cause at all is learned too (empirical Bayes), so
the agent finds out by itself which causes its task has. They are the base measure of a Dirichlet prior: the outcomes of
a transition that was seen soon weigh more. Where causes of two outcomes are active, that prevails which prevailed
before. An episode ends at none of its starts, so each is a test of the causes of ends. Learning conjunctions that
trigger effects: DOORmax (Diuk, Cohen & Littman 2008). A conjunction that no test has covered is known to be unknown
(KWIK, Li et al. 2011), and novelty counts by conjunctions rather than by whole states (width-based search, Lipovetzky &
Geffner 2012).
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Floats, Ints

from .factors import Code, CodeTransition, strides, table_size
from .settings import OutcomeSettings

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_LARGEST_TEMPLATE = 1 << 15
"""Sets of factors with more joint values are no candidates."""
_CERTAIN = 1.0 - 1e-6
_LEAST = 1e-6
_SURPRISING = 0.1
"""Probability of an end above which it is a surprise that an episode goes on."""
_ACTIVE = 0.5
"""Probability above which a cause is held to be active where causes of two outcomes are."""

Outcome = tuple[float, bool]
"""Reward, and whether the episode ended."""


class _Templates:
    """Conjunctions over T sets of factors, numbered by the values of these: one number in each set holds in a code."""

    def __init__(self, sets: list[tuple[int, ...]], sizes: tuple[int, ...], first: int) -> None:
        self.sets = [factors for factors in sets if table_size(factors, sizes) <= _LARGEST_TEMPLATE]
        self.of_each = [table_size(factors, sizes) for factors in self.sets]
        self._first = first + np.cumsum(self.of_each) - self.of_each
        self._multipliers = np.zeros((len(sizes), len(self.sets)))
        for column, factors in zip(self._multipliers.T, self.sets, strict=True):
            column[list(factors)] = strides(factors, sizes)
        self.strides = strides(range(len(sizes)), sizes)
        """Multipliers that number whole codes. Shape (P,)."""

    def numbers(self, codes: Ints) -> Ints:
        """Those that hold in codes (N, P). Shape (N, T)."""
        return np.asarray((codes @ self._multipliers).astype(np.int64) + self._first)  # floats are fast, and exact here


class Conjunctions:
    """All candidate conjunctions of factors with so many values each, numbered, in groups of one order and kind.

    Attributes:
        next: Those of values of the next code.
        choice: Those of an action and values of the code before it.
        group: Group of each, which has one order, with or without the action, ascending. Shape (J,).
        of_each: How many there are of each group. Shape (G,).
        prior: Prior probability of being a cause, a group. Shape (G,).
    """

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: OutcomeSettings) -> None:
        count = len(sizes)
        most = min(settings.order, count)
        orders = sorted({*range(1, most + 1), *([count - 1] if most > 1 else []), count})
        sets = [factors for order in orders for factors in itertools.combinations(range(count), order)]
        self.next = _Templates(sets, sizes, 0)
        with_action = [(*factors, count) for factors in [(), *sets]]
        self.choice = _Templates(with_action, (*sizes, n_actions), sum(self.next.of_each))
        kinds = [(each is self.choice, len(factors)) for each in (self.next, self.choice) for factors in each.sets]
        groups = {kind: number for number, kind in enumerate(dict.fromkeys(kinds))}
        self.group = np.repeat([groups[kind] for kind in kinds], self.next.of_each + self.choice.of_each)
        self.of_each = np.bincount(self.group)
        beyond = np.array([max(0, values - 2) for _, values in groups])
        chosen = np.array([with_action for with_action, _ in groups])
        by_kind = np.where(chosen, settings.choice_decay, 1.0)
        self.prior: Floats = settings.prior * settings.order_decay**beyond * by_kind

    def active(self, codes: Ints, actions: Ints, following: Ints) -> Ints:
        """Which conjunctions hold in transitions between codes (N, P) by actions (N,). Shape (N, templates)."""
        choices = np.column_stack([codes, actions])
        return np.concatenate([self.next.numbers(following), self.choice.numbers(choices)], axis=1)


class _Cases(NamedTuple):
    """Transitions (U,), the conjunctions that hold in any of them (M,), and which hold in which, as ones (U, M)."""

    met: Ints
    holds: csr_array
    times: Floats  #: how often each transition was seen

    def responsibility(self, strength: Floats, leak: float) -> Floats:
        """How many of the transitions each of them, so strong (M,), is held to have decided. Shape (M,)."""
        caused = 1.0 - (1.0 - leak) * np.exp(self.holds @ np.log1p(-strength))
        return strength * (self.holds.T @ (self.times / caused))


class _Evidence:
    """All distinct transitions, of which each has an outcome (U,); M conjunctions were met, T hold in each of them."""

    def __init__(self, active: Ints, outcome: Ints, count: Floats, conjunctions: Conjunctions, outcomes: int) -> None:
        from scipy.sparse import csr_array  # noqa: PLC0415 - loads for long

        held = np.bincount(active.ravel(), minlength=len(conjunctions.group)) > 0
        first = np.arange(0, active.size + 1, active.shape[1])
        place = (np.cumsum(held) - 1)[active.ravel()]
        holds = csr_array((np.ones(active.size), place, first), shape=(len(active), held.sum()))
        self.outcome = outcome
        self.all = _Cases(np.flatnonzero(held), holds, count)
        self.of: list[_Cases] = []
        """Those of each outcome; their conjunctions are numbered among those that were met."""
        for each in range(outcomes):
            own = outcome == each
            met = np.unique(holds[own].indices)
            self.of.append(_Cases(met, holds[own][:, met], count[own]))
        self.tried = np.bincount(conjunctions.group[self.all.met], minlength=len(conjunctions.prior))
        """How many were met of each group, which are in this order. Shape (G,)."""

    def tests(self, weight: Floats) -> Floats:
        """Sum of the weights (U,) of the transitions in which each conjunction holds. Shape (M,)."""
        return self.all.holds.T @ (weight * self.all.times)


class _Explanation(NamedTuple):
    """How all outcomes but a default may come about."""

    default: int
    strength: Floats  #: of the conjunctions that were met. Shape (O, M).
    prior: Floats  #: probability that one of each group is a cause. Shape (O, G).
    log_posterior: float  #: log likelihood less the cost of the causes


class Causes(NamedTuple):
    """Learned causes."""

    outcomes: tuple[Outcome, ...]  #: the outcomes they are about. Length O.
    default: int  #: index of the default outcome, which has no causes
    strength: Floats  #: probability that a conjunction brings an outcome about. Shape (O, J).
    tests: Floats  #: how often each conjunction was tested while nothing else decided. Shape (J,).
    #: Probability that an untested conjunction is a cause, a group: of an outcome without an end, and of one with it.
    #: Shape (2, G).
    cause_rate: Floats
    log_posterior: float  #: log likelihood less the cost of the causes


class OutcomeModel:
    """Predicts outcomes, of those seen so far, and names the untested causes."""

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: OutcomeSettings) -> None:
        self.settings = settings
        self.conjunctions = Conjunctions(sizes, n_actions, settings)
        self.outcomes: list[Outcome] = []
        self._earlier: dict[Outcome, Floats] = {}
        self._counts: dict[tuple[Code, int, Code, int], int] = {}
        self.starts: dict[Code, int] = {}
        """How often episodes began with each code."""
        self.causes: Causes | None = None
        self.rewards: Floats = np.zeros(0)
        """Reward of each outcome that causes were learned of. Shape (O,)."""
        self.ends: Floats = np.zeros(0)
        """1 for each of them that ends the episode, else 0. Shape (O,)."""
        self._going_on: set[float] = set()
        """Numbers of codes in which the present episode went on."""

    def add(self, row: CodeTransition) -> None:
        """Take in one transition; :meth:`fit` learns from it."""
        outcome = (row.reward, row.terminated)
        if outcome not in self.outcomes:
            self.outcomes.append(outcome)
        key = (row.code, row.action, row.following, self.outcomes.index(outcome))
        self._counts[key] = self._counts.get(key, 0) + 1

    def add_start(self, code: Code) -> None:
        """An episode began with this code, and so nothing that holds in it ends an episode at once."""
        self.starts[code] = self.starts.get(code, 0) + 1

    def _begun(self) -> Floats:
        """In how many starts each conjunction held, but for starts that ended an episode once reached. Shape (J,)."""
        ended = {following for _, _, following, outcome in self._counts if self.outcomes[outcome][1]}
        starts = {code: times for code, times in self.starts.items() if code not in ended}
        codes = np.array(list(starts), dtype=np.int64).reshape(-1, len(self.conjunctions.next.strides))
        numbers = self.conjunctions.next.numbers(codes)
        times = np.repeat(np.array(list(starts.values()), dtype=np.float64), numbers.shape[1])
        found = np.bincount(numbers.ravel(), times, minlength=len(self.conjunctions.group))
        return np.asarray(found, dtype=np.float64)

    def fit(self) -> None:
        """Learn the causes anew from everything seen; whichever outcome explains it best is the default."""
        if not self._counts:
            return
        codes, actions, following, outcome = (np.array(column) for column in zip(*self._counts, strict=True))
        active = self.conjunctions.active(codes, actions, following)
        count = np.array(list(self._counts.values()), dtype=np.float64)
        evidence = _Evidence(active, outcome, count, self.conjunctions, len(self.outcomes))
        self._went_on = self._begun()
        self._kept = np.array([self._kept_of(outcome, evidence) for outcome in range(len(self.outcomes))])
        explanations = [self._explain(evidence, default) for default in range(len(self.outcomes))]
        self.causes = causes = self._causes(evidence, max(explanations, key=lambda each: each.log_posterior))
        pseudo_tests = self.settings.pseudo_tests
        goes_on, ends = causes.cause_rate[:, self.conjunctions.group]
        untested = goes_on * pseudo_tests / (pseudo_tests + causes.tests)
        untested += ends * pseudo_tests / (pseudo_tests + causes.tests + self._went_on)
        self._spared = np.log1p(-np.vstack([causes.strength, untested])).T.copy()
        """Log probability that each conjunction causes no outcome, and last that it is no untested cause. (J, O + 1)"""
        self.prevails = self._precedence(evidence, causes)
        self.rewards, self.ends = np.array(causes.outcomes, dtype=np.float64).T.copy()
        choices = np.column_stack([codes, actions]) @ self.conjunctions.choice.strides
        self._seen, place = np.unique(_pairs(choices, following @ self.conjunctions.next.strides), return_inverse=True)
        """Numbers of the distinct transitions, ascending; below, how often each brought each outcome, and zeros."""
        self._brought = np.zeros((len(self._seen) + 1, len(self.outcomes)))
        np.add.at(self._brought, (place, outcome), count)

    def _precedence(self, evidence: _Evidence, causes: Causes) -> Floats:
        """How probably each outcome prevails over each other where causes of both are active. Shape (O, O).

        Half a case of each is known beforehand. Where outcomes are compared to themselves it is 1.
        """
        strength = causes.strength[:, evidence.all.met]
        active = 1.0 - np.exp(evidence.all.holds @ np.log1p(-strength).T)  # [U, O]
        active = np.where(active > _ACTIVE, active, 0.0)
        came = np.eye(len(self.outcomes))[evidence.outcome] * active * evidence.all.times[:, None]
        wins = came.T @ active  # [O, O]
        prevails = (wins + 0.5) / (wins + wins.T + 1.0)
        np.fill_diagonal(prevails, 1.0)
        return prevails

    def reset_for_new_task(self) -> None:
        """Forget all that was seen; earlier causes become priors, until a test of this task refutes them.

        A cause of an earlier task that no test refuted is still a prior in the one after the next. A conjunction that
        was *not* a cause earlier says nothing: goals change, and a task's own are to be found.
        """
        causes = self.causes
        if causes is not None:
            weight = self.settings.transfer_weight
            self._earlier = dict(zip(causes.outcomes, causes.strength, strict=True)) if weight else {}
            self.outcomes = sorted(self._earlier, key=lambda each: each != causes.outcomes[causes.default])
        self._counts = {}
        self.starts = {}
        self.causes = None

    def _kept_of(self, outcome: int, evidence: _Evidence) -> Floats:
        """Priors of an earlier task's causes (J,), believed as far as those that were tested bring it about here, too.

        A test fails where the earlier task's default came instead, which is the first outcome.
        """
        earlier = self._earlier.get(self.outcomes[outcome], np.zeros(len(self.conjunctions.group)))
        causes = earlier[evidence.all.met] > 0.5
        holds, fails = (evidence.tests(evidence.outcome == each)[causes] > 0.0 for each in (outcome, 0))
        pseudo = self.settings.pseudo_causes
        return earlier * (pseudo * self.settings.transfer_weight + holds.sum()) / (pseudo + (holds | fails).sum())

    def predict(self, codes: Ints, actions: Ints, following: Ints) -> tuple[Floats, Floats]:
        """Outcome probabilities (N, O) of N transitions, and the probability that something untested decides (N,)."""
        causes = self.causes
        assert causes is not None, "fit before predicting"
        choices, spared_by_choice = self._spared_by(self.conjunctions.choice, np.column_stack([codes, actions]))
        nexts, spared_by_next = self._spared_by(self.conjunctions.next, following)
        *none, tested = np.exp(spared_by_next + spared_by_choice).T
        probability = _by_causes(np.array(none), causes.default, self.prevails).T  # [N, O]
        unknown = (1.0 - tested) * probability[:, causes.default]
        probability *= self.settings.pseudo_seen / probability.sum(axis=1, keepdims=True)
        pairs = _pairs(choices, nexts)
        place = np.minimum(np.searchsorted(self._seen, pairs), len(self._seen) - 1)
        probability += self._brought[np.where(self._seen[place] == pairs, place, -1)]
        if self._going_on:
            unseen = self._seen[place] != pairs
            went_on = unseen & np.isin(nexts, list(self._going_on))
            probability[went_on[:, None] & (self.ends > 0.0)] = 0.0
        return probability / probability.sum(axis=1, keepdims=True), unknown

    def goes_on(self, code: Code, action: int, following: Code) -> bool:
        """An episode went on after a transition: believe that nothing unseen that leads there ends it.

        Returns whether that changes predictions. It does not where the transition was seen before, because then chance
        decides, nor where its end was improbable.
        """
        codes, actions, nexts = np.array([code]), np.array([action]), np.array([following])
        probability, _ = self.predict(codes, actions, nexts)
        ends = float(probability[0] @ self.ends)
        choices = np.column_stack([codes, actions]) @ self.conjunctions.choice.strides
        numbers = nexts @ self.conjunctions.next.strides
        if _pairs(choices, numbers)[0] in self._seen or not _SURPRISING < ends < 1.0:
            return False
        self._going_on.add(float(numbers[0]))
        return True

    def forget_going_on(self) -> bool:
        """Forget what :meth:`goes_on` was told; returns whether that changes predictions."""
        told = bool(self._going_on)
        self._going_on.clear()
        return told

    def _spared_by(self, conjunctions: _Templates, codes: Ints) -> tuple[Ints, Floats]:
        """The numbers of codes (N, P), and the sums of :attr:`_spared` over the conjunctions that hold in them, (N, O +
        1).
        """
        numbers = codes @ conjunctions.strides
        _, which, place = np.unique(numbers, return_index=True, return_inverse=True)
        active = conjunctions.numbers(codes[which])
        return numbers, self._spared.take(active.T, axis=0).sum(axis=0)[place]

    def _explain(self, evidence: _Evidence, default: int) -> _Explanation:
        """Causes of every outcome but ``default``."""
        others = [outcome for outcome in range(len(self.outcomes)) if outcome != default]
        strength = np.zeros((len(self.outcomes), len(evidence.all.met)))
        priors = np.zeros((len(self.outcomes), len(evidence.tried)))
        cost = 0.0
        for outcome in others:
            strength[outcome], priors[outcome] = self._causes_of(outcome, evidence, default, len(others))
            prior = np.maximum(np.repeat(priors[outcome], evidence.tried), self._kept[outcome, evidence.all.met])
            cost -= float((np.maximum(strength[outcome] - prior, 0.0) * np.log(prior)).sum())
        none = (1.0 - self.settings.leak) * np.exp(evidence.all.holds @ np.log1p(-strength).T).T
        probability = _by_causes(none, default)
        likelihood = probability[evidence.outcome, np.arange(len(evidence.outcome))] / probability.sum(axis=0)
        fit = float((evidence.all.times * np.log(np.maximum(likelihood, _LEAST))).sum())
        return _Explanation(default, strength, priors, fit - cost)

    def _causes_of(self, outcome: int, evidence: _Evidence, default: int, rivals: int) -> tuple[Floats, Floats]:
        """Expectation maximisation for one outcome: strengths (M,) and how likely each group holds causes (G,)."""
        settings = self.settings
        tried = evidence.tried
        cases = evidence.of[outcome]
        kept = self._kept[outcome, evidence.all.met]
        seen = (evidence.outcome == outcome) | (evidence.outcome == default)
        tests = settings.pseudo_tests + evidence.tests(np.where(seen, 1.0, settings.masked_weight))
        if self.outcomes[outcome][1]:
            tests += self._went_on[evidence.all.met]
        first = np.cumsum(tried) - tried
        base = self.conjunctions.prior / rivals
        prior = base
        strength = np.maximum(np.repeat(base, tried), kept)
        for _ in range(settings.sweeps):
            responsibility = cases.responsibility(strength.take(cases.met), settings.leak)
            strength = settings.pseudo_tests * np.maximum(np.repeat(prior, tried), kept)
            strength[cases.met] += responsibility
            np.minimum(np.divide(strength, tests, out=strength), _CERTAIN, out=strength)
            found = np.add.reduceat(strength, first)
            prior = (settings.pseudo_conjunctions * base + found) / (settings.pseudo_conjunctions + tried)
        return strength, prior

    def _causes(self, evidence: _Evidence, best: _Explanation) -> Causes:
        """Those of the best explanation, of all conjunctions, and how often each was tested.

        Tests are where nothing happened, and where a conjunction itself decided.
        """
        settings = self.settings
        all_of = self.conjunctions.of_each
        met = evidence.all.met
        pseudo = settings.pseudo_conjunctions
        strength = np.zeros((len(self.outcomes), all_of.sum()))
        tests = np.zeros(all_of.sum())
        tests[met] = evidence.tests(evidence.outcome == best.default)
        rate = np.tile(0.25 * pseudo * self.conjunctions.prior / (pseudo + evidence.tried), (2, 1))
        for outcome, cases in enumerate(evidence.of):
            if outcome == best.default:
                continue
            strength[outcome] = np.maximum(np.repeat(best.prior[outcome], all_of), self._kept[outcome])
            if self.outcomes[outcome][1]:
                strength[outcome] *= settings.pseudo_tests / (settings.pseudo_tests + self._went_on)
            strength[outcome, met] = best.strength[outcome]
            tests[met[cases.met]] += cases.responsibility(best.strength[outcome, cases.met], settings.leak)
            rate[int(self.outcomes[outcome][1])] += best.prior[outcome]
        return Causes(tuple(self.outcomes), best.default, strength, tests, np.minimum(rate, 0.99), best.log_posterior)


def _by_causes(inactive: Floats, default: int, prevails: Floats | None = None) -> Floats:
    """How probably a cause of each outcome is active and prevails over every other one; of the default, that none is.

    Args:
        inactive: Probability that no cause of each outcome is active, (O, N); the default's is unused.
        default: The default outcome.
        prevails: How probably each outcome prevails over each other, (O, O); by default one half.
    """
    inactive[default] = 1.0
    active = 1.0 - inactive
    if prevails is None:
        prevails = 0.5 + 0.5 * np.eye(len(active))
    probability = active * [(1.0 - lost[:, None] * active).prod(axis=0) for lost in 1.0 - prevails]
    probability[default] = inactive.prod(axis=0)
    return probability


def _pairs(choices: Ints, following: Ints) -> NDArray[np.complex128]:
    """Of transitions (N,) one number each, which no other has: of its code and action, and of the next code."""
    return choices + 1j * following
