"""Settings of the agents from Stable-Baselines3: its own names, the same for every task, family and preset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from imagine_bench.errors import require_known

from ..presets import FAMILIES, checked_values, flatten
from ..ranges import POSITIVE, PROBABILITY, require_ranges


@dataclass(frozen=True, kw_only=True)
class LibrarySettings:
    """Keywords of ``stable_baselines3.DQN`` and ``sb3_contrib.QRDQN`` that differ from the library's own.

    Attributes:
        learning_rate: Of Adam.
        buffer_size: Transitions of the replay buffer.
        learning_starts: Macro-actions before the first update, all of them random.
        batch_size: Transitions an update.
        gamma: Discount a macro-action, the same as our agents'.
        train_freq: Macro-actions between updates.
        gradient_steps: Updates then.
        target_update_interval: Macro-actions between copies of the network to its target.
        exploration_steps: Macro-actions over which the probability of a random one falls linearly.
        exploration_final_eps: Where it ends.
    """

    learning_rate: float = 1e-3
    buffer_size: int = 50_000
    learning_starts: int = 100
    batch_size: int = 32
    gamma: float = 0.95
    train_freq: int = 1
    gradient_steps: int = 4
    target_update_interval: int = 250
    exploration_steps: int = 600
    exploration_final_eps: float = 0.02


@dataclass(frozen=True, kw_only=True)
class PeerSettings:
    """All settings of a peer."""

    sb3: LibrarySettings = field(default_factory=LibrarySettings)


_RANGES = {
    "sb3.learning_rate": POSITIVE,
    "sb3.gamma": PROBABILITY,
    "sb3.exploration_final_eps": PROBABILITY,
}
"""Ranges of the numbers; every other is a count of at least 1."""


def names() -> frozenset[str]:
    """The dotted names of all settings."""
    return frozenset(flatten(PeerSettings()))


def resolve(preset: str, overrides: Mapping[str, Any], family: str) -> PeerSettings:
    """The settings, with single ones replaced; a preset and a family change nothing.

    Args:
        preset: A preset of the family.
        overrides: Values by dotted name, such as ``{"sb3.learning_rate": 1e-4}``.
        family: A name of :data:`.presets.FAMILIES`.

    Raises:
        UnknownNameError: No such family, preset or setting; the message lists what exists.
        InvalidValueError: A value of the wrong type or out of its range.
    """
    require_known("preset", preset, FAMILIES[require_known("settings family", family, FAMILIES)].presets)
    settings: PeerSettings = checked_values(PeerSettings(), overrides)
    require_ranges(flatten(settings), _RANGES)
    return settings
