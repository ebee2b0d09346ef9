"""Families of settings, their named presets, and single settings replaced by dotted name.

A family is the settings of one chapter of the thesis; a task names the one that it is measured with. A preset is
nothing but its deviations from the family's thesis values, each with its reason.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from imagine_bench.errors import InvalidValueError, UnknownNameError, require_known
from imagine_bench.interfaces import AgentContext

from .config_groups import Family
from .imagination.chapter_3 import CHAPTER_3
from .imagination.chapter_5 import CHAPTER_5
from .imagination.reward_termination import INPUTS
from .imagination.uncertainty import REDUCTIONS
from .networks.precision import PRECISIONS, settle
from .ranges import COUNT, FINITE, NOT_NEGATIVE, POSITIVE, PROBABILITY, RATE, SHARE, between, require_ranges
from .settings import START_STATES, Settings, WorldModelSettings

FAMILIES: dict[str, Family] = {"chapter_3": CHAPTER_3, "chapter_5": CHAPTER_5}
"""What a TaskSpec may name as its settings."""


_RANGES = {
    "model.dropout": SHARE,
    "model.reward_scale": POSITIVE,
    "model.learning_rate": POSITIVE,
    "model.max_norm": POSITIVE,
    "model.updates_per_step": COUNT,
    "model.spread": NOT_NEGATIVE,
    "model.balance": NOT_NEGATIVE,
    "model.sigma_floor": POSITIVE,
    "model.gradient_clip": POSITIVE,
    "controller.learning_rate": POSITIVE,
    "controller.discount": PROBABILITY,
    "controller.updates_per_step": NOT_NEGATIVE,
    "controller.target_rate": RATE,
    "controller.gradient_clip": POSITIVE,
    "controller.epsilon_min": PROBABILITY,
    "controller.epsilon_max": PROBABILITY,
    "controller.epsilon_decay": FINITE,
    "imagination.start_episode": NOT_NEGATIVE,
    "imagination.end_episode": NOT_NEGATIVE,
    "imagination.updates_per_step": NOT_NEGATIVE,
    "imagination.temperature": NOT_NEGATIVE,
    "imagination.exploration": PROBABILITY,
    "imagination.threshold": NOT_NEGATIVE,
    "imagination.threshold_quantile": PROBABILITY,
    "imagination.reward_threshold": NOT_NEGATIVE,
    "imagination.termination_threshold": between(0.0, 0.5, "it bounds the less likely of two"),
}
"""Ranges of the numbers; every other number is a count of at least 1."""

_WORDS = {
    "model.precision": ("precision", PRECISIONS),
    "model.assessment_input": ("assessment input", INPUTS),
    "imagination.start_states": ("start of imagined rollouts", START_STATES),
    "imagination.reduction": ("uncertainty reduction", tuple(REDUCTIONS)),
}
"""What settings that are words are called and may be."""


def flatten(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Every setting by dotted name."""
    flat: dict[str, Any] = {}
    for field in fields(settings):
        value = getattr(settings, field.name)
        name = f"{prefix}{field.name}"
        flat.update(flatten(value, f"{name}.") if is_dataclass(value) else {name: value})
    return flat


def names() -> frozenset[str]:
    """The dotted names of all settings."""
    return frozenset(flatten(Settings()))


def resolve(preset: str, overrides: Mapping[str, Any], family: str) -> Settings:
    """The settings of a preset, with single ones replaced.

    Args:
        preset: A preset of the family.
        overrides: Values by dotted name, such as ``{"controller.discount": 0.9}``.
        family: A name of :data:`FAMILIES`.

    Raises:
        UnknownNameError: No such family, preset or setting; the message lists what exists.
        InvalidValueError: A value of the wrong type or out of its range.
    """
    chosen = FAMILIES[require_known("settings family", family, FAMILIES)]
    deviations = chosen.presets[require_known("preset", preset, chosen.presets)]
    values = {name: deviation.value for name, deviation in deviations.items()}
    settings = checked_values(chosen.thesis, {**values, **overrides})
    _require_ranges(settings)
    _require_read(settings.model, chosen.thesis.model, overrides)
    return settings


