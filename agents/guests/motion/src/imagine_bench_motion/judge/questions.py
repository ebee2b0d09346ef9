"""Motions at the level of commands, with their results: the data and the questions of models of motion.

A question is a frame of the scene at rest and all commands of a motion; the answer is the macrostate that the simulator
ends in. Shapes: ``N`` motions, ``T`` control periods of the longest, ``A`` numbers of an action.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from imagine_bench.tasks.continuous.controls import HAND_SPEED_M_S
from imagine_bench.tasks.continuous.env import RATE_HZ, MotionEnv
from imagine_bench.tasks.continuous.expert import Expert

from imagine_bench.arrays import Arrays, Floats32, Frame, Ints, State
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Rules
from imagine_bench.rules import states_of_play
from imagine_bench.seeding import SeedTree

from .interface import Motions

DEPTH = 4
"""Motions of a chain."""
VARIANTS = ("planned", "aside", "raised")
"""How a motion differs from the planner's: not at all; 8 mm to a side; 60 mm higher, so that it grips nothing."""
ASIDE_M = 0.008
RAISED_M = 0.06
_SHARES = (0.5, 0.25, 0.25)
_BLEND = 8
"""Control periods at the start over which a motion is shifted, and at the end over which it comes back."""
PERIOD_S = 1.0 / RATE_HZ
_TRIES = 10
"""Motions that are drawn for each pair, at most."""
_CALM = 8
"""Control periods without a command that follow a motion, so that everything comes to rest."""


@dataclass(frozen=True, kw_only=True)
class AnsweredMotions(Motions):
    """N motions, and their results."""

    variants: Ints  #: which of :data:`VARIANTS` it is. Shape (N,).
    states: Ints  #: macrostate before. Shape (N, M).
    reached: Ints  #: macrostate after. Shape (N, M).
    proper: Ints  #: 1 where the motion ended without a fault. Shape (N,).

    def first(self, n: int) -> Motions:
        """The first n motions, and of them the part that a model may learn from."""
        return Motions(**{each.name: getattr(self, each.name)[:n] for each in fields(Motions)})


@dataclass(frozen=True, kw_only=True)
class MotionQuestions:
    """The questions to every model of motions, the same for all."""

    planned: AnsweredMotions
    raised: AnsweredMotions  #: the same motions, 60 mm higher
    chains: Sequence[AnsweredMotions]  #: by depth

    def arrays(self) -> Arrays:
        """All of it by name, for a file."""
        parts = {"planned": self.planned, "raised": self.raised}
        parts |= {f"chain{depth}": each for depth, each in enumerate(self.chains)}
        return {f"{part}.{name}": array for part, motions in parts.items() for name, array in vars(motions).items()}

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> MotionQuestions:
        """The inverse of :meth:`arrays`."""
        parts: dict[str, dict[str, Any]] = {}
        for name, array in arrays.items():
            part, _, field = name.partition(".")
            parts.setdefault(part, {})[field] = array
        planned = AnsweredMotions(**parts.pop("planned"))
        raised = AnsweredMotions(**parts.pop("raised"))
        return cls(planned=planned, raised=raised, chains=[AnsweredMotions(**parts[each]) for each in sorted(parts)])


class _Row(NamedTuple):
    before: Frame
    after: Frame
    actions: Floats32
    label: int
    variant: int
    state: Ints
    reached: Ints
    proper: bool


