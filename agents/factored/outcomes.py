"""What is rewarded and what ends an episode: causes among conjunctions of values, and which of them are untested.

An *outcome* is a pair (reward, whether the episode ended) that was seen. One of them is the default; each other has
causes: conjunctions of a few values of the next code, or of an action and values of the code before it. Any active
cause brings its outcome about: a noisy-OR (Pearl 1988, 4.3.2), whose causes are learned by expectation maximisation
with sparse Beta priors. How likely a conjunction of each order is a cause at all is learned too (empirical Bayes), so
the agent finds out by itself which causes its task has. They are the base measure of a Dirichlet prior: what a
transition brought when it was seen soon weighs more. Learning conjunctions that trigger effects: DOORmax (Diuk, Cohen &
Littman 2008). What no test has covered is known to be unknown (KWIK, Li et al. 2011), and novelty counts by
conjunctions rather than by whole states (width-based search, Lipovetzky & Geffner 2012).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats

from .factors import Code, Codes, CodeTransition, strides, table_size
from .settings import OutcomeSettings

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_LARGEST_TEMPLATE = 1 << 15
"""Sets of factors with more joint values are no candidates."""
_CERTAIN = 1.0 - 1e-6
_LEAST = 1e-6

Outcome = tuple[float, bool]
"""Reward, and whether the episode ended."""


class _Templates:
    """Conjunctions over T sets of factors, numbered by the values of these: one number in each set holds in a code."""

    def __init__(self, sizes: tuple[int, ...]) -> None:
        self._sizes = sizes
        self._first = np.zeros(0, dtype=np.int64)
        self._multipliers = np.zeros((len(sizes), 0))

    def append(self, factors: tuple[int, ...], first: int) -> None:
        """One more set; ``first`` is its first number."""
        multipliers = np.zeros(len(self._sizes))
        multipliers[list(factors)] = strides(factors, self._sizes)
        self._first = np.append(self._first, first)
        self._multipliers = np.column_stack([self._multipliers, multipliers])

    def numbers(self, codes: Codes) -> NDArray[np.int64]:
        """Those that hold in codes (N, P). Shape (N, T)."""
        found = codes.astype(np.float64) @ self._multipliers  # fast, and these numbers are exact
        return np.asarray(found.astype(np.int64) + self._first)


class Conjunctions:
    """All candidate conjunctions of factors with so many values each, numbered, in groups of one order and kind.

    Attributes:
        group: Group of each, which has one order, with or without the action, ascending. Shape (J,).
        of_each: How many there are of each group. Shape (G,).
        prior: Prior probability of being a cause, a group. Shape (G,).
    """

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: OutcomeSettings) -> None:
        count = len(sizes)
        most = min(settings.order, count)
        orders = sorted({*range(1, most + 1), *([count - 1] if most > 1 else []), count})
        sets = [factors for order in orders for factors in itertools.combinations(range(count), order)]
        self._next = _Templates(sizes)
        self._choice = _Templates((*sizes, n_actions))
        members: list[NDArray[np.int64]] = []
        groups: dict[tuple[bool, int], int] = {}
        first = 0
        for templates, with_action, factors in (
            *((self._next, False, each) for each in sets), *((self._choice, True, each) for each in [(), *sets])
        ):  # fmt: skip
            whole = (*factors, count) if with_action else factors
            size = table_size(whole, (*sizes, n_actions))
            if size > _LARGEST_TEMPLATE:
                continue
            templates.append(whole, first)
            members.append(np.full(size, groups.setdefault((with_action, len(factors)), len(groups))))
            first += size
        self.group = np.concatenate(members)
        self.of_each = np.bincount(self.group)
        beyond = np.array([max(0, order + with_action - 2) for with_action, order in groups])
        self.prior: Floats = settings.prior * settings.order_decay**beyond

    def active(self, codes: Codes, actions: NDArray[np.int64], following: Codes) -> NDArray[np.int64]:
        """Which conjunctions hold in transitions between codes (N, P) by actions (N,). Shape (N, templates)."""
        return np.concatenate([self.of_next(following), self.of_choice(codes, actions)], axis=1)

    def of_next(self, following: Codes) -> NDArray[np.int64]:
        """Those of them that are about the next code alone."""
        return self._next.numbers(following)

    def of_choice(self, codes: Codes, actions: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of them that are about the action and the code before it."""
        return self._choice.numbers(np.column_stack([codes, actions]))


@dataclass(frozen=True, slots=True)
class _Cases:
    """Transitions (U,), the conjunctions that hold in any of them (M,), and which hold in which, as ones (U, M)."""

    met: NDArray[np.int64]
    holds: csr_array
    held: csr_array  #: its transpose
    count: Floats  #: how often each transition was seen

    @classmethod
    def of(cls, active: NDArray[np.int64], count: Floats, size: int) -> _Cases:
        """Of those active (U, T), of so many there are."""
        from scipy.sparse import csr_array  # noqa: PLC0415 - loads for long

        held = np.bincount(active.ravel(), minlength=size) > 0
        first = np.arange(0, active.size + 1, active.shape[1], dtype=np.int32)
        place = (np.cumsum(held, dtype=np.int32) - 1)[active.ravel()]
        holds = csr_array((np.ones(active.size), place, first), shape=(len(active), held.sum()))
        return cls(np.flatnonzero(held), holds, holds.T, count)

    def responsibility(self, strength: Floats, leak: float) -> Floats:
        """How many of the transitions each of them, so strong (M,), is held to have decided. Shape (M,)."""
        caused = 1.0 - (1.0 - leak) * np.exp(self.holds @ np.log1p(-strength))
        return np.asarray(strength * (self.held @ (self.count / caused)))


class _Evidence:
    """All distinct transitions, of which each has an outcome (U,); M conjunctions were met, T hold in each of them."""

    def __init__(self, active: NDArray[np.int64], outcome: NDArray[np.int64], count: Floats, group: NDArray[np.int64],
                 groups: int, outcomes: int) -> None:  # fmt: skip
        self.outcome = outcome
        self.all = _Cases.of(active, count, len(group))
        place = np.zeros(len(group), dtype=np.int64)
        place[self.all.met] = np.arange(len(self.all.met))
        among = place[active]
        self.of = [
            _Cases.of(among[own], count[own], len(self.all.met)) for own in outcome == np.arange(outcomes)[:, None]
        ]
        """Those of each outcome; their conjunctions are numbered among those that were met."""
        self.tried = np.bincount(group[self.all.met], minlength=groups)
        """How many were met of each group, which are in this order. Shape (G,)."""

    def tests(self, weight: Floats) -> Floats:
        """Sum of the weights (U,) of the transitions in which each conjunction holds. Shape (M,)."""
        return np.asarray(self.all.held @ (weight * self.all.count))


@dataclass(frozen=True, slots=True)
class _Seen:
    """How often each transition that was seen brought each outcome."""

    choices: NDArray[np.int64]  #: numbers of codes and actions, ascending
    following: NDArray[np.int64]  #: of next codes, ascending
    both: NDArray[np.int64]  #: of the pairs, by their places in these, ascending. Shape (U,).
    counts: Floats  #: of outcomes, and zeros at the end. Shape (U + 1, O).

    @classmethod
    def of(cls, choice: NDArray[np.int64], following: NDArray[np.int64], outcome: NDArray[np.int64], count: Floats,
           outcomes: int) -> _Seen:  # fmt: skip
        """Of transitions by the numbers of their choices and next codes, each with an outcome and a count, (N,)."""
        choices, first = np.unique(choice, return_inverse=True)
        nexts, second = np.unique(following, return_inverse=True)
        both, place = np.unique(first * len(nexts) + second, return_inverse=True)
        counts = np.zeros((len(both) + 1, outcomes))
        np.add.at(counts, (place, outcome), count)
        return cls(choices, nexts, both, counts)

    def read(self, choice: NDArray[np.int64], following: NDArray[np.int64], at_choice: NDArray[np.int64],
             at: NDArray[np.int64]) -> Floats:  # fmt: skip
        """Those of N transitions, whose choices and next codes stand ``at`` these places of the numbers: (N, O)."""
        first = _places(self.choices, choice)[at_choice]
        second = _places(self.following, following)[at]
        both = np.where((first < 0) | (second < 0), -1, first * len(self.following) + second)
        return np.asarray(self.counts[_places(self.both, both)])


@dataclass(frozen=True, slots=True)
class _Explanation:
    """How all outcomes but a default may come about."""

    default: int
    strength: Floats  #: of the conjunctions that were met. Shape (O, M).
    prior: Floats  #: probability that one of each group is a cause. Shape (O, G).
    log_posterior: float  #: log likelihood less the cost of the causes


@dataclass(frozen=True, slots=True)
class Causes:
    """Learned causes."""

    outcomes: tuple[Outcome, ...]  #: the outcomes they are about. Length O.
    default: int  #: index of the default outcome, which has no causes
    strength: Floats  #: probability that a conjunction brings an outcome about. Shape (O, J).
    tests: Floats  #: how often each conjunction was tested while nothing else decided. Shape (J,).
    cause_rate: Floats  #: probability that an untested conjunction is a cause of anything, a group. Shape (G,).
    log_posterior: float  #: log likelihood less the cost of the causes


class OutcomeModel:
    """Predicts outcomes, of those seen so far, and says what is untested."""

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: OutcomeSettings) -> None:
        self.settings = settings
        self.conjunctions = Conjunctions(sizes, n_actions, settings)
        self._strides = strides(tuple(range(len(sizes))), sizes)
        self._strides_of_choice = strides(tuple(range(len(sizes) + 1)), (*sizes, n_actions))
        self.outcomes: list[Outcome] = []
        self._earlier: dict[Outcome, Floats] = {}
        self._priors: dict[Outcome, Floats] = {}
        self._counts: dict[tuple[Code, int, Code, int], int] = {}
        self.causes: Causes | None = None
        self._spared = np.zeros((0, 1))
        """Log probability that each conjunction causes no outcome, and last that it is no untested cause. (J, O + 1)"""

    def add(self, row: CodeTransition) -> None:
        """Take in one transition; :meth:`fit` learns from it."""
        outcome = (row.reward, row.terminated)
        if outcome not in self.outcomes:
            self.outcomes.append(outcome)
        key = (row.code, row.action, row.following, self.outcomes.index(outcome))
        self._counts[key] = self._counts.get(key, 0) + 1

    def fit(self) -> None:
        """Learn the causes anew from everything seen; whichever outcome explains it best is the default."""
        if not self._counts:
            return
        codes, actions, following, outcome = (np.array(column) for column in zip(*self._counts, strict=True))
        active = self.conjunctions.active(codes, actions, following)
        count = np.array(list(self._counts.values()), dtype=np.float64)
        group = self.conjunctions.group
        evidence = _Evidence(active, outcome, count, group, len(self.conjunctions.prior), len(self.outcomes))
        self._priors = {each: self._kept(each, earlier, evidence) for each, earlier in self._earlier.items()}
        explanations = [self._explain(evidence, default) for default in range(len(self.outcomes))]
        self.causes = causes = self._causes(evidence, max(explanations, key=lambda each: each.log_posterior))
        pseudo_tests = self.settings.pseudo_tests
        untested = causes.cause_rate[self.conjunctions.group] * pseudo_tests / (pseudo_tests + causes.tests)
        self._spared = np.log1p(-np.vstack([causes.strength, untested])).T.copy()
        choice = np.column_stack([codes, actions]) @ self._strides_of_choice
        self._seen = _Seen.of(choice, following @ self._strides, outcome, count, len(self.outcomes))

    def reset_for_new_task(self) -> None:
        """Forget all that was seen; earlier causes become priors, until a test of this task refutes them.

        A cause of an earlier task that no test refuted is still a prior in the one after the next. What was *not* a
        cause earlier says nothing: goals change, and a task's own are to be found.
        """
        causes = self.causes
        if causes is not None:
            weight = self.settings.transfer_weight
            order = [causes.default, *(index for index in range(len(causes.outcomes)) if index != causes.default)]
            self.outcomes = [causes.outcomes[index] for index in order] if weight else []
            self._earlier = {causes.outcomes[index]: causes.strength[index] for index in order} if weight else {}
        self._counts = {}
        self.causes = None

    def _kept(self, outcome: Outcome, earlier: Floats, evidence: _Evidence) -> Floats:
        """Priors of an earlier task's causes (J,), believed as far as those that were tested bring it about here, too.

        A test fails where the earlier task's default came instead, which is the first outcome.
        """
        causes = earlier[evidence.all.met] > 0.5
        holds, fails = (
            evidence.tests((evidence.outcome == each).astype(np.float64))[causes] > 0.0
            for each in (self.outcomes.index(outcome), 0)
        )
        good = holds.sum()
        tested = (holds | fails).sum()
        pseudo = self.settings.pseudo_causes
        return earlier * (pseudo * self.settings.transfer_weight + good) / (pseudo + tested)

    def _prior(self, outcome: int, groups: Floats, each: NDArray[np.int64], which: NDArray[np.int64] | slice) -> Floats:
        """Prior probability of ``which`` conjunctions to cause ``outcome``: their groups', or an earlier task's.

        ``groups`` (G,) is that of each group, of which there are ``each`` (G,) many.
        """
        earlier = self._priors.get(self.outcomes[outcome])
        own = np.repeat(groups, each)
        return own if earlier is None else np.maximum(own, earlier[which])

    @property
    def rewards(self) -> Floats:
        """Reward of each outcome that causes were learned of. Shape (O,)."""
        return np.array([reward for reward, _ in self.causes.outcomes] if self.causes else [])

    @property
    def ends(self) -> Floats:
        """1 for each of them that ends the episode, else 0. Shape (O,)."""
        return np.array([float(terminated) for _, terminated in self.causes.outcomes] if self.causes else [])

    def predict(self, codes: Codes, actions: NDArray[np.int64], following: Codes) -> tuple[Floats, Floats]:
        """Outcome probabilities (N, O) of N transitions, and the probability that something untested decides (N,)."""
        causes = self.causes
        assert causes is not None, "fit before predicting"
        nexts, which, at = _distinct(following, self._strides)
        choices, how, at_choice = _distinct(np.column_stack([codes, actions]), self._strides_of_choice)
        of_next = self.conjunctions.of_next(following[which])
        of_choice = self.conjunctions.of_choice(codes[how], actions[how])
        of_next, of_choice = (self._spared.take(active.T, axis=0).sum(axis=0) for active in (of_next, of_choice))
        *none, tested = np.exp(of_next[at] + of_choice[at_choice]).T
        probability = _by_causes(np.array(none), causes.default).T  # [N, O]
        unknown = (1.0 - tested) * probability[:, causes.default]
        probability *= self.settings.pseudo_seen / probability.sum(axis=1, keepdims=True)
        probability += self._seen.read(choices, nexts, at_choice, at)
        return probability / probability.sum(axis=1, keepdims=True), unknown

    def _explain(self, evidence: _Evidence, default: int) -> _Explanation:
        """Causes of every outcome but ``default``."""
        others = [outcome for outcome in range(len(self.outcomes)) if outcome != default]
        strength = np.zeros((len(self.outcomes), len(evidence.all.met)))
        priors = np.zeros((len(self.outcomes), len(evidence.tried)))
        cost = 0.0
        for outcome in others:
            strength[outcome], priors[outcome] = self._causes_of(outcome, evidence, default, len(others))
            prior = self._prior(outcome, priors[outcome], evidence.tried, evidence.all.met)
            cost -= float((np.maximum(strength[outcome] - prior, 0.0) * np.log(prior)).sum())
        none = (1.0 - self.settings.leak) * np.exp(evidence.all.holds @ np.log1p(-strength).T).T
        probability = _by_causes(none, default)
        likelihood = probability[evidence.outcome, np.arange(len(evidence.outcome))] / probability.sum(axis=0)
        fit = float((evidence.all.count * np.log(np.maximum(likelihood, _LEAST))).sum())
        return _Explanation(default, strength, priors, fit - cost)

    def _causes_of(self, outcome: int, evidence: _Evidence, default: int, rivals: int) -> tuple[Floats, Floats]:
        """Expectation maximisation for one outcome: strengths (M,) and how likely each group holds causes (G,)."""
        settings = self.settings
        tried = evidence.tried
        cases = evidence.of[outcome]
        met = evidence.all.met
        seen = (evidence.outcome == outcome) | (evidence.outcome == default)
        tests = settings.pseudo_tests + evidence.tests(np.where(seen, 1.0, settings.masked_weight))
        first = np.cumsum(tried) - tried
        base = self.conjunctions.prior / rivals
        prior = base
        strength = self._prior(outcome, base, tried, met)
        for _ in range(settings.sweeps):
            responsibility = cases.responsibility(strength.take(cases.met), settings.leak)
            strength = self._prior(outcome, prior, tried, met)
            strength *= settings.pseudo_tests
            strength[cases.met] += responsibility
            np.minimum(np.divide(strength, tests, out=strength), _CERTAIN, out=strength)
            found = np.add.reduceat(strength, first)
            prior = (settings.pseudo_conjunctions * base + found) / (settings.pseudo_conjunctions + tried)
        return strength, prior

    def _causes(self, evidence: _Evidence, best: _Explanation) -> Causes:
        """Those of the best explanation, of all conjunctions, and how often each was tested.

        Tests are where nothing happened, and where a conjunction was itself what decided.
        """
        settings = self.settings
        all_of = self.conjunctions.of_each
        met = evidence.all.met
        pseudo = settings.pseudo_conjunctions
        strength = np.zeros((len(self.outcomes), all_of.sum()))
        tests = np.zeros(all_of.sum())
        tests[met] = evidence.tests(evidence.outcome == best.default)
        rate = 0.5 * pseudo * self.conjunctions.prior / (pseudo + evidence.tried)
        for outcome, cases in enumerate(evidence.of):
            if outcome == best.default:
                continue
            strength[outcome] = self._prior(outcome, best.prior[outcome], all_of, slice(None))
            strength[outcome, met] = best.strength[outcome]
            tests[met[cases.met]] += cases.responsibility(best.strength[outcome, cases.met], settings.leak)
            rate = rate + best.prior[outcome]
        return Causes(tuple(self.outcomes), best.default, strength, tests, np.minimum(rate, 0.99), best.log_posterior)


def _by_causes(inactive: Floats, default: int) -> Floats:
    """Activation of each outcome, of which no cause is active with this probability (O, N); the default's is unused."""
    inactive[default] = 1.0
    probability = 1.0 - inactive
    probability[default] = inactive.prod(axis=0)
    return probability


def _distinct(
    values: Codes, multipliers: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The distinct numbers of rows (N, V), where each comes first, and which each row has: (U,), (U,) and (N,)."""
    return np.unique(values @ multipliers, return_index=True, return_inverse=True)


def _places(among: NDArray[np.int64], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each number stands among those, which are ascending; -1 where it does not."""
    place = np.minimum(np.searchsorted(among, numbers), len(among) - 1)
    return np.where(among[place] == numbers, place, -1)
