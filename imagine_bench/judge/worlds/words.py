"""Questions about a whole world in words and images, for a person."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from imagine_bench.arrays import State
from imagine_bench.judge.worlds.tables import Transitions

YES = 1
NO = 0
Shown = tuple[str, State | None]
"""The words above an image, and the macrostate that it shows; None for a hidden one."""


class Words(NamedTuple):
    """A question for a person."""

    text: str
    images: Sequence[Shown]
    answers: Sequence[str] = ()
    answer_images: Sequence[State] = ()  # macrostates whose images are the answers, where these are no words


class Named(NamedTuple):
    """The names of a world for a person."""

    states: Sequence[State]  #: the T macrostates
    actions: Sequence[str]  #: names of macro-actions
    factors: Sequence[str]  #: names of a macrostate's parts

    def of_stream(self, shown: Transitions, row: int) -> list[Shown]:
        """The images of transitions that do not follow one another, each before and after."""
        images: list[Shown] = []
        each = zip(shown.states[row], shown.actions[row], shown.reached[row], strict=True)
        for number, (before, action, after) in enumerate(each, 1):
            images.append((f"{number}. before", self.states[before]))
            images.append((f"after: {self.actions[action]}", self.states[after]))
        return images

    def chosen(self, rows: Iterable[int]) -> list[State]:
        """The macrostates of some rows."""
        return [self.states[row] for row in rows]


def yes_and_no(options: Iterable[int]) -> list[str]:
    """Those options in words."""
    return ["yes" if option == YES else "no" for option in options]
