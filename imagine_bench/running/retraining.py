"""Runs trained again, some of each agent drawn at random, and compared with the kept ones."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import comb
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from imagine_bench import registry
from imagine_bench.data.folder import read_dataset
from imagine_bench.errors import (
    AbsentError,
    ArtefactError,
    ImagineBenchError,
    InvalidValueError,
    SetupError,
    UnknownNameError,
    plain,
    require,
)
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import Job, Launcher, RunSpec
from imagine_bench.registry.machine import describe_environment
from imagine_bench.running.bench import ProgressBar
from imagine_bench.running.trained import encoder_of_run
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_facts, read_control
from imagine_bench.store.files import reading
from imagine_bench.store.results import KeptEpisodes, RunResult
from imagine_bench.values import pack

SAME_COST = (4.0, 1.0)
"""Factor and CPU seconds by which the cost of training and of tests may differ on the same processor."""
SAME_EPISODES = 10
"""First training episodes in which another processor, whose roundings differ, takes the same macro-actions."""
SAME_TESTS = 0.2
"""Share of tests that may go otherwise on another processor, where training took the same macro-actions."""
SAME_SUCCESS = 0.25
"""Difference of success at a budget that is let pass on another processor, where training took others."""
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


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The findings about a run, the bench's protocol or of its report."""

    what: str
    complaint: str = ""  #: Empty where all holds
    episodes: int = 0  #: Played again
    unshown: tuple[str, ...] = ()  #: Claims that were not compared
    holds: str = "holds"  #: The words where there is no complaint
    of_training: bool = False  #: Whether it is on a run that was trained again

    def __str__(self) -> str:
        if self.complaint:
            return f"{self.what}: {self.complaint}"
        played = f"; {self.episodes:,} episodes played again" if self.episodes else ""
        return f"{self.what}: {self.holds}{played}{''.join(f'; not shown: {each}' for each in self.unshown)}"


def judged(what: str, check: Callable[[], Verdict]) -> Verdict:
    """The verdict of a check, which raises an error for the first claim that does not hold."""
    try:
        return check()
    except ArtefactError as error:
        return Verdict(what=what, complaint=brief_lines(error))
    except Exception as error:  # whoever forges a file can write anything
        reason = f"{type(error).__name__}: {brief_lines(error)}"
        return Verdict(what=what, complaint=f"its parts do not fit together ({reason}).")


def brief_lines(error: object) -> str:
    """The message of an error, on one line."""
    return " ".join(plain(error).split())


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


def train_again(folder: Path, retraining: Retraining) -> list[Verdict]:
    """Train runs of the bench in ``folder`` again, in a folder that is then removed, and compare.

    Raises:
        ArtefactError: The bench is damaged.
        InvalidValueError: Less than one run of each agent is asked for, or a dataset is given that no run had.
        SetupError: Nothing can be written, or there is no GL.
    """
    protocol = read_control(folder)
    kept = BenchStore(folder, protocol)
    differing = _differing(kept)
    wanted = drawn(protocol, retraining.runs, retraining.nonce)
    _require_dataset(folder, protocol, retraining.dataset)
    found = []
    with TemporaryDirectory(prefix="imagine-bench-verify-") as scratch:
        again = BenchStore(Path(scratch), protocol)
        jobs = list[Job]()
        lacking = dict[tuple[str, int], str]()
        why = dict[tuple[str, int], str]()
        for run in wanted:
            try:
                spec = _spec(protocol, *run, retraining)
                jobs.append(Job(spec=spec, folder=again.run_folder(*run)))
            except (AbsentError, SetupError, UnknownNameError) as error:  # its package, encoder or dataset is not here
                lacking[run] = brief_lines(error).rstrip(".")
            except ImagineBenchError as error:
                why[run] = str(error)
        with ProgressBar([job.spec for job in jobs]) as show:
            for failure in retraining.launcher.launch(jobs, show):
                why[failure.job.spec.agent, failure.job.spec.seed] = failure.reason
        for run in wanted:
            what = f"{run[0]} seed {run[1]}, trained again"
            if run in lacking:
                unshown = f"whether {run[0]} seed {run[1]} repeats ({lacking[run]})"
                found.append(Verdict(what=what, holds="not compared", unshown=(unshown,)))
                continue
            if run in why:
                found.append(Verdict(what=what, complaint=f"it cannot be: {brief_lines(why[run])}"))
                continue
            one, other = (run_folder.load_run(store.run_folder(*run)) for store in (kept, again))
            verdict = judged(what, partial(_compared, what, one, other, differing))
            found.append(replace(verdict, of_training=True))
    return found


def _require_dataset(folder: Path, protocol: Protocol, given: Path | None) -> None:
    """Raise InvalidValueError for a dataset that the runs of a bench did not learn from."""
    if given is None:
        return
    if protocol.dataset is None:
        raise InvalidValueError(f"No run of {folder} learned from a dataset; leave --dataset out.")
    identity = read_dataset(given).identity
    if identity != protocol.dataset:
        raise InvalidValueError(f"{given} is {identity}; runs of {folder} learned from {protocol.dataset}.")


