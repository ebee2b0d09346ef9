"""Judged code finds nothing of its caller and cannot outlive or stop it; each of its faults is one sentence."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from imagine_bench.errors import InvalidValueError
from imagine_bench.running.isolation import GuestError, Isolated, Limits, why_open

CLOSED = pytest.param(True, marks=pytest.mark.skipif(bool(why_open()), reason=why_open()), id="closed off")
OPEN = pytest.param(False, id="where the system cannot close it off")
Start = Callable[..., Isolated]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    begun: list[Isolated] = []
    (tmp_path / "hidden").mkdir()
    (tmp_path / "hidden" / "truth").touch()

    def starts(*, closed: bool, **limits: float) -> Isolated:
        begun.append(
            Isolated(
                "hostile_guest:Hostile",
                log=tmp_path / "log.txt",
                forbidden=["imagine_bench.tasks"],
                hidden=[tmp_path / "hidden"],
                limits=Limits(**limits),  # type: ignore[arg-type]
                closed=closed,
            )
        )
        return begun[-1]

    yield starts
    for each in begun:
        each.close()


@pytest.mark.parametrize("closed", [CLOSED, OPEN])
def test_a_guest_finds_nothing_of_its_caller(start: Start, tmp_path: Path, closed: bool) -> None:
    secret = "the truth of the caller"
    held = {secret: secret}
    assert secret in held, "the caller holds it, as a variable and in an object"
    guest = start(closed=closed)
    assert guest.call("count_of", secret[::-1].encode())["found"] == 0
    for module in ("imagine_bench.tasks", "imagine_bench.tasks.arrows.rules"):
        with pytest.raises(GuestError, match="tasks is closed to code that is judged"):
            guest.call("imported", module)
    guest.call("imported", "imagine_bench.agents")
    spent_s = guest.cpu_s
    guest.call("listed", str(tmp_path))
    assert guest.cpu_s >= spent_s > 0.0, "of all calls together"
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        if not closed:
            assert guest.call("connected", port) == {}, "said by why_open and on the page"
            return
        with pytest.raises(GuestError, match="Network is unreachable"):
            guest.call("connected", port)
    folder = str(tmp_path / "hidden")
    assert guest.call("listed", folder)["names"].tolist() == []
    assert guest.call("others")["processes"].tolist() == [1]
    tried = guest.call("unmounted", folder)
    assert tried["failed"] and tried["names"].tolist() == []


def test_only_a_forbidden_module_and_those_below_it_are_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not others whose names begin or end alike, such as another package beside the package of a task."""
    allowed = ("grid_world_tools", "grid_world2.rules", "small.grid_world", "grid")
    forbidden = ("grid_world", "grid_world.rules", "grid_world.rules.exact", "games.grid", "games.grid.rules")
    beside = ("games", "games.grid_tools")
    for name in (*allowed, *forbidden, *beside):
        folder = tmp_path / name.replace(".", "/")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    closed = ["grid_world", "games.grid"]
    with Isolated("hostile_guest:Hostile", log=tmp_path / "log.txt", forbidden=closed, closed=False) as guest:
        for name in forbidden:
            with pytest.raises(GuestError, match="is closed to code that is judged"):
                guest.call("imported", name)
        for name in (*allowed, *beside):
            assert guest.call("imported", name) == {}


_ENDS = [
    ("exits", (0,), "SystemExit: 0"),
    ("dies", (0,), "ended itself with exit code 0"),
    ("dies", (3,), "ended itself with exit code 3"),
    ("hangs", (), "was stopped after 10 s"),
    ("raises", (), r"ValueError: depth\\x1b\[31m$"),
    ("gives_text", (), "AttributeError"),
]


@pytest.mark.parametrize("closed", [CLOSED, OPEN])
def test_each_end_of_a_guest_is_one_sentence(start: Start, closed: bool) -> None:
    guest = start(closed=closed, call_s=10.0)  # a loaded machine takes seconds to start it
    for method, given, words in _ENDS:
        with pytest.raises(InvalidValueError, match=words) as found:
            guest.call(method, *given)
        assert str(found.value).isprintable()
        if "Error" not in words and "Exit" not in words:
            with pytest.raises(InvalidValueError, match="its process "):
                guest.call("others")
            guest = start(closed=closed, call_s=10.0)


def test_a_killed_or_pickling_guest_is_a_sentence(start: Start, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="was killed, such as for lack of memory"):
        start(closed=False).call("killed")
    if sys.platform == "linux":
        with pytest.raises(GuestError, match="MemoryError"):
            start(closed=False, memory=2**30).call("grows")
        with pytest.raises(InvalidValueError, match="it sent something that is no answer"):
            start(closed=False).call("sends_a_pickle", str(tmp_path / "carried_out"))
    assert not (tmp_path / "carried_out").exists()


def _grows(file: Path) -> bool:
    """Whether a file is being written to, which may be about to begin."""
    deadline_s = time.monotonic() + 30
    while not file.exists():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    size = file.stat().st_size
    time.sleep(0.5)
    return file.stat().st_size > size


@pytest.mark.parametrize("closed", [CLOSED, OPEN])
def test_nothing_outlives_the_caller(tmp_path: Path, closed: bool) -> None:
    beat = tmp_path / "beat"
    leave = f"guest.call('leaves', {str(beat)!r})" if closed else ""  # elsewhere a detached process stays
    lines = (
        "import sys; from pathlib import Path; from imagine_bench.running.isolation import Isolated",
        f"sys.path.insert(0, {str(Path(__file__).parents[1] / 'fakes')!r})",
        f"guest = Isolated('hostile_guest:Hostile', log=Path({str(tmp_path / 'log')!r}), closed={closed})",
        leave,
        "print('begun', flush=True)",
        "guest.call('hangs')",
    )
    caller = subprocess.Popen([sys.executable, "-c", "\n".join(lines)], stdout=subprocess.PIPE, text=True)
    assert caller.stdout is not None and caller.stdout.readline() == "begun\n"
    caller.stdout.close()
    family = psutil.Process(caller.pid).children(recursive=True)
    assert len(family) >= 2 and (not closed or _grows(beat))
    caller.send_signal(signal.SIGKILL)
    caller.wait()
    assert psutil.wait_procs(family, timeout=10)[1] == []
    assert not closed or not _grows(beat)


@pytest.mark.parametrize("closed", [CLOSED])
def test_what_a_guest_detaches_ends_with_it(start: Start, tmp_path: Path, closed: bool) -> None:
    guest = start(closed=closed)
    guest.call("leaves", str(tmp_path / "beat"))
    assert _grows(tmp_path / "beat")
    guest.close()
    assert not _grows(tmp_path / "beat")
