"""What a family of settings is: one chapter's values, and how each preset deviates from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .settings import Settings


@dataclass(frozen=True, slots=True)
class Deviation:
    """A value that is not the thesis', and why."""

    value: Any
    reason: str


@dataclass(frozen=True, slots=True)
class Family:
    """The settings of one chapter of the thesis.

    Attributes:
        thesis: The chapter's values.
        presets: What each preset changes of them, by dotted name.
    """

    thesis: Settings
    presets: dict[str, dict[str, Deviation]]
