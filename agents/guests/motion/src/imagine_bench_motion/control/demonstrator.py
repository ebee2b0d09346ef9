"""Policies that give demonstrations: the scripted expert, also with errors, and commands by chance."""

from __future__ import annotations

import math

import numpy as np
from imagine_bench.tasks.continuous.controls import Motion
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench.tasks.world import World

ASIDE_M = 0.004
TURNED_RAD = math.radians(5.0)
"""Standard deviations of how far aside, along x and y, and how far turned a noisy expert takes an object to be."""
COMMAND_NOISE = 0.03
"""Standard deviation of the noise on its hand's velocity and turning, as a share of the largest."""
FAILURES = 0.15
"""The share of its macro-actions that change nothing, because the fingers let go too early."""
_HOLD = 10
"""Periods for which commands by chance are held."""


class Demonstrator:
    """Plays an environment of continuous control by twist. It sees the true scene.

    An expert carries out optimal macro-actions. One that has no effect is planned again from where the scene stands.
    A noisy expert errs where objects stand, moves with noise, and lets go too early now and then.

    Args:
        env: The environment, begun; only its scene and its rules are read.
        planner: A world like the environment's, for plans.
        policy: ``"expert"``, ``"noisy"`` or ``"random"``.
        rng: Draws errors and commands.
    """

    def __init__(self, env: MotionEnv, planner: World, policy: str, rng: np.random.Generator) -> None:
        self._env = env
        self._planner = planner
        self._expert = Expert(env, planner)
        self._policy = policy
        self._rng = rng
        self._drawn: Motion = np.zeros(len(env.control_names), np.float32)
        planner.sensing.aside_m = (0.0, 0.0)
        planner.sensing.turned_rad = 0.0

    @property
    def macro_action(self) -> int:
        """The macro-action under way, -1 where there is none."""
        return self._expert.macro_action

    def act(self) -> Motion:
        """The next command. Shape (7,), float32."""
        env = self._env
        if self._policy == "random":
            if env.episode.periods % _HOLD == 0:
                self._drawn = self._rng.uniform(-1.0, 1.0, self._drawn.shape).astype(np.float32)
            return self._drawn
        if self._expert.is_done:
            self._begin()
        if self._expert.is_done:  # no motion is known for it
            return np.zeros_like(self._drawn)
        action = self._expert.act()
        if self._policy == "noisy":
            action[:-1] += self._rng.normal(0.0, COMMAND_NOISE, len(action) - 1).astype(np.float32)
        return np.clip(action, -1.0, 1.0)

    def _begin(self) -> None:
        fails = False
        if self._policy == "noisy":
            sensing = self._planner.sensing
            x_m, y_m = self._rng.normal(0.0, ASIDE_M, 2).tolist()
            sensing.aside_m = (x_m, y_m)
            sensing.turned_rad = float(self._rng.normal(0.0, TURNED_RAD))
            fails = bool(self._rng.random() < FAILURES)
        self._expert.begin(self._env.task.rules.optimal_action(self._env.episode.macrostate), fails=fails)
