"""Rules for every test: a limit on CPU time, a cache folder that is empty at first, and no waiting for the disk.

A fast test uses at most about 3 seconds of CPU time: one that uses more is named, one that uses twice as much fails.

The limit grows where the machine is slower than the one it was set on: a calibration loop is timed at the session's
start, and again before a test fails. Other programs may have slowed the machine for those seconds alone, so a test that
fails for its time, and for nothing else, is run up to two times more (``--reruns`` in pyproject.toml); a test that is
too slow always fails always. Child processes count. Fixtures that tests share do not, nor do modules that a
test is the first of its process to import: which test that is depends on the order of the tests.
"""

from __future__ import annotations

import itertools
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING
from unittest import mock

import numpy as np
import pytest

if TYPE_CHECKING:
    from guest_packages import Guests
    from whole_outputs import Expected

LIMIT_CPU_S = 3.0
"""CPU seconds that a fast test may use on the machine whose calibration loop takes the seconds below."""
CALIBRATION_CPU_S = 0.15
_USED = "cpu_s"


def calibration_cpu_s() -> float:
    """CPU seconds of a fixed piece of work: the least of three rounds, in numpy, in Python, and among many objects.

    The objects do not fit into a processor's nearest cache: where another process crowds the memory, tests become
    slower than arithmetic does.
    """

    def once() -> float:
        before = time.process_time()
        matrix = np.full((128, 128), 0.5)
        for _ in range(60):
            matrix = np.tanh(matrix @ matrix / 64.0)
        sum(number * number % 7 for number in range(400_000))
        objects = {(number % 977, number): [number] for number in range(50_000)}
        sorted(objects, key=lambda key: (key[0], -key[1]))
        return time.process_time() - before

    return min(once() for _ in range(3))


def slowness() -> float:
    """How many times slower than the reference this machine is now, at least 1."""
    return max(1.0, calibration_cpu_s() / CALIBRATION_CPU_S)


def cpu_s() -> float:
    """CPU seconds of this process and of the children it has waited for."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


class ImportTime:
    """CPU seconds that this process has spent on executing modules for the first time."""

    def __init__(self) -> None:
        self.cpu_s = 0.0
        self._executing = False
        self._execute = SourceFileLoader.exec_module

        def timed(loader: SourceFileLoader, module: ModuleType) -> None:  # a method of the loader, not of this class
            self._timed(loader, module)

        self.patch = mock.patch.object(SourceFileLoader, "exec_module", timed)

    def _timed(self, loader: SourceFileLoader, module: ModuleType) -> None:
        if self._executing:
            self._execute(loader, module)
            return
        before = time.process_time()
        self._executing = True
        try:
            self._execute(loader, module)
        finally:
            self._executing = False
            self.cpu_s += time.process_time() - before


class CpuLimit:
    """The pytest plugin that holds fast tests to the limit."""

    def __init__(self) -> None:
        self.slowness = slowness()
        self.slow: list[tuple[float, str]] = []
        self.imports = ImportTime()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, object, object]:
        """Time the test itself; a test that passed fails if it used twice the limit."""
        before = cpu_s() - self.imports.cpu_s
        with self.imports.patch:
            result = yield
        used = cpu_s() - self.imports.cpu_s - before
        if item.get_closest_marker("slow") is None:
            item.user_properties.append((_USED, used / self.slowness))
            if used > 2.0 * LIMIT_CPU_S * self.slowness:
                self.slowness = max(self.slowness, slowness())
            limit = LIMIT_CPU_S * self.slowness
            if used > 2.0 * limit:
                pytest.fail(
                    f"The test used {used:.1f} CPU s, more than twice the limit of {limit:.1f} CPU s. "
                    "Make it cheaper, share a trained model in a module's fixture, or mark it slow.",
                    pytrace=False,
                )
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember the tests over the limit."""
        used = dict(report.user_properties).get(_USED)
        if report.when == "call" and isinstance(used, float) and used > LIMIT_CPU_S:
            self.slow.append((used, report.nodeid))

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Name the tests over the limit, the slowest first."""
        if self.slow:
            terminalreporter.section(f"fast tests over {LIMIT_CPU_S:.0f} CPU s, in seconds of the reference machine")
        for used, name in sorted(self.slow, reverse=True):
            terminalreporter.line(f"{used:6.1f}  {name}")


class OwnCache:
    """The pytest plugin that gives each process of the session a cache of its own, empty at first.

    A test that finds an encoder in the user's cache passes on one machine, and trains it for a minute on the next.
    """

    def __init__(self) -> None:
        self.folder = tempfile.mkdtemp(prefix="imagine_bench_cache_")
        os.environ["IMAGINE_BENCH_CACHE"] = self.folder

    def pytest_unconfigure(self) -> None:
        """Delete it."""
        shutil.rmtree(self.folder, ignore_errors=True)


class NoFlush:
    """The pytest plugin that lets nobody of this process wait for the disk: tests kill processes, none cuts the power.

    Child processes wait as usual.
    """

    def __init__(self) -> None:
        self._real = os.fsync
        os.fsync = lambda handle: None

    def pytest_unconfigure(self) -> None:
        """Wait again."""
        os.fsync = self._real


def pytest_xdist_auto_num_workers() -> int:
    """One worker more than there are cores: tests that wait for a process of their own leave a core idle."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return cores + 1


