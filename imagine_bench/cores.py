"""How many cores this process may use: those of the machine that its affinity and its container's quota leave it."""

from __future__ import annotations

import math
import os
from pathlib import Path

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Environment of a run: small networks are slower on two threads, and bits repeat only at a fixed count."""


def usable_cores(root: Path = Path("/")) -> int:
    """Cores that this process may use, at least 1.

    A quota of a part of a core counts as that core: 1.5 are 2. ``root`` is the folder above ``proc`` and ``sys``.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.ceil(min(cores, _quota(root))))


def _quota(root: Path) -> float:
    """Cores that control groups of Linux allow, version 2 (``cpu.max``) or 1; infinity where there is no limit."""
    least = math.inf
    groups = root / "proc/self/cgroup"
    lines = groups.read_text().splitlines() if groups.is_file() else []
    for controllers, path in (line.split(":", 2)[1:] for line in lines if line.count(":") >= 2):
        if not controllers or "cpu" in controllers.split(","):
            top = root / "sys/fs/cgroup" / controllers
            inner = top / path.lstrip("/")
            for folder in (inner, *inner.parents):  # each limits all groups below it
                if folder.is_relative_to(top):
                    least = min(least, _limit(folder))
    return least


def _limit(folder: Path) -> float:
    """Cores that one control group allows."""
    try:
        if (folder / "cpu.max").is_file():
            quota, period = (folder / "cpu.max").read_text().split()
        else:
            quota, period = ((folder / f"cpu.cfs_{name}_us").read_text().strip() for name in ("quota", "period"))
        return float(quota) / float(period) if quota != "max" and float(quota) > 0 else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf
