"""Runs trained again, some of each agent drawn at random, and compared with the kept ones."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from math import comb
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, ImagineBenchError, InvalidValueError
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import Job, Launcher, RunSpec
from imagine_bench.registry.machine import describe_environment
from imagine_bench.running.bench import ProgressBar
from imagine_bench.running.trained import encoder_of_run
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_facts, read_control
from imagine_bench.store.files import reading
from imagine_bench.store.results import RunResult
from imagine_bench.values import pack

SAME_SUCCESS = 0.25
"""Difference of success at a budget that is let pass where another processor or version trains again."""
SAME_COST = (4.0, 3.0)
"""Factor and CPU seconds by which the cost of training may differ, where the same processor trains again."""
_OF_MACHINES = {"cpu", "gl_renderer", "device"}
"""Facts on which bits depend, and which whoever trains again may not be able to choose."""
_OF_OBSERVERS = ("open_loop", "beliefs", "imagined")
"""Beginnings of the names of parts that only observed runs keep."""


@dataclass(frozen=True, kw_only=True)
class Retraining:
    """How runs of a bench are trained again."""

    runs: int  #: Of each agent, at least 1
    nonce: str  #: Decides which: a new one a check, or that of a check that is repeated
    launcher: Launcher
    encoder: str | None = None  #: As of :func:`.trained.load_trained`
    dataset: Path | None = None  #: The folder of the protocol's dataset, if it has one


class Repeat(NamedTuple):
    """The comparison of one run with the same run trained again."""

    agent: str
    seed: int
    complaint: str  #: Empty where it repeats
    remark: str  #: The parts that repeat, or why bits were not compared


def drawn(protocol: Protocol, count: int, nonce: str) -> list[tuple[str, int]]:
    """Agent and seed of ``count`` runs of each agent, or all that it has, which the nonce decides.

    Raises InvalidValueError: less than one run.
    """
    if count < 1:
        raise InvalidValueError(f"{count} runs of each agent cannot be trained again; give at least 1.")
    runs = []
    for agent in protocol.agents:
        root = int.from_bytes(hashlib.sha256(f"{nonce} {protocol.hash} {agent}".encode()).digest())
        rng = np.random.default_rng(root)
        chosen = rng.permutation(protocol.seeds_of(agent))[:count]
        runs += [(agent, int(seed)) for seed in sorted(chosen)]
    return runs


def chance_to_find(runs: int, forged: int, count: int) -> float:
    """Probability that ``count`` of an agent's ``runs``, drawn at random, hold one of those that were forged."""
    return 1.0 - comb(runs - forged, count) / comb(runs, count)


def train_again(folder: Path, retraining: Retraining) -> list[Repeat]:
    """Train runs of the bench in ``folder`` again, in a folder that is then removed, and compare.

    Raises:
        ArtefactError: The bench is damaged.
        InvalidValueError: Less than one run of each agent is asked for.
        SetupError: Nothing can be written, or there is no GL.
    """
    protocol = read_control(folder)
    kept = BenchStore(folder, protocol)
    differing = _differing(kept)
    wanted = drawn(protocol, retraining.runs, retraining.nonce)
    found = []
    with TemporaryDirectory(prefix="imagine-bench-verify-") as scratch:
        again = BenchStore(Path(scratch), protocol)
        jobs = list[Job]()
        why = {}
        for run in wanted:
            try:
                spec = _spec(protocol, *run, retraining)
                jobs.append(Job(spec=spec, folder=again.run_folder(*run)))
            except ImagineBenchError as error:
                why[run] = str(error)
        with ProgressBar([job.spec for job in jobs]) as show:
            for failure in retraining.launcher.launch(jobs, show):
                why[failure.job.spec.agent, failure.job.spec.seed] = failure.reason
        for run in wanted:
            complaint = f"it cannot be trained again: {why[run]}" if run in why else ""
            remark = ""
            if not complaint:
                one, other = (run_folder.load_run(store.run_folder(*run)) for store in (kept, again))
                complaint, remark = _compared(one, other, differing)
            found.append(Repeat(*run, complaint, remark))
    return found


def _spec(protocol: Protocol, agent: str, seed: int, retraining: Retraining) -> RunSpec[Protocol]:
    dataset = retraining.dataset
    if protocol.dataset is not None and dataset is None and registry.agent_entry(agent).learns:
        raise ArtefactError(f"it learned from the dataset {protocol.dataset}; give its folder with --dataset.")
    through = encoder_of_run(protocol, agent, retraining.encoder)
    return RunSpec(protocol=protocol, agent=agent, seed=seed, encoder=through, dataset=dataset)


def _differing(store: BenchStore) -> list[str]:
    """Facts that decide the bits of a result and that differ now, or between sessions of the bench."""
    environment = describe_environment()
    with reading(store.folder, "a bench with environment and sessions"):
        names = {*store.changed(environment)}
        for session in bench_facts(store.folder)["environment"]["sessions"]:
            names |= {*session["changed"]}
        return sorted(names if store.protocol.device == "cpu" else names | {"device"})


def _compared(kept: RunResult, again: RunResult, differing: Sequence[str]) -> tuple[str, str]:
    """A complaint, empty if the run repeats, and a remark on the comparison."""
    before = _digests(kept)
    now = _digests(again)
    is_older = run_folder.read_config(kept.folder)["format"] == run_folder.WITHOUT_TRAINING
    lacking = [name for name in now if name not in before and not name.startswith(_OF_OBSERVERS)]
    if lacking and not is_older:
        return f"{lacking[0]} is not kept, and training again gives it.", ""
    wrong = [name for name, digest in before.items() if now.get(name, digest) != digest]
    pairs = list(zip(kept.checkpoints, again.checkpoints, strict=True))
    apart = max(abs(one.success_rate - other.success_rate) for one, other in pairs)
    success = f"success differs by at most {100 * apart:.0f} points at a budget"
    if wrong and not _OF_MACHINES & {*differing}:
        remedy = f" Its {' and '.join(differing)} differ here; train it again with the same." if differing else ""
        return f"{wrong[0]} does not repeat; {success}.{remedy}", ""
    if wrong and apart > SAME_SUCCESS:
        return f"{success}, and {100 * SAME_SUCCESS:.0f} are let pass where {', '.join(differing)} differs.", ""
    if wrong:
        return "", f"{success}; bits were not compared, for {', '.join(differing)} is said to have been another"
    factor, cpu_s = SAME_COST
    was_s, is_s = (rows[-1].train_cpu_s for rows in (kept.checkpoints, again.checkpoints))
    if not differing and max(was_s, is_s) > factor * min(was_s, is_s) + cpu_s:
        return f"{was_s:,.1f} CPU s of training were kept, and it took {is_s:,.1f}.", ""
    return "", f"repeats to the bit in {len(before)} parts"


def _digests(run: RunResult) -> dict[str, str]:
    """A digest of each part of a run that repeats to the bit, by name; a part that was not kept has none."""
    snapshot = run_folder.load_newest(run.folder / run_folder.CHECKPOINTS)
    parts: dict[str, object] = {
        "settings": run.settings,
        "success in training": run.training_success,
        "lengths in training": run.training_length,
        "starts of training": run.training_starts,
        "training episodes": run.training,
        "tried macro-actions": None if run.tried is None else sorted(run.tried.tolist()),
    }
    for row in run.checkpoints:
        values = {name: value for name, value in vars(row).items() if not name.endswith("_cpu_s")}
        values["diagnostics"] = {n: value for n, value in row.diagnostics.items() if not n.startswith("time/")}
        values |= {f"tests' {name}": value for name, value in vars(values.pop("kept")).items()}
        parts |= {f"{name} after {row.episodes:,} episodes": value for name, value in values.items()}
    parts["weights"] = None if snapshot is None else snapshot.agent.arrays
    parts["imagined rollouts"] = [*run.imagined, *run.sampled_rollouts] or None
    return {name: part_digest(part) for name, part in parts.items() if part is not None}


def part_digest(part: object) -> str:
    """A digest of whatever :func:`.values.pack` takes."""
    values, arrays = pack(part)
    found = hashlib.sha256(json.dumps(values, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        found.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return found.hexdigest()
