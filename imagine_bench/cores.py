"""How many cores and how much memory this process may use: those of the machine that its container leaves it."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Environment of a run: small networks are slower on two threads, and bits repeat only at a fixed count."""


_FILES = {
    "cpu": (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")),
    "memory": (("memory.max",), ("memory.limit_in_bytes",)),
}
"""The files of a control group of Linux, version 2 or 1, with a limit, and with the period that it is of."""


def usable_cores(root: Path = Path("/")) -> int:
    """Cores that this process may use, at least 1: its affinity and its container's quota bound them.

    A quota of a part of a core counts as that core: 1.5 are 2. ``root`` is the folder above ``proc`` and ``sys``.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.ceil(min(cores, _least(root, "cpu"))))


def usable_memory(root: Path = Path("/")) -> int:
    """Bytes of memory that this process may use: the machine's, or its container's limit. ``root`` is as above."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return int(min(machine, _least(root, "memory")))


def _least(root: Path, controller: str) -> float:
    """The least limit of the control groups that this process is in; infinity where there is none."""
    least = math.inf
    groups = root / "proc/self/cgroup"
    lines = groups.read_text().splitlines() if groups.is_file() else []
    for controllers, path in (line.split(":", 2)[1:] for line in lines if line.count(":") >= 2):
        if not controllers or controller in controllers.split(","):
            top = root / "sys/fs/cgroup" / controllers
            inner = top / path.lstrip("/")
            for folder in (inner, *inner.parents):  # each limits all groups below it
                if folder.is_relative_to(top):
                    least = min(least, *(_limit(folder, names) for names in _FILES[controller]))
    return least


def _limit(folder: Path, names: Sequence[str]) -> float:
    """The limit that these files of one control group say; infinity where they are missing or say none."""
    try:
        limit, *period = (float(word) for name in names for word in (folder / name).read_text().split())
        return limit / sum(period or [1.0]) if limit > 0 else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf
