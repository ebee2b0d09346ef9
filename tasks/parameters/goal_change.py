"""Goal change: after a macro-action that ends nothing, the human may want something else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from imagine_bench.interfaces import Outcome


def changing_goal(
    outcomes: Sequence[Outcome], elsewhere: Callable[[Outcome], Sequence[Outcome]], probability: float
) -> tuple[Outcome, ...]:
    """Outcomes after each of which the human, with some probability, says something else; equal ones are one.

    Args:
        outcomes: Those of a macro-action of a human who keeps to what they say.
        elsewhere: What an outcome becomes where the human says something else instead, each equally likely.
        probability: That the human does so, in (0, 1].
    """
    chances: dict[Outcome, float] = {}
    for outcome in outcomes:
        others = () if outcome.terminated else tuple(elsewhere(outcome))
        share = probability if others else 0.0
        for each, chance in ((outcome, 1.0 - share), *((other, share / len(others)) for other in others)):
            key = replace(each, probability=1.0)
            chances[key] = chances.get(key, 0.0) + outcome.probability * chance
    return tuple(replace(each, probability=chance) for each, chance in chances.items() if chance)
