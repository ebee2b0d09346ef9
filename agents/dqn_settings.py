"""Settings of the DQN; the defaults are the thesis' values of chapter 5."""

from __future__ import annotations

from dataclasses import dataclass, field

from imagine_bench.errors import InvalidValueError

from .settings import (
    COUNT,
    FINITE,
    LAYERS,
    NOT_NEGATIVE,
    POSITIVE,
    PROBABILITY,
    RATE,
    ConfigGroup,
    Hyperparameters,
    Override,
    setting,
)


@dataclass(frozen=True, kw_only=True)
class ControllerSettings:
    """The action-value network, its updates and its exploration (thesis 5.2.2), which must not rise."""

    hidden: tuple[int, ...] = setting((512, 256, 128), LAYERS)
    learning_rate: float = setting(1e-3, POSITIVE)
    batch_size: int = setting(64, COUNT)  #: transitions an update, real or imagined
    updates_per_step: int = setting(1, NOT_NEGATIVE)  #: updates on real transitions a real step, N_R
    #: Gamma in [0, 1], a macro-action. The thesis gives none; see docs/explanation/deviations.md.
    discount: float = setting(0.95, PROBABILITY)
    #: How far the target network moves toward the learning one after each update, in (0, 1]: 1 is no target network
    #: (thesis).
    target_rate: float = setting(1.0, RATE)
    #: Exploration probability in the limit; ``epsilon_max`` that at step 0.
    epsilon_min: float = setting(0.001, PROBABILITY)
    epsilon_max: float = setting(0.8, PROBABILITY)
    epsilon_decay: float = setting(0.03, FINITE)  #: decay rate lambda, a real step

    def __post_init__(self) -> None:
        if self.epsilon_min > self.epsilon_max:
            raise InvalidValueError(
                f"controller.epsilon_min {self.epsilon_min} is above controller.epsilon_max {self.epsilon_max}: "
                "exploration would rise. Set it to that or less."
            )


@dataclass(frozen=True, kw_only=True)
class ReplaySettings:
    """How many real transitions are kept; the oldest go first (thesis 5.2.2)."""

    real: int = setting(50_000, COUNT)


@dataclass(frozen=True, kw_only=True)
class DQNSettings:
    """All settings of the DQN."""

    controller: ControllerSettings = field(default_factory=ControllerSettings)
    memory: ReplaySettings = field(default_factory=ReplaySettings)


CONTROLLER_3 = ControllerSettings(hidden=(512, 256), learning_rate=2.5e-4)
"""The thesis' values of chapter 3 (3.2.2)."""

FAST_3: dict[str, Override] = {
    "controller.learning_rate": Override(1e-3, "model-only training is short: a new controller learns on 3,000 steps"),
    "controller.target_rate": Override(0.02, "without a target network the values of a long chat with a human swing"),
    "controller.epsilon_decay": Override(0.001, "at 0.03 most of the 36 wrong macro-actions stay unseen"),
}
FAST_5: dict[str, Override] = {
    "controller.epsilon_decay": Override(0.003, "0.03 ends exploration after 100 episodes: 13 points less (factors)"),
}

HYPERPARAMETERS = Hyperparameters(
    {
        "chapter_3": ConfigGroup(
            DQNSettings(controller=CONTROLLER_3), {"minimal": FAST_3, "fast": FAST_3, "published": {}}
        ),
        "chapter_5": ConfigGroup(DQNSettings(), {"minimal": FAST_5, "fast": FAST_5, "published": {}}),
    }
)
