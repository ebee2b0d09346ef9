"""Settings of the agents from Stable-Baselines3: its own names, the same for every task and set of hyperparameters.

Those that imagine have a world model too, with the settings of the suite's own agents that imagine.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from imagine_bench.agents.imagination.settings import HYPERPARAMETERS as IMAGINATION
from imagine_bench.agents.imagination.settings import Settings
from imagine_bench.agents.settings import (
    COUNT,
    NOT_NEGATIVE,
    POSITIVE,
    PROBABILITY,
    ROWS,
    ConfigGroup,
    Hyperparameters,
    between,
    setting,
)


@dataclass(frozen=True, kw_only=True)
class SB3Settings:
    """Keywords of ``stable_baselines3.DQN`` and ``sb3_contrib.QRDQN`` that differ from the library's own."""

    learning_rate: float = setting(1e-3, POSITIVE)  #: step size of the optimiser
    buffer_size: int = setting(50_000, ROWS)  #: transitions of the replay buffer
    learning_starts: int = setting(100, ROWS)  #: macro-actions before the first update, all of them random
    batch_size: int = setting(64, COUNT)  #: transitions an update
    gamma: float = setting(0.95, PROBABILITY)  #: discount a macro-action, the same as our agents'
    train_freq: int = setting(1, COUNT)  #: macro-actions between updates
    gradient_steps: int = setting(8, COUNT)  #: updates then
    target_update_interval: int = setting(50, ROWS)  #: macro-actions between copies of the network to its target
    #: Macro-actions over which the probability of a random one falls linearly.
    exploration_steps: int = setting(600, ROWS)
    exploration_final_eps: float = setting(0.02, PROBABILITY)  #: where it ends


@dataclass(frozen=True, kw_only=True)
class QuantileSettings(SB3Settings):
    """Those of ``sb3_contrib.QRDQN``, whose network predicts quantiles of the return."""

    #: Quantiles for each macro-action. The library has 200, its authors 10 to 170 where they tuned it for small tasks.
    n_quantiles: int = setting(25, between(2, 1000))


@dataclass(frozen=True, kw_only=True)
class PPOSettings:
    """Keywords of ``stable_baselines3.PPO`` that differ from the library's own, chosen on seeds 1001 and 1002."""

    learning_rate: float = setting(3e-3, POSITIVE)  #: step size of the optimiser
    n_steps: int = setting(64, between(2, 10_000))  #: macro-actions between updates
    batch_size: int = setting(64, between(2, 10_000))  #: transitions an update
    n_epochs: int = setting(10, COUNT)  #: how often each of them is learned from
    gamma: float = setting(0.95, PROBABILITY)  #: discount a macro-action, the same as our agents'
    ent_coef: float = setting(0.01, NOT_NEGATIVE)  #: weight of the policy's entropy
    vf_coef: float = setting(0.5, NOT_NEGATIVE)  #: weight of the value's loss
    max_grad_norm: float = setting(5.0, POSITIVE)  #: largest norm of the gradient


@dataclass(frozen=True, kw_only=True)
class NoveltySettings:
    """Settings of random network distillation, a bonus for observations that were seldom seen."""

    #: Of the bonus beside the scaled reward, chosen on seeds 1001 and 1002; the paper has 1 beside 2.
    weight: float = setting(0.02, NOT_NEGATIVE)
    learning_rate: float = setting(1e-3, POSITIVE)  #: step size of the predictor's optimiser
    width: int = setting(64, between(1, 4096))  #: hidden units, and outputs, of both networks
    discount: float = setting(0.99, PROBABILITY)  #: of the sum of errors whose deviation scales the bonus
    update_every: int = setting(16, between(1, 10_000))  #: macro-actions between updates of the predictor
    epochs: int = setting(4, COUNT)  #: gradient steps then, each on all of these observations


@dataclass(frozen=True, kw_only=True)
class LibrarySettings:
    """All settings of an agent from Stable-Baselines3, of which an algorithm reads its own section."""

    sb3: SB3Settings = field(default_factory=SB3Settings)
    ppo: PPOSettings = field(default_factory=PPOSettings)
    #: Every reward is multiplied by this number before the library sees it. Rewards of up to 50 become rewards of up
    #: to 2: the library's losses and its authors' settings are made for rewards of about 1.
    reward_scale: float = setting(0.04, POSITIVE)


@dataclass(frozen=True, kw_only=True)
class MixSettings:
    """How real and imagined experience mix."""

    imagined_episodes: int = setting(4, between(0, 1000))  #: after each real episode, once imagination has begun


@dataclass(frozen=True, kw_only=True)
class CuriousSettings(LibrarySettings):
    """Those with a bonus for observations that were seldom seen."""

    novelty: NoveltySettings = field(default_factory=NoveltySettings)


@dataclass(frozen=True, kw_only=True)
class ImaginingSettings(LibrarySettings, Settings):
    """Those with a world model; ``controller``, and how our own agents mix experience, are without effect."""

    mix: MixSettings = field(default_factory=MixSettings)


def _joined(group: ConfigGroup[Settings]) -> ConfigGroup[ImaginingSettings]:
    own = {part.name: getattr(group.published, part.name) for part in fields(group.published)}
    return ConfigGroup(ImaginingSettings(**own), group.sets)


HYPERPARAMETERS = Hyperparameters.everywhere(LibrarySettings())
PIXELS = Hyperparameters.everywhere(LibrarySettings(sb3=SB3Settings(gradient_steps=2)))
"""Of the DQN on frames, chosen on seeds 1001 and 1002. An update costs about thirty times as much CPU time there."""
QUANTILES = Hyperparameters.everywhere(LibrarySettings(sb3=QuantileSettings(gradient_steps=2)))
"""Of QR-DQN on frames: those of the DQN. With the library's 200 quantiles a run would take three times as long."""
CURIOUS = Hyperparameters.everywhere(CuriousSettings())
IMAGINING = Hyperparameters({name: _joined(group) for name, group in IMAGINATION.groups.items()})
