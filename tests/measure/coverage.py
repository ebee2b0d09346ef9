"""``python tests/measure/coverage.py [DRAWS]``: do intervals cover, and do tests err, as often as they state?

Every agent and budget with five kept seeds or more gives a population: its scores, smoothed on the logit scale. Benches
are drawn from these, with and without one seed in ten that is stuck at chance, and judged by
:mod:`imagine_bench.statistics` as every report is.
"""

from __future__ import annotations

import csv
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from imagine_bench import registry, statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Floats
from imagine_bench.registry.machine import describe_environment
from imagine_bench.seeding import SeedTree
from imagine_bench.store.files import reading, require_writable, write_json

RESULTS = Path(__file__).parents[2] / "docs" / "results"
SEEDS = (3, 5, 10, 20)
STUCK = (0.0, 0.1)  # shares of seeds that are stuck
_CHANCE = 0.16  # where these are, as a greedy policy that always chooses the same
_TESTS = 200  # test episodes a seed
_SIZE = 2_000  # members of a population
_CELLS = (3, 2)  # budgets of a table, and agents beside the base


def populations(results: Path) -> list[Floats]:
    """Success rates (seeds,) of every learner and budget below a folder of kept results with five seeds or more.

    Raises:
        InvalidValueError: There are none.
        ArtefactError: A file that is no table of results.
    """
    found: dict[tuple[Path, str, str], list[float]] = defaultdict(list)
    learners = {name for name, entry in registry.agents().items() if entry.learns}
    for path in sorted(results.rglob("results.csv")):
        with path.open(newline="") as file, reading(path, "a table of results"):
            for row in csv.DictReader(file):
                if row.get("agent") in learners and "successes" in row:
                    share = int(row["successes"]) / int(row["test_episodes"])
                    found[path, row["agent"], row["episodes"]].append(share)
    many = [np.array(shares) for shares in found.values() if len(shares) >= 5]
    if not many:
        raise InvalidValueError(f"Below {results} no learner has five seeds; give a folder of kept results.")
    return many


def measure(scores: list[Floats], draws: int, rng: np.random.Generator) -> Iterator[dict[str, float]]:
    """Judge ``draws`` benches of every kind, each from a population of its own that ``scores`` give.

    A row has the number of ``seeds``, the share of ``stuck`` ones, ``coverage``, the share of 95 % intervals that hold
    the population's interquartile mean, ``false_cell``, the share of differences that do not exist and have p < 0.05,
    and ``false_table``, the share of tables of six such with any that is claimed, by Holm.
    """
    for stuck in STUCK:
        members = [_members(shares, stuck, rng) for shares in scores]
        truth = [statistics.iqm(each) for each in members]
        for count in SEEDS:
            found = np.empty((draws, 3))
            for draw in range(draws):
                which = rng.integers(len(members), size=_CELLS[0]).tolist()
                drawn = [rng.choice(members[index], size=(1 + _CELLS[1], count)) for index in which]
                low, high = statistics.interval(drawn[0][0], trials=_TESTS)
                pairs = [(other, base) for base, *others in drawn for other in others]
                tests = np.array([statistics.difference(*pair, trials=_TESTS).p for pair in pairs])
                claimed = tests < 1.0 - statistics.LEVEL
                any_claimed = statistics.holm(tests).min() < 1.0 - statistics.LEVEL
                found[draw] = low <= truth[which[0]] <= high, claimed.mean(), any_claimed
            coverage, false_cell, false_table = found.mean(axis=0).tolist()
            rates = {"coverage": coverage, "false_cell": false_cell, "false_table": false_table}
            yield {"seeds": count, "stuck": stuck, **rates}


def main(draws: int = 2_000, results: Path = RESULTS, out: Path = Path("runs/coverage.json")) -> None:
    """Measure, print a Markdown table line by line, and keep it as JSON with seed, commit and machine."""
    scores = populations(results)
    require_writable(out.parent)
    print("| seeds | stuck, % | intervals that hold, % | false claims a cell, % | a table of six, % |")
    print("|---|---|---|---|---|")
    rows = []
    for row in measure(scores, draws, SeedTree(0).child("coverage").generator()):
        rows.append(row)
        seeds, *shares = row.values()
        print(f"| {seeds} | " + " | ".join(f"{100.0 * share:.1f}" for share in shares) + " |", flush=True)
    facts = {"populations": len(scores), "draws": draws, "seed": 0, "environment": describe_environment()}
    write_json(out, {**facts, "rows": rows})


def _members(shares: Floats, stuck: float, rng: np.random.Generator) -> Floats:
    """Scores of a population: kept ones moved by a normal kernel on the logit scale (Silverman), then tested."""
    clipped = np.clip(shares, 0.5 / _TESTS, 1.0 - 0.5 / _TESTS)
    logits = np.log(clipped / (1.0 - clipped))
    width = max(0.1, 0.9 * float(logits.std(ddof=1)) * len(shares) ** -0.2)
    moved = 1.0 / (1.0 + np.exp(-(rng.choice(logits, size=_SIZE) + width * rng.normal(size=_SIZE))))
    chances = np.where(rng.random(_SIZE) < stuck, _CHANCE, moved)
    return np.asarray(rng.binomial(_TESTS, chances) / _TESTS)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
