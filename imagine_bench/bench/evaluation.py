"""Episodes, and greedy test episodes: the same starts for every agent and seed, none of them ever a training start."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from imagine_bench.bench.cohort import cpu_time_s
from imagine_bench.interfaces import Agent, Observation, Transition
from imagine_bench.seeding import Purpose, episode_seed

Info = dict[str, Any]


def observation(frame: Any, info: Info, *, privileged: bool) -> Observation:
    """What an agent may see of a step: the macrostate only if it is registered as privileged."""
    return Observation(frame=frame, macrostate=np.asarray(info["macrostate"]) if privileged else None)


def play(
    env: gymnasium.Env[Any, Any],
    agent: Agent,
    *,
    seed: int,
    explore: bool,
    privileged: bool,
    before_acting: Callable[[Observation, Info], None] | None = None,
) -> Iterator[tuple[Transition, Info]]:
    """One episode, a real transition at a time; the agent learns nothing here.

    Args:
        env: The task's environment.
        agent: Chooses the macro-actions.
        seed: Decides the whole episode but for the agent: the environment carries nothing over from the one before.
        explore: Whether the agent explores.
        privileged: Whether it is shown the macrostate.
        before_acting: Called with what the agent sees and the ``info`` that it does not, before each macro-action.

    Yields:
        Each transition with the ``info`` that followed it.
    """
    frame, info = env.reset(seed=seed)
    before, over = observation(frame, info, privileged=privileged), False
    while not over:
        if before_acting is not None:
            before_acting(before, info)
        action = agent.act(before, explore=explore)
        frame, reward, terminated, truncated, info = env.step(action)
        after = observation(frame, info, privileged=privileged)
        yield (
            Transition(
                observation=before,
                action=action,
                reward=float(reward),
                next_observation=after,
                terminated=bool(terminated),
                truncated=bool(truncated),
            ),
            info,
        )
        before, over = after, terminated or truncated


class TrainingStarts(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Starts each training episode of a run where every agent of that seed starts it, whatever seed a loop asks for.

    Args:
        env: The task's environment.
        seed: The run's seed.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], seed: int) -> None:
        super().__init__(env)
        self._seed, self._episode = seed, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Info]:
        """Start the next training episode; ``seed`` changes nothing."""
        start = episode_seed("training", self._seed, self._episode)
        self._episode += 1
        return self.env.reset(seed=start, options=options)


@dataclass
class EvaluationCounts:
    """Counts over test episodes; a checkpoint may carry them half way.

    Attributes:
        episodes: Test episodes done.
        successes: Those that ended in success.
        env_steps: Macro-actions in them.
        return_sum: Sum of their undiscounted returns.
        faults: Macro-actions whose physics disagreed with the rules.
        cpu_s: CPU seconds spent.
        diagnostics: The agent's own means at the moment the test began.
    """

    episodes: int = 0
    successes: int = 0
    env_steps: int = 0
    return_sum: float = 0.0
    faults: int = 0
    cpu_s: float = 0.0
    diagnostics: dict[str, float] = field(default_factory=dict)

    def add_episode(
        self, env: gymnasium.Env[Any, Any], agent: Agent, *, privileged: bool, purpose: Purpose = "evaluation"
    ) -> None:
        """Play the next test episode of ``purpose`` greedily and count it; the count says which start it has."""
        start_s = cpu_time_s()
        seed, success = episode_seed(purpose, 0, self.episodes), False
        for transition, info in play(env, agent, seed=seed, explore=False, privileged=privileged):
            self.env_steps += 1
            self.return_sum += transition.reward
            self.faults += bool(info["fault"])
            success = bool(info["is_success"])
        self.episodes += 1
        self.successes += success
        self.cpu_s += cpu_time_s() - start_s
