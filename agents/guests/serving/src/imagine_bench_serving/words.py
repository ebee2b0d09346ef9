"""A task in words, for whoever answers in words: the goal, the effects of macro-actions, and the content of a frame.

The words of a moment tell the value of each coordinate of the macrostate in the frame of that moment, as a perfect
probe reads it, or that the coordinate is not seen; nothing else. They tell no rule that the description of the task
does not, no plan, and no probability.
"""

from __future__ import annotations

from imagine_bench.arrays import Info
from imagine_bench.interfaces import TaskSpec
from imagine_bench.rules import ending

_SEES = (
    "The scene is seen by a camera on the robot's hand. Up in its image is toward the human, and down is toward the "
    "robot, which is the agent."
)
_OF_TASKS = {
    "arrow": "Clockwise is as a clock's hands turn in the image. A clockwise quarter turn takes an arrow that points "
    "toward the human to the right, from the right toward the agent, from there to the left, and from the left toward "
    "the human.",
    "pick_place": "The ball stands on the left, the car in the middle and the cup on the right. A picked object is in "
    "the robot's hand; only one can be there.",
}
"""The effects of macro-actions that one look at the scene shows, by the beginning of the task's name."""


def briefing(spec: TaskSpec) -> str:
    """The task in words: the goal, the view, the macro-actions by number, and how an episode ends."""
    more = [words for name, words in _OF_TASKS.items() if spec.id.startswith(name)]
    actions = [f"{number}: {name}" for number, name in enumerate(spec.action_names)]
    ends = (
        f"An episode ends when the goal is reached, when a macro-action breaks a rule, or after {spec.horizon} "
        "macro-actions. After each one you are told its reward and what is seen. Macro-actions, by number:"
    )
    return "\n".join([f"{spec.title}. {spec.description}", _SEES, *more, ends, *actions])


def seen_in_words(spec: TaskSpec, info: Info) -> str:
    """The content of a frame in words: each coordinate's name and value."""
    shown = info["shown"] if "shown" in info else info["macrostate"]
    values = spec.value_names(shown)
    pairs = zip(spec.macrostate_names, values, strict=True)
    return f"Seen now: {'; '.join(f'{name}: {value}' for name, value in pairs)}."


def done_in_words(spec: TaskSpec, action: int, reward: float) -> str:
    """A macro-action and its reward, in words."""
    return f"You did {action}: {spec.action_names[action]}. Reward {reward:+g}."


def end_in_words(info: Info, *, terminated: bool) -> str:
    """How an episode ended, in words."""
    return f"The episode is over: {ending(info, terminated=terminated)}."
