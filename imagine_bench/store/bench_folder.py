"""Where a bench lies: ``<root>/<task>/<preset>-<protocol hash>/<agent>/seed_<n>/``; other settings lie elsewhere.

``protocol.json`` says what is compared and ``sessions.json`` who worked on it, when, with what; nothing is ever
overwritten by another protocol, for its hash is in the name.
"""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError, plain
from imagine_bench.exact.certificate import Certificate, certificate, from_json
from imagine_bench.protocols.control import Protocol, spec_of
from imagine_bench.protocols.data import ProtocolData, digest
from imagine_bench.protocols.task_types import Result, read_as, type_of
from imagine_bench.registry.entries import file_name
from imagine_bench.store import run_folder
from imagine_bench.store.files import (
    lock,
    make_folder,
    read_json,
    read_sealed,
    reading,
    sealed,
    write_json,
)

KEPT = "bench.json"
"""Protocol, environment and sessions in one file, as :mod:`.archive` keeps them for good."""
_PROTOCOL, _ENVIRONMENT, _SESSIONS = "protocol.json", "environment.json", "sessions.json"
_CERTIFICATE = "certificate.json"
_NAME = re.compile("-([0-9a-f]{12})$")
"""The hash in a folder's name; whoever moves a bench elsewhere may leave it out."""
_IDENTITY = ("commit", "versions", "gl_renderer", "cpu")
"""Facts that decide the bits of a result."""


class BenchStore:
    """The folder of one protocol: that of :func:`bench_folder`, or wherever somebody has moved it to."""

    def __init__(self, folder: Path, protocol: ProtocolData) -> None:
        self.protocol, self.folder = protocol, folder
        self._began_s = time.monotonic()
        self._sessions: list[dict[str, Any]] = []

    def open(self) -> None:
        """Make the folder, or raise ArtefactError where it is of another protocol, SetupError where it is read-only."""
        make_folder(self.folder)
        path = self.folder / _PROTOCOL
        if not path.exists():
            write_json(path, self.protocol.as_dict())
        elif read_protocol(self.folder).as_dict() != self.protocol.as_dict():  # a list in a file may be a tuple
            raise ArtefactError(f"{path} is of another protocol than its folder's name says. It was left untouched.")

    def lock(self) -> AbstractContextManager[None]:
        """Hold the folder for this process. Raises BusyError: another bench works there."""
        return lock(self.folder / ".lock", f"The bench folder {self.folder}")

    def run_folder(self, agent: str, seed: int) -> Path:
        """The folder of one run."""
        return self.folder / file_name(self.protocol.written_name(agent)) / f"seed_{seed}"

    def require_own(self, folders: Collection[Path]) -> None:
        """Raise ArtefactError for a run's folder among ``folders`` that says it is of another protocol."""
        for agent in self.protocol.agents:
            for seed in self.protocol.seeds:
                if (folder := self.run_folder(agent, seed)) in folders:
                    run_folder.require_run_of(folder, self.protocol, agent, seed)

    def missing(self, until: int | None = None) -> list[tuple[str, int]]:
        """Agents and seeds that are not finished, or have not come to the budget ``until``, seed by seed."""
        wanted = [(agent, seed) for seed in self.protocol.seeds for agent in self.protocol.agents]
        unfinished = [pair for pair in wanted if not run_folder.is_done(self.run_folder(*pair))]
        return [pair for pair in unfinished if until is None or run_folder.reached(self.run_folder(*pair)) < until]

    def begin_session(self, environment: dict[str, Any]) -> list[str]:
        """Note that work starts now, in what :func:`.describe_environment` says; returns :meth:`changed`."""
        path = self.folder / _ENVIRONMENT
        begun = path.exists()
        if begun:
            self._sessions = _read_sessions(self.folder)
        self._began_s = time.monotonic()
        changed, now = self.changed(environment), _facts(environment)
        self._sessions.append({
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "wall_s": 0.0,
            "command": environment["command"],
            "changed": {name: now.get(name) for name in changed},
        })  # fmt: skip
        self.save_time()
        if not begun:
            write_json(path, sealed(environment))  # last, so that a bench with an environment has sessions too
        return changed

    def keep_certificate(self, certify: Callable[[str, str | None], Certificate | None]) -> None:
        """Keep the certificate of the protocol's world, which is what ``certify`` says of its task and split, once."""
        path, protocol = self.folder / _CERTIFICATE, self.protocol
        if isinstance(protocol, Protocol) and not path.exists():
            found = certify(protocol.task, protocol.split)
            if found is not None:
                write_json(path, sealed(dataclasses.asdict(found)))

    def changed(self, environment: dict[str, Any]) -> list[str]:
        """Names of facts that decide the bits and are not as in the first session; none before there was one."""
        path = self.folder / _ENVIRONMENT
        first = read_sealed(path, "a bench's environment") if path.exists() else environment
        then, now = _facts(first), _facts(environment)
        return [name for name in _IDENTITY if then.get(name) != now.get(name)]

    def save_time(self) -> None:
        """Note how long this session has lasted, so that a kill loses little of the count."""
        self._sessions[-1]["wall_s"] = round(time.monotonic() - self._began_s, 3)
        write_json(self.folder / _SESSIONS, sealed({"sessions": self._sessions}))


def certificate_of(task: str, split: str | None) -> Certificate | None:
    """The certificate of a task from the starts that tests have; None of a guest's whose rules fail."""
    try:
        return certificate(spec_of(task, split, testing=True))
    except Exception as error:
        if registry.is_own(task):
            raise
        print(f"Note: {task} has no certificate ({type(error).__name__}: {plain(error)}).")
        return None


