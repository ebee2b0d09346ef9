"""A bench as it is kept for good: ``protocol.json``, ``environment.json``, ``sessions.json`` and the report's
``results.csv``, without run folders. Every success rate, length and cost is in it; pictures and imaginations are not.
What was not finished when it was kept is read like any unfinished bench.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.store.bench_folder import read_protocol
from imagine_bench.store.partial import largest_part
from imagine_bench.store.results import BenchResult, Checkpoint, RunResult
from imagine_bench.task_types import TASK_TYPES

_RESULTS = "results.csv"
_COUNTS = ("episodes", "env_steps", "test_episodes", "successes", "faults")
_NUMBERS = ("mean_return", "mean_length", "train_cpu_s", "eval_cpu_s")
_COMPUTED = ("agent", "seed", "success_rate", "wilson_low", "wilson_high")


def is_archive(folder: Path) -> bool:
    """Whether a folder holds a bench in this form."""
    return (folder / _RESULTS).is_file()


def load_archive(folder: Path) -> BenchResult:
    """Read such a folder.

    Raises:
        ArtefactError: It is damaged; the message names the file.
        InvalidValueError: It is of a task that is learned from data.
    """
    path, whole = folder / _RESULTS, read_protocol(folder)
    if whole.task not in TASK_TYPES["control"].tasks:
        raise InvalidValueError(
            f"{folder} keeps a bench of {whole.task}, whose tables are its .csv files; only kept results of agents "
            "that act have a report. The command in its environment.json makes the bench anew, with one."
        )
    rows: dict[tuple[str, int], list[Checkpoint]] = {}
    try:
        for row in csv.DictReader(io.StringIO(path.read_text())):
            rows.setdefault((row["agent"], int(row["seed"])), []).append(_checkpoint(row))
    except (KeyError, ValueError, TypeError, OSError) as error:
        raise ArtefactError(
            f"{path} is not the table of a bench of agents: {error!r}. It was left untouched."
        ) from error
    wanted = [(agent, seed) for agent in whole.agents for seed in whole.seeds]
    reached = {pair: rows[pair][-1].episodes if pair in rows else 0 for pair in wanted}
    return largest_part(whole, reached, lambda agent, seed: _run(folder, agent, seed, tuple(rows[agent, seed])), folder)


def _checkpoint(row: Mapping[str, str]) -> Checkpoint:
    known = (*_COUNTS, *_NUMBERS, *_COMPUTED)
    numbers: dict[str, Any] = {name: float(row[name]) for name in _NUMBERS}
    numbers |= {name: int(row[name]) for name in _COUNTS}
    return Checkpoint(
        **numbers,
        diagnostics={name: float(text) for name, text in row.items() if name not in known and text != ""},
    )


def _run(folder: Path, agent: str, seed: int, checkpoints: tuple[Checkpoint, ...]) -> RunResult:
    return RunResult(
        agent=agent,
        seed=seed,
        checkpoints=checkpoints,
        settings={},
        training_success=np.zeros(0, dtype=np.bool_),
        training_length=np.zeros(0, dtype=np.int64),
        imagined=(),
        folder=folder,
        recording=None,
    )
