"""Settings of the tabular agents: discount and exploration by the names and values of the DQN's, and the updates."""

from __future__ import annotations

from dataclasses import dataclass, field

from imagine_bench.agents.dqn_settings import FAST_3, FAST_5, GreedySettings
from imagine_bench.agents.settings import POSITIVE, RATE, UPDATES, ConfigGroup, Hyperparameters, Override, S, setting
from imagine_bench_factored.settings import LearnedPerceptionSettings


@dataclass(frozen=True, kw_only=True)
class CountTableSettings:
    """All settings of the count tables; where exploration is directed, the epsilons do nothing."""

    controller: GreedySettings = field(default_factory=GreedySettings)


@dataclass(frozen=True, kw_only=True)
class OwnCountTableSettings(CountTableSettings):
    """All settings of the count table that learns to see."""

    perception: LearnedPerceptionSettings = field(default_factory=LearnedPerceptionSettings)


@dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """How action values in a table are updated; the thesis gives no numbers, these are Sutton & Barto's (8.1).

    On three tuning seeds 0.1 to 0.5 showed no clear difference; 1 was better for Dyna-Q and worse for Q-learning.
    """

    step_size: float = setting(0.1, RATE)  #: alpha, the share of each error that is corrected
    planning_steps: int = setting(50, UPDATES)  #: updates by the model a real step; 0 is Q-learning


@dataclass(frozen=True, kw_only=True)
class DynaQSettings(CountTableSettings):
    """All settings of Q-learning and Dyna-Q."""

    table: UpdateSettings = field(default_factory=UpdateSettings)


@dataclass(frozen=True, kw_only=True)
class PriorSettings:
    """The prior of posterior sampling for a pair of state and action."""

    #: How many counts the prior weighs; 0.01 to 0.3 were tried on two tuning seeds (1000, 1001), no clear winner.
    concentration: float = setting(0.3, POSITIVE)


@dataclass(frozen=True, kw_only=True)
class PosteriorSamplingSettings(CountTableSettings):
    """All settings of posterior sampling; the epsilons do nothing."""

    prior: PriorSettings = field(default_factory=PriorSettings)


def _hyperparameters(published: S, *unused: str) -> Hyperparameters[S]:
    def group(fast: dict[str, Override]) -> ConfigGroup[S]:
        own = {name: value for name, value in fast.items() if name == "controller.epsilon_decay"}
        return ConfigGroup(published, {"minimal": own, "fast": own, "published": {}}, frozenset(unused))

    return Hyperparameters({"chapter_3": group(FAST_3), "chapter_5": group(FAST_5)})


_EPSILONS = tuple(f"controller.epsilon_{name}" for name in ("min", "max", "decay"))

HYPERPARAMETERS = _hyperparameters(CountTableSettings())
DIRECTED = HYPERPARAMETERS.without(*_EPSILONS)
OWN = _hyperparameters(OwnCountTableSettings()).without(*_EPSILONS)
POSTERIOR_SAMPLING = _hyperparameters(PosteriorSamplingSettings()).without(*_EPSILONS)
DYNA_Q = _hyperparameters(DynaQSettings())
Q_LEARNING = _hyperparameters(DynaQSettings(table=UpdateSettings(planning_steps=0)), "table.planning_steps")
"""No override makes it plan, so that both can be compared in one bench."""
