"""Do intervals cover, do tables err, is a true difference found? ``python tests/measure/interval_coverage.py [DRAWS]``.

A law says how often a trained agent solves its tests. From each law benches are drawn, and judged by
:mod:`imagine_bench.statistics` as every report is. Kept scores are drawn as they are. Runs of the other laws are tested
on 200 starts that are the same for all runs of a bench, and some are hard for all.
"""

from __future__ import annotations

import csv
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import scipy

from imagine_bench import registry, statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Floats
from imagine_bench.registry.machine import describe_environment
from imagine_bench.seeding import SeedTree
from imagine_bench.store.files import reading, require_writable, write_json

RESULTS = Path(__file__).parents[2] / "docs" / "results"
SEEDS = (3, 4, 5, 6, 7, 8, 9, 10, 12, 15, 20)
_CELLS = (3, 2)  # budgets of a table, and agents beside the base
_MANY_CELLS = (3, 8)  # budgets and agents of a table of 21
_TESTS = 200  # test episodes a seed
_COMMON = 0.5  # share of the variance of a test's latent difficulty that its start has, for all runs alike
_MANY = 200_000  # draws that give a law's true interquartile mean
_LEVEL = 1.0 - statistics.LEVEL

Law = Callable[[np.random.Generator, tuple[int, ...]], Floats]
"""Success rates of runs, of a shape."""
Row = dict[str, float | str]


def one_mode(mean: float, spread: float) -> Law:
    """Normal, cut off at 0 and 1."""
    return lambda rng, shape: rng.normal(mean, spread, shape).clip(0.0, 1.0)


