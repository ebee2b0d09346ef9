"""Is the imagined distribution right? Sampled futures against the exact ones of the rules, outcome by outcome.

A model that keeps one of several possible outcomes, or blurs them into one that cannot happen, may look right on each
single prediction; here it does not. Every macrostate that is not terminal is paired with every macro-action; after it
an optimal agent acts on what it sees, imagined or real, so that both are compared in closed loop to any depth.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench.capabilities import FutureSampler, SampledFutures
from imagine_bench.interfaces import Floats, Macrostate, Rules, State, TaskSpec
from imagine_bench.rules import Belief, advance, by_macrostate, states_of
from imagine_bench.seeding import Purpose, SeedTree
from imagine_bench.store.results import Futures

DEPTH = 5  # macro-actions of each future
FRAMES = 4  # different frames of each start among which its samples are divided
MODE = 0.05  # least probability of an outcome that counts as a mode
MISSED = 0.2  # a mode is missed if it is imagined less than this times as often as it happens


def imagined_futures(
    agent: FutureSampler, spec: TaskSpec, *, samples: int, appearance: str, seeds: SeedTree,
    purpose: Purpose = "evaluation",
) -> Futures:  # fmt: skip
    """Sample an agent's futures from every pair of a macrostate and a macro-action, and compare them with the rules.

    Of each pair there are ``samples`` futures, at least one; more than :data:`FRAMES` are rounded up to a multiple.
    The frames (kinematic mode) are the same for every agent and seed; tuning has frames of its own. The agent, which
    imagines with the generator of ``seeds``, is not changed.
    """
    rules = spec.rules
    alive = [state for state in states_of(rules) if not rules.is_terminal(state)]
    pairs = [(state, action) for state in alive for action in range(rules.n_actions)]
    frames = min(FRAMES, samples)
    states = np.array([state for state, _ in pairs for _ in range(frames)], dtype=np.int64)  # [P F, M]
    actions = np.array([action for _, action in pairs for _ in range(frames)], dtype=np.int64)
    sampled = agent.sample_futures(
        spec.render_macrostates(states, appearance, SeedTree(0).child(purpose, "futures", spec.id).generator()),
        actions,
        follow=lambda macrostates: follow_optimum(rules, macrostates),
        samples=-(-samples // frames),
        depth=DEPTH,
        rng=seeds.generator(),
    )
    return compare(rules, pairs, sampled)


def follow_optimum(rules: Rules, macrostates: Macrostate) -> Macrostate:
    """The rules' optimal macro-action in each macrostate (N, M), or -1 where no episode goes on. Shape (N,)."""
    known = {state: rules.optimal_action(state) for state in states_of(rules) if not rules.is_terminal(state)}
    return np.array([known.get(state, -1) for state in map(tuple, macrostates.tolist())], dtype=np.int64)


def compare(rules: Rules, pairs: list[tuple[State, int]], sampled: SampledFutures) -> Futures:
    """Compare sampled futures with the rules: F rows for each of P pairs (macrostate, macro-action), pair by pair."""
    depth, rows, samples = sampled.rewards.shape
    count = rows // len(pairs) * samples
    macrostates = sampled.macrostates.reshape(depth, len(pairs), count, -1)
    rewards, ended = (values.reshape(depth, len(pairs), count) for values in (sampled.rewards, sampled.ended))
    table: dict[str, Floats] = {}
    for column, (state, action) in enumerate(pairs):
        belief: Belief = {(state, False): 1.0}
        for step in range(depth):
            alive = _mass(belief, over=False)
            belief, reward = advance(rules, belief, action if step == 0 else None)
            exact, imagined = by_macrostate(belief), _shares(macrostates[step, column])
            measures = {
                "total_variation": total_variation(exact, imagined),
                "sampling_noise_floor": sampling_noise_floor(exact, count),
                "missed": missed_modes(exact, imagined),
                "hallucinated": hallucinated_modes(exact, imagined),
                "reward_error": abs(float(rewards[step, column].mean()) - reward),
                "termination_error": abs(float(ended[step, column].mean()) - _mass(belief, over=True)),
                "survival_probability": alive,
            }
            for name, value in measures.items():
                table.setdefault(name, np.zeros((depth, len(pairs))))[step, column] = value
    return Futures(
        macrostates=np.array([state for state, _ in pairs], dtype=np.int64),
        actions=np.array([action for _, action in pairs], dtype=np.int64),
        samples=np.array(count),
        **table,
    )


def total_variation(exact: dict[State, float], imagined: dict[State, float]) -> float:
    """Half the sum of absolute differences of two distributions: 0 for equal ones, 1 for those that share nothing."""
    return 0.5 * sum(abs(exact.get(key, 0.0) - imagined.get(key, 0.0)) for key in {*exact, *imagined})


def sampling_noise_floor(exact: dict[State, float], count: int) -> float:
    """Expected total variation between ``exact`` and ``count`` samples of itself: what a perfect model would show.

    Half the sum of the mean absolute deviations of binomial counts, by De Moivre's formula (Diaconis & Zabell 1991).
    """
    p = np.minimum(np.array(list(exact.values())), 1.0)
    m = np.floor(count * p)
    deviation = 2.0 * (m + 1.0) * (1.0 - p) * scipy.stats.binom.pmf(m + 1.0, count, p)  # E |X - count p|
    return float(0.5 * deviation.sum() / count)


def missed_modes(exact: dict[State, float], imagined: dict[State, float]) -> int:
    """Outcomes of at least :data:`MODE` that are imagined less than :data:`MISSED` times as often as they happen."""
    return sum(share >= MODE and imagined.get(key, 0.0) < MISSED * share for key, share in exact.items())


def hallucinated_modes(exact: dict[State, float], imagined: dict[State, float]) -> int:
    """Outcomes imagined at least :data:`MODE` of the time that the rules make impossible."""
    return sum(share >= MODE and exact.get(key, 0.0) == 0.0 for key, share in imagined.items())


def _mass(belief: Belief, *, over: bool) -> float:
    """Probability that the episode has ended, or that it has not."""
    return sum(share for (_, ended), share in belief.items() if ended == over)


def _shares(macrostates: Macrostate) -> dict[State, float]:
    """How often each macrostate occurs among (N, M) of them."""
    counts = Counter(map(tuple, macrostates.tolist()))
    return {state: count / len(macrostates) for state, count in counts.items()}
