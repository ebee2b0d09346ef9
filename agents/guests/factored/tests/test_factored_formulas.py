"""The own agent's formulas, each once more in plain loops over a small learned model."""

from __future__ import annotations

import itertools
import math
from collections import Counter

import numpy as np
import pytest
from imagine_bench_factored.dynamics import FactorPrediction
from imagine_bench_factored.factors import Code, CodeTransition
from imagine_bench_factored.model import FactoredModel
from imagine_bench_factored.outcomes import Conjunctions, OutcomeModel
from imagine_bench_factored.settings import (
    DynamicsSettings,
    FactoredSettings,
    OutcomeSettings,
    PlanningSettings,
)

from imagine_bench.interfaces import Floats

SIZES, ACTIONS = (2, 3), 2
DYNAMICS = DynamicsSettings(
    parents=2,
    persistence=0.4,
    parent_decay=0.25,
    concentration=0.5,
    slip=0.02,
    by_itself=0.2,
    alike=0.3,
    fails=0.2,
    pseudo_fails=4.0,
)
SETTINGS = FactoredSettings(dynamics=DYNAMICS, planning=PlanningSettings(least_probability=0.1, branches=3))
CODES = list(itertools.product(*map(range, SIZES)))
STARTS = [(0, 0), (1, 0), (1, 0)]
"""Codes that episodes began with: each tests for ends, and for nothing else."""


def lived() -> list[CodeTransition]:
    """Twelve transitions; not every action was tried in every code."""
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(12):
        code, following = CODES[rng.integers(6)], CODES[rng.integers(6)]
        end = following == (1, 2)
        rows.append(CodeTransition(code, int(rng.integers(2)), following, 5.0 if end else -1.0, end))
    return rows


@pytest.fixture(scope="module")
def model() -> FactoredModel:
    learned = FactoredModel(SIZES, ACTIONS, SETTINGS)
    for row in lived():
        learned.add(row)
    for start in STARTS:
        learned.outcomes.add_start(start)
    learned.outcomes.fit()
    return learned


PARENTS = {0: ((0,), (0, 1)), 1: ((1,), (0, 1))}


def shares(counts: Floats, spread: Floats) -> tuple[Floats, Floats, float]:
    """Of counts of the next value: the expectation with pseudo counts, the seen value, the weight of the prior."""
    pseudo = DYNAMICS.concentration * len(counts)
    total = counts.sum()
    return (counts + pseudo * spread) / (total + pseudo), counts / max(total, 1), pseudo / (total + pseudo)


def structures(
    factor: int, code: Code, rows: list[CodeTransition], pooled: list[CodeTransition], fails: float
) -> list[tuple[Floats, Floats, float]]:
    """The expectation of each for an action after ``rows`` of it, and others that were pooled.

    It stays; changes by itself; tables; tables whose rows are alike. Each is the expected value, the seen one, and the
    weight of the prior.
    """
    values = SIZES[factor]
    stays = np.eye(values)[code[factor]]
    others = 1.0 - stays
    uniform = np.full(values, 1.0 / values)

    def following(some: list[CodeTransition], parents: tuple[int, ...]) -> Floats:
        alike = [row for row in some if all(row.code[parent] == code[parent] for parent in parents)]
        return np.bincount([row.following[factor] for row in alike], minlength=values)

    expected, seen, unknown = shares(following(pooled, (factor,)), uniform)
    found = [(stays * 0.98 + others * 0.02 / (values - 1), stays * bool(rows), 0.0)]
    found.append((expected, seen * bool(rows), unknown))
    alike = []
    stayed = sum(row.following[factor] == row.code[factor] for row in rows)
    rate = (stayed + 4.0 * fails) / (len(rows) + 4.0)
    frequency = stayed / max(len(rows), 1)
    *_, of_rate = shares(np.full(values, len(rows) / values), uniform)
    for parents in PARENTS[factor]:
        here = following(rows, parents)
        found.append(shares(here, uniform))
        goes, went, unknown = shares(here * others, others / (values - 1))
        expected = rate * stays + (1 - rate) * goes
        alike.append((expected, frequency * stays + (1 - frequency) * went, (1 - rate) * unknown + rate * of_rate))
    return found + alike


