"""The parameters of a world: its name in one line, ``pick_place:slip=0.1``, the content of its frames, and its rules.

Gesture and lag: frames may hide the human's gesture, and come some macro-actions late. The first observations of an
episode repeat the start. Slip: the fingers open too early, so that a macro-action leaves all as it is. Goal change:
after a macro-action that ends nothing, the human may want something else.
"""

from __future__ import annotations

import abc
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from numbers import Integral, Real
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from imagine_bench.errors import InvalidValueError, UnknownKeywordError, brief
from imagine_bench.interfaces import ObservationModel, Outcome, Rules, State
from imagine_bench.rules import optimal_policy, tabulate
from imagine_bench.values import Setting

GESTURES = ("always", "first")
HIDDEN = -1
_OF_COMMANDS = (
    "macro-actions begin and end with objects on their slots, so give it to an environment of continuous control: "
    "gymnasium.make('imagine_bench/ArrowPuzzleMotion-v0', placement=0.03)"
)
_Seen = TypeVar("_Seen")


def _never(macrostate: State) -> bool:
    """No macrostate's gesture is always shown."""
    return False


@dataclass(frozen=True, kw_only=True)
class GestureObservation:
    """Frames of macrostates whose last coordinate, the gesture, may be hidden.

    Args:
        gesture: ``"always"``, ``"first"``, or the probability that a frame shows it.
        lag: Macro-actions that a frame is old.
        always_shown: Whether no frame hides the gesture of a macrostate; a function that a module defines,
            so that it can be pickled.
    """

    gesture: str | float
    lag: int
    always_shown: Callable[[State], bool]

    def seen(self, macrostate: State, step: int) -> tuple[tuple[float, State], ...]:
        """The content of a frame taken after ``step`` macro-actions may show, as :meth:`.ObservationModel.seen`."""
        shown = self.gesture
        if isinstance(shown, str):
            shown = float(shown == "always" or step == 0)
        if self.always_shown(macrostate):
            shown = 1.0
        both = ((shown, macrostate), (1.0 - shown, (*macrostate[:-1], HIDDEN)))
        return tuple((share, what) for share, what in both if share)


def hides(sight: ObservationModel, macrostate: State, step: int, rng: np.random.Generator) -> bool:
    """Whether a frame hides the gesture, drawn where that is a matter of chance."""
    seen = sight.seen(macrostate, step)
    which = 0 if len(seen) == 1 else int(rng.random() >= seen[0][0])
    return seen[which][1][-1] == HIDDEN


def delivered(under_way: tuple[_Seen, ...], newest: _Seen, lag: int) -> tuple[_Seen, ...]:
    """The observations under way once the newest one is taken in; the first of it is due now."""
    return (*under_way, newest)[-1 - lag :]


