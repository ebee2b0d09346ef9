"""Measures how often planned motions succeed, macro-action by macro-action, for the certificate of continuous control.

A segment is one macro-action of :class:`.expert.Expert`, by hand twists. It is as ruled if its only event is this
macro-action, without a fault, and if the hand is back near its observation pose at the end. In a world whose grips slip
by chance, a segment whose grip slipped is as ruled if it has no event.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from imagine_bench.arrays import Floats, State
from imagine_bench.errors import InvalidValueError
from imagine_bench.rules import states_of_play

from ..scenes.arm import ARM_JOINTS, arm_columns
from ..scenes.constants import OBSERVATION_QPOS_RAD
from ..world import MAX_SKEW_RAD
from .controls import HAND_SPEED_M_S, HAND_TURN_RAD_S, MOST_OPEN_M
from .env import MotionEnv
from .expert import Expert

START_M = 0.04
START_RAD = math.radians(15.0)
"""A segment starts with the hand off its observation pose by up to so much along each axis, and about the vertical."""
_MOVE_PERIODS = 10
"""Periods in which the hand is moved there."""
_DRAWN_AT_ONCE = 25
"""Random actions that are drawn and carried out together, which is quicker and does the same."""
_PADS_M = 0.022
"""The point between the fingers is at most so far above an object that both touch: half the diagonal of a pad."""
_LEAST_TURN_RAD = math.pi / 2 - MAX_SKEW_RAD
"""A cube that is turned by less still has its direction."""
_SINKS_M = 0.01
"""An object that is put down may rest so much higher than it stands."""


@dataclass(kw_only=True)
class Measured:
    """All segments at one appearance, whole episodes, and counts of a random policy; can be written as JSON."""

    #: Of each pair: objects, macro-action, tries, those as ruled, mean and longest duration (s), and whether the
    #: episode ends there, so that the duration is without the way back to the observation pose.
    segments: list[tuple[State, int, int, int, float, float, bool]]
    pairs: int  #: (arrangement of objects, macro-action) pairs that there are
    faults: dict[str, int]  #: the most frequent reasons of those not as ruled, with their counts
    episodes: int  #: of the optimal macro-actions, one after another
    solved: int
    least_s: list[float]  #: of each pair, as :func:`least_seconds`
    time_limit_s: float  #: of the environment
    random_episodes: int = 0  #: with a uniformly random hand twist each period
    random_solved: int = 0


def measure(env: MotionEnv, *, tries: int, turns: int) -> Measured:
    """Measure all that a certificate needs, but for chance.

    Args:
        env: An environment of the task, by hand twists.
        tries: Segments, spread evenly over the pairs, each pair once at least; of more pairs, a sample of so many.
        turns: Macro-actions of whole episodes of the optimal policy; the last episode is played to its end.

    Raises:
        InvalidValueError: An environment with a placement, which the certificate does not tell apart.
    """
    if env.placement_m:
        raise InvalidValueError(
            f"placement is {env.placement_m:g}; a certificate is of objects on their slots, so leave it out."
        )
    rng = np.random.default_rng(0)
    pairs = _pairs(env)
    chosen = pairs if len(pairs) <= tries else [pairs[each] for each in sorted(rng.permutation(len(pairs))[:tries])]
    expert = Expert(env, env.another_world())
    faults: Counter[str] = Counter()
    segments = []
    for number, (state, action) in enumerate(chosen):
        rng = np.random.default_rng([0, number])
        seconds = []
        as_ruled = 0
        for attempt in range(math.ceil(tries / len(chosen))):
            env.reset(seed=10_000 * number + attempt, options={"macrostate": state})
            if attempt:
                move_aside(env, rng)
            fault, taken_s = _segment(env, expert, action)
            seconds.append(taken_s)
            as_ruled += fault is None
            faults.update([fault] if fault else [])
        mean_s = round(float(np.mean(seconds)), 3)
        longest_s = round(max(seconds), 3)
        ends = env.task.rules.outcomes(state, action)[0].terminated
        segments.append((state[:-1], action, len(seconds), as_ruled, mean_s, longest_s, ends))
    solved = _episodes(env, expert, turns)
    return Measured(
        segments=segments,
        pairs=len(pairs),
        faults=dict(faults.most_common(10)),
        episodes=len(solved),
        solved=sum(solved),
        least_s=[least_seconds(env, state, action) for state, action in chosen],
        time_limit_s=env.time_limit_s,
    )


def least_seconds(env: MotionEnv, state: State, action: int) -> float:
    """A lower bound of the duration of a segment, in whole control periods; docs/explanation/certificates.md proves it.

    The hand moves at the largest twist. Only heights count. A standing object is gripped where it stands, turned if
    its macro-action turns it, and the hand comes back if the episode goes on. A held object is thrown down.
    """
    outcome = env.task.rules.outcomes(state, action)[0]
    after_m, _ = _heights_m(env, outcome.macrostate)
    before_m, tops_m = _heights_m(env, state)
    (index,) = np.flatnonzero(np.not_equal(state[:-1], outcome.macrostate[:-1]))
    hand_m = env.controls.hand_pose(np.array(OBSERVATION_QPOS_RAD))[0][2] - START_M
    drop_m = before_m[index] - after_m[index]
    if drop_m > START_M:
        gravity_m_s2 = -float(env.model.opt.gravity[2])
        fall_m = max(0.0, drop_m - START_M - _SINKS_M)
        seconds = (math.sqrt(HAND_SPEED_M_S**2 + 2.0 * gravity_m_s2 * fall_m) - HAND_SPEED_M_S) / gravity_m_s2
    else:
        is_turned = abs(drop_m) < _SINKS_M
        ways = 1 if outcome.terminated else 2
        seconds = ways * max(0.0, hand_m - tops_m[index] - _PADS_M - _SINKS_M) / HAND_SPEED_M_S
        seconds += is_turned * _LEAST_TURN_RAD / HAND_TURN_RAD_S
    return round(math.ceil(seconds / env.period_s - 1e-9) * env.period_s, 3)


def _heights_m(env: MotionEnv, state: State) -> tuple[Floats, Floats]:
    """Heights of the objects of a macrostate, and of their tops. Shapes (N,)."""
    env.restart(seed=0, options={"macrostate": state})
    model = env.model
    upward = env.data.geom_xmat[:, 6:]
    centers, halves = np.hsplit(model.geom_aabb, 2)
    tops_m = env.data.geom_xpos[:, 2] + (upward * centers + np.abs(upward) * halves).sum(axis=1)
    highest_m = [
        tops_m[(model.geom_bodyid == body) & (model.geom_contype > 0)].max() for body in env.world.object_bodies
    ]
    return env.world.object_poses()[:, 2], np.array(highest_m)


def _pairs(env: MotionEnv) -> list[tuple[State, int]]:
    """For each arrangement of objects and macro-action that changes it, a macrostate; one that goes on, if any does."""
    rules = env.task.rules
    found: dict[tuple[State, int], tuple[bool, State]] = {}
    for state in states_of_play(rules):
        for action in range(rules.n_actions):
            outcomes = rules.outcomes(state, action)
            goes_on = not outcomes[0].terminated
            if all(each.macrostate[:-1] == state[:-1] for each in outcomes):
                continue
            best, _ = found.get((state[:-1], action), (False, state))
            if goes_on or not best:
                found[state[:-1], action] = (goes_on, state)
    return [(state, action) for (_, action), (_, state) in found.items()]


def move_aside(env: MotionEnv, rng: np.random.Generator) -> None:
    """Move the hand off its observation pose, as far as starts may be."""
    offset: Floats = np.append(START_M * rng.uniform(-1, 1, 3), START_RAD * rng.uniform(-1, 1))
    twist = offset / np.array([HAND_SPEED_M_S] * 3 + [HAND_TURN_RAD_S]) / (_MOVE_PERIODS * env.period_s)
    grip = 2.0 * env.data.ctrl[arm_columns(env.model).ctrl[-1]] / MOST_OPEN_M - 1.0
    for _ in range(_MOVE_PERIODS):
        env.step(np.array([*twist[:3], 0.0, 0.0, twist[3], grip], dtype=np.float32))


def _segment(env: MotionEnv, expert: Expert, action: int) -> tuple[str | None, float]:
    """Why a macro-action was not as ruled, or None; and its seconds."""
    before = env.episode.macrostate
    began_s = env.elapsed_s
    expert.begin(action)
    events = []
    over = slipped = False
    while not (expert.is_done or over):
        _, _, terminated, truncated, info = env.step(expert.act())
        over = bool(terminated or truncated)
        slipped |= env.episode.slipping
        if info["event"]:
            events.append(info)
    seconds = env.elapsed_s - began_s
    if expert.refused or len(events) != int(not slipped):
        return expert.refused or f"{len(events)} events{' of a grip that slipped' * slipped}", seconds
    for event in events:
        reached = tuple(event["macrostate"].tolist())
        if event["fault"] or reached not in [each.macrostate for each in env.task.rules.outcomes(before, action)]:
            return str(event["fault_reason"]) or "another macro-action", seconds
    if slipped and over:
        return str(info["fault_reason"]) or "the episode ended as the grip slipped", seconds
    strayed = not over and _is_far(env)
    return "the hand ended further off than segments start" if strayed else None, seconds


def _is_far(env: MotionEnv) -> bool:
    """Whether the hand is further off its observation pose than where segments start."""
    now_m, now = env.controls.hand_pose(env.data.qpos[arm_columns(env.model).qpos[: len(ARM_JOINTS)]])
    rest_m, rest = env.controls.hand_pose(np.array(OBSERVATION_QPOS_RAD))
    cos = (np.trace(now.T @ rest) - 1.0) / 2.0
    return bool(np.linalg.norm(now_m - rest_m) > START_M or cos < math.cos(START_RAD))


def _episodes(env: MotionEnv, expert: Expert, turns: int) -> list[bool]:
    """Of each whole episode of optimal macro-actions, one after another, whether it is solved."""
    solved: list[bool] = []
    done = 0
    while done < turns:
        env.reset(seed=len(solved))
        over = False
        while not over:
            expert.begin(env.task.rules.optimal_action(env.episode.macrostate))
            done += 1
            while not (expert.is_done or over):
                _, _, terminated, truncated, info = env.step(expert.act())
                over = bool(terminated or truncated)
        solved.append(bool(info["is_success"]))
    return solved


def random_episode(env: MotionEnv, seed: int) -> bool:
    """Whether uniformly random actions, a new one each period, solve an episode."""
    rng = np.random.default_rng([seed, 1])  # seed alone would repeat the numbers that the start was drawn with
    env.restart(seed=seed)
    space = env.controls.space
    while True:
        actions = rng.uniform(space.low, space.high, (_DRAWN_AT_ONCE, *space.shape))
        last = env.carry_out(actions)[-1]
        if last.terminated or last.truncated:
            return last.success
