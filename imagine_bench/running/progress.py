"""Work on the screen: one bar, with the time left and what was last heard of a run."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
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


class ProgressBar(AbstractContextManager["ProgressBar"]):
    """Shows :class:`~imagine_bench.protocols.runs.Progress` on a terminal as a bar, elsewhere as a line now and then.

    ``specs`` are the runs to come, to their ends even where they pause on the way.
    """

    def __init__(self, specs: Sequence[RunSpec[ProtocolData]]) -> None:
        self._works = {(spec.protocol.hash, spec.agent, spec.seed): spec.work for spec in specs}
        self._done = dict.fromkeys(self._works, 0)
        self._before = dict[RunKey, int]()
        self._finished = set[RunKey]()
        self._began_s = time.monotonic()
        self._shown_s = self._began_s
        form = "{percentage:3.0f} % |{bar:20}| {desc}"
        total = sum(self._works.values())
        self._bar = tqdm(total=total, bar_format=form, leave=False, disable=not sys.stderr.isatty())

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def __call__(self, progress: Progress) -> None:
        """Show how far a run is."""
        run = (progress.bench, progress.agent, progress.seed)
        if progress.phase == "failed":  # what it lacks will not be done
            self._works[run] = self._done[run]
            tqdm.write(f"{progress.agent} seed {progress.seed} failed: {progress.detail}", file=sys.stderr)
            return
        self._before.setdefault(run, progress.done)  # what an earlier session did took no time now
        self._done[run] = progress.done
        pauses = progress.phase == "done"
        if pauses and progress.done >= self._works[run]:
            self._finished.add(run)
        shown = f"{len(self._finished)} of {len(self._works)} runs done, {self._times()}"
        sentence = f"{shown}; {_sentence(progress, self._works[run])}"
        if not self._bar.disable:
            self._bar.total = sum(self._works.values())
            self._bar.n = sum(self._done.values())
            self._bar.set_description_str(sentence)
        elif pauses or time.monotonic() - self._shown_s > _LINE_EVERY_S:
            self._shown_s = time.monotonic()
            print(sentence, file=sys.stderr, flush=True)

    def _times(self) -> str:
        """Time gone and, once there is something to judge by, time left."""
        gone_s = time.monotonic() - self._began_s
        done = sum(self._done.values())
        played = done - sum(self._before.values())
        missing = sum(self._works.values()) - done
        left = f", {tqdm.format_interval(gone_s * missing / played)} left" if played else ""
        return f"{tqdm.format_interval(gone_s)} gone{left}"


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