def settings_of(context: AgentContext) -> Settings:
    """The settings that an agent is to be built with, the precision settled for its device.

    Raises:
        UnknownNameError: The context names a family, preset or setting that does not exist.
        InvalidValueError: A value of the wrong type or out of its range.
    """
    settings = resolve(context.preset, context.overrides, context.settings)
    precision = settle(settings.model.precision, context.device)
    return replace(settings, model=replace(settings.model, precision=precision))


def _require_ranges(settings: Settings) -> None:
    flat = flatten(settings)
    for name, (kind, known) in _WORDS.items():
        require_known(kind, flat[name], known)
    require_ranges(flat, _RANGES)
    model, controller, imagination = settings.model, settings.controller, settings.imagination
    if controller.epsilon_min > controller.epsilon_max:
        raise InvalidValueError(
            f"controller.epsilon_min {controller.epsilon_min} is above controller.epsilon_max "
            f"{controller.epsilon_max}: exploration would rise. Set it to that or less."
        )
    if imagination.end_episode is not None and imagination.end_episode <= imagination.start_episode:
        raise InvalidValueError(
            f"imagination.end_episode {imagination.end_episode} is not above imagination.start_episode "
            f"{imagination.start_episode}: nothing would be imagined. Set it above that, or to null for no end."
        )
    if model.dropout > 0 and not (model.dynamics_hidden and (model.shared_hidden or model.reward_hidden)):
        raise InvalidValueError(
            "model.dropout acts on hidden layers: give model.dynamics_hidden and model.reward_hidden at least one each "
            "or set it to 0."
        )


def _require_read(model: WorldModelSettings, thesis: WorldModelSettings, overrides: Mapping[str, Any]) -> None:
    """Raise InvalidValueError for sizes of networks that there are not, and for networks whose sizes nobody gave."""
    own = ("model.reward_hidden", "model.termination_hidden")
    for name in own:
        if model.shared_hidden and overrides.get(name):
            raise InvalidValueError(
                f"{name} {overrides[name]} is not read beside model.shared_hidden {model.shared_hidden}, the hidden "
                "layers of one network for both outputs; leave it out, or set model.shared_hidden to []."
            )
    if thesis.shared_hidden and not model.shared_hidden and not overrides.keys() >= set(own):
        raise InvalidValueError(
            f"Without model.shared_hidden each output has a network of its own: give {' and '.join(own)} too."
        )


def checked_values(settings: Any, values: Mapping[str, Any]) -> Any:
    """Settings of two levels with single ones replaced by dotted name, each checked against its declared type.

    Raises:
        UnknownNameError: No such setting; the message lists what exists.
        InvalidValueError: A value of the wrong type.
    """
    known = flatten(settings)
    sections: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        if name not in known:
            raise UnknownNameError("setting", name, known)
        section, _, key = name.partition(".")
        hint = get_type_hints(type(getattr(settings, section)))[key]
        sections.setdefault(section, {})[key] = checked(name, hint, value)
    return replace(settings, **{name: replace(getattr(settings, name), **new) for name, new in sections.items()})


def checked(name: str, hint: Any, value: Any) -> Any:
    """``value`` as the type ``hint``, where nothing is lost by it."""
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    for option in options:
        if option is type(None) and value is None:
            return None
        if option is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        if get_origin(option) is tuple and isinstance(value, list | tuple):
            if all(type(item) is int for item in value):
                return tuple(value)
        elif isinstance(option, type) and type(value) is option:
            return value
    wanted = " or ".join(getattr(option, "__name__", str(option)) for option in options)
    raise InvalidValueError(f"Setting {name!r} was given {value!r}; it takes {wanted}.")
