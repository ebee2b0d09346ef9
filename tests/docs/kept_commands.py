"""The command that makes each kept bench again, ``docs/results/commands.csv``, and how its protocol differs today.

``python tests/docs/kept_commands.py`` writes the file anew from the kept protocols.
"""

from __future__ import annotations

import csv
import json
import shlex
from pathlib import Path
from typing import Any, NamedTuple

from imagine_bench.cli import parsed
from imagine_bench.cli.benches import Bench
from imagine_bench.protocols.control import Protocol, protocol
from imagine_bench.protocols.data import ProtocolData, digest
from imagine_bench.registry import TASKS
from imagine_bench.running.bench import plan
from imagine_bench.running.control import resolved_settings
from imagine_bench.running.task_types import read_protocol

RESULTS = Path(__file__).parents[2] / "docs" / "results"
COMMANDS = RESULTS / "commands.csv"
FOLDERS = sorted(path.parent for path in RESULTS.rglob("bench.json") if path.parent.name != "report")
NOT_OPTIONS = ("encoder", "codes", "sampled_futures", "settings_digest", "agent_names", "dataset")
"""Fields of a protocol that no option sets: what they were is compared, and a difference is named in the file."""


class Command(NamedTuple):
    """A row of the file."""

    folder: str  #: below ``docs/results``
    command: str  #: makes the bench again
    differs: str  #: fields of the protocol that today's command gives another value, separated by spaces


def read() -> dict[str, Command]:
    """The rows of the file, by folder."""
    with COMMANDS.open(newline="") as file:
        return {row["folder"]: Command(**row) for row in csv.DictReader(file)}


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
    """The fields of a kept protocol, in today's names, that ``today`` gives another value."""
    kept = kept_values(folder)
    now = _values(today)
    if isinstance(today, Protocol):
        written = read_protocol(folder).written_name
        now["settings_digest"] = digest({written(agent): value for agent, value in resolved_settings(today).items()})
    encoders = ("encoder", "codes")
    return sorted(name for name in kept if name not in encoders and kept[name] != now.get(name))


def command(folder: Path) -> list[str]:
    """The words of a command that makes a kept bench again, after ``imagine-bench bench``."""
    kept = kept_values(folder)
    words = [kept["task"]]
    if kept["preset"] != "quick":
        words += ["--preset", kept["preset"]]
    for option in ("overrides", "physics"):
        if pairs := kept.get(option):
            words += ["--set" if option == "overrides" else "--physics"]
            words += [f"{name}={value if isinstance(value, str) else json.dumps(value)}" for name, value in pairs]
    words += [
        word
        for path in folder.glob("*.safetensors")
        for word in ("--encoder", str(path.relative_to(RESULTS.parents[1])))
    ]
    usual = _values(planned([*words, "--agents", *kept["agents"]]))
    for name, value in kept.items():
        if name in (*NOT_OPTIONS, "task", "preset", "overrides", "physics") or value == usual.get(name):
            continue
        texts = value if isinstance(value, list) else [value]
        words += [f"--{name.replace('_', '-')}", *(str(text) for text in texts)]
    if kept["agents"] == usual.get("agents"):
        words += ["--agents", *kept["agents"]]
    return words


def kept_values(folder: Path) -> dict[str, Any]:
    """The fields that a kept protocol has (an older one lacks the later fields), its agents by today's labels."""
    values = _values(read_protocol(folder))
    return {name: values[name] for name in json.loads((folder / "bench.json").read_text())["protocol"]}


def _values(one: ProtocolData) -> dict[str, Any]:
    """The fields of a protocol as JSON has them, its agents by today's labels."""
    return {**one.as_dict(), "agents": list(one.agents)}


def main() -> None:
    """Write the file anew."""
    rows = []
    for folder in FOLDERS:
        words = command(folder)
        differs = " ".join(differing(folder, planned(words)))
        rows.append(
            Command(folder.relative_to(RESULTS).as_posix(), shlex.join(["imagine-bench", "bench", *words]), differs)
        )
    with COMMANDS.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(Command._fields)
        table.writerows(rows)


if __name__ == "__main__":
    main()
