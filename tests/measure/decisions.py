"""``python tests/measure/decisions.py [BENCH] [DRAWS]``: how often would the default bench have decided its headlines?

BENCH is a kept bench with many seeds of the agents of the headlines, by default the one of this repository. Groups of
six of its seeds are repetitions of the default bench: first disjoint ones, then random draws. Printed first is how
often looking again and again, with more seeds each time, claims a headline though all agents have one law.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import interval_coverage
import numpy as np

from imagine_bench import statistics
from imagine_bench.interfaces import Floats
from imagine_bench.protocols.control import PRESETS
from imagine_bench.running.headlines import stages
from imagine_bench.store.loading import load_so_far

KEPT = interval_coverage.RESULTS / "arrow_puzzle-quick-fresh_seeds"
PAIRS: Sequence[tuple[str, str]] = PRESETS["quick"]["headlines"]
SEEDS = len(PRESETS["quick"]["seeds"])
LOOKS = stages(SEEDS, 15)
"""Seeds at each look of --until-decided."""
_LEVEL = 1.0 - statistics.LEVEL


def decided(runs: Sequence[tuple[Floats, Floats]], trials: int) -> list[bool]:
    """Which headlines are decided, of the scores (seeds,) of both agents of each."""
    p_values = statistics.holm([statistics.difference(*pair, trials=trials).p for pair in runs])
    return (p_values < _LEVEL).tolist()


def repetitions(bench: Path, draws: int, rng: np.random.Generator) -> dict[str, list[list[bool]]]:
    """Which headlines each repetition decides, of disjoint groups of seeds and of random ones."""
    result = load_so_far(bench)
    scores = {agent: result.success_rates(agent)[:, -1] for pair in PAIRS for agent in pair}
    seeds = rng.permutation(len(result.protocol.seeds))
    groups = {
        "disjoint": [seeds[start : start + SEEDS] for start in range(0, len(seeds) - SEEDS + 1, SEEDS)],
        "random": [rng.choice(seeds, SEEDS, replace=False) for _ in range(draws)],
    }
    trials = result.protocol.evaluation_episodes
    return {
        name: [decided([(scores[agent][some], scores[base][some]) for agent, base in PAIRS], trials) for some in each]
        for name, each in groups.items()
    }


def false_claims(runs: Floats, looks: Sequence[int] = tuple(LOOKS), trials: int | None = None) -> float:
    """Share of benches that claim a headline at any look, from scores (draws, 3, seeds) of three agents of one law."""
    claimed = np.zeros(len(runs), dtype=bool)
    for count in looks:
        agent, *bases = (runs[:, place, :count] for place in range(3))
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
    bench = next((Path(word) for word in words if not word.isdigit()), KEPT)
    draws = next((int(word) for word in words if word.isdigit()), 4000)
    rng = np.random.default_rng(0)
    for name, runs in drawn(draws, rng).items():
        print(f"{name}: {100 * false_claims(runs):.1f} % of benches claim a difference that is none, at any of {LOOKS}")
    for name, found in repetitions(bench, draws, rng).items():
        both = np.mean([all(each) for each in found])
        single = np.mean(found, axis=0)
        print(f"{len(found)} {name} repetitions of {SEEDS} seeds: both decided in {100 * both:.1f} %")
        for (agent, base), share in zip(PAIRS, single, strict=True):
            print(f"  {agent} against {base}: {100 * share:.1f} %")


if __name__ == "__main__":
    main(sys.argv[1:])
