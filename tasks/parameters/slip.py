"""Slip: the fingers open too early, so that a macro-action leaves all as it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from imagine_bench.interfaces import Outcome


def slipping(outcomes: Sequence[Outcome], unmoved: Outcome, probability: float) -> tuple[Outcome, ...]:
    """The outcomes of a macro-action that with some probability does nothing; ``unmoved`` is what that gives."""
    kept = (replace(each, probability=(1.0 - probability) * each.probability) for each in outcomes)
    return (*kept, replace(unmoved, probability=probability))
