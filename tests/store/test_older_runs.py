"""A bench that commit abcb05c began is read, and finished to the same bits.

``of_abcb05c/whole`` is a finished bench; ``of_abcb05c/killed`` an equal one, killed within its second test.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from small_runs import final_arrays, made_bench, of_before_digests, same_but_for_time, small

from imagine_bench.running.bench import load_bench, read_protocol
from imagine_bench.store.bench_folder import bench_folder
from imagine_bench.store.loading import load_so_far
from imagine_bench.store.results import BenchResult

OLDER = Path(__file__).parent / "of_abcb05c"


def test_a_killed_bench_is_read_and_ends_in_the_bits_of_a_whole_one(tmp_path: Path) -> None:
    protocol = read_protocol(OLDER / "whole")
    assert protocol == of_before_digests() and protocol.hash == "c12d19f8f687"
    folder = bench_folder(tmp_path, protocol)
    shutil.copytree(OLDER / "killed", folder)
    assert load_so_far(folder).protocol.budgets == (4,)
    result = made_bench(small(), tmp_path)
    assert isinstance(result, BenchResult)
    shutil.copytree(OLDER / "whole", tmp_path / "whole")
    whole = load_bench(tmp_path / "whole")
    assert isinstance(whole, BenchResult)
    assert same_but_for_time(result.runs[0], whole.runs[0])
    ours = final_arrays(result.runs[0].folder)
    theirs = final_arrays(whole.runs[0].folder)
    assert ours.keys() == theirs.keys()
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)
