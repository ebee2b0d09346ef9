"""What is rewarded and what ends an episode: causes among conjunctions of values, and which of them are untested.

An *outcome* is a pair (reward, whether the episode ended) that was seen. One of them is the default; each other has
causes: conjunctions of a few values of the next code, or of an action and values of the code before it. Any active
cause brings its outcome about: a noisy-OR (Pearl 1988, 4.3.2), whose causes are learned by expectation maximisation
with sparse Beta priors. How likely a conjunction of each order is a cause at all is learned too (empirical Bayes), so
the agent finds out by itself which causes its task has. Learning conjunctions that trigger effects: DOORmax (Diuk,
Cohen & Littman 2008). What no test has covered is known to be unknown (KWIK, Li et al. 2011), and novelty counts by
conjunctions rather than by whole states (width-based search, Lipovetzky & Geffner 2012).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats

from .factors import Code, Codes, CodeTransition, strides, table_size
from .settings import OutcomeSettings

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
        self._first, self._multipliers = np.zeros(0, dtype=np.int64), np.zeros((len(sizes), 0))

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
        group: Group of each, which has one order, with or without the action. Shape (J,).
        prior: Prior probability of being a cause, a group. Shape (G,).
    """

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: OutcomeSettings) -> None:
        count = len(sizes)
        orders = sorted({*range(1, min(settings.order, count) + 1), count})
        sets = [factors for order in orders for factors in itertools.combinations(range(count), order)]
        self._next, self._choice = _Templates(sizes), _Templates((*sizes, n_actions))
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
class _Evidence:
    """Distinct transitions: active conjunctions (U, T), outcome (U,), how often each was seen (U,)."""

    active: NDArray[np.int64]
    outcome: NDArray[np.int64]
    count: Floats


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
        self._priors: dict[Outcome, Floats] = {}
        self._counts: dict[tuple[Code, int, Code, int], int] = {}
        self.causes: Causes | None = None
        self._known, self._spared = np.ones(0), np.zeros((0, 0))
        """Probability that each conjunction is no untested cause, (J,), and log of that it causes nothing, (O, J)."""

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
        evidence = _Evidence(active, outcome, np.array(list(self._counts.values()), dtype=np.float64))
        candidates = [self._explain(evidence, default) for default in range(len(self.outcomes))]
        self.causes = causes = max(candidates, key=lambda causes: causes.log_posterior)
        pseudo_tests = self.settings.pseudo_tests
        self._known = 1.0 - causes.cause_rate[self.conjunctions.group] * pseudo_tests / (pseudo_tests + causes.tests)
        self._spared = np.log1p(-causes.strength)

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
            self._priors = {causes.outcomes[index]: weight * causes.strength[index] for index in order}
        self._counts, self.causes = {}, None

    def _prior(self, outcome: int, groups: Floats, which: NDArray[np.int64] | slice = slice(None)) -> Floats:
        """Prior probability of these conjunctions to cause ``outcome``: their groups' (G,), or an earlier task's."""
        earlier = self._priors.get(self.outcomes[outcome])
        own = groups[self.conjunctions.group[which]]
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
        known, spared = self._known, self._spared
        which, at = _distinct(following, self._strides)
        how, at_choice = _distinct(np.column_stack([codes, actions]), self._strides_of_choice)
        none, tested = np.zeros((len(spared), len(codes))), np.ones(len(codes))
        for active, back in (
            (self.conjunctions.of_next(following[which]), at),
            (self.conjunctions.of_choice(codes[how], actions[how]), at_choice),
        ):
            none += spared[:, active].sum(axis=2)[:, back]
            tested *= known[active].prod(axis=1)[back]
        probability = _by_causes(np.exp(none), causes.default)  # [O, N]
        return (probability / probability.sum(axis=0)).T, (1.0 - tested) * probability[causes.default]

    def _explain(self, evidence: _Evidence, default: int) -> Causes:
        """Causes of every outcome but ``default``."""
        group, settings = self.conjunctions.group, self.settings
        size, groups = len(group), len(self.conjunctions.prior)
        met = np.bincount(evidence.active.ravel(), minlength=size) > 0
        tried = np.bincount(group[met], minlength=groups)
        others = [outcome for outcome in range(len(self.outcomes)) if outcome != default]
        strength, cost = np.zeros((len(self.outcomes), size)), 0.0
        rate = 0.5 * settings.pseudo_conjunctions * self.conjunctions.prior / (settings.pseudo_conjunctions + tried)
        for outcome in others:
            strength[outcome], groups_prior = self._causes_of(outcome, evidence, default, met, tried, len(others))
            prior = self._prior(outcome, groups_prior)
            extra = np.maximum(strength[outcome] - prior, 0.0)
            cost -= float((extra * np.log(prior))[met].sum())
            rate = rate + groups_prior
        probability = _noisy_or(strength, evidence.active, default, settings.leak)
        likelihood = probability[evidence.outcome, np.arange(len(evidence.outcome))] / probability.sum(axis=0)
        fit = float((evidence.count * np.log(np.maximum(likelihood, _LEAST))).sum())
        tests = self._tests(strength, evidence, default)
        return Causes(tuple(self.outcomes), default, strength, tests, np.minimum(rate, 0.99), fit - cost)

    def _causes_of(
        self, outcome: int, evidence: _Evidence, default: int, met: NDArray[np.bool_], tried: NDArray[np.int64],
        rivals: int,
    ) -> tuple[Floats, Floats]:  # fmt: skip
        """Expectation maximisation for one outcome: strengths (J,) and how likely each group holds causes (G,)."""
        settings, rows = self.settings, np.flatnonzero(met)
        group = self.conjunctions.group[rows]
        positive = evidence.outcome == outcome
        weight = np.where(positive | (evidence.outcome == default), 1.0, settings.masked_weight) * evidence.count
        tests = _spread(evidence.active, weight, len(met))[rows]
        active, count = (np.cumsum(met) - 1)[evidence.active[positive]], evidence.count[positive]  # among those met
        base = self.conjunctions.prior / rivals
        prior, strength = base, self._prior(outcome, base, rows)
        for _ in range(settings.sweeps):
            responsibility = _responsibility(strength, active, count, settings.leak, len(group))
            hits = settings.pseudo_tests * self._prior(outcome, prior, rows) + responsibility
            strength = np.minimum(hits / (settings.pseudo_tests + tests), _CERTAIN)
            found = np.bincount(group, strength, len(base))
            prior = (settings.pseudo_conjunctions * base + found) / (settings.pseudo_conjunctions + tried)
        whole = self._prior(outcome, prior)
        whole[rows] = strength
        return whole, prior

    def _tests(self, strength: Floats, evidence: _Evidence, default: int) -> Floats:
        """Tests of each conjunction: where nothing happened, and where it was itself what decided. Shape (J,)."""
        size = strength.shape[1]
        tests = _spread(evidence.active, np.where(evidence.outcome == default, evidence.count, 0.0), size)
        for outcome in range(len(strength)):
            own = evidence.outcome == outcome
            if outcome != default and own.any():
                active, count = evidence.active[own], evidence.count[own]
                tests += _responsibility(strength[outcome], active, count, self.settings.leak, size)
        return tests


