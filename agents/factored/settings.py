"""Every setting of the agent ``factored``. They are the same for every task, family and preset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from imagine_bench.errors import require_known

from ..presets import FAMILIES, checked_values, flatten
from ..ranges import COUNT, INSIDE, NOT_NEGATIVE, POSITIVE, PROBABILITY, RATE, require_ranges

EXPLORATIONS = ("curiosity", "optimism", "random")


@dataclass(frozen=True, kw_only=True)
class DynamicsSettings:
    """What an action does to each part; see :mod:`.dynamics`.

    Attributes:
        factored: Whether each part has a model of its own; otherwise the whole code is one part (an ablation).
        parents: Most parts that one part's next value may depend on, itself included.
        persistence: Prior probability that an action leaves a part alone.
        parent_factor: Factor on the prior for each parent more.
        concentration: Pseudo-count of each value in a Dirichlet prior (Heckerman et al. 1995).
        slip: Probability with which a part that is left alone is read otherwise all the same.
    """

    factored: bool = True
    parents: int = 3
    persistence: float = 0.5
    parent_factor: float = 0.2
    concentration: float = 0.03
    slip: float = 0.005


@dataclass(frozen=True, kw_only=True)
class OutcomeSettings:
    """What is rewarded and what ends an episode; see :mod:`.outcomes`.

    Attributes:
        order: Most values in a conjunction that may be a cause; the whole code may always be one.
        prior: Prior probability that one value, or a pair, is a cause.
        order_factor: Factor on it for each value more than two.
        pseudo_tests: How many tests of one conjunction the prior is worth.
        pseudo_conjunctions: How many conjunctions of a kind the prior is worth.
        leak: Probability of an outcome without a cause.
        masked_weight: Weight of a test in which some other cause decided.
        sweeps: Steps of expectation maximisation.
        carried: How much a cause of an earlier task is believed to be one of the next, untested; 0 forgets it.
    """

    order: int = 3
    prior: float = 0.1
    order_factor: float = 0.3
    pseudo_tests: float = 0.2
    pseudo_conjunctions: float = 3.0
    leak: float = 1e-3
    masked_weight: float = 0.1
    sweeps: int = 25
    carried: float = 0.5


@dataclass(frozen=True, kw_only=True)
class PlanningSettings:
    """Imagining futures and choosing among them; see :mod:`.planner`.

    Attributes:
        depth: Macro-actions that are imagined ahead.
        discount: Of rewards, a macro-action.
        branches: Most next codes of one action.
        least_probability: Less likely ones are not imagined, but for the likeliest.
        states: Most codes that one plan visits.
        exploration: ``"curiosity"`` goes where most is unknown, ``"optimism"`` believes that the unknown is worth the
            best reward seen, ``"random"`` acts greedily but for random actions (the last two are ablations).
        novelty_discount: Of what is unknown, a macro-action.
        boredom: Where less than this is unknown within reach, curiosity rests and the agent acts greedily.
        epsilon: Probability of a random action where exploration is random.
    """

    depth: int = 20
    discount: float = 0.95
    branches: int = 8
    least_probability: float = 0.02
    states: int = 3000
    exploration: str = "curiosity"
    novelty_discount: float = 0.95
    boredom: float = 0.01
    epsilon: float = 0.1


@dataclass(frozen=True, kw_only=True)
class ImagineSettings:
    """All settings of the agent."""

    dynamics: DynamicsSettings = field(default_factory=DynamicsSettings)
    outcomes: OutcomeSettings = field(default_factory=OutcomeSettings)
    planning: PlanningSettings = field(default_factory=PlanningSettings)


_RANGES = {
    "dynamics.parents": COUNT,
    "dynamics.parent_factor": RATE,
    "dynamics.persistence": INSIDE,
    "dynamics.concentration": POSITIVE,
    "dynamics.slip": INSIDE,
    "outcomes.order": NOT_NEGATIVE,
    "outcomes.prior": INSIDE,
    "outcomes.pseudo_tests": POSITIVE,
    "outcomes.pseudo_conjunctions": POSITIVE,
    "outcomes.leak": INSIDE,
    "outcomes.order_factor": RATE,
    "outcomes.sweeps": COUNT,
    "planning.depth": COUNT,
    "planning.branches": COUNT,
    "planning.states": COUNT,
}
"""Ranges of the numbers; every other is a share."""


def names() -> frozenset[str]:
    """The dotted names of all settings."""
    return frozenset(flatten(ImagineSettings()))


def resolve(preset: str, overrides: Mapping[str, Any], family: str) -> ImagineSettings:
    """The settings, with single ones replaced; a preset and a family change nothing.

    Args:
        preset: A preset of the family.
        overrides: Values by dotted name, such as ``{"planning.exploration": "random"}``.
        family: A name of :data:`..presets.FAMILIES`.

    Raises:
        UnknownNameError: No such family, preset, setting or exploration; the message lists what exists.
        InvalidValueError: A value of the wrong type or out of its range.
    """
    require_known("preset", preset, FAMILIES[require_known("settings family", family, FAMILIES)].presets)
    settings: ImagineSettings = checked_values(ImagineSettings(), overrides)
    require_known("exploration", settings.planning.exploration, EXPLORATIONS)
    require_ranges(flatten(settings), _RANGES, otherwise=PROBABILITY)
    return settings