def two_modes(low_share: float, low: float = 0.2, high: float = 0.95) -> Law:
    """Two groups of runs, each normal with a standard deviation of 3 points."""

    def law(rng: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        middle = np.where(rng.random(shape) < low_share, low, high)
        return (middle + rng.normal(0.0, 0.03, shape)).clip(0.0, 1.0)

    return law


def _skewed(rng: np.random.Generator, shape: tuple[int, ...]) -> Floats:
    return rng.beta(0.5, 3.0, shape)


LAWS: dict[str, Law] = {
    "one mode": one_mode(0.6, 0.15),
    "runs alike": one_mode(0.6, 0.01),
    "two modes 1:1": two_modes(1 / 2),
    "two modes 1:2": two_modes(1 / 3),
    "two modes 1:3": two_modes(1 / 4),
    "one in four stuck": two_modes(1 / 4, low=0.16, high=0.9),
    "ceiling": one_mode(1.0, 0.01),
    "skewed": _skewed,
}
"""Laws of both agents: no difference exists. Beside these stand the kept scores."""
WORST = "two modes 1:1"
PAIRS = {
    "one mode, gap of 40": (one_mode(0.7, 0.15), one_mode(0.3, 0.15)),
    "two modes, 1:3 against 3:1": (two_modes(1 / 4), two_modes(3 / 4)),
}
"""Laws of two agents that differ."""


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


def measure(scores: list[Floats], draws: int, rng: np.random.Generator, seeds: Sequence[int] = SEEDS) -> Iterator[Row]:
    """Judge ``draws`` benches of every law and number of seeds; first of kept ``scores``, each a population.

    A row has the ``law``, the number of ``seeds``, and shares, NaN where so few seeds are not judged: ``coverage``,
    of 95 % intervals that hold the law's interquartile mean, ``difference``, of those of a difference that hold 0,
    and ``false_table``, of tables of six differences that do not exist with any that is claimed, by Holm.
    """
    truth = [_middle_half(np.repeat(each, 4)) for each in scores]
    for count in seeds:
        which = rng.integers(len(scores), size=(draws, _CELLS[0]))
        yield _judged("kept scores", _kept(scores, which, count, rng), np.array(truth)[which[:, 0]])
    for name, law in LAWS.items():
        middle = _middle_half(law(rng, (_MANY,)))
        for count in seeds:
            runs = law(rng, (draws, _CELLS[0], 1 + _CELLS[1], count))
            yield _judged(name, _tested(runs, rng), np.full(draws, middle))
    for count in seeds:
        runs = LAWS[WORST](rng, (draws, *_MANY_CELLS, count))
        yield _judged(f"{WORST}, table of 21", _tested(runs, rng), np.full(draws, np.nan))


def power(draws: int, rng: np.random.Generator, seeds: Sequence[int] = SEEDS) -> Iterator[Row]:
    """How often a true difference is shown: ``alone``, and in a ``table`` of six that all differ so.

    ``coverage`` is the share of intervals that hold it.
    """
    for name, pair in PAIRS.items():
        truth = np.subtract(*(_middle_half(law(rng, (_MANY,))) for law in pair))
        for count in seeds:
            first, second = (law(rng, (draws, 6, count)) for law in pair)
            scores = _tested(np.stack([first, second], axis=2), rng)
            _, low, high, p = statistics.differences(scores[:, :, 0], scores[:, :, 1], trials=_TESTS)
            holm = np.apply_along_axis(statistics.holm, 1, p)
            yield {
                "law": name,
                "seeds": count,
                "coverage": _share((low <= truth) & (truth <= high), low),
                "alone": _share(p < _LEVEL, p),
                "table": _share(holm < _LEVEL, p),
            }


def main(draws: int = 2_000, results: Path = RESULTS, out: Path = Path("runs/coverage.json")) -> None:
    """Measure, print Markdown tables line by line, and keep them as JSON with seed, commit and machine."""
    scores = populations(results)
    require_writable(out.parent)
    tree = SeedTree(0).child("coverage")
    found = {
        "rows": measure(scores, draws, tree.child("laws").generator()),
        "power": power(draws, tree.child("power").generator()),
    }
    facts = {"populations": len(scores), "draws": draws, "tests": _TESTS, "common": _COMMON, "seed": 0}
    write_json(out, {**facts, "environment": describe_environment()} | {k: _printed(v) for k, v in found.items()})


def _printed(rows: Iterator[Row]) -> list[Row]:
    kept: list[Row] = []
    for row in rows:
        if not kept:
            print(f"\n| {' | '.join(row)} |\n{'|---' * len(row)}|")
        cells = (f"{100.0 * cell:.1f}" if isinstance(cell, float) else f"{cell}" for cell in row.values())
        print(f"| {' | '.join(cells)} |".replace("nan", "too few"), flush=True)
        kept.append({name: "" if str(cell) == "nan" else cell for name, cell in row.items()})
    return kept


def _judged(law: str, scores: Floats, truth: Floats) -> Row:
    """A row, of scores (draws, budgets, agents, seeds), the first agent the base."""
    low, high = statistics.bounds(scores[:, 0, 0], trials=_TESTS)
    _, least, most, p = statistics.differences(scores[:, :, 1:], scores[:, :, :1], trials=_TESTS)
    tables = p.reshape(len(p), -1)
    return {
        "law": law,
        "seeds": scores.shape[-1],
        "coverage": _share((low <= truth + 1e-9) & (truth - 1e-9 <= high), low + truth),
        "difference": _share((least <= 0.0) & (most >= 0.0), least),
        "false_table": _share(tables.min(axis=1) * tables.shape[1] < _LEVEL, tables),
    }


def _share(holds: np.ndarray, known: Floats) -> float:
    return float("nan") if np.isnan(known).all() else float(holds.mean())


def _kept(scores: list[Floats], which: np.ndarray, count: int, rng: np.random.Generator) -> Floats:
    """Scores (draws, budgets, agents, count) of the populations ``which`` (draws, budgets), drawn as they are."""
    sizes = np.array([len(each) for each in scores])
    first = np.cumsum(sizes) - sizes
    places = rng.random((*which.shape, 1 + _CELLS[1], count)) * sizes[which][..., None, None]
    return np.concatenate(scores)[first[which][..., None, None] + places.astype(int)]


def _tested(runs: Floats, rng: np.random.Generator) -> Floats:
    """Shares of solved tests of runs (draws, ..., seeds), all runs of a draw from the same starts."""
    limits = scipy.special.ndtri(runs)
    starts = np.sqrt(_COMMON) * rng.standard_normal((len(runs), _TESTS), dtype=np.float32)
    solved = np.zeros(runs.shape)
    for start in starts.T:
        hard = start.reshape(-1, *[1] * (runs.ndim - 1))
        noise = rng.standard_normal(runs.shape, dtype=np.float32)
        solved += hard + np.sqrt(1.0 - _COMMON) * noise <= limits
    return solved / _TESTS


def _middle_half(shares: Floats) -> float:
    """The interquartile mean of a population, whose size four divides."""
    quarter = len(shares) // 4
    return float(np.sort(shares)[quarter:-quarter].mean())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
