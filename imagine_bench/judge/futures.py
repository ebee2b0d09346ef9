"""Is the imagined distribution right? Sampled futures against the exact ones of the rules, outcome by outcome.

A model that keeps one of several possible outcomes, or blurs them into one that cannot happen, may look right on each
single prediction; here it does not. Every macrostate of play is paired with every macro-action; after it an optimal
agent acts on what it sees, imagined or real, so that both are compared in closed loop to any depth.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from imagine_bench.capabilities import FutureSampler, SampledFutures
from imagine_bench.interfaces import Rules, TaskSpec
from imagine_bench.seeding import Purpose, SeedTree
from imagine_bench.store.results import Futures

DEPTH = 5
"""Macro-actions of each future."""
FRAMES = 4
"""Different pictures of each beginning among which its samples are divided."""
MODE = 0.05
"""Least probability of an outcome that counts as a mode."""
MISSING = 0.2
"""A mode is missing if it is imagined less than this times as often as it happens."""

State = tuple[int, ...]
Ending = dict[tuple[State, bool], float]
"""Probabilities of (macrostate, whether the episode ended there)."""


def imagined_futures(
    agent: FutureSampler,
    spec: TaskSpec,
    *,
    samples: int,
    appearance: str,
    seeds: SeedTree,
    purpose: Purpose = "evaluation",
) -> Futures:
    """Sample an agent's futures from every pair of a macrostate of play and a macro-action, and compare them.

    Args:
        agent: It is not changed.
        spec: The task; its frames are the same for every agent and seed.
        samples: Futures of each pair, at least one; rounded up to a multiple of :data:`FRAMES` where they are more.
        appearance: Appearance level of the frames (kinematic mode).
        seeds: Names the generator that imagination draws from.
        purpose: What the comparison is for; tuning has frames of its own.
    """
    rules = spec.rules
    play = [state for state in rules.states if not rules.is_terminal(state)]
    pairs = [(state, action) for state in play for action in range(rules.n_actions)]
    frames = min(FRAMES, samples)
    states = np.array([state for state, _ in pairs for _ in range(frames)], dtype=np.int64)  # [P F, M]
    actions = np.array([action for _, action in pairs for _ in range(frames)], dtype=np.int64)
    drawn = agent.sample_futures(
        spec.render_macrostates(states, appearance, SeedTree(0).child(purpose, "futures", spec.id).generator()),
        actions,
        follow=lambda macrostates: follow_optimum(rules, macrostates),
        samples=-(-samples // frames),
        depth=DEPTH,
        rng=seeds.generator(),
    )
    return compare(rules, pairs, drawn)


def follow_optimum(rules: Rules, macrostates: NDArray[np.int64]) -> NDArray[np.int64]:
    """The rules' optimal macro-action in each macrostate (N, M), or -1 where no episode goes on. Shape (N,)."""
    known: dict[State, int] = {
        state: rules.optimal_action(state) for state in rules.states if not rules.is_terminal(state)
    }
    return np.array([known.get(state, -1) for state in map(tuple, macrostates.tolist())], dtype=np.int64)


def compare(rules: Rules, pairs: list[tuple[State, int]], drawn: SampledFutures) -> Futures:
    """Compare sampled futures with the rules.

    Args:
        rules: The macrostate machine.
        pairs: Beginnings (macrostate, macro-action), P of them.
        drawn: Futures of P F rows, F rows a pair one after the other.
    """
    depth, rows, samples = drawn.rewards.shape
    count = rows // len(pairs) * samples
    macrostates = drawn.macrostates.reshape(depth, len(pairs), count, -1)
    rewards, ended = (values.reshape(depth, len(pairs), count) for values in (drawn.rewards, drawn.ended))
    names = (
        "total_variation",
        "floor",
        "missing",
        "hallucinated",
        "reward_error",
        "termination_error",
        "survival_probability",
    )
    table = {name: np.zeros((depth, len(pairs))) for name in names}
    for column, (state, action) in enumerate(pairs):
        belief: Ending = {(state, False): 1.0}
        for step in range(depth):
            table["survival_probability"][step, column] = sum(share for (_, over), share in belief.items() if not over)
            belief, reward = _advance(rules, belief, action if step == 0 else None)
            exact = _by_state(belief)
            imagined = _shares(macrostates[step, column])
            table["total_variation"][step, column] = total_variation(exact, imagined)
            table["floor"][step, column] = sampling_floor(exact, count)
            table["missing"][step, column] = missing_modes(exact, imagined)
            table["hallucinated"][step, column] = invented_modes(exact, imagined)
            table["reward_error"][step, column] = abs(float(rewards[step, column].mean()) - reward)
            over = sum(share for (_, is_over), share in belief.items() if is_over)
            table["termination_error"][step, column] = abs(float(ended[step, column].mean()) - over)
    return Futures(
        macrostates=np.array([state for state, _ in pairs], dtype=np.int64),
        actions=np.array([action for _, action in pairs], dtype=np.int64),
        samples=np.array(count),
        **table,
    )


def total_variation(exact: dict[State, float], imagined: dict[State, float]) -> float:
    """Half the sum of absolute differences of two distributions: 0 for equal ones, 1 for those that share nothing."""
    return 0.5 * sum(abs(exact.get(key, 0.0) - imagined.get(key, 0.0)) for key in {*exact, *imagined})


def sampling_floor(exact: dict[State, float], count: int) -> float:
    """Expected total variation between ``exact`` and ``count`` samples of itself: what a perfect model would show.

    Half the sum of the mean absolute deviations of binomial counts, by De Moivre's formula (Diaconis & Zabell 1991).
    """
    from scipy import stats  # noqa: PLC0415 - loads slowly, and every command imports this module

    p = np.minimum(np.array(list(exact.values())), 1.0)
    m = np.floor(count * p)
    deviation = 2.0 * (m + 1.0) * (1.0 - p) * stats.binom.pmf(m + 1.0, count, p)  # E |X - count p|
    return float(0.5 * deviation.sum() / count)


def missing_modes(exact: dict[State, float], imagined: dict[State, float]) -> int:
    """Outcomes of at least :data:`MODE` that are imagined less than :data:`MISSING` times as often as they happen."""
    return sum(share >= MODE and imagined.get(key, 0.0) < MISSING * share for key, share in exact.items())


def invented_modes(exact: dict[State, float], imagined: dict[State, float]) -> int:
    """Outcomes imagined at least :data:`MODE` of the time that the rules make impossible."""
    return sum(share >= MODE and exact.get(key, 0.0) == 0.0 for key, share in imagined.items())


def _advance(rules: Rules, belief: Ending, first: int | None) -> tuple[Ending, float]:
    """The belief after one more macro-action, ``first`` or else an optimal one, and the reward expected of it."""
    after: Ending = {}
    reward = 0.0
    for (state, over), weight in belief.items():
        if over:
            after[state, True] = after.get((state, True), 0.0) + weight
            continue
        for outcome in rules.outcomes(state, rules.optimal_action(state) if first is None else first):
            share, key = weight * outcome.probability, (outcome.macrostate, outcome.terminated)
            after[key] = after.get(key, 0.0) + share
            reward += share * outcome.reward
    return after, reward


def _by_state(belief: Ending) -> dict[State, float]:
    shares: dict[State, float] = {}
    for (state, _), share in belief.items():
        shares[state] = shares.get(state, 0.0) + share
    return shares


def _shares(macrostates: NDArray[np.int64]) -> dict[State, float]:
    """How often each macrostate occurs among (N, M) of them."""
    counts = Counter(map(tuple, macrostates.tolist()))
    return {state: count / len(macrostates) for state, count in counts.items()}