def _spec(protocol: Protocol, agent: str, seed: int, retraining: Retraining) -> RunSpec[Protocol]:
    """The run as it was. Raises AbsentError, SetupError or UnknownNameError: this machine lacks a part of it."""
    dataset = retraining.dataset
    if registry.is_player(agent):
        raise AbsentError("it is a person's, or a program's elsewhere, that cannot be trained here.")
    if protocol.dataset is not None and dataset is None and registry.agent_entry(agent).learns:
        raise AbsentError(f"it learned from the dataset {protocol.dataset}; give its folder with --dataset.")
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


def _compared(what: str, kept: RunResult, again: RunResult, differing: Sequence[str]) -> Verdict:
    """The comparison of a run with the same run trained again, where these facts differ."""
    before = _digests(kept)
    now = _digests(again)
    is_older = run_folder.read_config(kept.folder)["format"] == run_folder.WITHOUT_TRAINING
    lacking = [name for name in now if name not in before and not name.startswith(_OF_OBSERVERS)]
    require(is_older or not lacking, f"{' '.join(lacking[:1])} is not kept, and training again gives it.")
    wrong = [name for name, digest in before.items() if now.get(name, digest) != digest]
    facts = " and ".join(differing)
    remedy = f" Here it is trained with another {facts}; train it again with the same." if differing else ""
    elsewhere = _OF_MACHINES & {*differing}
    said = f"for its {facts} is said to have been another"
    if wrong and elsewhere:
        alike = _beyond_rounding(kept, again, remedy)
        return Verdict(what=what, holds=f"its first {alike:,} training episodes repeat", unshown=(f"bits, {said}",))
    require(not wrong, f"{' '.join(wrong[:1])} does not repeat.{remedy}")
    holds = f"repeats to the bit in {len(before)} parts"
    if elsewhere:
        return Verdict(what=what, holds=holds, unshown=(f"CPU seconds, {said}",))
    costs = [(run.checkpoints[-1].train_cpu_s, sum(row.eval_cpu_s for row in run.checkpoints)) for run in (kept, again)]
    for name, was_s, is_s in zip(("training", "tests"), *costs, strict=True):
        factor, cpu_s = SAME_COST
        is_near = max(was_s, is_s) <= factor * min(was_s, is_s) + cpu_s
        require(is_near, f"{was_s:,.1f} CPU s of {name} were kept, and it took {is_s:,.1f}.")
    return Verdict(what=what, holds=holds)


def _beyond_rounding(kept: RunResult, again: RunResult, remedy: str) -> int:
    """Refuse differences that the roundings of another processor do not explain.

    The same learner takes the same macro-actions until a rounding decides one. Until then its tests are the same too.
    Returns the number of training episodes until then.
    """
    episodes = [_episodes(run, alike=kept.training) for run in (kept, again)]
    apart = [number for number, (one, other) in enumerate(zip(*episodes, strict=False)) if one != other]
    played = apart[0] if apart else len(episodes[1])
    alike = len(again.training_length) - len(episodes[1]) + played  # with those of a dataset
    early = f"training episode {alike} took other macro-actions, before roundings of another processor matter.{remedy}"
    require(not apart or played >= SAME_EPISODES, early)
    for one, other in zip(kept.checkpoints, again.checkpoints, strict=True):
        where = f"after {one.episodes:,} episodes"
        points = abs(one.success_rate - other.success_rate)
        far = f"{where} success differs by {points:.0%}, and {SAME_SUCCESS:.0%} of the tests are let pass.{remedy}"
        require(points <= SAME_SUCCESS, far)
        if one.kept is not None and other.kept is not None and other.episodes <= alike:
            tests = range(other.test_episodes)
            others = sum(one.kept.actions_of(test) != other.kept.actions_of(test) for test in tests)
            same = f"{where} {others} of {len(tests)} tests went otherwise, though training was the same.{remedy}"
            require(others <= SAME_TESTS * len(tests), same)
    return alike


def _episodes(run: RunResult, alike: KeptEpisodes | None) -> list[object]:
    """The compared parts of each training episode: its macro-actions, or of an older run, success and length."""
    if alike is None or run.training is None:
        return [*zip(run.training_success.tolist(), run.training_length.tolist(), strict=True)]
    return [run.training.actions_of(episode) for episode in range(len(run.training.lengths))]


def _digests(run: RunResult) -> dict[str, str]:
    """A digest of each part of a run that repeats to the bit, by name; a part that was not kept has none."""
    snapshot = run_folder.load_newest(run.folder / run_folder.CHECKPOINTS)
    parts: dict[str, object] = {
        "settings": run.settings,
        "success in training": run.training_success,
        "lengths in training": run.training_length,
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
