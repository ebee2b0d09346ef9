"""Every setting of the agent ``factored``. They are the same for every task and set of hyperparameters."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..settings import COUNT, INSIDE, NOT_NEGATIVE, POSITIVE, PROBABILITY, RATE, SWITCH, Hyperparameters, setting


@dataclass(frozen=True, kw_only=True)
class DynamicsSettings:
    """What an action does to each factor; see :mod:`.dynamics`.

    Attributes:
        factored: Whether each factor has a model of its own; otherwise the whole code is one factor (an ablation).
        parents: Most factors that one factor's next value may depend on, itself included.
        persistence: Prior probability that an action leaves a factor alone.
        parent_decay: Multiplies the prior for each further parent.
        concentration: Pseudo-count of each value in a Dirichlet prior (Heckerman et al. 1995).
        slip: Probability with which a factor that is left alone is misread.
    """

    factored: bool = setting(True, SWITCH)
    parents: int = setting(3, COUNT)
    persistence: float = setting(0.5, INSIDE)
    parent_decay: float = setting(0.2, RATE)
    concentration: float = setting(0.03, POSITIVE)
    slip: float = setting(0.005, INSIDE)


@dataclass(frozen=True, kw_only=True)
class OutcomeSettings:
    """What is rewarded and what ends an episode; see :mod:`.outcomes`.

    Attributes:
        order: Most values in a conjunction that may be a cause; the whole code may always be one.
        prior: Prior probability that one value, or a pair, is a cause.
        order_decay: Multiplies it for each value beyond two.
        pseudo_tests: How many tests of one conjunction the prior is worth.
        pseudo_conjunctions: How many conjunctions of one order the prior is worth.
        leak: Probability of an outcome without a cause.
        masked_weight: Weight of a test in which some other cause decided.
        sweeps: Steps of expectation maximisation.
        transfer_weight: Prior probability that a cause of an earlier task is one of the next; 0 forgets it.
    """

    order: int = setting(3, NOT_NEGATIVE)
    prior: float = setting(0.1, INSIDE)
    order_decay: float = setting(0.3, RATE)
    pseudo_tests: float = setting(0.2, POSITIVE)
    pseudo_conjunctions: float = setting(3.0, POSITIVE)
    leak: float = setting(1e-3, INSIDE)
    masked_weight: float = setting(0.1, PROBABILITY)
    sweeps: int = setting(25, COUNT)
    transfer_weight: float = setting(0.5, PROBABILITY)


@dataclass(frozen=True, kw_only=True)
class PlanningSettings:
    """Planning and exploration; see :mod:`.planner`.

    Attributes:
        depth: Macro-actions that are planned ahead.
        discount: Of rewards, a macro-action.
        branches: Most next codes of one action.
        least_probability: Less likely ones are not followed, but for the likeliest.
        states: Most codes that one plan visits.
        exploration: ``"curiosity"`` goes where most is unknown, ``"optimism"`` values the unknown at the best
            reward seen, ``"random"`` acts greedily but for random actions (the last two are ablations).
        novelty_discount: Of what is unknown, a macro-action.
        exploration_threshold: Novelty within reach below which the agent acts greedily.
        epsilon: Probability of a random action where exploration is random.
    """

    depth: int = setting(20, COUNT)
    discount: float = setting(0.95, PROBABILITY)
    branches: int = setting(8, COUNT)
    least_probability: float = setting(0.02, PROBABILITY)
    states: int = setting(3000, COUNT)
    exploration: str = setting("curiosity", ("curiosity", "optimism", "random"))
    novelty_discount: float = setting(0.95, PROBABILITY)
    exploration_threshold: float = setting(0.01, PROBABILITY)
    epsilon: float = setting(0.1, PROBABILITY)


@dataclass(frozen=True, kw_only=True)
class FactoredSettings:
    """All settings of the agent."""

    dynamics: DynamicsSettings = field(default_factory=DynamicsSettings)
    outcomes: OutcomeSettings = field(default_factory=OutcomeSettings)
    planning: PlanningSettings = field(default_factory=PlanningSettings)


HYPERPARAMETERS = Hyperparameters.everywhere(FactoredSettings())