def bench_folder(root: Path, protocol: ProtocolData) -> Path:
    """Where the bench of a protocol belongs below ``root``, the folder of all benches, such as ``runs``."""
    return Path(root / file_name(protocol.task) / f"{protocol.preset}-{protocol.hash}")


def load_bench(folder: Path) -> Result:
    """Read a finished bench. Raises ArtefactError: it is no bench, runs are missing, or a file is damaged."""
    protocol = read_protocol(folder)
    kind, store = type_of(protocol), BenchStore(folder, protocol)
    folders = [store.run_folder(agent, seed) for agent in protocol.agents for seed in protocol.seeds]
    done = [run for run in folders if run_folder.is_done(run)]
    store.require_own(done)
    runs = tuple(kind.load_run(run) for run in done)
    return kind.result(protocol=protocol, runs=runs, **bench_facts(folder))


def bench_facts(folder: Path) -> dict[str, Any]:
    """``environment``, ``folder`` and ``wall_s`` of a bench's result, or ArtefactError for a missing, damaged file."""
    if (folder / KEPT).exists():
        kept = read_json(folder / KEPT, "a kept bench")
        with reading(folder / KEPT, "a kept bench"):
            facts, sessions = kept["environment"], _with_times(kept["sessions"])
    else:
        facts, sessions = read_sealed(folder / _ENVIRONMENT, "a bench's environment"), _read_sessions(folder)
    return {
        "environment": {**facts, "sessions": sessions},
        "folder": folder,
        "wall_s": sum(session["wall_s"] for session in sessions),
        **_certificate(folder),
    }


def _certificate(folder: Path) -> dict[str, Certificate]:
    """``certificate`` of a bench's result, where it was kept: of agents that act, since 2026-11-25."""
    path, what = folder / _CERTIFICATE, "a world's certificate"
    if (folder / KEPT).exists():
        path = folder / KEPT
        values = read_json(path, "a kept bench").get("certificate")
    else:
        values = read_sealed(path, what) if path.exists() else None
    with reading(path, what):
        return {} if values is None else {"certificate": from_json(values)}


def require_either(given: Path | None, task: str | None) -> None:
    """Raise InvalidValueError where a path and a task are given: what lies at a path is of a task already."""
    if given is not None and task is not None:
        raise InvalidValueError(f"Both {given} and --task {task} were given; leave one of them out.")


def newest_bench(root: Path, tasks: Collection[str] = ()) -> Path:
    """The bench folder below ``root`` that was worked on last, of any task or of some, or ArtefactError.

    A task's name without options also means it with any.
    """
    found = [path for path in root.glob(f"*/*/{_SESSIONS}") if not tasks or _is_of(path.parts[-3], tasks)]
    if not found:
        some = next(iter(tasks), "arrow_puzzle")
        where = root / file_name(some) if len(tasks) == 1 else root
        raise ArtefactError(
            f"There is no {'such ' if tasks else ''}bench below {where}; "
            f"run one with 'imagine-bench bench --task {some}'."
        )
    return max(found, key=lambda path: path.stat().st_mtime).parent


def newest_recording(root: Path, task: str | None = None) -> Path:
    """The recording below ``root`` that was written last, of any task or of one, or ArtefactError; tasks as above."""
    where = root / file_name(task or "")
    folders = [each for each in root.glob("*/") if task is None or _is_of(each.name, (task,))]
    found = sorted(
        (path for each in folders for path in each.glob("**/recording.rrd")), key=lambda path: path.stat().st_mtime
    )
    if not found:
        raise ArtefactError(
            f"There is no recording below {where}; run a bench with 'imagine-bench bench --task "
            f"{task or 'arrow_puzzle'}'."
        )
    return found[-1]


def _is_of(folder: str, tasks: Collection[str]) -> bool:
    names = [file_name(task) for task in tasks]
    return any(folder == name or folder.startswith(f"{name}-") for name in names)


def _facts(environment: Mapping[str, Any]) -> dict[str, Any]:
    """An environment with its machine's processor among the facts."""
    return {**environment, "cpu": environment.get("machine", {}).get("cpu")}


def _read_sessions(folder: Path) -> list[dict[str, Any]]:
    path, what = folder / _SESSIONS, "a bench's sessions"
    sessions = read_sealed(path, what)
    with reading(path, what):
        return _with_times(sessions["sessions"])


def _with_times(sessions: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{**session, "wall_s": float(session["wall_s"])} for session in sessions]


def read_protocol(folder: Path) -> ProtocolData:
    """The protocol of a bench folder. Raises ArtefactError: it is missing or damaged."""
    kept = (folder / KEPT).exists()
    path, what = folder / (KEPT if kept else _PROTOCOL), "a bench's protocol"
    data = read_json(path, what)
    name = _NAME.search(folder.resolve().name)
    if name is not None and not kept and digest(data) != name[1]:
        raise ArtefactError(
            f"{path} is damaged: {name[1]} in its folder's name stands for another protocol. It was left untouched."
        )
    with reading(path, what):
        return read_as(data["protocol"] if kept else data)


def read_control(folder: Path) -> Protocol:
    """The protocol of a bench folder of agents that act. Raises ArtefactError: it is another's, missing or damaged."""
    protocol = read_protocol(folder)
    if not isinstance(protocol, Protocol):
        raise ArtefactError(f"{folder} is of a regression task, in which no agent acts; give one of agents.")
    return protocol