def learned_by_hand() -> tuple[Floats, list[float], int]:
    """How probable each structure of each factor and action is, (2, A, 6), and how often any action fails to change it.

    Priors, and how well each told the next value; the joint knowledge of actions is pooled whenever a tenth more was
    seen.
    """
    by_size = np.array([1 / 1.25, 0.25 / 1.25])
    prior = np.array([0.4, 0.6 * 0.2, *0.6 * 0.8 * 0.7 * by_size, *0.6 * 0.8 * 0.3 * by_size])
    weight, fails, pooled_at = np.tile(prior, (2, ACTIONS, 1)), [0.2, 0.2], 0
    for seen, row in enumerate(lived(), start=1):
        before = [each for each in lived()[: seen - 1] if each.action == row.action]
        for factor in range(2):
            every = structures(factor, row.code, before, lived()[:pooled_at], fails[factor])
            for index, (expected, *_) in enumerate(every):
                weight[factor, row.action, index] *= expected[row.following[factor]]
        if seen >= 1.1 * pooled_at:
            pooled_at = seen
            tried, stayed = np.zeros(2), np.zeros(2)
            for factor, each in itertools.product(range(2), lived()[:seen]):
                same = [row for row in lived()[:seen] if row.action == each.action]
                if all(row.following[factor] == row.code[factor] for row in same):
                    continue  # nothing says that this action ever changes it
                changes = 1.0 - weight[factor, each.action, 0] / weight[factor, each.action].sum()
                tried[factor] += changes
                stayed[factor] += changes * (each.following[factor] == each.code[factor])
            of_all = (stayed.sum() + 0.2) / (tried.sum() + 1.0)
            fails = [(stayed[factor] + 4.0 * of_all) / (tried[factor] + 4.0) for factor in range(2)]
    return weight / weight.sum(axis=2, keepdims=True), fails, pooled_at


def predicted(factor: int, code: Code, action: int) -> tuple[FactorPrediction, Floats]:
    """Predictions, and experience: averages over the structures."""
    weight, fails, pooled_at = learned_by_hand()
    rows = [row for row in lived() if row.action == action]
    every = structures(factor, code, rows, lived()[:pooled_at], fails[factor])
    expected, seen, unknown = zip(*every, strict=True)
    stays = np.eye(SIZES[factor])[code[factor]]  # where an action leaves a factor alone, only reading it may fail
    mean = weight[factor, action]
    return FactorPrediction(mean @ np.array([stays, *expected[1:]]), mean @ np.array(unknown)), mean @ np.array(seen)


@pytest.mark.parametrize("factor", [0, 1])
def test_dynamics_average_over_what_a_factor_may_depend_on(model: FactoredModel, factor: int) -> None:
    found, seen = model.dynamics.predict(np.array(CODES))[factor], model.dynamics.factors[factor].seen(np.array(CODES))
    for (row, code), action in itertools.product(enumerate(CODES), range(ACTIONS)):
        by_hand, seen_by_hand = predicted(factor, code, action)
        assert found.expected[row, action] == pytest.approx(by_hand.expected)
        assert seen[row, action] == pytest.approx(seen_by_hand)
        assert found.unknown[row, action] == pytest.approx(by_hand.unknown)
    many = np.tile(CODES, (20, 1))
    again = model.dynamics.factors[factor].seen(many)
    np.testing.assert_allclose(again, np.tile(seen, (20, 1, 1)), err_msg="read in several parts")


def test_each_conjunction_has_a_number_of_its_own() -> None:
    """Single values and whole codes, of the code after, or of the one before together with the action."""
    conjunctions = Conjunctions(SIZES, ACTIONS, OutcomeSettings(order=1, prior=0.1, order_decay=0.3, choice_decay=0.5))
    every = list(itertools.product(CODES, range(ACTIONS), CODES))
    active = conjunctions.active(*(np.array([row[part] for row in every]) for part in range(3)))
    told = [
        [(following[0],), (following[1],), following, (action,), (code[0], action), (code[1], action), (*code, action)]
        for code, action, following in every
    ]
    named = set()
    for keys, row in zip(told, active.tolist(), strict=True):
        named |= set(zip(range(7), keys, row, strict=True))
    assert sorted(number for *_, number in named) == list(range(2 + 3 + 6 + 2 + 4 + 6 + 12)), "one a conjunction"
    prior = conjunctions.prior[conjunctions.group]
    for place, _, number in named:
        with_action = 0.5 if place >= 3 else 1.0
        order = 0.3 if place == 6 else 1.0
        assert prior[number] == pytest.approx(0.1 * order * with_action), "two values and the action are three"


