"""Every setting of the count table: discount and exploration, by the names and values of the DQN's."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..dqn_settings import FAST_3, FAST_5, GreedySettings
from ..settings import ConfigGroup, Hyperparameters, Override


@dataclass(frozen=True, kw_only=True)
class CountTableSettings:
    """All settings of the agent; where exploration is directed, the epsilons do nothing."""

    controller: GreedySettings = field(default_factory=GreedySettings)


def _group(fast: dict[str, Override]) -> ConfigGroup[CountTableSettings]:
    own = {name: value for name, value in fast.items() if name == "controller.epsilon_decay"}
    return ConfigGroup(CountTableSettings(), {"minimal": own, "fast": own, "published": {}})


HYPERPARAMETERS = Hyperparameters({"chapter_3": _group(FAST_3), "chapter_5": _group(FAST_5)})
