"""Settings of the regressors of chapter 4: the thesis' values, and how presets and regressors deviate from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, get_type_hints

from imagine_bench.errors import InvalidValueError, UnknownNameError, require_known

from ..config_groups import Deviation
from ..networks.mlp import dropout_bits
from ..networks.precision import PRECISIONS
from ..presets import checked
from ..ranges import NOT_NEGATIVE, POSITIVE, PROBABILITY, RATE, Range, between, require_ranges
from .bayesian_mdn import MDNSettings


@dataclass(frozen=True, kw_only=True)
class RegressorSettings(MDNSettings):
    """A regressor: its networks and how long they train. The defaults are the thesis' (4.5.1).

    Attributes:
        epochs: Passes over the data.
        final_rate: What the learning rate falls to after the last epoch, as a cosine, as a share of the first's
            (Loshchilov & Hutter 2017). 1 keeps it, as the thesis does.
        batch_size: Rows an update, at most; None for all, as the thesis names none.
        members: Networks of an ensemble, M; 1 is a single network with dropout.
        weight_samples: Dropout masks, T; of an ensemble, each member is one sample.
        divergence_draws: Values drawn from each weight sample's mixture to estimate their divergence.
    """

    epochs: int = 3000
    final_rate: float = 1.0
    batch_size: int | None = None
    members: int = 1
    weight_samples: int = 50
    divergence_draws: int = 1


_BATCH = Deviation(1000, "where there are more data: few epochs, more steps (all at once was not tried here)")
_FALLING = Deviation(0.01, "a rate that stays leaves the mixtures blunt; the thesis names no schedule")

PRESETS: dict[str, dict[str, Deviation]] = {
    "smoke": {
        "epochs": Deviation(20, "shows that every part works, within a minute"),
        "batch_size": _BATCH,
        "learning_rate": Deviation(3e-3, "so few epochs want larger steps"),
        "precision": Deviation("auto", "CPU time; see docs/uncertainty.md for what it changes"),
    },
    "quick": {
        "epochs": Deviation(600, "CPU time"),
        "batch_size": _BATCH,
        "learning_rate": Deviation(3e-3, "fewer epochs want larger steps"),
        "final_rate": _FALLING,
        "precision": Deviation("auto", "CPU time; see docs/uncertainty.md for what it changes"),
    },
    "thesis": {
        "final_rate": _FALLING,
        "precision": Deviation("auto", "CPU time; see docs/uncertainty.md for what it changes"),
    },
    "full": {"final_rate": _FALLING},
}
"""What each preset changes of the thesis' values."""

ENSEMBLE: dict[str, Deviation] = {
    "members": Deviation(5, "as many as Lakshminarayanan et al. (2017) recommend"),
    "dropout": Deviation(0.0, "in an ensemble the members are the weight samples"),
    "batch_size": Deviation(250, "so few epochs want more steps in each"),
    "divergence_draws": Deviation(10, "five members then give as many values as 50 dropout samples"),
}
"""What a deep ensemble changes of every preset; its epochs are those of :func:`_ensemble_epochs`."""
ENSEMBLE_SHARE = 10
"""Five members for a tenth of the epochs cost half of one network with dropout: as preset it must not win by
arithmetic. Epochs that are set are each member's."""
ENSEMBLE_EPOCHS = 120
"""Below so many epochs members have hardly learned; they get them where that costs no more than the one network."""

_RANGES = {
    "dropout": between(0.0, 0.95),
    "weight_decay": NOT_NEGATIVE,
    "learning_rate": RATE,
    "final_rate": PROBABILITY,
    "gradient_clip": POSITIVE,
    "sigma_floor": between(1e-9, 1.0),
    "sigma_ceiling": between(1.0, 1e9),
    "weight_samples": between(2, 1_000, "the spread of one sample is 0"),
    "components": between(1, 1_000),
    "members": between(1, 1_000),
    "batch_size": Range(lambda value: value >= 8, "must be at least 8: layers are standardised over a batch"),
}
"""Ranges of the numbers; every other number is a count of at least 1."""


def resolve(preset: str, overrides: Mapping[str, Any], *, ensemble: bool) -> RegressorSettings:
    """The settings of a preset, with single ones replaced.

    Args:
        preset: A name of :data:`PRESETS`.
        overrides: Values by name, such as ``{"epochs": 100}``, for every regressor; but ``dropout`` is the one
            network's and ``members`` the ensemble's, and the other goes without.
        ensemble: Whether they are for a deep ensemble.

    Raises:
        UnknownNameError: No such preset or setting; the message lists what exists.
        InvalidValueError: A value of the wrong type or out of its range.
    """
    require_known("preset", preset, PRESETS)
    values = {name: deviation.value for name, deviation in PRESETS[preset].items()}
    if ensemble:
        epochs = values.get("epochs", RegressorSettings().epochs)
        values |= {name: deviation.value for name, deviation in ENSEMBLE.items()}
        values["epochs"] = _ensemble_epochs(epochs)
    known = {field.name for field in fields(RegressorSettings)}
    hints = get_type_hints(RegressorSettings)
    for name, value in overrides.items():
        if name not in known:
            raise UnknownNameError("setting", name, sorted(known))
        given = checked(name, hints[name], value)
        if name != ("dropout" if ensemble else "members"):
            values[name] = given
    settings = replace(RegressorSettings(), **values)
    _require_ranges(settings)
    _require_samples(settings, ensemble=ensemble)
    return settings


def resolve_all(preset: str, overrides: Mapping[str, Any]) -> tuple[RegressorSettings, RegressorSettings]:
    """The settings of one network and of an ensemble; raises what any regressor would raise for them."""
    return resolve(preset, overrides, ensemble=False), resolve(preset, overrides, ensemble=True)


def _ensemble_epochs(epochs: int) -> int:
    """Epochs of each member where one network trains for ``epochs``: all preset members together cost no more."""
    fair = max(1, epochs // ENSEMBLE["members"].value)
    return min(fair, max(ENSEMBLE_EPOCHS, epochs // ENSEMBLE_SHARE))


def _require_ranges(settings: RegressorSettings) -> None:
    require_known("precision", settings.precision, PRECISIONS)
    if settings.dropout > 0.0 and len(settings.hidden) < 2:
        raise InvalidValueError(
            f"Setting hidden is {settings.hidden}; dropout acts between hidden layers, so it needs at least two of "
            "them. Add one."
        )
    require_ranges({field.name: getattr(settings, field.name) for field in fields(settings)}, _RANGES)


def _require_samples(settings: RegressorSettings, *, ensemble: bool) -> None:
    """Epistemic uncertainty is what weight samples disagree about, so there must be different ones."""
    if ensemble and settings.members < 2:
        raise InvalidValueError("Setting members is 1 in an ensemble; it must be at least 2: the spread of one is 0.")
    if not ensemble and dropout_bits(settings.dropout) == 0:
        raise InvalidValueError(
            f"Setting dropout is {settings.dropout}, which counts as 0 (in steps of 1/256): all weight samples of one "
            "network would be the same. Give at least 0.002; the regressor 'ensemble' goes without by itself."
        )
