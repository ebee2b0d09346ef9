"""A bench as it is kept for good, in two files: ``bench.json`` and ``results.csv`` (docs/reference/formats.md).

Every success rate, length and cost is in them; images, imaginations and checkpoints are not. A report writes both, so
a bench is kept by copying them. What was not finished when it was kept is read like any unfinished bench.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench import statistics
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.registry.old_names import agent_label
from imagine_bench.store.bench_folder import KEPT, is_of_regression, read_control, read_protocol_values
from imagine_bench.store.files import csv_text, json_text, read_json
from imagine_bench.store.merge import largest_part
from imagine_bench.store.results import BenchResult, Checkpoint, RunResult

_RESULTS = "results.csv"
_COUNTS = ("episodes", "env_steps", "test_episodes", "successes")
_MEANS = ("mean_return", "mean_length")
_COSTS = ("faults", "train_cpu_s", "eval_cpu_s")
_DERIVED = ("success_rate", "wilson_low", "wilson_high")
"""Columns for a reader's comfort; what is read back is computed anew from the counts."""


def archive_files(result: BenchResult) -> dict[str, str]:
    """The two files of a bench of agents, by name."""
    environment = dict(result.environment)
    sessions = environment.pop("sessions", [])
    facts = {
        "protocol": (result.whole or result.protocol).as_dict(),
        "protocol_hash": result.protocol_hash,
        "environment": environment,
        "sessions": sessions,
    }
    if result.certificate is not None:
        facts["certificate"] = dataclasses.asdict(result.certificate)
    return {KEPT: json_text(facts), _RESULTS: results_csv(result)}


def results_csv(result: BenchResult) -> str:
    """One row an agent, seed and budget; every diagnostic the agents report has its column."""
    names = sorted({name for _, checkpoint in result.rows for name in checkpoint.diagnostics})
    protocol = result.whole or result.protocol
    rows: list[list[object]] = [["agent", "seed", *_COUNTS, *_DERIVED, *_MEANS, *_COSTS, "solved", *names]]
    for run, checkpoint in result.rows:
        low, high = statistics.wilson(checkpoint.successes, checkpoint.test_episodes)
        row = [protocol.written_name(run.agent), run.seed, *(getattr(checkpoint, name) for name in _COUNTS)]
        row += [checkpoint.success_rate, low, high]
        row += [getattr(checkpoint, name) for name in (*_MEANS, *_COSTS)] + [checkpoint.solved or ""]
        rows.append(row + [checkpoint.diagnostics.get(name, "") for name in names])
    return csv_text(rows)


def load_archive(folder: Path) -> BenchResult:
    """Read such a folder.

    Raises:
        ArtefactError: It is damaged.
        InvalidValueError: It is of a task that is learned from data.
    """
    path = folder / _RESULTS
    values = read_protocol_values(folder)
    if is_of_regression(values):
        raise InvalidValueError(
            f"{folder} keeps a bench of {values['task']}, whose tables are its .csv files; only kept results of agents "
            f"that act have a report. The command in its {KEPT} makes the bench anew, with one."
        )
    whole = read_control(folder)
    rows: dict[tuple[str, int], list[Checkpoint]] = {}
    names = {"agent_names": whole.agent_names}
    try:
        for row in csv.DictReader(io.StringIO(path.read_text())):
            rows.setdefault((agent_label(row["agent"], names), int(row["seed"])), []).append(_checkpoint(row))
    except (KeyError, ValueError, TypeError, OSError) as error:
        raise ArtefactError(
            f"{path} is not the table of a bench of agents: {error!r}. It was left untouched."
        ) from error
    runs = {(agent, seed): _run(folder, agent, seed, tuple(found)) for (agent, seed), found in rows.items()}
    made_with = str(read_json(folder / KEPT, "a kept bench").get("protocol_hash", ""))
    return largest_part(whole, runs, folder, made_with)


def _checkpoint(row: Mapping[str, str]) -> Checkpoint:
    numbers: dict[str, Any] = {name: float(row[name]) for name in (*_MEANS, *_COSTS[1:])}
    numbers |= {name: int(row[name]) for name in (*_COUNTS, _COSTS[0])}
    known = ("agent", "seed", "solved", *numbers, *_DERIVED)
    return Checkpoint(
        **numbers,
        solved=row.get("solved") or None,
        diagnostics={name: float(text) for name, text in row.items() if name not in known and text != ""},
    )


def _run(folder: Path, agent: str, seed: int, checkpoints: tuple[Checkpoint, ...]) -> RunResult:
    return RunResult(
        agent=agent,
        seed=seed,
        checkpoints=checkpoints,
        settings={},
        folder=folder,
        training_success=np.zeros(0, dtype=np.bool_),
        training_length=np.zeros(0, dtype=np.int64),
    )
