"""Where a bench lies: ``<root>/<task>/<preset>-<protocol hash>/<agent>/seed_<n>/``; other settings lie elsewhere.

``protocol.json`` holds the protocol, and ``sessions.json`` the environment of the first session, the exact facts of the
world, and when and with which command work went on. Nothing is ever overwritten by another protocol, for its hash is in
the name. A bench that is kept for good is one file, ``bench.json``, and a table: see :mod:`.loading`.
"""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.exact.certificate import Certificate, from_json
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import ProtocolData, digest
from imagine_bench.registry import packages_of
from imagine_bench.registry.entries import file_name
from imagine_bench.registry.machine import versions
from imagine_bench.store import run_folder
from imagine_bench.store.files import lock, make_folder, read_json, read_sealed, reading, sealed, sweep, write_json
from imagine_bench.values import Json

P = TypeVar("P", bound=ProtocolData)
L = TypeVar("L")
Certify = Callable[[str, str | None], Certificate | None]

KEPT = "bench.json"
"""Protocol, environment and sessions in one file, as :mod:`.loading` keeps them for good."""
_PROTOCOL = "protocol.json"
_SESSIONS = "sessions.json"
_EARLIER = ("environment", "certificate")
"""Facts that lie in files of their own where a bench began before 2026-11-28."""
_DECISIVE = ("commit", "versions", "gl_renderer")
_NO_BENCHES = {
    "judgement.json": "is a judgement of world models; 'imagine-bench judge' with the same options shows it again",
    f"report/{KEPT}": "is a report of merged benches, which has no runs; give the folder of one of these benches, or "
    "the folder 'report' below this one to see its table again",
    "config.json": "is one run; give the folder of its bench, which is two folders above",
    "study.json": "is a study, which has no runs of its own; give the folder of one of its benches",
    "suite.json": "is a suite, which has no runs of its own; give the folder of one of its benches",
    "report/suite.json": "is a suite, which has no runs of its own; give the folder of one of its benches",
    "card.json": "is a dataset; 'imagine-bench dataset --describe' shows it",
}
"""Folders of other kinds by a file that they have, and the sentence where a bench's is wanted."""
_NAME = re.compile("-([0-9a-f]{12})$")
"""The hash in a folder's name; whoever moves a bench elsewhere may leave it out."""


class BenchStore:
    """The folder of one protocol: that of :func:`bench_folder`, or wherever somebody has moved it to."""

    def __init__(self, folder: Path, protocol: ProtocolData) -> None:
        self.protocol = protocol
        self.folder = folder
        self._began_s = time.monotonic()
        self._facts: dict[str, Any] = {}

    @contextmanager
    def held(self) -> Iterator[None]:
        """Make the folder, and hold it for this process.

        Raises:
            ArtefactError: It is of another protocol.
            BusyError: Another bench works there.
            SetupError: It cannot be written.
        """
        make_folder(self.folder)
        with lock(self.folder / ".lock", f"The bench folder {self.folder}"):
            sweep(self.folder)
            if not (self.folder / _PROTOCOL).exists():
                write_json(self.folder / _PROTOCOL, self.protocol.as_dict())
            read_protocol_values(self.folder)
            yield

    def run_folder(self, agent: str, seed: int) -> Path:
        """Return the folder of one run."""
        return self.folder / file_name(self.protocol.written_name(agent)) / f"seed_{seed}"

    def load(self, load_run: Callable[[Path], L]) -> dict[tuple[str, int], L]:
        """Read every run by ``load_run``. Raises ArtefactError: a run is damaged or of another protocol."""
        found = {pair: load_run(self.run_folder(*pair)) for pair in self.protocol.runs}
        for (agent, seed), run in found.items():
            if run is not None:
                run_folder.require_run_of(self.run_folder(agent, seed), self.protocol, agent, seed)
        return found

    def missing(self) -> list[tuple[str, int]]:
        """Return the runs that are not finished, seed by seed."""
        return [pair for pair in self.protocol.runs if not run_folder.is_done(self.run_folder(*pair))]

    def begin_session(self, environment: Mapping[str, Json], certify: Certify = lambda task, split: None) -> list[str]:
        """Note that work starts now, in the facts that :func:`.describe_environment` gives; returns :meth:`changed`.

        The first time, the exact facts of the protocol's world are kept too, which ``certify`` gives for its task and
        split.
        """
        if (self.folder / _SESSIONS).exists():
            self._facts = _facts(self.folder)
        else:
            self._facts = {"environment": environment, "sessions": []}
            found = certify(self.protocol.task, self.protocol.split) if isinstance(self.protocol, Protocol) else None
            if found is not None:
                self._facts["certificate"] = dataclasses.asdict(found)
        changed = _changed(self._facts["environment"], environment)
        started = datetime.now(UTC).isoformat(timespec="seconds")
        self._facts["sessions"].append({"started": started, "command": environment["command"], "changed": changed})
        self._began_s = time.monotonic()
        self.save_time()
        return list(changed)

    def changed(self, environment: Mapping[str, Json]) -> list[str]:
        """Return names of facts that decide the bits and differ from the first session's."""
        return list(_changed(_facts(self.folder)["environment"], environment))

    def save_time(self) -> None:
        """Note how long this session has lasted."""
        self._facts["sessions"][-1]["wall_s"] = round(time.monotonic() - self._began_s, 3)
        write_json(self.folder / _SESSIONS, sealed(self._facts))


