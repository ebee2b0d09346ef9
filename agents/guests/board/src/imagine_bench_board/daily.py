"""A world a day: an arrow puzzle that its date draws, with exact facts, on which hardly anybody has trained."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.rules import RuleFacts
from imagine_bench.values import Setting

from . import rounds

_CUBES = (3, 4)
"""More are drawn slowly: each draw enumerates its world."""
_GOALS = ("pointed", "toward_agent", "clockwise", "all")
_FORBIDS = ("none", "neighbours", "equal", "agent")
_COUPLINGS = ("none", "neighbour")
_CHANCES = (0.0, 0.0, 0.05, 0.1, 0.2)
"""Values of slip and of a changing goal."""
_ATTEMPTS = 1000
_EASIEST = 0.15
"""Chance level above which a world is too easy to tell agents apart."""
_WORST_OPTIMUM = 0.9


@dataclass(frozen=True, kw_only=True)
class DailyWorld:
    """The world of a day."""

    day: str
    task: str  #: The world in one line
    digest: str  #: SHA-256 of the day, the world and the secret, which may be published before
    facts: RuleFacts  #: Exact

    def __str__(self) -> str:
        facts = self.facts
        return (
            f"{self.day}: {self.task}\n"
            f"chance {facts.chance_level:.1%}, optimum {facts.optimum:.1%}, optimal return {facts.optimal_return:.2f}\n"
            f"SHA-256 of 'day:world:secret': {self.digest}"
        )


def world_of_day(day: str | None = None, secret: str = "") -> DailyWorld:
    """Draw the world of a day; the same day and secret give the same world.

    Worlds that chance solves too often, or that even an optimal player often loses, are drawn again.

    Raises:
        InvalidValueError: It is no day.
    """
    date = rounds.today() if day is None else rounds.day_of(day)
    root = hashlib.sha256(f"world of the day:{date}:{secret}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(root))
    for _ in range(_ATTEMPTS):
        try:
            spec = registry.task(_drawn(rng))
        except InvalidValueError:  # a goal that the rules never allow
            continue
        facts = spec.facts()
        if facts.chance_level <= _EASIEST and facts.optimum >= _WORST_OPTIMUM:
            digest = hashlib.sha256(f"{date}:{spec.id}:{secret}".encode()).hexdigest()
            return DailyWorld(day=str(date), task=spec.id, digest=digest, facts=facts)
    raise InvalidValueError(f"No world of {date} was found in {_ATTEMPTS:,} draws; give another day.")


def _drawn(rng: np.random.Generator) -> str:
    """A world in one line; the order of its macro-actions is one of 2**32 draws."""
    options: dict[str, Setting] = {
        "cubes": int(rng.choice(_CUBES)),
        "goal": str(rng.choice(_GOALS)),
        "forbid": str(rng.choice(_FORBIDS)),
        "coupling": str(rng.choice(_COUPLINGS)),
        "shuffle": int(rng.integers(2**32)),
        "slip": float(rng.choice(_CHANCES)),
        "goal_change": float(rng.choice(_CHANCES)),
    }
    return f"arrows:{','.join(f'{name}={value}' for name, value in options.items())}"
