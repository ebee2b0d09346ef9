"""Every setting of ``factored`` and ``factored:given``, the same for every task and set of hyperparameters."""

from __future__ import annotations

from dataclasses import dataclass, field

from imagine_bench.agents.settings import (
    COUNT,
    INSIDE,
    POSITIVE,
    PROBABILITY,
    RATE,
    SWITCH,
    Hyperparameters,
    between,
    setting,
)


@dataclass(frozen=True, kw_only=True)
class DynamicsSettings:
    """The effect of an action on each factor; see :mod:`.dynamics`."""

    #: Whether each factor has a model of its own; otherwise the whole code is one factor (an ablation).
    factored: bool = setting(True, SWITCH)
    parents: int = setting(3, between(1, 10))  #: most factors that a factor's next value may depend on, itself included
    persistence: float = setting(0.5, INSIDE)  #: prior probability that an action leaves a factor alone
    parent_decay: float = setting(0.2, RATE)  #: multiplies the prior for each further parent
    #: Pseudo-count of each value in a Dirichlet prior (Heckerman et al. 1995).
    concentration: float = setting(0.03, POSITIVE)
    #: Unless the prior weighs so much, the next value counts as known: of chance there is always more to learn.
    least_unknown: float = setting(0.03, PROBABILITY)
    slip: float = setting(0.005, INSIDE)  #: probability with which a factor that is left alone is misread
    by_itself: float = setting(0.02, INSIDE)  #: prior probability that a factor which changes does so by itself
    alike: float = setting(0.5, INSIDE)  #: prior probability that an action fails as often wherever it changes a factor
    fails: float = setting(0.05, INSIDE)  #: how often that is, beforehand
    pseudo_fails: float = setting(100.0, POSITIVE)  #: how many tries of an action how often the others fail is worth


@dataclass(frozen=True, kw_only=True)
class OutcomeSettings:
    """Rewards and ends of episodes; see :mod:`.outcomes`."""

    #: Most values in a conjunction that may be a cause. The whole code may always be one and, unless this is below 2,
    #: the whole code less any one value.
    order: int = setting(3, between(0, 10))
    prior: float = setting(0.1, INSIDE)  #: prior probability that one value, or a pair, is a cause
    order_decay: float = setting(0.1, RATE)  #: multiplies it for each value beyond two
    choice_decay: float = setting(0.02, RATE)  #: multiplies it for one of an action and values before it
    pseudo_tests: float = setting(0.2, POSITIVE)  #: how many tests of one conjunction the prior is worth
    pseudo_conjunctions: float = setting(3.0, POSITIVE)  #: how many conjunctions of one order the prior is worth
    leak: float = setting(1e-3, INSIDE)  #: probability of an outcome without a cause
    #: Sightings of a transition that the prediction of its causes is worth.
    pseudo_seen: float = setting(0.2, POSITIVE)
    masked_weight: float = setting(0.1, PROBABILITY)  #: weight of a test in which some other cause decided
    sweeps: int = setting(25, COUNT)  #: steps of expectation maximisation
    #: Prior probability that a cause of an earlier task is one of the next; 0 forgets it.
    transfer_weight: float = setting(0.8, PROBABILITY)
    pseudo_causes: float = setting(2.0, POSITIVE)  #: how many tested causes of an earlier task that is worth


@dataclass(frozen=True, kw_only=True)
class PlanningSettings:
    """Planning and exploration; see :mod:`.planner`."""

    depth: int = setting(20, COUNT)  #: macro-actions that are planned ahead
    discount: float = setting(0.95, PROBABILITY)  #: of rewards, a macro-action
    branches: int = setting(8, COUNT)  #: most next codes of one action
    least_probability: float = setting(0.02, PROBABILITY)  #: less likely ones are not followed, but for the likeliest
    states: int = setting(400, between(1, 1_000_000))  #: most codes that one plan visits
    #: ``"r_max"`` values all that is unknown enough at the best reward seen, and is curious where that offers
    #: nothing. ``"curiosity"`` goes where most is unknown, ``"optimism"`` weighs the best reward seen by how much is
    #: unknown, ``"random"`` acts greedily but for random actions (the last three are ablations).
    exploration: str = setting("r_max", ("r_max", "curiosity", "optimism", "random"))
    novelty_discount: float = setting(0.95, PROBABILITY)  #: of novelty, a macro-action
    #: Novelty within reach below which the agent acts greedily.
    exploration_threshold: float = setting(0.01, PROBABILITY)
    r_max_threshold: float = setting(0.2, PROBABILITY)  #: more than this is unknown enough
    epsilon: float = setting(0.1, PROBABILITY)  #: probability of a random action where exploration is random


@dataclass(frozen=True, kw_only=True)
class FactoredSettings:
    """All settings of the agent ``factored:given``."""

    dynamics: DynamicsSettings = field(default_factory=DynamicsSettings)
    outcomes: OutcomeSettings = field(default_factory=OutcomeSettings)
    planning: PlanningSettings = field(default_factory=PlanningSettings)


HYPERPARAMETERS = Hyperparameters.everywhere(FactoredSettings())


@dataclass(frozen=True, kw_only=True)
class LearnedPerceptionSettings:
    """How an agent learns to see; see :class:`.perception.LearnedPerception`."""

    #: Most frames of its own that it remembers, 12 kB each; then perception stays as it is.
    frames: int = setting(1000, between(4, 100_000))
    #: Factors are found anew once so many times the frames of the last time were seen, and something had no known value
    growth: float = setting(1.1, between(1.0, 100.0))
    growth_if_known: float = setting(1.5, between(1.0, 100.0))  #: the same where everything had one


@dataclass(frozen=True, kw_only=True)
class LearnedSettings(FactoredSettings):
    """All settings of the agent ``factored``, whose perception is learned."""

    #: How much more likely, as a logarithm, a memory must make other episodes than none does; see ``memory``.
    memory_evidence: float = setting(10.0, POSITIVE)
    perception: LearnedPerceptionSettings = field(default_factory=LearnedPerceptionSettings)


LEARNED = Hyperparameters.everywhere(LearnedSettings())
