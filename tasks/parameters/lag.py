"""Lag: what is observed is some macro-actions old; the first observations of an episode repeat the start."""

from __future__ import annotations

import copy
from typing import Generic, TypeVar

_Observed = TypeVar("_Observed")


class Lag(Generic[_Observed]):
    """The observations that are still under way; ``kept`` is all its state.

    Args:
        macro_actions: Age of what is delivered.
    """

    def __init__(self, macro_actions: int) -> None:
        self.macro_actions = macro_actions
        self.kept: tuple[_Observed, ...] = ()

    def deliver(self, observation: _Observed) -> _Observed:
        """Take in the observation of this moment, once each, and return the one that is due, the caller's own."""
        if not self.macro_actions:
            return observation
        self.kept = (*self.kept, observation)[-1 - self.macro_actions :]
        return copy.deepcopy(self.kept[0])
