"""``python tests/measure/decisions.py [BENCH ...] [DRAWS]``: how often would the default bench decide its headlines?

The benches are kept ones of the agents of the headlines, by default those of this repository; their seeds are put
together. A group with as many seeds of each agent as the default bench has is a repetition of it. First come groups
that share no seed, then groups drawn with replacement, which differ as groups of new seeds would. Where the kept runs
have another number of tests than the default bench, the drawn scores get its noise (:func:`with_noise_of`). Printed
before is how often one look, and several with more seeds each time, claim a headline though all agents have one law.
Printed last are the CPU seconds of these runs.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import interval_coverage
import numpy as np

from imagine_bench import statistics
from imagine_bench.interfaces import Floats
from imagine_bench.protocols.control import PRESETS, protocol
from imagine_bench.running.headlines import stages
from imagine_bench.store.loading import load_so_far
from imagine_bench.store.results import BenchResult

KEPT = (interval_coverage.RESULTS / "arrow_puzzle-quick-seeds_570_to_593",)
PAIRS: Sequence[tuple[str, str]] = PRESETS["quick"]["headlines"]
_DEFAULT = protocol("arrow_puzzle")
COUNTS = {agent: len(_DEFAULT.seeds_of(agent)) for pair in PAIRS for agent in pair}
"""Seeds of each agent in the default bench."""
LOOKS = stages(len(_DEFAULT.seeds), 19)
"""Seeds of each agent at each look of --until-decided."""
_LEVEL = 1.0 - statistics.LEVEL


def decided(scores: Mapping[str, Floats], trials: int) -> list[bool]:
    """Which headlines are decided, of the scores (seeds,) of each agent."""
    found = [statistics.difference(scores[agent], scores[base], trials=trials).p for agent, base in PAIRS]
    return (statistics.holm(found) < _LEVEL).tolist()


def repetitions(benches: Sequence[Path], draws: int, rng: np.random.Generator) -> dict[str, list[list[bool]]]:
    """Which headlines each repetition decides, of groups that share no seed and of groups drawn with replacement."""
    results = [load_so_far(bench) for bench in benches]
    trials = min(result.protocol.evaluation_episodes for result in results)
    scores = {agent: rng.permutation(scores_of(agent, results)) for agent in COUNTS}
    apart = min(len(scores[agent]) // count for agent, count in COUNTS.items())
    tests = _DEFAULT.evaluation_episodes
    noisy = {agent: with_noise_of(tests, each, trials, rng, draws) for agent, each in scores.items()}
    groups = {
        "disjoint": [
            {agent: scores[agent][place * count : (place + 1) * count] for agent, count in COUNTS.items()}
            for place in range(apart)
        ],
        "drawn": [{agent: rng.choice(noisy[agent], count) for agent, count in COUNTS.items()} for _ in range(draws)],
    }
    trials_of = {"disjoint": trials, "drawn": tests}
    return {name: [decided(group, trials_of[name]) for group in each] for name, each in groups.items()}


def with_noise_of(tests: int, scores: Floats, trials: int, rng: np.random.Generator, draws: int) -> Floats:
    """Scores (draws,) as runs with ``tests`` tests would have, from scores (seeds,) of runs with ``trials`` tests.

    The variance of scores is that between trained agents plus the binomial one of the tests. Scores are drawn, moved
    toward their mean until the former is left, and given binomial noise anew. ``tests`` equal to ``trials`` changes
    nothing but for chance.
    """
    variance = scores.var(ddof=1)
    between = max(variance - np.mean(scores * (1.0 - scores)) / (trials - 1), 0.0)
    drawn = scores.mean() + (rng.choice(scores, draws) - scores.mean()) * np.sqrt(between / variance)
    return rng.binomial(tests, np.clip(drawn, 0.0, 1.0)) / tests


def scores_of(agent: str, results: Sequence[BenchResult]) -> Floats:
    """Success rates (seeds,) of an agent after as many episodes as the default bench has, of all benches with it."""
    with_agent = [result for result in results if agent in result.protocol.agents]
    last = _DEFAULT.budgets[-1]
    columns = [result.success_rates(agent)[:, result.protocol.budgets.index(last)] for result in with_agent]
    return np.concatenate(columns)


def cpu_seconds(benches: Sequence[Path]) -> dict[str, float]:
    """CPU seconds that a run of each agent takes on average, for all its training and tests."""
    results = [load_so_far(bench) for bench in benches]
    spent: dict[str, list[float]] = {agent: [] for agent in COUNTS}
    for run in (run for result in results for run in result.runs if run.agent in COUNTS):
        spent[run.agent].append(run.checkpoints[-1].train_cpu_s + sum(row.eval_cpu_s for row in run.checkpoints))
    return {agent: float(np.mean(each)) for agent, each in spent.items()}


def false_claims(
    runs: Floats, looks: Sequence[Sequence[int]] = tuple((count,) * 3 for count in LOOKS), trials: int | None = None
) -> float:
    """Share of benches that claim a headline at any look, from scores (draws, 3, seeds) of three agents of one law.

    A look is the number of seeds of the agent and of both that it is compared with.
    """
    claimed = np.zeros(len(runs), dtype=bool)
    for counts in looks:
        agent, *bases = (runs[:, place, :count] for place, count in enumerate(counts))
        p_values = [statistics.differences(agent, base, trials=trials)[3] for base in bases]
        claimed |= len(looks) * len(bases) * np.min(p_values, axis=0) < _LEVEL
    return float(claimed.mean())


def drawn(draws: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Scores (draws, 3, seeds) of three agents of one law: every law of :mod:`interval_coverage`, and kept scores."""
    shape = (draws, 3, LOOKS[-1])
    found = {name: law(rng, shape) for name, law in interval_coverage.LAWS.items()}
    many = interval_coverage.populations(interval_coverage.RESULTS)
    kept = [rng.choice(many[which], shape[1:]) for which in rng.integers(len(many), size=draws)]
    return {**found, "kept scores": np.array(kept)}


def main(words: Sequence[str]) -> None:
    """Print both measurements."""
    benches = [Path(word) for word in words if not word.isdigit()] or KEPT
    draws = next((int(word) for word in words if word.isdigit()), 4000)
    rng = np.random.default_rng(0)
    once = [tuple(COUNTS[agent] for agent in ("imagination", "dqn", "dqn_more_updates"))]
    for name, runs in drawn(draws, rng).items():
        shares = [100.0 * share for share in (false_claims(runs, once), false_claims(runs))]
        print(
            f"{name}: {shares[0]:.1f} % of benches claim a difference that is none, with {once[0]} seeds; "
            f"{shares[1]:.1f} % at any look, with {LOOKS} seeds of each"
        )
    for name, found in repetitions(benches, draws, rng).items():
        both = np.mean([all(each) for each in found])
        single = np.mean(found, axis=0)
        print(f"{len(found)} {name} repetitions of {COUNTS} seeds: both decided in {100 * both:.1f} %")
        for (agent, base), share in zip(PAIRS, single, strict=True):
            print(f"  {agent} against {base}: {100 * share:.1f} %")
    for agent, cpu_s in cpu_seconds(benches).items():
        print(f"{agent}: {COUNTS[agent]} runs of {cpu_s:.0f} CPU s")


if __name__ == "__main__":
    main(sys.argv[1:])
