"""Settings as data: dataclass fields that carry their ranges, named sets of values, and overrides by dotted name.

An agent declares a frozen dataclass whose fields are :func:`setting` s, or sections of such fields, and one
:class:`Hyperparameters` beside it. Nothing heavy is imported here, so that settings can be checked before torch loads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from types import UnionType
from typing import TYPE_CHECKING, Any, Generic, TypeVar, Union, get_args, get_origin, get_type_hints

from imagine_bench.errors import InvalidValueError, UnknownNameError, brief, require_known
from imagine_bench.interfaces import AgentContext
from imagine_bench.values import Setting, kind_in_words

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_HUGE = 10**300  # integers beyond it are no floats, and in no range
CONFIG_GROUPS = ("chapter_3", "chapter_5")
"""Groups that a task may name: the chapter of the thesis whose settings it is measured with."""
SETS = ("minimal", "fast", "published")
"""Named sets of values: ``published`` is the thesis', ``fast`` values that fit minutes, ``minimal`` values that only
show that all parts work."""

S = TypeVar("S", bound="DataclassInstance")
V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class Range:
    """A set of values, in words too. NaN satisfies no comparison, so it is never allowed."""

    holds: Callable[[Any], bool]
    words: str


def between(low: float, high: float, why: str = "") -> Range:
    """Numbers from ``low`` to ``high``, both allowed; ``why`` is the reason against the others."""
    return Range(lambda value: low <= value <= high, f"must lie in [{low:g}, {high:g}]" + (why and f": {why}"))


Allowed = Range | tuple[str, ...]
"""The values that a setting may have: a range, or words."""
PROBABILITY = between(0.0, 1.0)
INSIDE = Range(lambda value: 0.0 < value < 1.0, "must lie between 0 and 1")
RATE = Range(lambda value: 0.0 < value <= 1.0, "must lie in (0, 1]")
POSITIVE = Range(lambda value: 0.0 < value <= 1e6, "must be above 0 and at most 1e+06")
NOT_NEGATIVE = between(0.0, 1e6)
UPDATES = between(0, 1000)
"""Updates a step; the thesis makes 16 at most."""
COUNT = between(1, 10_000)
ROWS = between(1, 5_000_000)
"""Kept transitions, macro-actions or epochs: more fit no memory, or no day."""
DROPOUT = Range(
    lambda value: value == 0.0 or 1 / 256 <= value <= 255 / 256,
    "must be 0 or lie in [1/256, 255/256]: dropout masks count in 256ths",
)
SIZES = Range(
    lambda sizes: len(sizes) <= 16 and all(1 <= size <= 8192 for size in sizes),
    "must be numbers of units, each at least 1 and at most 8192, of at most 16 layers",
)
LAYERS = Range(lambda sizes: len(sizes) > 0 and SIZES.holds(sizes), f"{SIZES.words}, of one layer or more")
SWITCH = Range(lambda value: True, "may be true or false")

PRECISIONS = ("auto", "float32", "bfloat16")
"""Number formats of hidden layers: ``auto`` is bfloat16 where the device has instructions for it, else float32."""


def setting(default: V, allowed: Allowed) -> V:
    """A dataclass field with a default and the values that it may have: a range, or words."""
    return field(default=default, metadata={"allowed": allowed})


@dataclass(frozen=True, slots=True)
class Override:
    """A value that is not the published one, and why."""

    value: Setting
    reason: str


@dataclass(frozen=True, slots=True)
class ConfigGroup(Generic[S]):
    """The settings of one chapter of the thesis, or of one kind of agent."""

    published: S
    sets: Mapping[str, Mapping[str, Override]]  #: by name of a set, its changes of them, by dotted name
    #: Settings that this group does without: an override of one is checked and left out.
    unused: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Hyperparameters(Generic[S]):
    """All settings that an agent can have, by config group, which the registry names and the bench reads."""

    groups: Mapping[str, ConfigGroup[S]]
    has_no_effect: frozenset[str] = frozenset()  #: Settings by dotted name; a bench refuses them

    @classmethod
    def everywhere(cls, settings: S, **sets: Mapping[str, Override]) -> Hyperparameters[S]:
        """The same settings in every group, and in every set but those that are given."""
        return cls({group: ConfigGroup(settings, {**{name: {} for name in SETS}, **sets}) for group in CONFIG_GROUPS})

    def names(self) -> frozenset[str]:
        """The dotted names of all settings."""
        return frozenset(flatten(next(iter(self.groups.values())).published))

    def inert(self) -> frozenset[str]:
        """The dotted names of settings that have no effect on the agent in any group."""
        return self.has_no_effect.union(frozenset[str].intersection(*(each.unused for each in self.groups.values())))

    def without(self, *names: str) -> Hyperparameters[S]:
        """The same settings of an agent on which some have no effect; their values stay in its settings."""
        return replace(self, has_no_effect=frozenset(names))

    def of(self, context: AgentContext) -> S:
        """The settings that an agent's context asks for; raises as :meth:`resolve`."""
        return self.resolve(context.hyperparameters, context.overrides, context.config_group)

    def resolve(self, hyperparameters: str, overrides: Mapping[str, Setting], group: str) -> S:
        """The settings of a set, with single ones replaced.

        Args:
            hyperparameters: Name of a set of the group.
            overrides: Values by dotted name, such as ``{"controller.discount": 0.9}``.
            group: A name of :attr:`groups`.

        Raises:
            UnknownNameError: No such group, set, setting or word; the message lists all that exist.
            InvalidValueError: A value of the wrong type or out of its range.
        """
        chosen = self.groups[require_known("config group", group, self.groups)]
        changes = chosen.sets[require_known("set of hyperparameters", hyperparameters, chosen.sets)]
        given = checked(chosen.published, overrides)
        used = {name: value for name, value in given.items() if name not in chosen.unused}
        return replaced(chosen.published, {**{name: change.value for name, change in changes.items()}, **used})


