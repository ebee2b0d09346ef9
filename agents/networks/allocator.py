"""Let the C library keep the memory that tensors free, for the next ones, or give it back."""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD = -1
_TOP_PAD = -2
_MMAP_THRESHOLD = -3
"""Parameters of ``mallopt`` (glibc, malloc.h)."""
_MIB = 2**20


def keep_freed_memory() -> None:
    """Ask glibc not to give blocks below 32 MiB back to the system at once; elsewhere do nothing.

    An update of the world model frees and takes a few megabytes dozens of times. Each page given back costs a fault
    when taken again: 1,500 to 2,200 an update at the thesis' settings, a fifth of its time.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # no glibc: macOS, musl, Windows
        return
    for parameter, size in ((_MMAP_THRESHOLD, 32 * _MIB), (_TRIM_THRESHOLD, 512 * _MIB), (_TOP_PAD, 64 * _MIB)):
        mallopt(parameter, size)


def release_freed_memory() -> None:
    """Ask glibc to give all freed memory back to the system, also between blocks in use; elsewhere do nothing.

    A learner that keeps small blocks between large ones that it frees, such as frames between activations, takes more
    and more memory otherwise.
    """
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError, TypeError):
        return
    trim(0)
