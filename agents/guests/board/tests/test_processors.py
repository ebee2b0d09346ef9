"""The verdicts on the board do not change with the processor: masks take its newer instructions away.

Nor do they change with another MuJoCo. OTHER_MUJOCO names its folder, made by
``pip install --no-deps --target FOLDER mujoco==4.0.0 mujoco-core==4.0.0``.
"""

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
_C_LIBRARY_512 = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ"}
_NUMPY_512 = {
    "NPY_DISABLE_CPU_FEATURES": " ".join(
        name for name in _NUMPY["NPY_DISABLE_CPU_FEATURES"].split() if "512" in name or name == "X86_V4"
    )
}
_TORCH = {"ATEN_CPU_CAPABILITY": "default"}
MASKS: Mapping[str, Mapping[str, str]] = {
    "none": {},
    "C library": _C_LIBRARY,
    "C library, AVX-512": _C_LIBRARY_512,
    "numpy": _NUMPY,
    "numpy, AVX-512": _NUMPY_512,
    "torch": _TORCH,
    "all three": {**_C_LIBRARY, **_NUMPY, **_TORCH},
}
ACTING = ("C library", "numpy", "all three")
"""Masks under which poses have other bits on a processor with AVX2 and FMA: the masks are no empty gesture."""
OTHER_MUJOCO = os.environ.get("OTHER_MUJOCO", "")
_CODE = """
import hashlib, json, sys
from pathlib import Path
import gymnasium
import imagine_bench
from imagine_bench_board.check import check, installed_mujoco
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
values = {"poses": poses.hexdigest(), "verdicts": [str(each) for each in found], "mujoco": installed_mujoco()}
print(json.dumps(values))
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
        lines.append(f"masked: {name:18} {len(masked['verdicts'])} rows hold as before; poses are {same}")
        assert masked["verdicts"] == plain["verdicts"]
        assert same == "others" or name not in ACTING or not __cpu_features__["FMA3"], f"the mask {name} does nothing"
    with capsys.disabled():
        print("", *lines, sep="\n")


def test_a_row_of_the_board_holds_with_all_masks() -> None:
    row = next(folder for folder in row_folders(BOARD) if folder.name.startswith("dreamer_v3"))
    (verdict,) = found(row, MASKS["all three"])["verdicts"]
    assert ": holds in arrow_puzzle, physics, clean; open starts; 50 episodes played again;" in verdict


@pytest.mark.slow
@pytest.mark.skipif(not OTHER_MUJOCO, reason="OTHER_MUJOCO names no folder with another MuJoCo")
def test_every_row_holds_with_another_mujoco(capsys: pytest.CaptureFixture[str]) -> None:
    plain = found(BOARD, {})
    other = found(BOARD, {"PYTHONPATH": OTHER_MUJOCO})
    assert other["mujoco"] != plain["mujoco"] and other["poses"] != plain["poses"], "the other MuJoCo did not play"
    with capsys.disabled():
        print("", f"MuJoCo {other['mujoco']}:", *other["verdicts"], sep="\n")
    assert other["verdicts"] == plain["verdicts"]
