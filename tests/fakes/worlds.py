"""The worlds of the registered tasks, for tests that would only repeat themselves on two tasks of one scene."""

from __future__ import annotations

from imagine_bench import registry

_MEASURED = [task for task in map(registry.task, registry.TASKS) if task.targets is not None]
WORLDS = tuple(task.id for i, task in enumerate(_MEASURED) if task.encoder not in [e.encoder for e in _MEASURED[:i]])
"""The first task of each scene."""
