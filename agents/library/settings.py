"""Settings of the agents from Stable-Baselines3: its own names, the same for every task and set of hyperparameters."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..settings import COUNT, POSITIVE, PROBABILITY, ROWS, Hyperparameters, setting


@dataclass(frozen=True, kw_only=True)
class SB3Settings:
    """Keywords of ``stable_baselines3.DQN`` and ``sb3_contrib.QRDQN`` that differ from the library's own."""

    learning_rate: float = setting(1e-3, POSITIVE)
    buffer_size: int = setting(50_000, ROWS)  #: transitions of the replay buffer
    learning_starts: int = setting(100, ROWS)  #: macro-actions before the first update, all of them random
    batch_size: int = setting(32, COUNT)
    gamma: float = setting(0.95, PROBABILITY)  #: discount a macro-action, the same as our agents'
    train_freq: int = setting(1, COUNT)  #: macro-actions between updates
    gradient_steps: int = setting(4, COUNT)  #: updates then
    target_update_interval: int = setting(250, ROWS)  #: macro-actions between copies of the network to its target
    #: Macro-actions over which the probability of a random one falls linearly.
    exploration_steps: int = setting(600, ROWS)
    exploration_final_eps: float = setting(0.02, PROBABILITY)  #: where it ends


@dataclass(frozen=True, kw_only=True)
class LibrarySettings:
    """All settings of an agent from Stable-Baselines3."""

    sb3: SB3Settings = field(default_factory=SB3Settings)


HYPERPARAMETERS = Hyperparameters.everywhere(LibrarySettings())
