"""Every kept bench names the command that makes it again, and that command still asks for the same comparison.

``docs/results/commands.csv`` has a row a bench: its folder, the command, and the fields of the protocol that today's
command gives another value, separated by spaces.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from doc_cells import KEPT
from kept import RESULTS, facts, table

from imagine_bench.cli import exit_code as main
from imagine_bench.cli import parsed
from imagine_bench.cli.benches import Bench
from imagine_bench.protocols.control import Protocol, protocol
from imagine_bench.protocols.data import ProtocolData, digest
from imagine_bench.registry import TASKS
from imagine_bench.registry.entries import label_today
from imagine_bench.running.bench import plan, read_protocol
from imagine_bench.running.control import resolved_settings

COMMANDS = {row["folder"]: row for row in table("commands.csv")}
NOT_OPTIONS = (
    *("encoder", "codes", "sampled_futures", "settings_digest", "agent_names", "dataset"),
    *("headlines", "open_loop_starts", "recorded_episodes", "few_seeds"),
)
"""Fields of a protocol that no option sets: their values are compared, and a difference is named in the file."""


def name(folder: Path) -> str:
    return folder.relative_to(RESULTS).as_posix()


def words(folder: Path) -> list[str]:
    program, command, *rest = shlex.split(COMMANDS[name(folder)]["command"])
    assert [program, command] == ["imagine-bench", "bench"]
    return rest


def planned(words: list[str]) -> ProtocolData:
    """The protocol that a command has today, but for its encoders, which only its runs need."""
    command = parsed(["bench", *words])
    assert isinstance(command, Bench)
    task, preset, options = command.asked()
    options.pop("encoder", None)
    if task.partition(":")[0] not in TASKS:
        return plan(task, preset, **options)[0]
    return protocol(task, preset, **options)


def differing(folder: Path, today: ProtocolData) -> list[str]:
    """The fields of a kept protocol, in today's names, that ``today`` gives another value.

    An older protocol lacks the later fields.
    """
    written = read_protocol(folder)
    kept = _values(written)
    now = _values(today)
    if isinstance(today, Protocol):
        settings = resolved_settings(today)
        now["settings_digest"] = digest({written.written_name(agent): settings[agent] for agent in settings})
    fields = facts(f"{name(folder)}/bench.json")["protocol"].keys() - {"encoder", "codes"}
    return sorted(field for field in fields if kept[field] != now.get(field))


def _values(one: ProtocolData) -> dict[str, Any]:
    """The fields of a protocol as JSON has them, its agents by today's labels."""
    return {**one.as_dict(), "agents": list(one.agents)}


def test_each_kept_bench_has_one_command() -> None:
    assert list(COMMANDS) == [name(folder) for folder in KEPT]


@pytest.mark.parametrize("folder", KEPT, ids=name)
def test_the_command_asks_for_the_kept_comparison(folder: Path) -> None:
    differs = differing(folder, planned(words(folder)))
    assert differs == COMMANDS[name(folder)]["differs"].split()
    assert set(differs) <= set(NOT_OPTIONS), "an option of the command does not give the kept value"


@pytest.mark.slow
@pytest.mark.parametrize("folder", KEPT, ids=name)
def test_the_command_leaves_a_bench_of_the_same_shape(folder: Path, tmp_path: Path) -> None:
    """With one seed, one training episode and one test: the same agents, columns and rows a budget."""
    kept = table(f"{name(folder)}/results.csv")
    small = ["--seeds", "0", "--workers", "1", "--out", str(tmp_path)]
    if "episodes" in kept[0]:
        small += ["--budgets", "1", "--evaluation-episodes", "1"]
    else:
        small += ["--preset", "smoke", "--networks", "1"]
    if "--after" in words(folder):
        small += ["--after-episodes", "1"]
    assert main(["bench", *words(folder), *small]) == 0
    (made,) = tmp_path.rglob("report/results.csv")
    new = table(str(made))
    assert fixed_columns(new) == fixed_columns(kept)
    assert list(dict.fromkeys(row["agent"] for row in new)) == list(
        dict.fromkeys(label_today(row["agent"]) for row in kept)
    )


def fixed_columns(rows: list[dict[str, str]]) -> list[str]:
    """The columns that every bench of the type has; those after them depend on its agents' measurements.

    Benches of regressors before 2026-11-28 also had CRPS, transforms and pooled weight samples.
    """
    gone = re.compile("crps|pooled_|transform_distance")
    names = [name for name in rows[0] if not gone.match(name)]
    last = "success_rate" if "success_rate" in names else "auroc_nll"
    return names[: names.index(last) + 1]
