"""Motions at the level of commands, with their results: the data and the questions of models of motion.

A question is a frame of the scene at rest and all commands of a motion; the answer is the macrostate that the simulator
ends in. Shapes: ``N`` motions, ``T`` control periods of the longest, ``A`` numbers of an action.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from imagine_bench.arrays import Floats32, Frame, Ints, State
from imagine_bench.interfaces.motion import Motions
from imagine_bench.rules import states_of_play
from imagine_bench.tasks.continuous.controls import HAND_SPEED_M_S
from imagine_bench.tasks.continuous.env import RATE_HZ, MotionEnv
from imagine_bench.tasks.continuous.expert import Expert

VARIANTS = ("planned", "aside", "raised")
"""How a motion differs from the planner's: not at all; 8 mm to a side; 60 mm higher, so that it grips nothing."""
ASIDE_M = 0.008
RAISED_M = 0.06
_SHARES = (0.5, 0.25, 0.25)
_BLEND = 8
"""Control periods at the start over which a motion is shifted, and at the end over which it comes back."""
PERIOD_S = 1.0 / RATE_HZ
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

    def draw(self, n: int, rng: np.random.Generator) -> AnsweredMotions:
        """Motions from macrostates in which an episode can be, of all variants."""
        rules = self._env.task.rules
        states = states_of_play(rules)
        rows = []
        for _ in range(n):
            state = states[int(rng.integers(len(states)))]
            action = int(rng.integers(rules.n_actions))
            variant = int(rng.choice(len(VARIANTS), p=_SHARES))
            rows.append(self._one(state, action, variant, rng))
        return _stacked(rows)

    def pairs(self, n: int, rng: np.random.Generator) -> tuple[AnsweredMotions, AnsweredMotions]:
        """The same motions from equal scenes, once as planned and once raised, which changes nothing."""
        rules = self._env.task.rules
        states = states_of_play(rules)
        rows: tuple[list[_Row], list[_Row]] = ([], [])
        for _ in range(n):
            state = states[int(rng.integers(len(states)))]
            action = int(rng.integers(rules.n_actions))
            seed = int(rng.integers(2**31))
            for side, variant in zip(rows, ("planned", "raised"), strict=True):
                side.append(self._one(state, action, VARIANTS.index(variant), np.random.default_rng(seed)))
        return _stacked(rows[0]), _stacked(rows[1])

    def chains(self, n: int, depth: int, rng: np.random.Generator) -> list[AnsweredMotions]:
        """Planned motions one after another, each from where the one before ended; by depth."""
        rules = self._env.task.rules
        states = states_of_play(rules)
        rows: list[list[_Row]] = [[] for _ in range(depth)]
        for _ in range(n):
            self._env.reset(
                seed=int(rng.integers(2**31)), options={"macrostate": states[int(rng.integers(len(states)))]}
            )
            for each in rows:
                each.append(self._go_on(int(rng.integers(rules.n_actions))))
        return [_stacked(each) for each in rows]

    def _one(self, state: State, action: int, variant: int, rng: np.random.Generator) -> _Row:
        env = self._env
        seed = int(rng.integers(2**31))
        env.reset(seed=seed, options={"macrostate": state})
        planned = self._go_on(action).actions[:-_CALM]
        commands = _varied(planned, VARIANTS[variant], rng)
        env.reset(seed=seed, options={"macrostate": state})
        return self._carried_out(commands, action, variant)

    def _go_on(self, action: int) -> _Row:
        """Plan a macro-action from where the scene stands, and carry it out."""
        env = self._env
        before = env.get_state()
        self._expert.begin(action)
        planned = []
        while not self._expert.is_done:
            planned.append(self._expert.act())
            env.act(planned[-1])
        env.set_state(before)
        return self._carried_out(_varied(np.array(planned), "planned", np.random.default_rng(0)), action, 0)

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
