"""Settings of LeWM from torch-world, by the names of the paper where it has one."""

from __future__ import annotations

from dataclasses import dataclass, field

from imagine_bench.agents.settings import (
    COUNT,
    DROPOUT,
    NOT_NEGATIVE,
    POSITIVE,
    PROBABILITY,
    ROWS,
    Hyperparameters,
    Override,
    between,
    setting,
)

from imagine_bench.errors import InvalidValueError


@dataclass(frozen=True, kw_only=True)
class LeWMModelSettings:
    """Sizes of the encoder (ViT-tiny in the paper) and of the predictor, a transformer."""

    patch: int = setting(8, between(4, 32))  #: pixels of a patch's side; in the paper a 16th of the image's
    embedding: int = setting(192, between(4, 1024))  #: numbers that stand for a frame
    encoder_depth: int = setting(12, between(1, 24))  #: layers of the encoder
    encoder_heads: int = setting(3, between(1, 16))  #: attention heads of a layer of the encoder
    predictor_depth: int = setting(6, between(1, 24))  #: layers of the predictor
    predictor_heads: int = setting(16, between(1, 32))  #: attention heads of a layer of the predictor
    units: int = setting(2048, COUNT)  #: of the predictor's hidden layers and of both projections
    dropout: float = setting(0.1, DROPOUT)  #: in the predictor
    slices: int = setting(1024, COUNT)  #: directions in which the embeddings' distribution is compared

    def __post_init__(self) -> None:
        if 64 % self.patch or self.embedding % (4 * self.encoder_heads):
            raise InvalidValueError(
                f"model.patch is {self.patch} and model.embedding {self.embedding}: the first must divide 64, the "
                f"second be a multiple of 4 times model.encoder_heads, {4 * self.encoder_heads}."
            )


@dataclass(frozen=True, kw_only=True)
class LeWMSettings:
    """All settings of ``lewm``; by default the paper's, but for those of an agent that acts as it learns."""

    model: LeWMModelSettings = field(default_factory=LeWMModelSettings)
    regularisation: float = setting(0.09, NOT_NEGATIVE)  #: weight of SIGReg, lambda
    learning_rate: float = setting(5e-5, POSITIVE)  #: step size of the optimiser
    weight_decay: float = setting(1e-3, NOT_NEGATIVE)  #: weight decay of the optimiser, a gradient update
    batch_size: int = setting(128, between(2, 4096))  #: transitions
    replay_ratio: float = setting(1.0, between(0.0, 64.0))  #: gradient updates a macro-action
    learning_starts: int = setting(100, between(2, 10_000_000))  #: macro-actions before the first update, all random
    horizon: int = setting(3, between(1, 4))  #: macro-actions of the longest plan; all sequences are compared
    goals: int = setting(64, between(1, 1000))  #: frames to plan toward, the latest
    #: Macro-actions over which the probability of a random one falls linearly.
    exploration_steps: int = setting(600, ROWS)
    exploration_final_eps: float = setting(0.02, PROBABILITY)  #: where it ends
    buffer_size: int = setting(50_000, ROWS)  #: transitions remembered


_FAST = {
    "regularisation": Override(1.0, "solves 15 % after 500 episodes on a tuning seed, 0.09 less than 5 %"),
    "model.embedding": Override(96, "a world of some hundred macrostates; two cores"),
    "model.encoder_depth": Override(3, "as embedding"),
    "model.predictor_depth": Override(2, "as embedding"),
    "model.predictor_heads": Override(4, "as embedding"),
    "model.units": Override(256, "as embedding"),
    "model.slices": Override(256, "as embedding"),
    "learning_rate": Override(5e-4, "budgets are some hundred updates"),
    "batch_size": Override(64, "as embedding"),
}
_MINIMAL = {
    **_FAST,
    "model.patch": Override(32, "only shows that all parts work"),
    "model.embedding": Override(12, "only shows that all parts work"),
    "model.encoder_depth": Override(1, "only shows that all parts work"),
    "model.predictor_depth": Override(1, "only shows that all parts work"),
    "model.units": Override(16, "only shows that all parts work"),
    "model.slices": Override(16, "only shows that all parts work"),
    "batch_size": Override(8, "only shows that all parts work"),
    "learning_starts": Override(4, "only shows that all parts work"),
    "horizon": Override(2, "only shows that all parts work"),
}
HYPERPARAMETERS = Hyperparameters.everywhere(LeWMSettings(), fast=_FAST, minimal=_MINIMAL)
"""``published`` are the paper's."""
