"""Lag: what is observed is some macro-actions old; the first observations of an episode repeat the start."""

from __future__ import annotations

import copy
from typing import Any


class Lag:
    """The observations that are still under way; ``kept`` is all its state.

    Args:
        macro_actions: Age of what is delivered.
    """

    def __init__(self, macro_actions: int) -> None:
        self.macro_actions = macro_actions
        self.kept = tuple[Any, ...]()

    def deliver(self, observation: Any) -> Any:
        """Take in the observation of this moment, once each, and return the one that is due, the caller's own."""
        if not self.macro_actions:
            return observation
        self.kept = (*self.kept, observation)[-1 - self.macro_actions :]
        return copy.deepcopy(self.kept[0])
