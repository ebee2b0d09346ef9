"""Where a bench lies: ``<root>/<task>/<preset>-<protocol hash>/<agent>/seed_<n>/``; other settings lie elsewhere.

``protocol.json`` holds what is compared, ``environment.json`` what the first session ran on, and ``sessions.json`` when
and with which command work went on. Nothing is ever overwritten by another protocol, for its hash is in the name. A
bench that is kept for good is one file, ``bench.json``, and a table: see :mod:`.archive`.
"""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypedDict, TypeVar

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.exact.certificate import Certificate, from_json
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import ProtocolData, digest
from imagine_bench.registry.entries import file_name
from imagine_bench.store import run_folder
from imagine_bench.store.files import lock, make_folder, read_json, read_sealed, reading, sealed, write_json
from imagine_bench.values import Json

P = TypeVar("P", bound=ProtocolData)
L = TypeVar("L")

KEPT = "bench.json"
"""Protocol, environment and sessions in one file, as :mod:`.archive` keeps them for good."""
_PROTOCOL = "protocol.json"
_ENVIRONMENT = "environment.json"
_SESSIONS = "sessions.json"
_CERTIFICATE = "certificate.json"
_NAME = re.compile("-([0-9a-f]{12})$")
"""The hash in a folder's name; whoever moves a bench elsewhere may leave it out."""
_IDENTITY = ("commit", "versions", "gl_renderer", "cpu")
"""Facts that decide the bits of a result."""


class _Session(TypedDict):
    """One command that worked on a bench."""

    started: str
    wall_s: float
    command: Json
    changed: dict[str, Json]


class BenchStore:
    """The folder of one protocol: that of :func:`bench_folder`, or wherever somebody has moved it to."""

    def __init__(self, folder: Path, protocol: ProtocolData) -> None:
        self.protocol = protocol
        self.folder = folder
        self._began_s = time.monotonic()
        self._sessions: list[_Session] = []

    @property
    def pairs(self) -> list[tuple[str, int]]:
        """Agent and seed of every run, seed by seed."""
        return [(agent, seed) for seed in self.protocol.seeds for agent in self.protocol.agents]

    def open(self) -> None:
        """Make the folder.

        Raises:
            ArtefactError: It is of another protocol.
            SetupError: It cannot be written.
        """
        make_folder(self.folder)
        path = self.folder / _PROTOCOL
        if not path.exists():
            write_json(path, self.protocol.as_dict())
        elif read_protocol_as(self.folder, type(self.protocol)).as_dict() != self.protocol.as_dict():
            raise ArtefactError(f"{path} is of another protocol than its folder's name says. It was left untouched.")

    def lock(self) -> AbstractContextManager[None]:
        """Hold the folder for this process. Raises BusyError: another bench works there."""
        return lock(self.folder / ".lock", f"The bench folder {self.folder}")

    def run_folder(self, agent: str, seed: int) -> Path:
        """Return the folder of one run."""
        return self.folder / file_name(self.protocol.written_name(agent)) / f"seed_{seed}"

    def load(self, load_run: Callable[[Path], L]) -> dict[tuple[str, int], L]:
        """Read every run by ``load_run``. Raises ArtefactError: a run is damaged or of another protocol."""
        found = {pair: load_run(self.run_folder(*pair)) for pair in self.pairs}
        for (agent, seed), run in found.items():
            if run is not None:
                run_folder.require_run_of(self.run_folder(agent, seed), self.protocol, agent, seed)
        return found

    def missing(self, until: int | None = None) -> list[tuple[str, int]]:
        """Return the runs that are not finished, or have not come to the budget ``until``, seed by seed."""
        unfinished = [pair for pair in self.pairs if not run_folder.is_done(self.run_folder(*pair))]
        return [pair for pair in unfinished if until is None or run_folder.reached(self.run_folder(*pair)) < until]

    def begin_session(self, environment: Mapping[str, Json]) -> list[str]:
        """Note that work starts now, in what :func:`.describe_environment` says; returns :meth:`changed`."""
        path = self.folder / _ENVIRONMENT
        begun = path.exists()
        if begun:
            self._sessions = _sessions(self.folder)
        self._began_s = time.monotonic()
        changed = self.changed(environment)
        self._sessions.append(
            {
                "started": datetime.now(UTC).isoformat(timespec="seconds"),
                "wall_s": 0.0,
                "command": environment["command"],
                "changed": {name: _fact(environment, name) for name in changed},
            }
        )
        self.save_time()
        if not begun:
            write_json(path, sealed(environment))  # last, so that a bench with an environment has sessions too
        return changed

    def keep_certificate(self, certify: Callable[[str, str | None], Certificate | None]) -> None:
        """Keep the exact facts of the protocol's world, which ``certify`` gives for its task and split, once."""
        path = self.folder / _CERTIFICATE
        if isinstance(self.protocol, Protocol) and not path.exists():
            found = certify(self.protocol.task, self.protocol.split)
            if found is not None:
                write_json(path, sealed(dataclasses.asdict(found)))

    def changed(self, environment: Mapping[str, Json]) -> list[str]:
        """Return names of facts that decide the bits and differ from the first session's; none before there was one."""
        path = self.folder / _ENVIRONMENT
        first = read_sealed(path, "a bench's environment") if path.exists() else environment
        return [name for name in _IDENTITY if _fact(first, name) != _fact(environment, name)]

    def save_time(self) -> None:
        """Note how long this session has lasted, so that a kill loses little of the count."""
        self._sessions[-1]["wall_s"] = round(time.monotonic() - self._began_s, 3)
        write_json(self.folder / _SESSIONS, sealed({"sessions": self._sessions}))


