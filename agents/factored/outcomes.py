"""What is rewarded and what ends an episode: causes among conjunctions of values, and which of them are untested.

An *outcome* is a pair (reward, whether the episode ended) that was seen. One of them is the usual one; each other has
causes: conjunctions of a few values of the next code, or of an action and values of the code before it. Any active
cause brings its outcome about: a noisy-OR (Pearl 1988, 4.3.2), whose causes are learned by expectation maximisation
with sparse Beta priors; how likely a conjunction of each order and kind is a cause at all is learned beside (empirical
Bayes), so that the agent finds out by itself which kind of cause its task has. Learning conjunctions that trigger
effects: DOORmax (Diuk, Cohen & Littman 2008). What no test has covered is known to be unknown (KWIK, Li et al. 2011),
and novelty counts by conjunctions rather than by whole states (width-based search, Lipovetzky & Geffner 2012).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .dynamics import Codes, strides
from .experience import CodeTransition
from .settings import OutcomeSettings

_LARGEST_TEMPLATE = 1 << 15
"""Sets of parts with more joint values are no candidates."""
_CERTAIN = 1.0 - 1e-6
_LEAST = 1e-6

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Template:
    """Conjunctions over one set of parts: ``first`` numbers its first; ``acting`` ones hold the action too."""

    parts: list[int]
    strides: NDArray[np.int64]
    acting: bool
    first: int


class Conjunctions:
    """All candidate conjunctions, numbered.

    Args:
        sizes: Values of each part.
        n_actions: A.
        settings: Largest order and priors.

    Attributes:
        group: Group of each conjunction; a group is one kind and order. Shape (J,).
        prior: Prior probability of being a cause, a group. Shape (G,).
    """

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: OutcomeSettings) -> None:
        self._n_actions = n_actions
        count = len(sizes)
        orders = sorted({*range(1, min(settings.order, count) + 1), count})
        sets = [parts for order in orders for parts in itertools.combinations(range(count), order)]
        self._templates: list[_Template] = []
        groups: list[NDArray[np.int64]] = []
        kinds: dict[tuple[bool, int], int] = {}
        first = 0
        for acting, parts in [(False, each) for each in sets] + [(True, each) for each in [(), *sets]]:
            size = int(np.prod([sizes[part] for part in parts])) * (n_actions if acting else 1)
            if size > _LARGEST_TEMPLATE:
                continue
            self._templates.append(_Template(list(parts), strides(parts, sizes), acting, first))
            groups.append(np.full(size, kinds.setdefault((acting, len(parts)), len(kinds))))
            first += size
        self.group = np.concatenate(groups)
        beyond = np.array([max(0, order + acting - 2) for acting, order in kinds])
        self.prior: Floats = settings.prior * settings.order_factor**beyond

    def active(self, codes: Codes, actions: NDArray[np.int64], following: Codes) -> NDArray[np.int64]:
        """Which conjunctions hold in transitions between codes (N, P) by actions (N,). Shape (N, templates)."""
        columns = []
        for template in self._templates:
            source = codes if template.acting else following
            number = source[:, template.parts] @ template.strides
            columns.append(template.first + (number * self._n_actions + actions if template.acting else number))
        return np.stack(columns, axis=1)


@dataclass(frozen=True, slots=True)
class _Seen:
    """Distinct transitions: active conjunctions (U, T), outcome (U,), how often (U,)."""

    active: NDArray[np.int64]
    outcome: NDArray[np.int64]
    often: Floats


@dataclass(frozen=True, slots=True)
class Causes:
    """Learned causes.

    Attributes:
        kinds: The outcomes they are about, (reward, terminated) each.
        usual: Index of the usual outcome, which has no causes.
        strength: Probability that a conjunction brings an outcome about. Shape (O, J).
        tests: How often each conjunction was tested while nothing else decided. Shape (J,).
        promise: Probability that an untested conjunction is a cause of anything, a group. Shape (G,).
        log_posterior: Log likelihood less the cost of the causes.
    """

    kinds: tuple[tuple[float, bool], ...]
    usual: int
    strength: Floats
    tests: Floats
    promise: Floats
    log_posterior: float


class Outcomes:
    """Predicts outcomes and says what is untested.

    Args:
        sizes: Values of each part.
        n_actions: A.
        settings: Priors.

    Attributes:
        kinds: The outcomes seen so far, (reward, terminated) each.
    """

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: OutcomeSettings) -> None:
        self.settings = settings
        self.conjunctions = Conjunctions(sizes, n_actions, settings)
        self.kinds: list[tuple[float, bool]] = []
        self._hints: dict[tuple[float, bool], Floats] = {}
        self._seen: dict[tuple[tuple[int, ...], int, tuple[int, ...], int], int] = {}
        self.causes: Causes | None = None

    def add(self, row: CodeTransition) -> None:
        """Take in one transition; :meth:`fit` learns from it."""
        kind = (row.reward, row.terminated)
        if kind not in self.kinds:
            self.kinds.append(kind)
        key = (row.code, row.action, row.following, self.kinds.index(kind))
        self._seen[key] = self._seen.get(key, 0) + 1

    def fit(self) -> None:
        """Learn the causes anew from everything seen; whichever outcome explains it best is the usual one."""
        if not self._seen:
            return
        codes, actions, following, outcome = (np.array(column) for column in zip(*self._seen, strict=True))
        active = self.conjunctions.active(codes, actions, following)
        seen = _Seen(active, outcome, np.array(list(self._seen.values()), dtype=np.float64))
        candidates = [self._explain(seen, usual) for usual in range(len(self.kinds))]
        self.causes = max(candidates, key=lambda causes: causes.log_posterior)

    def reset_for_new_task(self) -> None:
        """Forget all that was seen; what were causes is believed, as a hint, until a test of this task refutes it.

        A cause of an earlier task that no test refuted is still a hint in the one after the next. What was *not* a
        cause earlier is no hint: goals change, and a task's own are to be found.
        """
        causes = self.causes
        if causes is not None:
            order = [causes.usual, *(kind for kind in range(len(causes.kinds)) if kind != causes.usual)]
            self.kinds = [causes.kinds[kind] for kind in order] if self.settings.carried else []
            self._hints = {causes.kinds[kind]: self.settings.carried * causes.strength[kind] for kind in order}
        self._seen, self.causes = {}, None

    def _believed(self, kind: int, prior: Floats) -> Floats:
        """Prior probability of each conjunction to be a cause of ``kind``: its group's (G,), or the hint's. (J,)."""
        hint = self._hints.get(self.kinds[kind])
        own = prior[self.conjunctions.group]
        return own if hint is None else np.maximum(own, hint)

    @property
    def rewards(self) -> Floats:
        """Reward of each outcome that causes were learned of. Shape (O,)."""
        return np.array([reward for reward, _ in self.causes.kinds] if self.causes else [])

    @property
    def ends(self) -> Floats:
        """1 for each of them that ends the episode, else 0. Shape (O,)."""
        return np.array([float(terminated) for _, terminated in self.causes.kinds] if self.causes else [])

    def predict(self, codes: Codes, actions: NDArray[np.int64], following: Codes) -> tuple[Floats, Floats]:
        """Outcome probabilities of N transitions, and the probability that something untested decides.

        Returns:
            Shapes (N, O) and (N,).
        """
        causes = self.causes
        assert causes is not None, "fit before predicting"
        active, settings = self.conjunctions.active(codes, actions, following), self.settings
        chance = _chance(causes.strength, active, causes.usual, leak=0.0)  # [O, N]
        unexplained = chance[causes.usual]
        promise = causes.promise[self.conjunctions.group[active]]
        untested = promise * settings.pseudo_tests / (settings.pseudo_tests + causes.tests[active])
        doubt = (1.0 - np.prod(1.0 - untested, axis=1)) * unexplained
        return (chance / chance.sum(axis=0)).T, doubt

    def _explain(self, seen: _Seen, usual: int) -> Causes:
        """Causes of every outcome but ``usual``."""
        group, settings = self.conjunctions.group, self.settings
        size, groups = len(group), len(self.conjunctions.prior)
        met = np.bincount(seen.active.ravel(), minlength=size) > 0
        tried = np.bincount(group[met], minlength=groups)
        others = [kind for kind in range(len(self.kinds)) if kind != usual]
        strength, cost = np.zeros((len(self.kinds), size)), 0.0
        promise = 0.5 * settings.pseudo_conjunctions * self.conjunctions.prior / (settings.pseudo_conjunctions + tried)
        for kind in others:
            strength[kind], prior = self._causes_of(kind, seen, usual, met, tried, len(others))
            believed = self._believed(kind, prior)
            extra = np.maximum(strength[kind] - believed, 0.0)
            cost -= float((extra * np.log(believed))[met].sum())
            promise = promise + prior
        chance = _chance(strength, seen.active, usual, settings.leak)
        right = chance[seen.outcome, np.arange(len(seen.outcome))] / chance.sum(axis=0)
        fit = float((seen.often * np.log(np.maximum(right, _LEAST))).sum())
        tests = self._tests(strength, seen, usual)
        return Causes(tuple(self.kinds), usual, strength, tests, np.minimum(promise, 0.99), fit - cost)

    def _causes_of(
        self, kind: int, seen: _Seen, usual: int, met: NDArray[np.bool_], tried: NDArray[np.int64], rivals: int
    ) -> tuple[Floats, Floats]:
        """Expectation maximisation for one outcome: strengths (J,) and how likely each group holds causes (G,)."""
        settings, group = self.settings, self.conjunctions.group
        positive = seen.outcome == kind
        weight = np.where(positive | (seen.outcome == usual), 1.0, settings.masked_weight) * seen.often
        tests = _spread(seen.active, weight, len(group))
        active, often = seen.active[positive], seen.often[positive]
        base = self.conjunctions.prior / rivals
        prior, strength = base, self._believed(kind, base)
        for _ in range(settings.sweeps):
            blame = _blame(strength, active, often, settings.leak, len(group))
            hits = settings.pseudo_tests * self._believed(kind, prior) + blame
            strength = np.minimum(hits / (settings.pseudo_tests + tests), _CERTAIN)
            found = np.bincount(group[met], strength[met], len(base))
            prior = (settings.pseudo_conjunctions * base + found) / (settings.pseudo_conjunctions + tried)
        return np.where(met, strength, self._believed(kind, prior)), prior

    def _tests(self, strength: Floats, seen: _Seen, usual: int) -> Floats:
        """Tests of each conjunction: where nothing happened, and where it was itself what decided. Shape (J,)."""
        size = strength.shape[1]
        tests = _spread(seen.active, np.where(seen.outcome == usual, seen.often, 0.0), size)
        for kind in range(len(strength)):
            own = seen.outcome == kind
            if kind != usual and own.any():
                tests += _blame(strength[kind], seen.active[own], seen.often[own], self.settings.leak, size)
        return tests


def _chance(strength: Floats, active: NDArray[np.int64], usual: int, leak: float) -> Floats:
    """Activation of each outcome by noisy-OR; of the usual one, that no other is active. Shape (O, N)."""
    silent = (1.0 - leak) * np.exp(np.log1p(-strength)[:, active].sum(axis=2))  # [O, N]
    silent[usual] = 1.0
    chance = 1.0 - silent
    chance[usual] = silent.prod(axis=0)
    return chance


def _blame(strength: Floats, active: NDArray[np.int64], often: Floats, leak: float, size: int) -> Floats:
    """How many of the transitions each conjunction is held to have decided. Shape (J,)."""
    caused = 1.0 - (1.0 - leak) * np.exp(np.log1p(-strength)[active].sum(axis=1))
    share = np.minimum(strength[active] / caused[:, None], 1.0) * often[:, None]
    return np.bincount(active.ravel(), share.ravel(), size)  # type: ignore[return-value]  # weights make it float64


def _spread(active: NDArray[np.int64], weight: Floats, size: int) -> Floats:
    """Sum of the weights (U,) of the transitions in which each conjunction holds. Shape (J,)."""
    return np.bincount(active.ravel(), np.repeat(weight, active.shape[1]), size)  # type: ignore[return-value]
