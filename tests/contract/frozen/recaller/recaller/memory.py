"""What followed each macro-action in each state, as it was seen. A state is any text, such as the code of a frame."""

from __future__ import annotations

from typing import Any

import numpy as np

Followed = tuple[str, float, bool]
"""State that followed, reward, whether the episode terminated."""


class Memory:
    """``outcomes[state, action]`` holds every outcome that was seen, with repetitions."""

    def __init__(self) -> None:
        self.outcomes: dict[tuple[str, int], list[Followed]] = {}

    def add(self, state: str, action: int, followed: Followed) -> None:
        self.outcomes.setdefault((state, action), []).append(followed)

    def count(self, state: str, action: int) -> int:
        return len(self.outcomes.get((state, action), ()))

    def draw(self, state: str, action: int, rng: np.random.Generator) -> Followed:
        """One of the outcomes; nothing changes where none was seen."""
        seen = self.outcomes.get((state, action))
        return seen[int(rng.integers(len(seen)))] if seen else (state, 0.0, False)

    def states(self) -> list[str]:
        return list(dict.fromkeys(state for state, _ in self.outcomes))

    def rows(self) -> list[list[Any]]:
        """Every outcome as JSON has it."""
        return [[state, action, *each] for (state, action), seen in self.outcomes.items() for each in seen]

    @classmethod
    def of(cls, rows: list[list[Any]]) -> Memory:
        """Undo :meth:`rows`."""
        memory = cls()
        for state, action, after, reward, terminated in rows:
            memory.add(state, int(action), (after, float(reward), bool(terminated)))
        return memory