def brought(model: FactoredModel, code: Code, action: int, following: Code) -> tuple[dict[int, float], float]:
    """Probability of each outcome, and that something untested decides: by causes, and by experience."""
    chance, untested = by_noisy_or(model, code, action, following)
    pseudo, same = SETTINGS.outcomes.pseudo_seen, [row for row in lived() if row[:3] == (code, action, following)]
    seen = Counter(model.outcomes.outcomes.index((row.reward, row.terminated)) for row in same)
    total = pseudo + len(same)
    return {each: (pseudo * chance[each] + seen[each]) / total for each in chance}, untested


def by_noisy_or(model: FactoredModel, code: Code, action: int, following: Code) -> tuple[dict[int, float], float]:
    """The same by causes alone."""
    causes, pseudo = model.outcomes.causes, SETTINGS.outcomes.pseudo_tests
    assert causes is not None
    (active,) = model.outcomes.conjunctions.active(np.array([code]), np.array([action]), np.array([following]))
    silent = np.prod(1.0 - causes.strength[:, active], axis=1)
    chance = {outcome: 1.0 - float(none) for outcome, none in enumerate(silent)}
    chance[causes.default] = none = float(np.prod(np.delete(silent, causes.default)))
    goes_on, ends = causes.cause_rate[:, model.outcomes.conjunctions.group[active]]
    tests, held = causes.tests[active], held_in_starts(model.outcomes, STARTS)[active]
    tested = np.prod(1.0 - pseudo * (goes_on / (pseudo + tests) + ends / (pseudo + tests + held)))
    return {outcome: share / sum(chance.values()) for outcome, share in chance.items()}, float(1.0 - tested) * none


def test_a_step_is_as_probable_as_its_factors_say(
    model: FactoredModel,
) -> None:
    following, sure = model.likeliest(np.array(CODES))
    for (row, code), action in itertools.product(enumerate(CODES), range(ACTIONS)):
        expected = [predicted(factor, code, action)[0].expected for factor in range(2)]
        assert following[row, action].tolist() == [int(each.argmax()) for each in expected]
        assert sure[row, action] == pytest.approx(math.prod(float(each.max()) for each in expected))
    untried = FactoredModel(SIZES, ACTIONS, SETTINGS)
    assert not untried.likeliest(np.array(CODES))[1].any()


def unsure(factors: list[FactorPrediction], untested: float) -> float:
    """The probability that something unknown decides: a factor, or the outcome."""
    return 1.0 - math.prod(1.0 - factor.unknown for factor in factors) * (1.0 - untested)