def pytest_configure(config: pytest.Config) -> None:
    """Hold every test of the session to the rules, plug-ins' tests too."""
    config.pluginmanager.register(CpuLimit(), "cpu-limit")
    config.pluginmanager.register(OwnCache(), "own-cache")
    config.pluginmanager.register(NoFlush(), "no-flush")


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option that keeps whole outputs as they are now."""
    parser.addoption("--write-expected", action="store_true", help="write tests/whole/expected again")


@pytest.fixture
def expected(request: pytest.FixtureRequest) -> Expected:
    """Compares a whole output with the kept one."""
    from whole_outputs import expected_of

    return expected_of(request.config)


@pytest.fixture
def guests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Guests]:
    """Packages of others, installed for one test."""
    from guest_packages import Guests

    installed = Guests(tmp_path / "site", monkeypatch)
    yield installed
    installed.forget()


@pytest.fixture
def die_after_saves(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """From now on runs of this process die right after their saves of these numbers, counted from 1."""
    from small_runs import KilledError

    from imagine_bench.running import run_state
    from imagine_bench.store.run_folder import Snapshot

    def die(*numbers: int) -> None:
        save = run_state.save_snapshot
        saves = itertools.count(1)

        def saved(folder: Path, snapshot: Snapshot) -> Path:
            path = save(folder, snapshot)
            if next(saves) in numbers:
                raise KilledError
            return path

        monkeypatch.setattr(run_state, "save_snapshot", saved)

    return die


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, which is also that of temporary files, is the test's own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


@pytest.fixture
def own_names() -> Iterator[None]:
    """The names of tasks, agents and world models that a test changes are as before when it ends."""
    from imagine_bench import registry

    tables = [(table, dict(table)) for table in (registry.TASKS, registry.AGENTS, registry.WORLD_MODELS)]
    yield
    for table, before in tables:
        table.clear()
        table.update(before)


@pytest.fixture
def without_shadows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Views for people drawn without shadows and soft edges, which cost a software renderer 0.1 s each."""
    from imagine_bench.tasks import observations, scene_reader
    from imagine_bench.tasks.rendering.cameras import DRAWN_GROUPS
    from imagine_bench.tasks.rendering.renderer import View

    def view(camera: str, width: int, height: int, *, quick: bool = False) -> View:
        return View(camera=camera, width=width, height=height, groups=DRAWN_GROUPS)

    for module in (observations, scene_reader):
        monkeypatch.setattr(module, "human_camera_view", view)
