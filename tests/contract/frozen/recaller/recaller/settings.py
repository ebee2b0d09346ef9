"""The agent's settings by dotted names, as imagine_bench reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from imagine_bench.errors import InvalidValueError, require_known


@dataclass(frozen=True, kw_only=True)
class Learning:
    """How values are learned."""

    step_size: float = 0.5
    discount: float = 0.95
    epsilon: float = 0.2


@dataclass(frozen=True, kw_only=True)
class Recalling:
    """How much is imagined."""

    rollouts: int = 2
    depth: int = 3


@dataclass(frozen=True, kw_only=True)
class RecallerSettings:
    """All settings."""

    learning: Learning = field(default_factory=Learning)
    recalling: Recalling = field(default_factory=Recalling)


def names() -> frozenset[str]:
    """The dotted names of all settings."""
    return frozenset(f"{part}.{name}" for part, values in asdict(RecallerSettings()).items() for name in values)


def resolve(hyperparameters: str, overrides: Mapping[str, Any], group: str) -> RecallerSettings:
    """The settings with single ones replaced; every set of hyper-parameters is the same here."""
    parts: dict[str, dict[str, Any]] = {"learning": {}, "recalling": {}}
    for dotted, value in overrides.items():
        require_known("setting", dotted, names())
        if isinstance(value, bool) or not isinstance(value, int | float) or value < 0:
            raise InvalidValueError(f"Setting {dotted} is {value!r}; give a number of at least 0.")
        part, _, name = dotted.partition(".")
        parts[part][name] = value
    return RecallerSettings(learning=Learning(**parts["learning"]), recalling=Recalling(**parts["recalling"]))
