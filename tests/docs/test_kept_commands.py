"""Every kept bench names the command that makes it again, and that command still asks for the same comparison."""

from __future__ import annotations

import csv
import shlex
from pathlib import Path

import pytest
from kept_commands import FOLDERS, NOT_OPTIONS, RESULTS, differing, planned, read

from imagine_bench.cli import main

_COMMANDS = read()


def name(folder: Path) -> str:
    return folder.relative_to(RESULTS).as_posix()


def words(folder: Path) -> list[str]:
    program, command, *rest = shlex.split(_COMMANDS[name(folder)].command)
    assert [program, command] == ["imagine-bench", "bench"]
    return rest


def test_each_kept_bench_has_one_command() -> None:
    assert list(_COMMANDS) == [name(folder) for folder in FOLDERS]


@pytest.mark.parametrize("folder", FOLDERS, ids=name)
def test_the_command_asks_for_the_kept_comparison(folder: Path) -> None:
    differs = differing(folder, planned(words(folder)))
    assert differs == _COMMANDS[name(folder)].differs.split()
    assert set(differs) <= set(NOT_OPTIONS), "an option of the command does not give what was kept"


def test_another_command_would_be_seen() -> None:
    (folder,) = (folder for folder in FOLDERS if name(folder) == "arrow_puzzle-sb3_imagined")
    assert differing(folder, planned(words(folder))) == []
    assert differing(folder, planned([*words(folder), "--appearance", "mild"])) == ["appearance"]
    assert differing(folder, planned([*words(folder), "--set", "controller.discount=0.5"])) != []


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS, ids=name)
def test_the_command_leaves_a_bench_of_the_same_shape(folder: Path, tmp_path: Path) -> None:
    """With one seed, one training episode and one test: the same agents, columns and rows a budget."""
    kept = rows(folder / "results.csv")
    small = ["--seeds", "0", "--workers", "1", "--out", str(tmp_path)]
    if "episodes" in kept[0]:
        small += ["--budgets", "1", "--evaluation-episodes", "1"]
    else:
        small += ["--preset", "smoke", "--networks", "1"]
    if "--after" in words(folder):
        small += ["--after-episodes", "1"]
    assert main(["bench", *words(folder), *small]) == 0
    (made,) = tmp_path.glob("*/results.csv")
    new = rows(made)
    assert fixed_columns(new) == fixed_columns(kept)
    assert [row["agent"] for row in new] == list(dict.fromkeys(row["agent"] for row in kept))


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def fixed_columns(table: list[dict[str, str]]) -> list[str]:
    """The columns that every bench of the type has; those after them depend on what its agents measured."""
    names = list(table[0])
    last = "solved" if "solved" in names else "auroc_nll"
    return names[: names.index(last) + 1]
