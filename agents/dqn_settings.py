"""Settings of the DQN; the defaults are the thesis' values of chapter 5."""

from __future__ import annotations

from dataclasses import dataclass, field

from imagine_bench.errors import InvalidValueError

from .settings import (
    COUNT,
    LAYERS,
    NOT_NEGATIVE,
    POSITIVE,
    PROBABILITY,
    RATE,
    ROWS,
    UPDATES,
    ConfigGroup,
    Hyperparameters,
    Override,
    setting,
)


@dataclass(frozen=True, kw_only=True)
class GreedySettings:
    """How an epsilon-greedy agent values and explores (thesis 5.2.2); exploration must not rise."""

    #: Gamma in [0, 1], a macro-action. The thesis gives none; see docs/explanation/deviations.md.
    discount: float = setting(0.95, PROBABILITY)
    epsilon_min: float = setting(0.001, PROBABILITY)  #: probability of a random macro-action in the limit
    epsilon_max: float = setting(0.8, PROBABILITY)  #: probability of a random macro-action at step 0
    epsilon_decay: float = setting(0.03, NOT_NEGATIVE)  #: decay rate lambda, a real step

    def __post_init__(self) -> None:
        if self.epsilon_min > self.epsilon_max:
            raise InvalidValueError(
                f"controller.epsilon_min {self.epsilon_min} is above controller.epsilon_max {self.epsilon_max}: "
                "exploration would rise. Set it to that or less."
            )


@dataclass(frozen=True, kw_only=True)
class ControllerSettings(GreedySettings):
    """The action-value network, its updates and its exploration (thesis 5.2.2)."""

    hidden: tuple[int, ...] = setting((512, 256, 128), LAYERS)  #: units of each hidden layer
    learning_rate: float = setting(1e-3, POSITIVE)  #: step size of Adam
    batch_size: int = setting(64, COUNT)  #: transitions an update, real or imagined
    updates_per_step: int = setting(1, UPDATES)  #: updates on real transitions a real step, N_R
    #: How far the target network moves toward the learning one after each update, in (0, 1]: 1 is no target network
    #: (thesis).
    target_rate: float = setting(1.0, RATE)


@dataclass(frozen=True, kw_only=True)
class ReplaySettings:
    """How many real transitions are kept; the oldest go first (thesis 5.2.2)."""

    real: int = setting(50_000, ROWS)  #: transitions that are kept
    #: The controller replays real transitions in proportion to |Bellman error| to this power (prioritised replay,
    #: Schaul et al. 2016); 0, the thesis: all alike.
    priority: float = setting(0.0, NOT_NEGATIVE)
    #: How far weights of the loss correct for that, in [0, 1].
    priority_correction: float = setting(0.4, PROBABILITY)


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

_Sets = dict[str, dict[str, Override]]
_SETS_3: _Sets = {"minimal": FAST_3, "fast": FAST_3, "published": {}}
_SETS_5: _Sets = {"minimal": FAST_5, "fast": FAST_5, "published": {}}


def _hyperparameters(sets_3: _Sets, sets_5: _Sets) -> Hyperparameters[DQNSettings]:
    """Those of a DQN with these sets of either chapter."""
    published_3 = DQNSettings(controller=CONTROLLER_3)
    return Hyperparameters(
        {"chapter_3": ConfigGroup(published_3, sets_3), "chapter_5": ConfigGroup(DQNSettings(), sets_5)}
    )


def _with_updates(sets: _Sets, **updates: int) -> _Sets:
    """The sets, with N_R + N_I updates a real step by name of a set."""
    reason = "as many updates of the controller as the agent imagination makes once it imagines, N_R + N_I"
    return {name: {**sets[name], "controller.updates_per_step": Override(updates[name], reason)} for name in sets}


_STEADY: dict[str, Override] = {
    "controller.hidden": Override((256, 128), "half the CPU time; as good (imagination, its control)"),
    "controller.target_rate": Override(0.05, "five updates a step diverge in some seeds without a target network"),
}
_MORE_5 = _with_updates(_SETS_5, minimal=5, fast=5, published=2)

HYPERPARAMETERS = _hyperparameters(_SETS_3, _SETS_5)
MORE_UPDATES = _hyperparameters(
    _with_updates(_SETS_3, minimal=2, fast=2, published=2),
    {**_MORE_5, **{name: {**_MORE_5[name], **_STEADY} for name in ("minimal", "fast")}},
)
"""Of the control ``dqn_more_updates``: as many updates a real step as ``imagination`` makes of its controller once it
imagines, one on real transitions and N_I on imagined ones (four at ``fast`` and ``minimal`` of chapter 5, else one)."""