def _changed(first: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Json]:
    """Facts of an environment that decide the bits of a result, those that differ from the first session's."""
    then, facts = (
        {**{name: each.get(name) for name in _DECISIVE}, "cpu": each.get("machine", {}).get("cpu")}
        for each in (first, now)
    )
    return {name: fact for name, fact in facts.items() if fact != then[name]}


def _facts(folder: Path) -> dict[str, Any]:
    """Environment, sessions and, where there is one, the certificate, as the files of a bench have them."""
    if is_archive(folder):
        return dict(read_json(folder / KEPT, "a kept bench"))
    found = read_sealed(folder / _SESSIONS, "a bench's sessions")
    for name in _EARLIER:
        path = folder / f"{name}.json"
        if name not in found and path.exists():
            found[name] = read_sealed(path, f"the {name} of a bench")
    return found


def bench_folder(root: Path, protocol: ProtocolData) -> Path:
    """Return where the bench of a protocol belongs below ``root``, the folder of all benches, such as ``runs``."""
    return Path(root / file_name(protocol.task) / f"{protocol.preset}-{protocol.hash}")


def as_begun(root: Path, protocol: P) -> P:
    """A protocol as its bench below ``root`` has it: without digests of packages where that is of before 2026-11-30.

    Such a bench goes on, unless its first session names another version of one of these packages.
    """
    places = protocol.code_places()
    of_classes = tuple((name, found[:12]) for name, found in protocol.code if name not in places)
    former = dataclasses.replace(protocol, code=of_classes)
    folder = bench_folder(root, former)
    if former == protocol or bench_folder(root, protocol).exists() or not (folder / _SESSIONS).exists():
        return protocol
    then = _facts(folder)["environment"]["versions"]
    now = versions()
    packages = packages_of(places.values())
    return former if all(then.get(name, now[name]) == now[name] for name in packages) else protocol


def with_other_code(folder: Path, protocol: ProtocolData) -> list[Path]:
    """Return the benches beside ``folder`` that differ from this protocol in the code of agents and tasks alone."""
    wanted = digest({**protocol.as_dict(), "code": None})
    found = []
    for path in sorted(folder.parent.glob(f"{protocol.preset}-*/{_PROTOCOL}")):
        values = read_json(path, "a bench's protocol")
        if path.parent != folder and digest({**values, "code": None}) == wanted:
            found.append(path.parent)
    return found


def bench_facts(folder: Path) -> dict[str, Any]:
    """Return ``environment``, ``folder``, ``wall_s`` and, where kept, ``certificate`` and ``made_with`` of a bench.

    Raises ArtefactError: a file is missing or damaged.
    """
    found = _facts(folder)
    with reading(folder, "a bench with environment and sessions"):
        facts = {
            "environment": {**found["environment"], "sessions": found["sessions"]},
            "folder": folder,
            "wall_s": sum(float(session["wall_s"]) for session in found["sessions"]),
        }
        if found.get("certificate") is not None:
            facts["certificate"] = from_json(found["certificate"])
        if "protocol_hash" in found:
            facts["made_with"] = str(found["protocol_hash"])
        return facts


def require_either(given: Path | None, task: str | None) -> None:
    """Raise InvalidValueError where a path and a task are given: a path belongs to a task already."""
    if given is not None and task is not None:
        raise InvalidValueError(f"Both {given} and --task {task} were given; leave one of them out.")


def newest_bench(root: Path, *tasks: str | None) -> Path:
    """Return the bench folder below ``root`` that was worked on last, of some tasks or of any, or ArtefactError."""
    return _newest(root, f"*/{_SESSIONS}", "bench", tasks).parent


def newest_recording(root: Path, *tasks: str | None) -> Path:
    """Return the recording below ``root`` that was written last, of some tasks or of any, or ArtefactError."""
    return _newest(root, "**/recording.rrd", "recording", tasks)


def _newest(root: Path, pattern: str, what: str, tasks: Sequence[str | None]) -> Path:
    """The file by ``pattern`` below the folders of some tasks, or of all, that was written last.

    A task's name without options also means it with any.
    """
    names = [task for task in tasks if task]
    wanted = [f"{file_name(name)}{options}" for name in names for options in ("", "-*")] or ["*"]
    found = [path for name in wanted for path in root.glob(f"{name}/{pattern}")]
    if not found:
        of = f" of {names[0]}" if len(names) == 1 else ""
        some = next(iter(names), "arrow_puzzle")
        raise ArtefactError(f"There is no {what}{of} below {root}; run 'imagine-bench bench --task {some}' first.")
    return max(found, key=lambda path: path.stat().st_mtime)


def is_archive(folder: Path) -> bool:
    """Return whether a folder holds a bench that is kept for good, see :mod:`.loading`."""
    return (folder / KEPT).is_file()


def read_protocol_values(folder: Path) -> dict[str, Any]:
    """Return the values of a bench folder's protocol. Raises ArtefactError: they are missing or damaged."""
    kept = is_archive(folder)
    path = folder / (KEPT if kept else _PROTOCOL)
    for file, words in _NO_BENCHES.items():
        if (folder / file).is_file() and not (path.exists() or (folder / _SESSIONS).exists()):
            raise ArtefactError(f"{folder} {words}.")
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
    with reading(folder, f"a bench with a {kind.__name__}"):
        return kind.from_dict(values)


def read_control(folder: Path) -> Protocol:
    """Return the protocol of a bench of agents that act.

    Raises ArtefactError: the bench is of a regression task, or its protocol is missing or damaged.
    """
    values = read_protocol_values(folder)
    if "variants" in values:
        raise ArtefactError(f"{folder} is of a regression task, in which no agent acts; give one of agents.")
    return read_protocol_as(folder, Protocol)