def flatten(settings: DataclassInstance) -> dict[str, Setting]:
    """Every setting by dotted name."""
    return {name: value for name, value, _, _ in _walk(settings)}


def replaced(settings: S, values: Mapping[str, Setting]) -> S:
    """The settings with values replaced by dotted name; a section's own rules are checked once it is whole."""
    own: dict[str, Setting] = {}
    sections: dict[str, dict[str, Setting]] = {}
    for name, value in values.items():
        section, _, inner = name.rpartition(".")
        (sections.setdefault(section, {}) if section else own)[inner] = value
    own |= {section: replaced(getattr(settings, section), inner) for section, inner in sections.items()}
    return replace(settings, **own)


def checked(settings: DataclassInstance, values: Mapping[str, Setting]) -> dict[str, Setting]:
    """Values by dotted name, each of its setting's type and within its range; raises as ``resolve``."""
    declared = {name: (hint, allowed) for name, _, hint, allowed in _walk(settings)}
    found = {}
    for name, value in values.items():
        if name not in declared:
            raise UnknownNameError("setting", name, declared)
        hint, allowed = declared[name]
        found[name] = typed = _typed(name, hint, value)
        if isinstance(allowed, tuple):
            require_known(f"value of setting {name}:", str(typed), allowed)
        elif typed is not None and not allowed.holds(typed):
            raise InvalidValueError(f"Setting {name} is {brief(typed)}; it {allowed.words}.")
    return found


def _walk(settings: DataclassInstance, prefix: str = "") -> Iterator[tuple[str, Setting, type, Allowed]]:
    """Name, value, type and range of every setting."""
    hints = get_type_hints(type(settings))
    for part in fields(settings):
        value = getattr(settings, part.name)
        name = f"{prefix}{part.name}"
        if is_dataclass(value) and not isinstance(value, type):
            yield from _walk(value, f"{name}.")
        else:
            yield name, value, hints[part.name], part.metadata["allowed"]


def _typed(name: str, hint: type, value: Setting) -> Setting:
    """``value`` as the type ``hint``, where nothing is lost by it."""
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    for option in options:
        if option is type(None) and value is None:
            return None
        if option is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(min(max(value, -_HUGE), _HUGE)) if isinstance(value, int) else value
        if get_origin(option) is tuple and isinstance(value, list | tuple):
            if all(type(item) is int for item in value):
                return tuple(value)
        elif isinstance(option, type) and type(value) is option:
            return value
    raise InvalidValueError(f"Setting {name!r} was given {brief(value)}; it takes {kind_in_words(hint)}.")
