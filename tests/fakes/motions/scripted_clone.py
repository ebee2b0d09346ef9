"""A clone that has learned nothing: it gives commands that are written down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from imagine_bench_motion.cloning import Clone
from imagine_bench_motion.skills import HOME_COMMAND, Command


class ScriptedClone(Clone):
    """Gives its commands one after the other, the last one again and again, and keeps its observations."""

    def __init__(self, commands: Sequence[Command] = (HOME_COMMAND,), **about: Any) -> None:
        self.about = {"observation": "proprio,objects", **about}
        self.commands = commands
        self.seen: list[dict[str, Any]] = []

    def begin(self, instruction: str) -> None:
        self.instruction = instruction
        self.due = list(self.commands)

    def act(self, observation: Mapping[str, Any]) -> Command:
        self.seen.append({name: part.copy() for name, part in observation.items()})
        return self.due.pop(0) if len(self.due) > 1 else self.due[0]
