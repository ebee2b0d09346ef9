"""Named presets of the learners' settings, and single settings replaced by dotted name.

A preset is nothing but its deviations from the thesis, each with its reason; the report prints them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from imagine_bench.errors import InvalidValueError, UnknownNameError, require_known

from .settings import Settings
from .uncertainty import reduction


@dataclass(frozen=True, slots=True)
class Deviation:
    """A value that is not the thesis', and why."""

    value: Any
    reason: str


_QUICK: dict[str, Deviation] = {
    "model.dynamics_hidden": Deviation(
        (512,), "shallow and wide generalises: 80 % of unseen transitions right after 500 episodes, 2 x 256: 52 %"
    ),
    "model.components": Deviation(2, "the rules are deterministic; two components cost less than five"),
    "model.reward_hidden": Deviation((256, 256), "CPU time: 3 x 512 is most of the arithmetic of the thesis' model"),
    "model.termination_hidden": Deviation((128, 128), "CPU time: a third of the arithmetic of 2 x 256"),
    "model.dropout": Deviation(0.25, "at 50 % the dynamics are right on 42 % of transitions, at 25 % on 64 %"),
    "model.learning_rate": Deviation(
        2e-3, "fewer updates a step want larger ones (measured with the whole model, not alone)"
    ),
    "model.updates_per_step": Deviation(3, "CPU time: with the batch, 21 times fewer rows a real step"),
    "model.batch_size": Deviation(128, "CPU time; see updates_per_step"),
    "model.predict_change": Deviation(True, "a macro-action moves one cube: 64 % of transitions right, 43 % without"),
    "model.sigma_floor": Deviation(0.2, "narrower components stop learning of the transitions they miss"),
    "model.gradient_clip": Deviation(10.0, "the likelihood of narrow components has steep walls"),
    "controller.epsilon_decay": Deviation(
        0.003, "0.03 ends exploration after 100 episodes; 64 % against 58 % after 1000, but 28 % against 37 % after 750"
    ),
    "imagination.start_episode": Deviation(300, "the quick model is right early; 1000 would leave nothing to compare"),
    "imagination.temperature": Deviation(0.0, "sampled latents leave the manifold that the networks know"),
    "imagination.exploration": Deviation(0.2, "a greedy rollout repeats the real actions"),
    "imagination.weight_samples": Deviation(10, "CPU time; the filter needs a rank, not a precise variance"),
    "imagination.reduction": Deviation("max", "0.3 on the sum of 24 latents keeps one in ten, on the mean everything"),
}

_SMOKE: dict[str, Deviation] = {
    **_QUICK,
    "model.updates_per_step": Deviation(1, "shows that every part works, within a minute"),
    "imagination.start_episode": Deviation(10, "imagination must happen within a few dozen episodes"),
}

PRESETS: dict[str, dict[str, Deviation]] = {
    "smoke": _SMOKE,
    "quick": _QUICK,
    "thesis": {},
    "full": {},
}


@dataclass(frozen=True, slots=True)
class _Range:
    """Which numbers a setting takes, in words too. NaN satisfies no comparison, so it is never allowed."""

    holds: Callable[[float], bool]
    words: str


_PROBABILITY = _Range(lambda value: 0.0 <= value <= 1.0, "must lie in [0, 1]")
_SHARE = _Range(lambda value: 0.0 <= value < 1.0, "must lie in [0, 1)")
_POSITIVE = _Range(lambda value: value > 0.0, "must be above 0")
_NOT_NEGATIVE = _Range(lambda value: value >= 0.0, "must be at least 0")
_COUNT = _Range(lambda value: value >= 1, "must be at least 1")
_RANGES = {
    "model.dropout": _SHARE,
    "model.learning_rate": _POSITIVE,
    "model.max_norm": _POSITIVE,
    "model.updates_per_step": _COUNT,
    "model.sigma_floor": _POSITIVE,
    "model.gradient_clip": _POSITIVE,
    "controller.learning_rate": _POSITIVE,
    "controller.discount": _PROBABILITY,
    "controller.updates_per_step": _NOT_NEGATIVE,
    "controller.epsilon_min": _PROBABILITY,
    "controller.epsilon_max": _PROBABILITY,
    "controller.epsilon_decay": _NOT_NEGATIVE,
    "imagination.start_episode": _NOT_NEGATIVE,
    "imagination.updates_per_step": _NOT_NEGATIVE,
    "imagination.temperature": _NOT_NEGATIVE,
    "imagination.exploration": _PROBABILITY,
    "imagination.threshold": _NOT_NEGATIVE,
}
"""Ranges of the numbers; every other number is a count of at least 1."""


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
    settings = _with_values(Settings(), {**values, **overrides})
    _require_ranges(settings)
    return settings


def _require_ranges(settings: Settings) -> None:
    reduction(settings.imagination.reduction)
    for name, value in flatten(settings).items():
        allowed = _RANGES.get(name, _COUNT)
        numbers = value if isinstance(value, tuple) else (value,)
        if any(type(number) in (int, float) and not allowed.holds(number) for number in numbers):
            raise InvalidValueError(f"Setting {name} is {value}; it {allowed.words}.")


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
