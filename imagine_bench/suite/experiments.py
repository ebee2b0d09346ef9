"""What the suite asks: experiments of a few levels each, fixed, named and hashed (after bsuite, Osband et al. 2020).

Every level is an ordinary bench: a task, what its protocol changes, and a number of real episodes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from imagine_bench.errors import InvalidValueError, require_known
from imagine_bench.protocols.data import digest

AGENTS = ("dqn", "imagination_uncertainty", "factored:given")
"""The agents that are compared where none are named."""
MEASURES = ("success", "auroc")
"""``"success"`` of test episodes, between chance and optimum of the level's certificate; or ``"auroc"``, with which
epistemic uncertainty tells wrong imagined transitions from right ones, between 0.5 and 1."""


@dataclass(frozen=True, kw_only=True)
class Level:
    """One position of an experiment's dial."""

    name: str  #: The position, for axes and tables
    task: str  #: Canonical name of the world
    episodes: int = 250  #: Real training episodes, on this task
    protocol: Mapping[str, Any] = field(default_factory=dict)  #: More fields of the protocol that differ


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One capability, and the dial that asks for more and more of it."""

    name: str
    dial: str  #: What its levels change, in words
    question: str  #: For a reader of the report
    levels: tuple[Level, ...]
    measure: str = "success"  #: One of :data:`MEASURES`


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Experiments, and what all their protocols share. Raises InvalidValueError: a name given twice."""

    name: str
    experiments: tuple[Experiment, ...]
    seeds: tuple[int, ...] = (0, 1)
    evaluation_episodes: int = 100
    execution: str = "kinematic"
    hyperparameters: str = "fast"

    def __post_init__(self) -> None:
        for what, names in (
            ("experiments", [each.name for each in self.experiments]),
            *((f"levels of {each.name}", [level.name for level in each.levels]) for each in self.experiments),
        ):
            if not names or len(set(names)) < len(names):
                raise InvalidValueError(f"{self.name} has the {what} {names}; give at least one, each name once.")

    @property
    def hash(self) -> str:
        """12 hex digits that change when anything in any level does; seeds and tests count, too."""
        return digest(dataclasses.asdict(self))

    def only(self, names: Sequence[str]) -> Suite:
        """The suite with some of its experiments, or all where none are named. Raises UnknownNameError."""
        known = {each.name: each for each in self.experiments}
        wanted = {require_known("experiment", name, known) for name in names} or set(known)
        return dataclasses.replace(self, experiments=tuple(known[name] for name in known if name in wanted))


def _dial(template: str, values: Sequence[object], **changes: Any) -> tuple[Level, ...]:
    """Levels whose name is a value, and whose task is the template with that value."""
    return tuple(Level(name=str(value), task=template.format(value), **changes) for value in values)


LADDER = Suite(
    name="ladder",
    experiments=(
        Experiment(
            name="perception", dial="appearance", question="Does it see through light, colors, camera and poses?",
            levels=tuple(
                Level(name=look, task="arrows", protocol={"appearance": look}) for look in ("clean", "mild", "strong")
            ),
        ),
        Experiment(
            name="size", dial="cubes", question="Does it still learn when there are more objects?",
            levels=(
                Level(name="1", task="arrow_puzzle_easy"), Level(name="2", task="arrows:cubes=2"),
                Level(name="3", task="arrows"), *_dial("arrows:cubes={}", (4, 6)),
            ),
        ),
        Experiment(
            name="plan_length", dial="mean shortest plan", question="Does it find long plans?",
            levels=(
                Level(name="1.3", task="arrows:forbid=none,horizon=3"),
                Level(name="3.1", task="arrows:goal=012,forbid=none,coupling=neighbour"),
                Level(name="4.0", task="arrows:cubes=4,goal=0123,forbid=none,coupling=neighbour"),
            ),
        ),
        Experiment(
            name="exploration", dial="chance level", question="Does it find a reward that blind choice rarely meets?",
            levels=(
                Level(name="15 %", task="arrows:goal=012,forbid=none,shuffle=1"),
                Level(name="3.8 %", task="arrows:goal=012,shuffle=1"),
                Level(name="0.4 %", task="arrows:cubes=4,goal=0123,shuffle=1"),
            ),
        ),
        Experiment(
            name="stochasticity", dial="slip", question="Does it cope with macro-actions that fail by chance?",
            levels=_dial("arrows:slip={}", (0.1, 0.2, 0.4)),
        ),
        Experiment(
            name="human", dial="fickle", question="Does it follow a human who changes their mind?",
            levels=_dial("arrows:fickle={}", (0.1, 0.2, 0.4)),
        ),
        Experiment(
            name="memory", dial="gesture", question="Does it remember what the human asked for?",
            levels=_dial("arrows:horizon=5,gesture={}", (0.75, 0.5, "first")),
        ),
        Experiment(
            name="delay", dial="lag", question="Does it act well on frames that are old?",
            levels=_dial("arrows:horizon=6,lag={}", (1, 2, 3)),
        ),
        Experiment(
            name="distraction", dial="distractors", question="Does it ignore what moves and does not matter?",
            levels=_dial("arrows:distractors={}", (1, 2, 4)),
        ),
        Experiment(
            name="structure", dial="split", question="Does it solve starts that training never had?",
            levels=tuple(
                Level(name=name, task="arrows", protocol={"split": split})
                for name, split in (
                    ("unseen pairs", "pairs=0:3:4"), ("unseen goal", "values=3:2"), ("longer plans", "plan_length=2"),
                )
            ),
        ),
        Experiment(
            name="transfer", dial="goal after arrow_puzzle",
            question="Does what it learned of the world serve another goal?",
            levels=tuple(
                Level(name=name, task=f"arrow_puzzle_{name}", episodes=50, protocol={"after": ("arrow_puzzle",)})
                for name in ("hard", "toward", "clockwise")
            ),
        ),
        Experiment(
            name="uncertainty", dial="real episodes", question="Does it know when its imagination is wrong?",
            levels=tuple(
                Level(name=str(episodes), task="arrows", episodes=episodes, protocol={"open_loop_starts": 100})
                for episodes in (50, 100, 150)
            ),
            measure="auroc",
        ),
    ),
)  # fmt: skip
"""The suite of ``make suite``; two cores are meant to be done with it within the hour."""
