"""Episodes, and greedy test episodes: the same starts for every agent and seed, none of them ever a training start."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Agent, Observation, State, Transition
from imagine_bench.interfaces.capabilities import begin_episode
from imagine_bench.running.counters import Counters, EvaluationCounts, Played
from imagine_bench.seeding import Purpose, episode_seed

Info = dict[str, Any]
Env = gymnasium.Env[Any, Any]


class ByName(gymnasium.ObservationWrapper[Any, Any, Any]):
    """An observation of one part, as a dict of that part."""

    def __init__(self, env: Env, name: str) -> None:
        super().__init__(env)
        self._name = name
        self.observation_space = gymnasium.spaces.Dict({name: env.observation_space})

    def observation(self, observation: Any) -> dict[str, Any]:
        """See above."""
        return {self._name: observation}


def play(
    env: Env,
    agent: Agent,
    *,
    seed: int,
    explore: bool,
    privileged: bool,
    before_acting: Callable[[Observation, Info], None] | None = None,
) -> Iterator[tuple[Transition, Info]]:
    """One episode, a real transition at a time, each with the ``info`` that followed it; the agent learns nothing here.

    ``seed`` decides the whole episode but for the agent: the environment carries nothing over from the one before.
    Before each macro-action, ``before_acting`` is called with what the agent sees and the ``info`` that it does not.
    """
    frame, info = env.reset(seed=seed)
    _require_sound(env, frame, 0.0)
    begin_episode(agent)
    before = Observation.of(frame, info, privileged=privileged)
    over = False
    while not over:
        if before_acting is not None:
            before_acting(before, info)
        action = agent.act(before, explore=explore)
        frame, reward, terminated, truncated, info = env.step(action)
        _require_sound(env, frame, reward)
        after = Observation.of(frame, info, privileged=privileged)
        transition = Transition(
            observation=before, action=action, reward=float(reward), next_observation=after,
            terminated=bool(terminated), truncated=bool(truncated),
        )  # fmt: skip
        yield transition, info
        before = after
        over = terminated or truncated


def _require_sound(env: Env, seen: Any, reward: Any) -> None:
    """Raise InvalidValueError for what no agent should be shown: a package's environment can give anything."""
    space = env.observation_space
    named = isinstance(space, gymnasium.spaces.Dict) and isinstance(seen, Mapping)
    for name, wanted in space.spaces.items() if named else [("frame", space)]:  # type: ignore[attr-defined]
        part = seen.get(name) if named else seen
        more = "'imagine-bench check --task' finds such faults."
        if isinstance(wanted, gymnasium.spaces.Box):
            given = (getattr(part, "shape", None), getattr(part, "dtype", type(part)))
            if given != (wanted.shape, wanted.dtype):
                raise InvalidValueError(
                    f"{env} gave a {name} of {given[1]} and shape {given[0]}; it declares {wanted.dtype} of shape "
                    f"{wanted.shape}. {more}"
                )
            if part.dtype.kind == "f" and not np.isfinite(part).all():
                raise InvalidValueError(f"{env} gave a {name} with NaN or infinity. {more}")
    if not math.isfinite(reward):
        raise InvalidValueError(f"{env} gave the reward {reward}; rewards are finite.")


def play_test_episode(counts: EvaluationCounts, env: Env, agent: Agent, *, privileged: bool, purpose: Purpose) -> None:
    """Play the next test episode of ``purpose`` greedily and count it; the count says which start it has."""
    start_s = time.process_time()
    begun = list[Played]()

    def begin(observation: Observation, info: Info) -> None:
        if not begun:
            begun.append(Played.begun(env, info))

    seed = episode_seed(purpose, 0, counts.episodes)
    for transition, info in play(env, agent, seed=seed, explore=False, privileged=privileged, before_acting=begin):
        begun[0].add(transition.action, transition.reward, info)
    counts.add(begun[0])
    counts.cpu_s += time.process_time() - start_s


def replay(env: Env, seed: int, actions: Sequence[int]) -> tuple[Played, bool]:
    """Play the macro-actions of an episode again, as far as it goes, and whether it ends with the last of them."""
    _, info = env.reset(seed=seed)
    played = Played.begun(env, info)
    over = False
    for action in actions:
        if over or action not in env.action_space:
            return played, False
        _, reward, terminated, truncated, info = env.step(action)
        played.add(action, float(reward), info)
        over = terminated or truncated
    return played, bool(over)


class Watched(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Counts where training episodes start and which macro-actions are tried where; the agent is told nothing."""

    def __init__(self, env: Env, counters: Counters) -> None:
        super().__init__(env)
        self._counters = counters
        self._at = list[int]()

    def reset(self, **options: Any) -> tuple[Any, Info]:
        """As the environment's."""
        seen, info = self.env.reset(**options)
        self._at = np.asarray(info["macrostate"]).tolist()
        self._counters.starts.append(self._at)
        return seen, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, Info]:
        """As the environment's."""
        after = self.env.step(action)
        self._counters.try_out(self._at, int(action))
        self._at = np.asarray(after[4]["macrostate"]).tolist()
        return after


class StartsFrom(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Starts every episode in one of some macrostates, equally likely, that its seed decides."""

    def __init__(self, env: Env, starts: Sequence[State]) -> None:
        super().__init__(env)
        self._starts = tuple(starts)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Info]:
        """Start an episode, where ``options`` say so if they do."""
        if options is None:
            rng = np.random.default_rng(seed)
            options = {"macrostate": self._starts[int(rng.integers(len(self._starts)))]}
        return self.env.reset(seed=seed, options=options)


class TrainingStarts(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Starts each training episode of a run where every agent of that seed starts it, whatever seed a loop asks for."""

    def __init__(self, env: Env, seed: int) -> None:
        super().__init__(env)
        self._seed = seed
        self._episode = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Info]:
        """Start the next training episode; ``seed`` changes nothing."""
        start = episode_seed("training", self._seed, self._episode)
        self._episode += 1
        return self.env.reset(seed=start, options=options)
