"""The verdicts on the board do not change with the processor: masks take its newer instructions away."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from imagine_bench_board.check import row_folders
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

BOARD = Path(__file__).parents[4] / "docs" / "board"
_C_LIBRARY = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ,-AVX2,-AVX,-FMA,-FMA4"}
_NUMPY = {"NPY_DISABLE_CPU_FEATURES": " ".join(name for name in __cpu_dispatch__ if __cpu_features__[name])}
_TORCH = {"ATEN_CPU_CAPABILITY": "default"}
MASKS: Mapping[str, Mapping[str, str]] = {
    "none": {},
    "C library": _C_LIBRARY,
    "numpy": _NUMPY,
    "torch": _TORCH,
    "all three": {**_C_LIBRARY, **_NUMPY, **_TORCH},
}
_CODE = """
import hashlib, json, sys
from pathlib import Path
import gymnasium
import imagine_bench
from imagine_bench_board.check import check
env = gymnasium.make("imagine_bench/ArrowPuzzle-v0", observation="state")
poses = hashlib.sha256()
for seed in range(5):
    env.reset(seed=seed)
    for action in (0, 3, 4, 1):
        over = env.step(action)[2]
        poses.update(env.unwrapped.data.qpos.tobytes())
        if over:
            break
found = check(Path(sys.argv[1]))
print(json.dumps({"poses": poses.hexdigest(), "verdicts": [str(each) for each in found]}))
"""


def found(folder: Path, mask: Mapping[str, str]) -> dict[str, Any]:
    """The verdicts on a board, or a row, in a process of its own with some instructions masked."""
    command = [sys.executable, "-c", _CODE, str(folder)]
    done = subprocess.run(command, env={**os.environ, **mask}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    values: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return values


@pytest.mark.slow
def test_the_verdicts_are_the_same_on_other_processors(capsys: pytest.CaptureFixture[str]) -> None:
    """Printed: the rows that hold, and whether the poses after physics are those without a mask."""
    plain = found(BOARD, MASKS["none"])
    assert all(": holds in " in verdict for verdict in plain["verdicts"])
    lines = []
    for name, mask in MASKS.items():
        masked = found(BOARD, mask)
        same = "the same" if masked["poses"] == plain["poses"] else "others"
        lines.append(f"masked: {name:10} {len(masked['verdicts'])} rows hold as before; poses are {same}")
        assert masked["verdicts"] == plain["verdicts"]
    with capsys.disabled():
        print("", *lines, sep="\n")


def test_a_row_of_the_board_holds_with_all_masks() -> None:
    row = next(folder for folder in row_folders(BOARD) if folder.name.startswith("dreamer_v3"))
    (verdict,) = found(row, MASKS["all three"])["verdicts"]
    assert ": holds in arrow_puzzle, physics, clean; open starts; 50 episodes played again;" in verdict
