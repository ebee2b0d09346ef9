"""A bench's metrics for TensorBoard and, offline, for Weights & Biases; extra ``tracking``.

They come from the ``metrics.csv`` of each run, which has a row for every budget tested so far. While a bench runs,
:class:`Tracked` also writes how often recent training episodes succeeded.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, lacking, plain, require_known, require_modules
from imagine_bench.protocols.data import Failure, Job, Launcher, OnProgress, Progress, Result
from imagine_bench.store import run_folder
from imagine_bench.store.files import make_folder, reading, table_rows

Scalars = Mapping[str, float]


def track(folder: Path, tool: str) -> Path:
    """Write the metrics of every run of a bench anew, by real training episodes.

    Args:
        folder: The bench's.
        tool: A name in :data:`TOOLS`.

    Returns:
        The folder inside it to open: ``tensorboard --logdir`` it, or ``wandb sync`` the runs in it.

    Raises:
        UnknownNameError: Another tool.
        InvalidValueError: No run there has been tested, it is a bench of regressors, or an agent has the tool's name.
        ArtefactError: A table is damaged, or a part of a finished run is missing.
        SetupError: The tool is not installed.
    """
    make_writer = TOOLS[require_known("tracking tool", tool, TOOLS)]
    require_modules(tool)
    for run in sorted(folder.glob("*/seed_*")):
        if run_folder.is_done(run):
            run_folder.require_done(run)
    runs = sorted(folder.glob("*/seed_*/metrics.csv"))
    if not runs:
        raise InvalidValueError(f"No run in {folder} has been tested yet; give the folder of a bench.")
    tables = {path.parent: _rows(path) for path in runs}
    out = folder / tool
    if any(out.glob("seed_*/config.json")):
        raise InvalidValueError(f"{out} holds the runs of an agent of this name; give another tool to --track.")
    shutil.rmtree(out, ignore_errors=True)
    for run, rows in tables.items():
        writer = make_writer(make_folder(out), run.relative_to(folder))
        for row in rows:
            writer.add(row, int(row["episodes"]))
        writer.close()
    return out


def _rows(path: Path) -> list[dict[str, float]]:
    """The rows of a run's table, with its success rates."""
    table = path.read_bytes().decode(errors="replace")
    if not table.startswith("episodes,"):
        raise InvalidValueError(
            f"{path.parents[2]} compares no agents by training episodes; give the folder of such a bench."
        )
    with reading(path, "the table of a run of an agent"):
        rows = table_rows(table, ("solved",))
        for row in rows:
            del row["solved"]
            row["success_rate"] = row["successes"] / row["test_episodes"]
    return rows


class Tracked:
    """A launcher whose runs are tracked while they go on: below ``<bench>/<tool>``, as :func:`track` has them.

    A tool that fails is left alone after one sentence; the runs go on.

    Raises:
        UnknownNameError: Another tool.
        SetupError: The tool is not installed.
        InvalidValueError: The task is learned from data, without training episodes.
    """

    def __init__(self, launcher: Launcher, tool: str, task: str) -> None:
        self._make_writer = TOOLS[require_known("tracking tool", tool, TOOLS)]
        require_modules(tool)
        if not registry.has_task(task):
            raise InvalidValueError(f"{task} has no training episodes to track; leave out --track.")
        self._launcher = launcher
        self._tool = tool
        self._failed = False
        self._launched: set[Path] = set()

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job by the launcher within; see :class:`.Launcher`."""
        self._launched.update(job.folder for job in jobs)
        runs = {(job.spec.protocol.hash, job.spec.agent, job.spec.seed): _Run(self, job.folder) for job in jobs}

        def show(progress: Progress) -> None:
            on_progress(progress)
            self.guarded(lambda: runs[progress.bench, progress.agent, progress.seed].take(progress))

        try:
            return self._launcher.launch(jobs, show)
        finally:
            for run in runs.values():
                self.guarded(run.close)

    def note(self, result: Result) -> None:
        """Print a sentence if some runs of a bench were finished before, so that they were not tracked."""
        before = [run.folder.parents[1] for run in result.runs if run.folder not in self._launched]
        if before:
            folders = dict.fromkeys(before)  # of merged benches each has its own
            commands = (f"'imagine-bench report {shlex.quote(str(each))} --track {self._tool}'" for each in folders)
            print(
                f"Note: {len(before)} of {len(result.runs)} runs were finished before and are not tracked: "
                f"{' and '.join(commands)} writes the tests of all runs."
            )

    def writer(self, run: Path) -> RunWriter:
        """The writer of the run of a folder."""
        bench = run.parents[1]
        return self._make_writer(make_folder(bench / self._tool), run.relative_to(bench))

    def guarded(self, act: Callable[[], None]) -> None:
        """Do something with the tool, unless it has failed."""
        if self._failed:
            return
        try:
            act()
        except Exception as error:  # whatever a library raises costs no run
            self._failed = True
            print(f"Note: {self._tool} failed and is left alone: {type(error).__name__}: {plain(error)}.")


class _Run:
    """A run and the number of its metrics that are written; none before its first news."""

    def __init__(self, tracked: Tracked, folder: Path) -> None:
        self._tracked = tracked
        self._folder = folder
        self._writer: RunWriter | None = None
        self._tests = 0
        self._episode = 0

    def take(self, progress: Progress) -> None:
        """Write the tests that have ended, and then how training goes."""
        self._writer = self._writer or self._tracked.writer(self._folder)
        self._write_tests(self._writer)
        if progress.phase == "training" and progress.success is not None and progress.episode > self._episode:
            self._episode = progress.episode
            self._writer.add({"training/recent_success": progress.success}, progress.episode)

    def _write_tests(self, writer: RunWriter) -> None:
        table = self._folder / "metrics.csv"
        rows = _rows(table) if table.exists() else []
        for row in rows[self._tests :]:
            writer.add(row, int(row["episodes"]))
        self._tests = len(rows)

    def close(self) -> None:
        """Write the metrics that are left."""
        if self._writer is not None:
            self._write_tests(self._writer)
            self._writer.close()


class _TensorBoard:
    def __init__(self, out: Path, run: Path) -> None:
        try:
            from tensorboard.summary import Writer  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise lacking("tensorboard") from error
        self._writer = Writer(str(out / run))

    def add(self, scalars: Scalars, episodes: int) -> None:
        for name, value in scalars.items():
            self._writer.add_scalar(name, value, episodes)
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


class _Wandb:
    _open: ClassVar[set[_Wandb]] = set()

    def __init__(self, out: Path, run: Path) -> None:
        try:
            import wandb  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise lacking("wandb") from error
        quiet = wandb.Settings(
            console="off", silent=True, x_disable_stats=True, x_disable_meta=True, disable_git=True, save_code=False
        )
        self._run = wandb.init(
            project=out.parent.name,
            group=run.parent.name,
            name=str(run),
            dir=out,
            mode="offline",
            settings=quiet,
            reinit="create_new",
        )
        self._teardown = wandb.teardown
        self._open.add(self)

    def add(self, scalars: Scalars, episodes: int) -> None:
        self._run.log({name: value for name, value in scalars.items() if name != "episodes"}, step=episodes)

    def close(self) -> None:
        self._run.finish()
        self._open.remove(self)
        if not self._open:
            self._teardown()  # ends its service, which writes the files


RunWriter = _TensorBoard | _Wandb
"""Where the scalars of one run go."""
TOOLS: dict[str, Callable[[Path, Path], RunWriter]] = {"tensorboard": _TensorBoard, "wandb": _Wandb}
"""The tools by name, each the class that writes a run below the folder of a bench."""
