"""Settings of DreamerV3 from sheeprl, by the names of the paper where it has one."""

from __future__ import annotations

from dataclasses import dataclass, field

from imagine_bench.agents.settings import (
    COUNT,
    NOT_NEGATIVE,
    POSITIVE,
    PROBABILITY,
    ROWS,
    Hyperparameters,
    Override,
    between,
    setting,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class DreamerModelSettings:
    """Sizes of the world model; actor and critic have as many units."""

    units: int = setting(256, COUNT)  #: of hidden layers
    layers: int = setting(1, between(1, 8))  #: hidden layers of each head, of the actor and of the critic
    recurrent: int = setting(256, COUNT)  #: units of the recurrent state
    channels: int = setting(24, between(1, 128))  #: of the first convolution; each further one has twice as many
    classes: int = setting(32, between(2, 64))  #: values of a categorical latent
    categoricals: int = setting(32, between(1, 64))  #: categorical latents


@dataclass(frozen=True, kw_only=True)
class DreamerSettings:
    """All settings of ``dreamer_v3``; by default the library's own of its smallest model, XS."""

    model: DreamerModelSettings = field(default_factory=DreamerModelSettings)
    replay_ratio: float = setting(1.0, between(0.0, 64.0))  #: gradient updates a macro-action
    learning_starts: int = setting(1024, ROWS)  #: macro-actions before the first update, all of them random
    batch_size: int = setting(16, COUNT)  #: sequences
    sequence_length: int = setting(64, between(2, 1024))  #: macro-actions
    horizon: int = setting(15, between(1, 256))  #: imagined macro-actions
    discount: float = setting(0.997, PROBABILITY)  #: discount of rewards, a macro-action
    return_decay: float = setting(0.95, PROBABILITY)  #: lambda of the returns
    entropy: float = setting(3e-4, NOT_NEGATIVE)  #: weight of the policy's entropy
    model_learning_rate: float = setting(1e-4, POSITIVE)  #: step size of the world model's optimiser
    actor_learning_rate: float = setting(3e-5, POSITIVE)  #: step size of the actor's optimiser
    critic_learning_rate: float = setting(3e-5, POSITIVE)  #: step size of the critic's optimiser
    buffer_size: int = setting(100_000, ROWS)  #: macro-actions remembered


_FAST = {
    "model.units": Override(128, "a world of some hundred macrostates; two cores"),
    "model.recurrent": Override(128, "as units"),
    "model.channels": Override(8, "as units; an update is 4 times as fast"),
    "model.classes": Override(8, "as units"),
    "model.categoricals": Override(8, "as units"),
    "learning_starts": Override(100, "episodes have 3 macro-actions, and budgets are some hundred episodes"),
    "sequence_length": Override(10, "an episode is over after 10 macro-actions (as danijar/dreamer#47 advises)"),
    "horizon": Override(5, "the longest of shortest plans is 5 macro-actions"),
    "discount": Override(0.95, "as our agents"),
}
_MINIMAL = {
    **_FAST,
    "model.units": Override(16, "only shows that all parts work"),
    "model.recurrent": Override(16, "only shows that all parts work"),
    "model.channels": Override(2, "only shows that all parts work"),
    "learning_starts": Override(4, "only shows that all parts work"),
    "replay_ratio": Override(0.5, "only shows that all parts work"),
}
HYPERPARAMETERS = Hyperparameters.everywhere(DreamerSettings(), fast=_FAST, minimal=_MINIMAL)
"""``published`` are the library's own."""
