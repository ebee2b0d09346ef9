"""Memory that was freed between blocks in use goes back to the system."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

import numpy as np
import pytest
from imagine_bench.agents.networks.allocator import keep_freed_memory, release_freed_memory

_MIB = 2**20


def resident_mib() -> float:
    """Memory of this process that is in use by the system's account, in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / _MIB


@pytest.mark.skipif(sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="needs glibc")
def test_memory_between_blocks_in_use_goes_back() -> None:
    keep_freed_memory()
    large, small = [], []
    for _ in range(100):
        large.append(np.ones(_MIB, dtype=np.uint8))
        small.append(np.ones(12_288, dtype=np.uint8))
    large.clear()
    before = resident_mib()
    release_freed_memory()
    assert resident_mib() < before - 90 and all(each.all() for each in small)