def test_what_follows_is_summed_over_all_that_may(model: FactoredModel) -> None:
    moves = model.moves(np.array(CODES))
    found = model.results(np.array(CODES), moves)
    causes = model.outcomes.causes
    assert causes is not None and len(causes.outcomes) == 2
    dropped = beyond = 0
    for (row, code), action in itertools.product(enumerate(CODES), range(ACTIONS)):
        factors = [predicted(factor, code, action)[0] for factor in range(2)]
        joint = {after: float(factors[0].expected[after[0]] * factors[1].expected[after[1]]) for after in CODES}
        likely = {after: share for after, share in joint.items() if share >= min(0.1, max(joint.values()))}
        dropped += len(joint) - len(likely)
        beyond += max(0, len(likely) - 3)
        likely = dict(sorted(likely.items(), key=lambda each: -each[1])[:3])
        reward = ends = untested = 0.0
        goes_on = {}
        for after, share in likely.items():
            weight = share / sum(likely.values())
            chance, open_here = brought(model, code, action, after)
            over = sum(share for outcome, share in chance.items() if causes.outcomes[outcome][1])
            reward += weight * sum(share * causes.outcomes[outcome][0] for outcome, share in chance.items())
            ends += weight * over
            untested += weight * open_here
            goes_on[after] = weight * (1.0 - over)
        branches = zip(map(tuple, moves.following[row, action].tolist()), found.p_continues[row, action], strict=True)
        assert {after: share for after, share in branches if share > 0.0} == pytest.approx(goes_on)
        assert found.reward[row, action] == pytest.approx(reward)
        assert found.p_terminated[row, action] == pytest.approx(ends)
        assert found.unknown[row, action] == pytest.approx(unsure(factors, untested))
    assert dropped > 0 and beyond > 0
    for each in lived()[:3]:
        (probability,), (unknown,) = model.probabilities([each])
        factors = [predicted(factor, each.code, each.action)[0] for factor in range(2)]
        chance, untested = brought(model, each.code, each.action, each.following)
        moved = factors[0].expected[each.following[0]] * factors[1].expected[each.following[1]]
        assert probability == pytest.approx(moved * chance[causes.outcomes.index((each.reward, each.terminated))])
        assert unknown == pytest.approx(unsure(factors, untested))


def test_a_goal_of_all_values_but_one_is_expected() -> None:
    """Four values of five are the goal; it was met with one value of the fifth alone, and each smaller part in vain."""
    goal = (1, 1, 1, 1)
    learned = OutcomeModel((2, 2, 2, 2, 3), ACTIONS, OutcomeSettings())
    for four in itertools.product(range(2), repeat=4):
        for fifth in range(1 if four == goal else 3):
            reached = four == goal
            learned.add(CodeTransition((0,) * 5, 0, (*four, fifth), 50.0 if reached else -1.0, reached))
    learned.fit()
    codes = np.array([(*goal, 2), (1, 1, 1, 0, 2)])
    chance, _ = learned.predict(np.zeros((2, 5), dtype=np.int64), np.zeros(2, dtype=np.int64), codes)
    met, missed = chance[:, learned.outcomes.index((50.0, True))]
    assert met > 0.5 and missed < 0.05


def teach(learned: OutcomeModel, rows: list[CodeTransition], starts: list[Code]) -> None:
    """Learn transitions, and codes that episodes began with."""
    for row in rows:
        learned.add(row)
    for start in starts:
        learned.add_start(start)
    learned.fit()


def held_in_starts(learned: OutcomeModel, starts: list[Code]) -> Floats:
    """In how many starts each conjunction of values of one code held. Shape (J,)."""
    of_next = sum(learned.conjunctions.next.of_each)
    held = np.zeros(len(learned.conjunctions.group))
    for start in starts:
        (here,) = learned.conjunctions.active(np.array([start]), np.array([0]), np.array([start]))
        held[here[here < of_next]] += 1.0
    return held


@pytest.mark.parametrize("starts", [[], [(0, 0), (1, 0), (1, 0), (1, 2)]], ids=["no starts", "starts"])
def test_causes_are_found_by_expectation_maximisation(starts: list[Code]) -> None:
    """The same with dense matrices over three outcomes: which conjunctions hold in which transitions, (N, M).

    A start is a test of every conjunction that holds in it, for outcomes that end an episode alone. A code that ended
    an episode, (1, 2), is no evidence as a start.
    """
    learned = OutcomeModel(SIZES, ACTIONS, OutcomeSettings(order=1, sweeps=6, masked_weight=0.3))
    rows = [row._replace(reward=2.0) if row.following == (0, 1) else row for row in lived()]
    teach(learned, rows, starts)
    settings, groups, causes = learned.settings, learned.conjunctions.group, learned.causes
    assert causes is not None and len(learned.outcomes) == 3
    active = learned.conjunctions.active(*(np.array([row[part] for row in rows]) for part in range(3)))
    brought = np.array([learned.outcomes.index((row.reward, row.terminated)) for row in rows])
    met = np.unique(active)
    holds = (active[:, :, None] == met).any(axis=1).astype(float)
    belongs = np.eye(len(learned.conjunctions.prior))[groups[met]]  # [M, G]
    few, pseudo = settings.pseudo_conjunctions, settings.pseudo_tests
    went_on = held_in_starts(learned, [start for start in starts if start != (1, 2)])

    def silent(strength: Floats) -> Floats:
        return (1.0 - settings.leak) * np.prod(1.0 - holds * strength, axis=1)

    def decided(strength: Floats, outcome: int) -> Floats:
        return strength * ((brought == outcome) / (1.0 - silent(strength)) @ holds)

    def explain(default: int) -> tuple[dict[int, Floats], Floats, Floats, float]:
        """Strengths by outcome, tests, rates of those that do not end and that end, and the posterior's logarithm."""
        strengths, chance = {}, np.ones((3, len(rows)))
        rate = np.tile(0.25 * few * learned.conjunctions.prior / (few + belongs.sum(axis=0)), (2, 1))
        tests = (brought == default) @ holds
        cost = 0.0
        for outcome in {0, 1, 2} - {default}:
            own = learned.conjunctions.prior / 2
            strength = belongs @ own
            weight = np.where((brought == outcome) | (brought == default), 1.0, settings.masked_weight) @ holds
            ends = learned.outcomes[outcome][1]
            weight = weight + ends * went_on[met]
            for _ in range(settings.sweeps):
                strength = (pseudo * belongs @ own + decided(strength, outcome)) / (pseudo + weight)
                own = (few * learned.conjunctions.prior / 2 + strength @ belongs) / (few + belongs.sum(axis=0))
            strengths[outcome] = strength
            rate[int(ends)] += own
            tests = tests + decided(strength, outcome)
            cost += float(np.maximum(strength - belongs @ own, 0.0) @ np.log(belongs @ own))
            chance[default] *= silent(strength)
        for outcome, strength in strengths.items():
            chance[outcome] = 1.0 - silent(strength)
            others = [1.0 - silent(strengths[other]) for other in strengths.keys() - {outcome}]
            chance[outcome] *= np.prod(1.0 - 0.5 * np.array(others), axis=0)  # either may prevail
        likelihood = chance[brought, np.arange(len(rows))] / chance.sum(axis=0)
        return strengths, tests, rate, float(np.log(likelihood).sum()) + cost

    assert causes.default == int(np.argmax([explain(default)[3] for default in range(3)])), "the best explanation"
    strengths, tests, rate, posterior = explain(causes.default)
    for outcome, strength in strengths.items():
        assert causes.strength[outcome, met] == pytest.approx(strength)
    assert causes.tests[met] == pytest.approx(tests)
    assert causes.cause_rate == pytest.approx(rate)
    assert causes.log_posterior == pytest.approx(posterior)


def test_of_two_outcomes_the_one_prevails_that_did_before() -> None:
    """Both ends have a cause, one value each; both causes held twice, and the bad end came. Then a new such code."""
    sizes = (2, 2, 5)
    learned = OutcomeModel(sizes, ACTIONS, OutcomeSettings(order=1))
    for first, second, third in itertools.product(*map(range, sizes)):
        outcome = (-5.0, True) if first else (50.0, True) if second else (-1.0, False)
        if not (first and second and third >= 2):
            learned.add(CodeTransition((0, 0, 0), 0, (first, second, third), *outcome))
    learned.fit()
    codes = np.array([(1, 1, 4), (1, 0, 4), (0, 1, 4)])
    chance, _ = learned.predict(np.zeros((3, 3), dtype=np.int64), np.ones(3, dtype=np.int64), codes)
    bad, good = (learned.outcomes.index((reward, True)) for reward in (-5.0, 50.0))
    assert chance[0, bad] > 0.7 and chance[0, good] < 0.4, "near (2 + 1/2) / (2 + 1) and 1/6"
    assert chance[1, bad] > 0.9 and chance[2, good] > 0.8
    assert learned.prevails[bad, good] == pytest.approx(5.0 / 6.0, abs=0.05)
    assert learned.prevails[bad, good] + learned.prevails[good, bad] == pytest.approx(1.0)
