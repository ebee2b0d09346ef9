"""Whole contents of files: recordings, and datasets in each format; ``tests/data`` reads these back to the bit."""

from __future__ import annotations

import json
import re
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
import pyarrow.parquet as pq
import pytest
from fake_agents import FakeImaginer
from imagine_bench_motion.control.datasets import replay
from imagine_bench_motion.control.recording import motion_recording
from recordings import as_text
from small_runs import FORMATS, collected, written
from whole_outputs import Expected, masked, rounded, short

from imagine_bench.recording.episodes import record_run

CHANGING = ("versions", "command", "commit", "minari_version", "observation_space", "observation.image")
"""Facts of a card that are not of its episodes, and large ones of frames."""


def test_recording_of_an_agent(tmp_path: Path, expected: Expected) -> None:
    path = tmp_path / "recording.rrd"
    with closing(gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic", appearance="mild")) as env:
        given: dict[str, Any] = {"seed": 3, "appearance": "mild", "episodes": 2}
        record_run("arrow_puzzle", FakeImaginer(), name="imagination", env=env, path=path, **given)
    expected("recording", as_text(path), exactly=False)


def test_recording_of_continuous_control(tmp_path: Path, expected: Expected) -> None:
    made: Any = gymnasium.make("imagine_bench/ArrowPuzzleEasyMotion-v0", disable_env_checker=True, size=32)
    commands = np.zeros((3, 7), np.float32)
    commands[:, 2] = -0.1
    commands[1:, 6] = 1.0
    expert_m = np.array([[0.6, 0.0, 0.2], [0.5, 0.0, 0.2]])
    with closing(made.unwrapped) as env, motion_recording(tmp_path / "motion.rrd", env, expert_m=expert_m) as watch:
        replay(env, 0, commands, watch)
    text = as_text(tmp_path / "motion.rrd")
    lines = text.splitlines()
    chosen = [f"{key}\n{line}" for key, line in zip(lines[::2], lines[1::2], strict=False) if "by no clock" not in key]
    expected("recording_motion", "\n".join(chosen) + text.partition("\nviews")[2], exactly=False)


def values(array: Any) -> str:
    """An array: type, shape, and its values, or the mean of each frame."""
    array = np.asarray(array)
    shown = array.mean(axis=(1, 2, 3)) / 25.0 if array.ndim == 4 else array
    words = " ".join(f"{each:.1f}" for each in shown) if array.ndim == 4 else rounded(shown, 6)
    return f"{array.dtype} {array.shape} {words}"


def of_npz(folder: Path) -> list[str]:
    found = []
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as arrays:
            found += [f"{path.name} {name}: {values(arrays[name])}" for name in sorted(arrays.files)]
    return found


def of_lerobot(folder: Path) -> list[str]:
    found = []
    for path in sorted(folder.rglob("*.parquet")):
        table = pq.read_table(path)
        for name, column in zip(table.schema.names, table.columns, strict=True):
            cells = ["PNG" if isinstance(cell, dict) and "bytes" in cell else cell for cell in column.to_pylist()]
            words = rounded(cells, 2 if "image" in name else 6)  # renderers differ by a gray level
            found.append(f"{path.relative_to(folder)} {name} ({column.type}): {words}")
    return found


def of_minari(folder: Path) -> list[str]:
    found = []
    (data,) = folder.glob("*/data")
    for episode in minari.MinariDataset(data):
        parts = {name: getattr(episode, name) for name in ("observations", "actions", "rewards", "terminations")}
        parts |= {"truncations": episode.truncations, **episode.infos}
        found += [f"episode {episode.id} {name}: {values(array)}" for name, array in parts.items()]
    return found


@pytest.mark.parametrize("format", FORMATS)
def test_dataset(format: str, tmp_path: Path, expected: Expected) -> None:
    """Two episodes; every number of steps is the sum of the lengths."""
    identity = written(tmp_path / "set", format, policy="mixed", episodes=2).identity
    episodes = collected("mixed", 2)[0]
    assert len(episodes.actions) == int(episodes.lengths.sum()) == len(episodes.frames) - 2
    folder = tmp_path / "set"
    content = {"npz": of_npz, "lerobot": of_lerobot, "minari": of_minari}[format](folder)
    texts = []
    for path in sorted([*folder.rglob("*.json"), *folder.rglob("*.md")]):
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".json":
            known = {name: fact for name, fact in json.loads(text).items() if name not in CHANGING}
            text = "\n".join(f"{name}: {json.dumps(known[name], sort_keys=True)}" for name in sorted(known))
        text = re.sub(r"Made with imagine_bench: `.*?`", "Made with imagine_bench: `COMMAND`", text)
        texts.append(f"== {path.relative_to(folder)}\n{text}")
    files = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    text = "\n".join([identity, *files, *content, *texts])
    expected(f"dataset_{format}", masked(short(text)), exactly=False)
