"""A bench on the screen: one bar for everything with the time left, and a line for each run that is going on."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager

from tqdm import tqdm

from imagine_bench.runs import Progress, RunSpec

_LINE_EVERY_S = 15.0
"""Between two lines where nobody watches a terminal."""


class ProgressBars(AbstractContextManager["ProgressBars"]):
    """Shows :class:`~imagine_bench.runs.Progress` on a terminal as bars, elsewhere as a line now and then.

    Args:
        specs: The runs to come.
        workers: Runs at a time.
    """

    def __init__(self, specs: Sequence[RunSpec], workers: int) -> None:
        self._live = sys.stderr.isatty()
        self._runs, self._finished = len(specs), 0
        self._done: dict[tuple[str, int], int] = {}
        self._shown_s = time.monotonic()
        self._total = tqdm(
            total=sum(spec.work for spec in specs),
            unit="episode",
            desc=self._description(),
            bar_format="{desc} |{bar:30}| {percentage:3.0f} %  {elapsed} elapsed, {remaining} left",
            disable=not self._live,
            leave=False,
        )
        self._lines: list[tuple[tuple[str, int] | None, tqdm]] = [
            (None, tqdm(bar_format="{desc}", position=row + 1, leave=False, disable=not self._live))
            for row in range(min(workers, len(specs)))
        ]

    def __exit__(self, *_: object) -> None:
        for _, line in self._lines:
            line.close()
        self._total.close()

    def __call__(self, progress: Progress) -> None:
        """Show how far a run is."""
        run = (progress.agent, progress.seed)
        first = run not in self._done
        self._total.update(progress.done - self._done.get(run, 0))
        self._done[run] = progress.done
        if first:  # what an earlier sitting did takes no time now, and must not promise too early an end
            self._total.initial += progress.done
        finished = progress.phase == "done"
        self._finished += finished
        self._total.set_description_str(self._description(), refresh=False)
        if self._live:
            self._show_on_line(run, "" if finished else _sentence(progress), free=finished)
        elif finished or time.monotonic() - self._shown_s > _LINE_EVERY_S:
            self._shown_s = time.monotonic()
            print(f"{self._description()}: {_sentence(progress)}", file=sys.stderr, flush=True)

    def _description(self) -> str:
        return f"{self._finished} of {self._runs} runs done"

    def _show_on_line(self, run: tuple[str, int], text: str, *, free: bool) -> None:
        rows = [row for row, (owner, _) in enumerate(self._lines) if owner == run]
        rows += [row for row, (owner, _) in enumerate(self._lines) if owner is None]
        if not rows:
            return
        line = self._lines[rows[0]][1]
        line.set_description_str(text)
        self._lines[rows[0]] = (None if free else run, line)


def _sentence(progress: Progress) -> str:
    success = "" if progress.success is None else f", success {100 * progress.success:.0f} %"
    return (
        f"{progress.agent} seed {progress.seed}: {progress.phase}, training episode {progress.episode}, "
        f"{100 * progress.done / progress.work:.0f} % done{success}"
    )
