"""Settings of the regressors of chapter 4; the defaults are the thesis' (4.5.1)."""

from __future__ import annotations

from dataclasses import dataclass

from imagine_bench.agents import settings as kinds
from imagine_bench.agents.settings import (
    COUNT,
    POSITIVE,
    PROBABILITY,
    ConfigGroup,
    Hyperparameters,
    Override,
    Range,
    between,
    setting,
)

from imagine_bench.errors import InvalidValueError

_DROPOUT = Range(
    lambda value: value == 0.0 or 1 / 256 <= value <= 0.95,
    "must be 0 or lie in [1/256, 0.95]: dropout masks count in 256ths",
)
_BATCH_SIZE = between(8, 1_000_000, "layers are standardised over a batch")


@dataclass(frozen=True, kw_only=True)
class RegressorSettings:
    """A regressor: Bayesian mixture density networks, and how long they train.

    Raises:
        InvalidValueError: Dropout without two hidden layers, or all weight samples would be the same.
    """

    hidden: tuple[int, ...] = setting((256, 256, 256), kinds.LAYERS)  #: units of each hidden layer
    components: int = setting(10, between(1, 1_000))  #: Gaussians in the mixture, K
    #: probability of dropping a unit of a hidden layer that another one follows
    dropout: float = setting(0.2, _DROPOUT)
    #: Of the hidden layers, weights and biases alike, added to the gradient: the term ``weight_decay / 2 * |w|^2`` of
    #: the loss. Were biases spared, the bend of a ReLU unit, at ``-b / w``, would leave the data as ``w`` shrinks, and
    #: a third of the first layer die.
    weight_decay: float = setting(0.02, kinds.NOT_NEGATIVE)
    learning_rate: float = setting(1e-3, kinds.RATE)  #: step size of Adam in the first epoch
    gradient_clip: float = setting(10.0, POSITIVE)  #: largest gradient norm of each network
    #: smallest standard deviation of a component, in units of the network's outputs
    sigma_floor: float = setting(1e-3, between(1e-9, 1.0))
    #: largest standard deviation of a component, in units of the network's outputs
    sigma_ceiling: float = setting(10.0, between(1.0, 1e9))
    #: number format of products between hidden layers while training
    precision: str = setting("float32", kinds.PRECISIONS)
    epochs: int = setting(3000, kinds.ROWS)  #: passes over the data
    #: Last epoch's learning rate as a share of the first's, to which it falls as a cosine (Loshchilov & Hutter 2017). 1
    #: keeps it, as the thesis does.
    final_rate: float = setting(1.0, PROBABILITY)
    #: rows an update, at most; None for all, as the thesis names none
    batch_size: int | None = setting(None, _BATCH_SIZE)
    members: int = setting(1, between(1, 1_000))  #: networks of an ensemble, M; 1 is a single network with dropout
    #: dropout masks, T; of an ensemble, each member is one sample
    weight_samples: int = setting(50, between(2, 1_000, "the spread of one sample is 0"))
    #: values sampled from each weight sample's mixture to estimate their divergence
    divergence_draws: int = setting(1, COUNT)

    def __post_init__(self) -> None:
        if self.dropout > 0.0 and len(self.hidden) < 2:
            raise InvalidValueError(
                f"Setting hidden is {self.hidden}; dropout acts between hidden layers, so it needs at least two of "
                "them. Add one."
            )
        if self.members == 1 and self.dropout == 0.0:
            raise InvalidValueError(
                "Settings members is 1 and dropout is 0: all weight samples would be the same, and their spread 0. "
                "Give mc_dropout a dropout of at least 1/256, or ensemble at least 2 members."
            )


_SMALLEST = "shows that every part works, within seconds"
_FALLING = Override(0.01, "a rate that stays leaves the mixtures blunt; the thesis names no schedule")
_FORMAT = Override("auto", "CPU time; see docs/explanation/uncertainty_method.md for its effects")
_SHORT = {
    "batch_size": Override(1000, "where there are more data: few epochs, more steps (all at once was not tried here)"),
    "learning_rate": Override(3e-3, "fewer epochs want larger steps"),
    "precision": _FORMAT,
}
_SETS: dict[str, dict[str, Override]] = {
    "minimal": {"epochs": Override(20, _SMALLEST), "weight_samples": Override(10, _SMALLEST), **_SHORT},
    "fast": {"epochs": Override(600, "CPU time"), **_SHORT, "final_rate": _FALLING},
    "published": {"final_rate": _FALLING, "precision": _FORMAT},
}
"""The changes of each set to the thesis' values for one network with dropout."""
_ENSEMBLE = {
    "members": Override(5, "as many as Lakshminarayanan et al. (2017) recommend"),
    "dropout": Override(0.0, "in an ensemble the members are the weight samples"),
    "batch_size": Override(250, "so few epochs want more steps in each"),
    "divergence_draws": Override(10, "five members then give as many values as 50 dropout samples"),
}
"""The changes of a deep ensemble to every set, beside its epochs."""
_EPOCHS = {"minimal": 4, "fast": 120, "published": 300}
"""Epochs of each of five members in every set: a tenth of the one network's, so that the ensemble costs half and does
not win by arithmetic. But at least 120, below which members have hardly learned, where that costs no more."""
_FEWER = "five members together must not cost more than one network"
_ENSEMBLE_SETS = {
    name: {**_SETS[name], **_ENSEMBLE, "epochs": Override(epochs, _FEWER)} for name, epochs in _EPOCHS.items()
}
HYPERPARAMETERS = Hyperparameters({
    "mc_dropout": ConfigGroup(RegressorSettings(), _SETS, unused=frozenset({"members"})),
    "ensemble": ConfigGroup(RegressorSettings(), _ENSEMBLE_SETS, unused=frozenset({"dropout"})),
})  # fmt: skip
