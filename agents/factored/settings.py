"""Every setting of the agent ``factored``. They are the same for every task and set of hyperparameters."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..settings import COUNT, INSIDE, NOT_NEGATIVE, POSITIVE, PROBABILITY, RATE, SWITCH, Hyperparameters, setting


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

    factored: bool = setting(True, SWITCH)
    parents: int = setting(3, COUNT)
    persistence: float = setting(0.5, INSIDE)
    parent_factor: float = setting(0.2, RATE)
    concentration: float = setting(0.03, POSITIVE)
    slip: float = setting(0.005, INSIDE)


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

    order: int = setting(3, NOT_NEGATIVE)
    prior: float = setting(0.1, INSIDE)
    order_factor: float = setting(0.3, RATE)
    pseudo_tests: float = setting(0.2, POSITIVE)
    pseudo_conjunctions: float = setting(3.0, POSITIVE)
    leak: float = setting(1e-3, INSIDE)
    masked_weight: float = setting(0.1, PROBABILITY)
    sweeps: int = setting(25, COUNT)
    carried: float = setting(0.5, PROBABILITY)


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

    depth: int = setting(20, COUNT)
    discount: float = setting(0.95, PROBABILITY)
    branches: int = setting(8, COUNT)
    least_probability: float = setting(0.02, PROBABILITY)
    states: int = setting(3000, COUNT)
    exploration: str = setting("curiosity", ("curiosity", "optimism", "random"))
    novelty_discount: float = setting(0.95, PROBABILITY)
    boredom: float = setting(0.01, PROBABILITY)
    epsilon: float = setting(0.1, PROBABILITY)


@dataclass(frozen=True, kw_only=True)
class ImagineSettings:
    """All settings of the agent."""

    dynamics: DynamicsSettings = field(default_factory=DynamicsSettings)
    outcomes: OutcomeSettings = field(default_factory=OutcomeSettings)
    planning: PlanningSettings = field(default_factory=PlanningSettings)


HYPERPARAMETERS = Hyperparameters.everywhere(ImagineSettings())
