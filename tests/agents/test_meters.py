"""Measurements of learners: their means, and CPU seconds."""

from __future__ import annotations

import time

import pytest
from imagine_bench.agents.meters import Meters


def test_means_are_of_what_was_counted_and_time_is_of_the_processor() -> None:
    meters = Meters()
    meters.add("share", 3.0, 1.0)
    meters.add("share", 5.0, 3.0)
    meters.add("uncounted", 1.0, 0.0)
    with meters.cpu_time("s"):
        time.sleep(0.2)
    with meters.cpu_time("s"):
        begun_s = time.process_time()
        while time.process_time() < begun_s + 0.04:
            pass
    meters.count("s", "nothing")
    meters.count("s")
    assert meters.read() == {"share": 2.0, "s": pytest.approx(0.02, abs=0.006), "nothing": 0.0}
    assert meters.read() == {}