def _noisy_or(strength: Floats, active: NDArray[np.int64], default: int, leak: float) -> Floats:
    """Activation of each outcome by noisy-OR; of the default, that no other is active. Shape (O, N)."""
    return _by_causes((1.0 - leak) * np.exp(np.log1p(-strength)[:, active].sum(axis=2)), default)


def _by_causes(inactive: Floats, default: int) -> Floats:
    """Activation of each outcome, of which no cause is active with this probability (O, N); the default's is unused."""
    inactive[default] = 1.0
    probability = 1.0 - inactive
    probability[default] = inactive.prod(axis=0)
    return probability


def _distinct(values: Codes, multipliers: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where each distinct row (N, V) comes first, and which of these each row is: (U,) and (N,)."""
    _, first, which = np.unique(values @ multipliers, return_index=True, return_inverse=True)
    return first, which


def _responsibility(strength: Floats, active: NDArray[np.int64], count: Floats, leak: float, size: int) -> Floats:
    """How many of the transitions each conjunction is held to have decided. Shape (J,)."""
    caused = 1.0 - (1.0 - leak) * np.exp(np.log1p(-strength)[active].sum(axis=1))
    share = np.minimum(strength[active] / caused[:, None], 1.0) * count[:, None]
    return np.bincount(active.ravel(), share.ravel(), size)  # type: ignore[return-value]  # weights make it float64


def _spread(active: NDArray[np.int64], weight: Floats, size: int) -> Floats:
    """Sum of the weights (U,) of the transitions in which each conjunction holds. Shape (J,)."""
    return np.bincount(active.ravel(), np.repeat(weight, active.shape[1]), size)  # type: ignore[return-value]
