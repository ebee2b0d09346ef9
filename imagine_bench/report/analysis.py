"""Which bench an analysis is of, and where its figures come from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from imagine_bench import registry
from imagine_bench.registry.machine import describe_environment
from imagine_bench.running.task_types import task_type
from imagine_bench.running.trained import require_control
from imagine_bench.store.bench_folder import newest_bench, require_either


def chosen(given: Path | None, root: Path, task: str | None) -> Path:
    """What was given, or else the newest bench of a task in which agents act, or of all such tasks.

    Raises:
        ImagineBenchError: Both are given, or there is no such bench.
    """
    require_either(given, task)
    if task is not None:
        task_type(task)  # knows every name
        require_control(task, f"Task {task!r}")
    return given or newest_bench(root, tuple(registry.tasks()) if task is None else (task,))


def provenance(protocol_hash: str) -> dict[str, object]:
    """Protocol, commit and command of a figure."""
    environment = describe_environment()
    return {"protocol_hash": protocol_hash, "commit": environment.get("commit"), "command": environment.get("command")}


def origin(facts: Mapping[str, object]) -> str:
    """Where the figures of a page come from: ``protocol hash 6bf1d791349c; commit c9d5ec664788.`` and so on."""
    return "; ".join(f"{name.replace('_', ' ')} {value}" for name, value in facts.items()) + "."