class MotionSource:
    """Makes motions in an environment of continuous control by ``twist``.

    Args:
        env: The environment; nothing that it observes is used.
    """

    def __init__(self, env: MotionEnv) -> None:
        self._env = env
        self._expert = Expert(env, env.another_world())
        rules = env.task.rules
        self._moves = [(state, action) for state in states_of_play(rules) for action in moving_actions(rules, state)]

    def draw(self, n: int, rng: np.random.Generator) -> AnsweredMotions:
        """Motions from macrostates in which an episode can be, of all variants."""
        rows = []
        for _ in range(n):
            state, action = self._moves[int(rng.integers(len(self._moves)))]
            variant = int(rng.choice(len(VARIANTS), p=_SHARES))
            rows.append(self._one(state, action, variant, rng))
        return _stacked(rows)

    def pairs(self, n: int, rng: np.random.Generator) -> tuple[AnsweredMotions, AnsweredMotions]:
        """The same motions from equal scenes, once as planned and once raised, which end in different macrostates.

        A pair that ends in one macrostate, as where a held object is let go a little higher, is drawn again.

        Raises:
            InvalidValueError: In this world too few such motions end differently.
        """
        rows: tuple[list[_Row], list[_Row]] = ([], [])
        for _ in range(_TRIES * n):
            if len(rows[0]) == n:
                break
            state, action = self._moves[int(rng.integers(len(self._moves)))]
            seed = int(rng.integers(2**31))
            planned, raised = (
                self._one(state, action, VARIANTS.index(variant), np.random.default_rng(seed))
                for variant in ("planned", "raised")
            )
            if planned.proper and raised.proper and moved(planned.reached, raised.reached):
                rows[0].append(planned)
                rows[1].append(raised)
        if len(rows[0]) < n:
            raise InvalidValueError(
                f"Only {len(rows[0])} of {_TRIES * n} motions end otherwise when they are raised; {n} are needed. "
                "Give another task."
            )
        return _stacked(rows[0]), _stacked(rows[1])

    def chains(self, n: int, depth: int, rng: np.random.Generator) -> list[AnsweredMotions]:
        """Planned motions one after another, each from where the one before ended; by depth."""
        rows: list[list[_Row]] = [[] for _ in range(depth)]
        for _ in range(n):
            start, _ = self._moves[int(rng.integers(len(self._moves)))]
            self._env.reset(seed=int(rng.integers(2**31)), options={"macrostate": start})
            for each in rows:
                actions = self._lasting(self._env.episode.macrostate)
                action = actions[int(rng.integers(len(actions)))]
                commands = _varied(self._planned(action), "planned", rng)
                each.append(self._carried_out(commands, action, VARIANTS.index("planned")))
        return [_stacked(each) for each in rows]

    def _lasting(self, state: State) -> list[int]:
        """Macro-actions that move an object, and after which another one can."""
        rules = self._env.task.rules
        found = []
        for action in moving_actions(rules, state):
            reached = rules.outcomes(state, action)[0].macrostate
            if moving_actions(rules, reached):
                found.append(action)
        return found

    def _one(self, state: State, action: int, variant: int, rng: np.random.Generator) -> _Row:
        self._env.reset(seed=int(rng.integers(2**31)), options={"macrostate": state})
        commands = _varied(self._planned(action), VARIANTS[variant], rng)
        return self._carried_out(commands, action, variant)

    def _planned(self, action: int) -> Floats32:
        """The commands (T, A) of a macro-action from where the scene stands, which is not changed.

        A command follows from the servos' commands before it alone, so nothing is simulated.
        """
        servos = self._env.data.ctrl
        before = servos.copy()
        self._expert.begin(action)
        planned = []
        while not self._expert.is_done:
            planned.append(self._expert.act())
            self._env.tell_servos(planned[-1])
        servos[:] = before
        return np.array(planned)

    def _carried_out(self, commands: Floats32, action: int, variant: int) -> _Row:
        env = self._env
        before = env.agent_view()
        state = np.array(env.episode.macrostate)
        faulty = False
        for command in commands:
            *_, info = env.act(command)
            faulty = faulty or bool(info["fault"])
        return _Row(
            before=before,
            after=env.agent_view(),
            actions=commands,
            label=action,
            variant=variant,
            state=state,
            reached=np.array(env.world.read().macrostate),
            proper=not faulty,
        )


def moved(before: Ints | State, after: Ints | State) -> bool:
    """Whether two macrostates differ in an object; their last number is a person's gesture."""
    return not np.array_equal(before[:-1], after[:-1])


def moving_actions(rules: Rules, state: State) -> list[int]:
    """The macro-actions that move an object by the rules, where nothing goes wrong."""
    return [action for action in range(rules.n_actions) if moved(state, rules.outcomes(state, action)[0].macrostate)]


def questions(source: MotionSource, pairs: int, chains: int, seeds: SeedTree) -> MotionQuestions:
    """So many counterfactual pairs and chains, from seeds of their own, which no training has."""
    planned, raised = source.pairs(pairs, seeds.child("pairs").generator())
    drawn = source.chains(chains, DEPTH, seeds.child("chains").generator())
    return MotionQuestions(planned=planned, raised=raised, chains=drawn)


def _varied(planned: Floats32, variant: str, rng: np.random.Generator) -> Floats32:
    """Twist commands (T, A) of a planned motion as a variant has them, and a moment of calm."""
    commands = planned.copy()
    shift_m = np.zeros(3)
    if variant == "aside":
        angle_rad = rng.uniform(-np.pi, np.pi)
        shift_m[:2] = ASIDE_M * np.cos(angle_rad), ASIDE_M * np.sin(angle_rad)
    elif variant == "raised":
        shift_m[2] = RAISED_M
    velocity = shift_m / (_BLEND * PERIOD_S * HAND_SPEED_M_S)
    commands[:_BLEND, :3] += velocity
    commands[-_BLEND:, :3] -= velocity
    calm = np.zeros((_CALM, commands.shape[1]), dtype=commands.dtype)
    calm[:, -1] = commands[-1, -1]
    return np.clip(np.concatenate([commands, calm]), -1.0, 1.0)


def _stacked(rows: list[_Row]) -> AnsweredMotions:
    lengths = np.array([len(row.actions) for row in rows])
    actions = np.zeros((len(rows), lengths.max(), rows[0].actions.shape[1]), dtype=np.float32)
    for row, padded in zip(rows, actions, strict=True):
        padded[: len(row.actions)] = row.actions
    return AnsweredMotions(
        before=np.stack([row.before for row in rows]),
        after=np.stack([row.after for row in rows]),
        actions=actions,
        lengths=lengths,
        labels=np.array([row.label for row in rows]),
        variants=np.array([row.variant for row in rows]),
        states=np.stack([row.state for row in rows]),
        reached=np.stack([row.reached for row in rows]),
        proper=np.array([row.proper for row in rows], dtype=np.int64),
    )
