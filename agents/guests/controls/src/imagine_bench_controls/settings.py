"""Settings of the controls that are a DQN with something added, or that imagine with the rules."""

from __future__ import annotations

from dataclasses import dataclass, field

from imagine_bench.agents.dqn_settings import CONTROLLER_3, FAST_3, FAST_5, DQNSettings
from imagine_bench.agents.imagination.inert import UNFILTERED
from imagine_bench.agents.settings import PROBABILITY, ConfigGroup, Hyperparameters, Override, S, between, setting

_MANY = "BBF's replay ratio"
_SLOW = "a slowly updated target network, as BBF's"
PRIORITIES = frozenset({"memory.priority", "memory.priority_correction"})
"""Settings that agents without prioritised replay do without."""


@dataclass(frozen=True, kw_only=True)
class SwapSettings:
    """Parts swapped between transitions."""

    share: float = setting(0.5, PROBABILITY)  #: of each batch that is swapped where the outcome is known


@dataclass(frozen=True, kw_only=True)
class SwappingSettings(DQNSettings):
    """All settings of ``dqn_swaps``."""

    swaps: SwapSettings = field(default_factory=SwapSettings)


@dataclass(frozen=True, kw_only=True)
class ReuseSettings:
    """How often and how far back real experience is used."""

    steps: int = setting(3, between(1, 100))  #: macro-actions whose rewards a target adds up, n
    #: Updates after which the network begins anew; 0: never.
    reset_every: int = setting(4_000, between(0, 10_000_000))
    kept: float = setting(0.5, PROBABILITY)  #: share of the hidden layers' weights that a reset keeps


@dataclass(frozen=True, kw_only=True)
class EfficientSettings(DQNSettings):
    """All settings of ``dqn_efficient``."""

    reuse: ReuseSettings = field(default_factory=ReuseSettings)


def _hyperparameters(
    published: S, published_3: S, more: dict[str, Override], unused: frozenset[str] = frozenset()
) -> Hyperparameters[S]:
    def group(settings: S, fast: dict[str, Override]) -> ConfigGroup[S]:
        quick = {**fast, **more}
        return ConfigGroup(settings, {"minimal": quick, "fast": quick, "published": more}, unused)

    return Hyperparameters({"chapter_3": group(published_3, FAST_3), "chapter_5": group(published, FAST_5)})


SWAPPING = _hyperparameters(SwappingSettings(), SwappingSettings(controller=CONTROLLER_3), {}, PRIORITIES)
EFFICIENT = _hyperparameters(
    EfficientSettings(), EfficientSettings(controller=CONTROLLER_3),
    {
        "controller.updates_per_step": Override(8, _MANY),
        "controller.target_rate": Override(0.02, _SLOW),
    },
    PRIORITIES,
)  # fmt: skip

_OF_A_MODEL = (
    *(name for name in UNFILTERED.names() if name.startswith("model.")),
    "imagination.temperature",
    "imagination.predicts_with",
    "imagination.curiosity",
    "imagination.weight_samples",
    "imagination.reduction",
    "imagination.accumulates",
    "imagination.confidence_scale",
)
KNOWING = UNFILTERED.without(*UNFILTERED.has_no_effect, *_OF_A_MODEL)
"""Of agents that imagine with the rules in place of a learned model."""