@dataclass(frozen=True, kw_only=True)
class WorldParameters:
    """A world by its parameters; ``str`` gives its canonical name, which tells every value but the defaults.

    Raises:
        InvalidValueError: A value of the wrong type or out of its range in ``RANGES``.
    """

    slip: float = 0.0  #: probability, up to 0.99, that a macro-action leaves all as it is
    goal_change: float = 0.0  #: probability that the human wants something else after a macro-action that ends nothing
    gesture: str | float = "always"  #: which frames show it: all, only the ``"first"``, or each with a probability
    lag: int = 0  #: macro-actions that a frame is old, 0 to 10
    distractors: int = 0  #: of no consequence, in view, 0 to 4: a screen of noise, the others balls that roll about

    FAMILY: ClassVar[str]
    SCENE: ClassVar[str]
    """Where the class of its scene lies, as ``module:name``."""
    IN_VIEW: ClassVar[tuple[str, ...]] = ("distractors",)
    """Parameters that a scene is made of."""
    RANGES: ClassVar[Mapping[str, tuple[float, float]]] = {
        "slip": (0.0, 0.99),
        "goal_change": (0.0, 1.0),
        "gesture": (0.0, 1.0),
        "lag": (0, 10),
        "distractors": (0, 4),
    }
    """Lowest and highest value of each number; integers where these are."""
    NAMED: ClassVar[Mapping[str, str]] = {"goal_change": "fickle"}
    """Parameters that canonical names spell as before, so that kept results keep their worlds; both are read."""
    MACRO_ACTIONS_ALONE: ClassVar[Mapping[str, str]] = {}
    """Parameters that continuous control cannot have, and what each says."""

    def __post_init__(self) -> None:
        for name, (low, high) in self.RANGES.items():
            if getattr(self, name) is not getattr(type(self), name) and not (name == "gesture" and self._named_gesture):
                object.__setattr__(self, name, self._in_range(name, low, high))

    @property
    def _named_gesture(self) -> bool:
        return isinstance(self.gesture, str) and self.gesture in GESTURES

    def _in_range(self, name: str, low: float, high: float) -> float:
        value = getattr(self, name)
        kind = type(low)
        right = isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
        if not right or not low <= value <= high:
            words = f"an integer from {low} to {high}" if kind is int else f"a number from {low:g} to {high:g}"
            also = f", or {' or '.join(GESTURES)}" if name == "gesture" else ""
            raise InvalidValueError(f"{name} is {brief(value)}; give {words}{also}.")
        return kind(value)

    def _usual(self, name: str) -> Setting:
        """The value that the canonical name leaves out."""
        return getattr(type(self), name)

    def __str__(self) -> str:
        common = WorldParameters.__annotations__
        own_first = sorted((each.name for each in fields(self)), key=lambda name: name in common)
        unusual = [name for name in own_first if getattr(self, name) != self._usual(name)]
        values = [f"{self.NAMED.get(name, name)}={getattr(self, name)}" for name in unusual]
        return f"{self.FAMILY}:{','.join(values)}" if values else self.FAMILY

    @property
    def words(self) -> str:
        """The part of the canonical name that tells values, as a list in a sentence."""
        return str(self).partition(":")[2].replace(",", ", ")

    def require_motion(self) -> None:
        """Raise InvalidValueError: the world has a parameter that has no meaning in continuous control."""
        for name, means in self.MACRO_ACTIONS_ALONE.items():
            if getattr(self, name) != getattr(type(self), name):
                raise InvalidValueError(f"{name}={getattr(self, name)} says {means}; leave it out at this level.")

    @property
    def plainest(self) -> Self:
        """The world with the fewest parameters that looks the same."""
        return type(self)(**{name: getattr(self, name) for name in self.IN_VIEW})

    @property
    def hash(self) -> str:
        """Eight hexadecimal digits of the canonical name."""
        return hashlib.sha256(str(self).encode()).hexdigest()[:8]

    @classmethod
    def spellings(cls) -> dict[str, str]:
        """Every name that a parameter may be given by, and the field that it means."""
        names = {each.name: each.name for each in fields(cls)}
        return names | {old: new for new, old in cls.NAMED.items()}

    @classmethod
    def taken_from(cls, options: dict[str, Setting], others: Iterable[str] = ()) -> Self:
        """The world that keyword arguments say, taken out of them.

        Raises:
            UnknownKeywordError: An argument that is neither a parameter nor one of the others.
            InvalidValueError: A parameter given twice, by both of its names; or one of continuous control alone.
        """
        spellings = cls.spellings()
        given: dict[str, Any] = {}
        for name in list(options):
            if name == "placement" and name not in others:
                raise InvalidValueError(f"placement is {brief(options[name])}; {_OF_COMMANDS}.")
            if name not in (*spellings, *others):
                raise UnknownKeywordError.of(name, (*spellings, *others))
            if name not in spellings:
                continue
            if spellings[name] in given:
                raise InvalidValueError(f"{spellings[name]} is given by both of its names; give it once.")
            given[spellings[name]] = options.pop(name)
        return cls(**given)

    @property
    def encoder_suffix(self) -> str:
        """The end of an encoder's name: the changes of frames by parameters."""
        hidden = "" if self.gesture in ("always", 1.0) else "_hidden"
        return hidden + (f"_distractors{self.distractors}" if self.distractors else "")

    def observation_model(self, always_shown: Callable[[State], bool] = _never) -> GestureObservation | None:
        """The content of frames; None where that is all, at once. For macrostates ``always_shown`` nothing is
        hidden.
        """
        if self.gesture in ("always", 1.0) and not self.lag:
            return None
        return GestureObservation(gesture=self.gesture, lag=self.lag, always_shown=always_shown)


class WorldRules(Rules):
    """The macrostate machine of a world with parameters; a task gives the effects of its macro-actions without them."""

    world: WorldParameters

    def slipped(self, macrostate: State) -> Outcome:
        """The outcome of a macro-action that leaves all as it is, for the fingers open too early."""
        return self.judge(macrostate, 0, macrostate)

    @abc.abstractmethod
    def asked_otherwise(self, outcome: Outcome) -> Sequence[Outcome]:
        """The outcomes in place of one where the human says something else, each equally likely."""

    def varied(self, macrostate: State, outcomes: tuple[Outcome, ...]) -> tuple[Outcome, ...]:
        """Outcomes of a macro-action as they are with slips and a changing goal; equal ones are one."""
        slip = self.world.slip
        change = self.world.goal_change
        if slip:
            kept = [replace(each, probability=(1.0 - slip) * each.probability) for each in outcomes]
            outcomes = (*kept, replace(self.slipped(macrostate), probability=slip))
        if not change:
            return outcomes
        chances: dict[Outcome, float] = {}
        for outcome in outcomes:
            others = () if outcome.terminated else self.asked_otherwise(outcome)
            share = change if others else 0.0
            for each, chance in ((outcome, 1.0 - share), *((other, share / len(others)) for other in others)):
                key = replace(each, probability=1.0)
                chances[key] = chances.get(key, 0.0) + outcome.probability * chance
        return tuple(replace(each, probability=chance) for each, chance in chances.items() if chance)

    def require_action(self, action: int) -> None:
        """Check a macro-action. Raises InvalidValueError: there is no such one."""
        if not 0 <= action < self.n_actions:
            raise InvalidValueError(f"Action {action} does not exist; give an integer from 0 to {self.n_actions - 1}.")

    @cached_property
    def _policy(self) -> dict[State, int]:
        tables = tabulate(self)
        return dict(zip(tables.index, optimal_policy(tables).tolist(), strict=True))

    def optimal_action(self, macrostate: State) -> int:
        """The action with the largest expected return (the lowest index among equals)."""
        return self._policy[tuple(int(value) for value in macrostate)]
