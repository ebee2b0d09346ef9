"""Named presets of the learners' settings, and single settings replaced by dotted name.

A preset is nothing but its deviations from the thesis, each with its reason; the report prints them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from imagine_bench.errors import InvalidValueError, UnknownNameError, require_known

from .settings import Settings


@dataclass(frozen=True, slots=True)
class Deviation:
    """A value that is not the thesis', and why."""

    value: Any
    reason: str


_QUICK: dict[str, Deviation] = {
    "model.dynamics_hidden": Deviation((256, 256), ""),
    "model.reward_hidden": Deviation((128, 128), ""),
    "model.termination_hidden": Deviation((128, 128), ""),
    "model.dropout": Deviation(0.25, ""),
    "model.updates_per_step": Deviation(4, ""),
    "model.batch_size": Deviation(128, ""),
    "model.predict_change": Deviation(True, ""),
    "model.reward_unit": Deviation(10.0, ""),
    "model.gradient_clip": Deviation(10.0, ""),
    "imagination.start_episode": Deviation(200, ""),
    "imagination.temperature": Deviation(0.0, ""),
    "imagination.exploration": Deviation(0.2, ""),
    "imagination.weight_samples": Deviation(10, ""),
}

PRESETS: dict[str, dict[str, Deviation]] = {
    "smoke": {},
    "quick": _QUICK,
    "thesis": {},
    "full": {},
}


def flatten(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Every setting by dotted name."""
    flat: dict[str, Any] = {}
    for field in fields(settings):
        value = getattr(settings, field.name)
        name = f"{prefix}{field.name}"
        flat.update(flatten(value, f"{name}.") if is_dataclass(value) else {name: value})
    return flat


def resolve(preset: str, overrides: Mapping[str, Any]) -> Settings:
    """The settings of a preset, with single ones replaced.

    Args:
        preset: A name of :data:`PRESETS`.
        overrides: Values by dotted name, such as ``{"controller.discount": 0.9}``.

    Raises:
        UnknownNameError: No such preset or setting; the message lists what exists.
        InvalidValueError: A value of the wrong type or out of its range.
    """
    deviations = PRESETS[require_known("preset", preset, PRESETS)]
    values = {name: deviation.value for name, deviation in deviations.items()}
    return _with_values(Settings(), {**values, **overrides})


def _with_values(settings: Settings, values: Mapping[str, Any]) -> Settings:
    known = flatten(Settings())
    sections: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        if name not in known:
            raise UnknownNameError("setting", name, known)
        section, _, key = name.partition(".")
        hint = get_type_hints(type(getattr(settings, section)))[key]
        sections.setdefault(section, {})[key] = _checked(name, hint, value)
    return replace(settings, **{name: replace(getattr(settings, name), **new) for name, new in sections.items()})


def _checked(name: str, hint: Any, value: Any) -> Any:
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
