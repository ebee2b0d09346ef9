"""Running means of a learner's measurements, emptied each time they are read."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Meters:
    """Named means since the last reading; they survive a checkpoint."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._counts: dict[str, float] = {}

    def add(self, name: str, value: float, count: float = 1.0) -> None:
        """Add ``value``, the sum of ``count`` measurements."""
        self._sums[name] = self._sums.get(name, 0.0) + value
        self._counts[name] = self._counts.get(name, 0.0) + count

    @contextmanager
    def cpu_time(self, name: str) -> Iterator[None]:
        """Add the CPU seconds of the block, uncounted: :meth:`count` says by how much they are divided."""
        start = time.process_time()
        yield
        self.add(name, time.process_time() - start, 0.0)

    def count(self, *names: str) -> None:
        """Count one more of the events that ``names`` are means of, such as a real step for CPU seconds a step."""
        for name in names:
            self.add(name, 0.0)

    def read(self) -> dict[str, float]:
        """The means since the last call, of the names that were measured."""
        means = {name: total / self._counts[name] for name, total in self._sums.items() if self._counts[name] > 0}
        self._sums = {}
        self._counts = {}
        return means

    def state(self) -> dict[str, list[float]]:
        """JSON-serialisable sums and counts by name."""
        return {name: [total, self._counts[name]] for name, total in self._sums.items()}

    def restore(self, state: dict[str, list[float]]) -> None:
        """Take up the result of :meth:`state`."""
        self._sums = {name: total for name, (total, _) in state.items()}
        self._counts = {name: count for name, (_, count) in state.items()}