def _fact(environment: Mapping[str, Json], name: str) -> Json:
    if name != "cpu":
        return environment.get(name)
    machine = environment.get("machine")
    return machine.get("cpu") if isinstance(machine, Mapping) else None


def bench_folder(root: Path, protocol: ProtocolData) -> Path:
    """Return where the bench of a protocol belongs below ``root``, the folder of all benches, such as ``runs``."""
    return Path(root / file_name(protocol.task) / f"{protocol.preset}-{protocol.hash}")


def bench_facts(folder: Path) -> dict[str, Any]:
    """Return ``environment``, ``folder``, ``wall_s`` and, where it was kept, ``certificate`` of a bench's result.

    Raises ArtefactError: a file is missing or damaged.
    """
    if is_archive(folder):
        found = read_json(folder / KEPT, "a kept bench")
    else:
        found = {"environment": read_sealed(folder / _ENVIRONMENT, "a bench's environment")}
        found["sessions"] = _sessions(folder)
        if (folder / _CERTIFICATE).exists():
            found["certificate"] = read_sealed(folder / _CERTIFICATE, "a world's certificate")
    path = folder / KEPT if is_archive(folder) else folder / _CERTIFICATE
    with reading(path, "the facts of a bench"):
        sessions = [{**session, "wall_s": float(session["wall_s"])} for session in found["sessions"]]
        facts = {
            "environment": {**found["environment"], "sessions": sessions},
            "folder": folder,
            "wall_s": sum(session["wall_s"] for session in sessions),
        }
        certificate = found.get("certificate")
        return facts if certificate is None else {**facts, "certificate": from_json(certificate)}


def _sessions(folder: Path) -> list[_Session]:
    path = folder / _SESSIONS
    sessions = read_sealed(path, "a bench's sessions")
    with reading(path, "a bench's sessions"):
        found: list[_Session] = sessions["sessions"]
        for session in found:
            session["wall_s"] = float(session["wall_s"])
        return found


def require_either(given: Path | None, task: str | None) -> None:
    """Raise InvalidValueError where a path and a task are given: what lies at a path is of a task already."""
    if given is not None and task is not None:
        raise InvalidValueError(f"Both {given} and --task {task} were given; leave one of them out.")


def newest(root: Path, pattern: str, tasks: Collection[str] = ()) -> Path | None:
    """Return the file by ``pattern`` below the folders of some tasks, or of all, that was written last; None without.

    A task's name without options also means it with any.
    """
    names = [file_name(task) for task in tasks]
    folders = [
        folder
        for folder in root.glob("*/")
        if not names or any(folder.name == name or folder.name.startswith(f"{name}-") for name in names)
    ]
    found = (path for folder in folders for path in folder.glob(pattern))
    return max(found, key=lambda path: path.stat().st_mtime, default=None)


def newest_bench(root: Path, tasks: Collection[str] = ()) -> Path:
    """Return the bench folder below ``root`` that was worked on last, of any task or of some, or ArtefactError."""
    found = newest(root, f"*/{_SESSIONS}", tasks)
    if found is None:
        some = next(iter(tasks), "arrow_puzzle")
        where = root / file_name(some) if len(tasks) == 1 else root
        raise ArtefactError(
            f"There is no {'such ' if tasks else ''}bench below {where}; "
            f"run one with 'imagine-bench bench --task {some}'."
        )
    return found.parent


def newest_recording(root: Path, task: str | None = None) -> Path:
    """Return the recording below ``root`` that was written last, of any task or of one, or ArtefactError."""
    found = newest(root, "**/recording.rrd", () if task is None else (task,))
    if found is None:
        raise ArtefactError(
            f"There is no recording below {root / file_name(task or '')}; run a bench with 'imagine-bench bench --task "
            f"{task or 'arrow_puzzle'}'."
        )
    return found


def is_archive(folder: Path) -> bool:
    """Return whether a folder holds a bench that is kept for good, see :mod:`.archive`."""
    return (folder / KEPT).is_file()


def read_protocol_values(folder: Path) -> dict[str, Any]:
    """Return the values of a bench folder's protocol. Raises ArtefactError: they are missing or damaged."""
    kept = is_archive(folder)
    path = folder / (KEPT if kept else _PROTOCOL)
    values = read_json(path, "a bench's protocol")
    name = _NAME.search(folder.resolve().name)
    if name is not None and not kept and digest(values) != name[1]:
        raise ArtefactError(
            f"{path} is damaged: {name[1]} in its folder's name stands for another protocol. It was left untouched."
        )
    with reading(path, "a bench's protocol"):
        return dict(values["protocol"]) if kept else values


def read_protocol_as(folder: Path, kind: type[P]) -> P:
    """Return the protocol of a bench folder, of a known class. Raises ArtefactError: it is missing or damaged."""
    values = read_protocol_values(folder)
    with reading(folder / (KEPT if is_archive(folder) else _PROTOCOL), "a bench's protocol"):
        return kind.from_dict(values)


def is_of_regression(values: Mapping[str, Json]) -> bool:
    """Return whether a protocol's values are those of a regression task, in which no agent acts."""
    return "variants" in values


def read_control(folder: Path) -> Protocol:
    """Return the protocol of a bench of agents that act.

    Raises ArtefactError: the bench is of a regression task, or its protocol is missing or damaged.
    """
    if is_of_regression(read_protocol_values(folder)):
        raise ArtefactError(f"{folder} is of a regression task, in which no agent acts; give one of agents.")
    return read_protocol_as(folder, Protocol)
