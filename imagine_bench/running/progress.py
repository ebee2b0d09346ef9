"""Work on the screen: of a bench one bar for everything with the time left, and a line for each run that goes on."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import TypeVar

from tqdm import tqdm

from imagine_bench.protocols.data import ProtocolData
from imagine_bench.protocols.runs import Progress, RunSpec

Item = TypeVar("Item")
RunKey = tuple[str, str, int]
"""Hash of its protocol, agent and seed of a run."""

_LINE_EVERY_S = 15.0
"""Between two lines where nobody watches a terminal."""


class ProgressBars(AbstractContextManager["ProgressBars"]):
    """Shows :class:`~imagine_bench.protocols.runs.Progress` on a terminal as bars, elsewhere as a line now and then.

    ``specs`` are the runs to come, to their ends even where they pause on the way; ``done`` is how much of each run
    earlier sessions did, by bench, agent and seed, as far as is known before it goes on.
    """

    def __init__(self, specs: Sequence[RunSpec[ProtocolData]], done: Mapping[RunKey, int] | None = None) -> None:
        self._works = {(spec.protocol.hash, spec.agent, spec.seed): spec.work for spec in specs}
        self._finished = set[RunKey]()
        self._done = dict(done or {})
        self._before = dict(self._done)
        self._seen = set[RunKey]()
        self._began_s = self._shown_s = time.monotonic()
        self._total: tqdm | None = None
        self._lines: list[tuple[RunKey | None, tqdm]] = []
        if sys.stderr.isatty():
            form = "{desc} |{bar:30}| {percentage:3.0f} %{postfix}"
            self._total = tqdm(total=sum(self._works.values()), desc=self._description(), bar_format=form, leave=False)

    def __exit__(self, *error: object) -> None:
        for _, line in self._lines:
            line.close()
        if self._total is not None:
            self._total.close()

    def __call__(self, progress: Progress) -> None:
        """Show how far a run is."""
        run = (progress.bench, progress.agent, progress.seed)
        pauses = progress.phase == "done"
        if progress.phase == "failed":
            self._drop(run, f"{progress.agent} seed {progress.seed} failed: {progress.detail}")
            return
        work = self._works[run]
        if run not in self._seen:  # what an earlier session did took no time now and foretells nothing
            self._seen.add(run)
            self._before[run] = progress.done
        self._done[run] = progress.done
        if pauses and progress.done >= work:
            self._finished.add(run)
        if self._total is not None:
            self._show_on_bars(self._total, run, "" if pauses else _sentence(progress, work))
        elif pauses or time.monotonic() - self._shown_s > _LINE_EVERY_S:
            self._shown_s = time.monotonic()
            print(f"{self._description()},{self._times()}; {_sentence(progress, work)}", file=sys.stderr, flush=True)

    def _drop(self, run: RunKey, sentence: str) -> None:
        """Say that a run failed; what it lacks will not be done."""
        self._works[run] = self._done.get(run, 0)
        if self._total is not None:
            self._total.total = sum(self._works.values())
            self._show_on_bars(self._total, run, "")
        tqdm.write(sentence, file=sys.stderr)

    def _description(self) -> str:
        return f"{len(self._finished)} of {len(self._works)} runs done"

    def _times(self) -> str:
        """Time gone and, once there is something to judge by, time left."""
        gone_s = time.monotonic() - self._began_s
        done = sum(self._done.values())
        played = done - sum(self._before.values())
        missing = sum(self._works.values()) - done
        left = f", {tqdm.format_interval(gone_s * missing / played)} left" if played else ""
        return f" {tqdm.format_interval(gone_s)} gone{left}"

    def _show_on_bars(self, total: tqdm, run: RunKey, text: str) -> None:
        total.n = sum(self._done.values())
        total.set_description_str(self._description(), refresh=False)
        total.set_postfix_str(self._times(), refresh=True)
        row = self._row(run)
        line = self._lines[row][1]
        line.set_description_str(text)
        self._lines[row] = (run if text else None, line)

    def _row(self, run: RunKey) -> int:
        """The run's line, else one that a finished run has left, else a new one below."""
        owners = [owner for owner, _ in self._lines]
        for wanted in (run, None):
            if wanted in owners:
                return owners.index(wanted)
        self._lines.append((run, tqdm(bar_format="{desc}", position=len(owners) + 1, leave=False)))
        return len(owners)


def counted(items: Iterable[Item], what: str, *, total: int) -> Iterator[Item]:
    """The items, and how many of ``total`` are done: on a terminal a bar, elsewhere a line now and then.

    An item is done when the next is asked for; ``what`` is what they are called.
    """
    with tqdm(total=total, desc=what, leave=False, disable=not sys.stderr.isatty()) as bar:
        shown_s = time.monotonic()
        for done, item in enumerate(items, start=1):
            yield item
            bar.update()
            if bar.disable and time.monotonic() - shown_s > _LINE_EVERY_S:
                shown_s = time.monotonic()
                print(f"{done} of {total} {what}", file=sys.stderr, flush=True)


def _sentence(progress: Progress, work: int) -> str:
    """What a run is doing, and how far it is of all its ``work``; what is done as far as a budget waits for others."""
    if progress.detail is not None:
        return f"{progress.agent} seed {progress.seed}: {progress.detail}, {100 * progress.done / work:.0f} %"
    phase = "waiting" if progress.phase == "done" and progress.done < work else progress.phase
    success = "" if progress.success is None else f", success {100 * progress.success:.0f} %"
    return (
        f"{progress.agent} seed {progress.seed}: {phase}, training episode {progress.episode}, "
        f"{100 * progress.done / work:.0f} % of its episodes{success}"
    )
