"""``python tests/measure/decisions.py [BENCH ...] [DRAWS]``: how often does the default bench decide its headlines?

The benches are kept ones of the agents of the headlines, by default those of this repository; their seeds are put
together. A group of these runs, in an order, is a repetition of the default bench, and of one with --until-decided,
whose first stage has the first runs. First come groups that share no run, then groups drawn with replacement, which
differ as groups of new seeds would. Where the kept runs have another number of tests than the default bench, the drawn
scores get its noise (:func:`with_noise_of`). Printed before is how often one bench claims a headline though all agents
have one law. Printed last are the CPU seconds of these runs.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import interval_coverage
import numpy as np

from imagine_bench import statistics
from imagine_bench.interfaces import Floats
from imagine_bench.protocols.control import protocol
from imagine_bench.protocols.presets import PRESETS
from imagine_bench.running.headlines import stages
from imagine_bench.store.loading import load_so_far
from imagine_bench.store.results import BenchResult

KEPT = (interval_coverage.RESULTS / "arrow_puzzle-quick-seeds_570_to_593",)
PAIRS: Sequence[tuple[str, str]] = PRESETS["quick"]["headlines"]
_DEFAULT = protocol("arrow_puzzle")
AGENTS = tuple(dict.fromkeys(agent for pair in PAIRS for agent in pair))


def looks_until(most: int) -> list[dict[str, int]]:
    """Seeds of each agent at each look of a bench that ends with ``most`` seeds of the agent that has most."""
    first = len(_DEFAULT.seeds)
    return [{agent: len(_DEFAULT.seeds_of(agent)) + count - first for agent in AGENTS} for count in stages(first, most)]


BENCHES = {"the default bench": looks_until(len(_DEFAULT.seeds)), "--until-decided": looks_until(19)}
"""The looks of both kinds of benches; the default bench has one."""
_LEVEL = 1.0 - statistics.LEVEL


def deciding_look(looks: Sequence[Mapping[str, int]], scores: Mapping[str, Floats], trials: int) -> int | None:
    """At which look, from 0 on, all headlines are decided, of the scores (seeds,) of each agent; None if at none."""
    for look, counts in enumerate(looks):
        so_far = {agent: scores[agent][:count] for agent, count in counts.items()}
        found = [statistics.difference(so_far[agent], so_far[base], trials=trials).p for agent, base in PAIRS]
        if (statistics.holm(found) * len(looks) < _LEVEL).all():
            return look
    return None


def repetitions(
    looks: Sequence[Mapping[str, int]], benches: Sequence[Path], draws: int, rng: np.random.Generator
) -> dict[str, list[int | None]]:
    """When each repetition is decided, of groups that share no run and of groups drawn with replacement."""
    results = [load_so_far(bench) for bench in benches]
    trials = min(result.protocol.evaluation_episodes for result in results)
    scores = {agent: rng.permutation(scores_of(agent, results)) for agent in AGENTS}
    last = looks[-1]
    apart = min(len(scores[agent]) // count for agent, count in last.items())
    tests = _DEFAULT.evaluation_episodes
    noisy = {agent: with_noise_of(tests, each, trials, rng, draws) for agent, each in scores.items()}
    groups = {
        "disjoint": [
            {agent: scores[agent][place * count : (place + 1) * count] for agent, count in last.items()}
            for place in range(apart)
        ],
        "drawn": [{agent: rng.choice(noisy[agent], count) for agent, count in last.items()} for _ in range(draws)],
    }
    trials_of = {"disjoint": trials, "drawn": tests}
    return {name: [deciding_look(looks, group, trials_of[name]) for group in each] for name, each in groups.items()}


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
    """CPU seconds of one run of each agent in the default bench: training to its end, and its tests."""
    spent: dict[str, list[float]] = {agent: [] for agent in AGENTS}
    for run in (run for bench in benches for run in load_so_far(bench).runs if run.agent in AGENTS):
        rows = [row for row in run.checkpoints if row.episodes in _DEFAULT.budgets]
        tests = sum(row.eval_cpu_s / row.test_episodes for row in rows) * _DEFAULT.evaluation_episodes
        spent[run.agent].append(rows[-1].train_cpu_s + tests)
    return {agent: float(np.mean(each)) for agent, each in spent.items()}


def false_claims(runs: Floats, looks: Sequence[Mapping[str, int]], trials: int | None = None) -> float:
    """Share of benches that claim a headline at any look, from scores (draws, 3, seeds) of three agents of one law."""
    claimed = np.zeros(len(runs), dtype=bool)
    for counts in looks:
        agent, *bases = (runs[:, place, : counts[name]] for place, name in enumerate(AGENTS))
        p_values = [statistics.differences(agent, base, trials=trials)[3] for base in bases]
        claimed |= len(looks) * len(bases) * np.min(p_values, axis=0) < _LEVEL
    return float(claimed.mean())


def drawn(draws: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Scores (draws, 3, seeds) of three agents of one law: every law of :mod:`interval_coverage`, and kept scores."""
    shape = (draws, 3, max(BENCHES["--until-decided"][-1].values()))
    found = {name: law(rng, shape) for name, law in interval_coverage.LAWS.items()}
    many = interval_coverage.populations(interval_coverage.RESULTS)
    kept = [rng.choice(many[which], shape[1:]) for which in rng.integers(len(many), size=draws)]
    return {**found, "kept scores": np.array(kept)}


def main(words: Sequence[str]) -> None:
    """Print both measurements."""
    benches = [Path(word) for word in words if not word.isdigit()] or KEPT
    draws = next((int(word) for word in words if word.isdigit()), 4000)
    rng = np.random.default_rng(0)
    for name, runs in drawn(draws, rng).items():
        shares = [f"{100.0 * false_claims(runs, looks):.1f} % of {bench}" for bench, looks in BENCHES.items()]
        print(f"{name}: a difference that is none is claimed by {', '.join(shares)}")
    spent = cpu_seconds(benches)
    for bench, looks in BENCHES.items():
        prices = [sum(spent[agent] * count for agent, count in counts.items()) for counts in looks]
        for name, found in repetitions(looks, benches, draws, rng).items():
            shares = [100.0 * found.count(look) / len(found) for look in range(len(looks))]
            taken = np.mean([prices[-1 if look is None else look] for look in found])
            print(
                f"{bench}: {sum(shares):.1f} % of {len(found)} {name} repetitions are decided, on average after ",
                end="",
            )
            print(f"{taken:.0f} CPU s of these agents")
            for counts, share, price in zip(looks, shares, prices, strict=True):
                print(f"  with {counts} seeds, after {price:.0f} CPU s: {share:.1f} %")
    for agent, cpu_s in spent.items():
        print(f"{agent}: a run takes {cpu_s:.0f} CPU s")


if __name__ == "__main__":
    main(sys.argv[1:])
