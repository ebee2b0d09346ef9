"""The worlds of the registered tasks, for tests that would only repeat themselves on two tasks of one scene."""

from __future__ import annotations

from imagine_bench import registry

WORLDS = tuple({registry.task(name).encoder: name for name in reversed(registry.TASKS)}.values())
"""The first task of each world."""
