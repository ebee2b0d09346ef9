"""Episodes, and greedy test episodes: the same starts for every agent and seed, none of them ever a training start."""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, SupportsFloat, TypedDict

import gymnasium
import numpy as np

from imagine_bench.arrays import Action, Info, Observed
from imagine_bench.environments import Env, Wrapper
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Agent, Observation, State, Transition
from imagine_bench.interfaces.capabilities import begin_episode
from imagine_bench.seeding import Purpose, episode_seed
from imagine_bench.store.results import KeptEpisodes


@dataclass
class EpisodeRecord:
    """What is kept of a test episode, while it is played; see :class:`.KeptEpisodes`."""

    start: list[int]
    fingerprint: int
    actions: list[int] = field(default_factory=list)
    total: float = 0.0
    faults: int = 0
    success: bool = False

    @classmethod
    def begun(cls, env: Env, info: Info) -> EpisodeRecord:
        """One that has just been reset."""
        start = [int(value) for value in info["macrostate"]]
        return cls(start, zlib.crc32(f"{start} {env.unwrapped.np_random.bit_generator.state}".encode()))

    def add(self, action: int, reward: float, info: Info) -> None:
        """Take in one macro-action."""
        self.actions.append(int(action))
        self.total += reward
        self.faults += bool(info["fault"])
        self.success = bool(info["is_success"])
        happened = np.array([*info["macrostate"], reward], dtype=np.float64)
        self.fingerprint = zlib.crc32(happened.tobytes(), self.fingerprint)


class TestFigures(TypedDict):
    """The fields of a :class:`.Checkpoint` that follow from its test episodes."""

    test_episodes: int
    successes: int
    solved: str
    mean_return: float
    mean_length: float
    faults: int


@dataclass
class EvaluationCounts:
    """Test episodes, in their order, as :class:`.KeptEpisodes` has them; a checkpoint may carry them half way."""

    starts: list[list[int]] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    solved: str = ""  #: ``1`` for each that ended in success, ``0`` for each other
    faults: list[int] = field(default_factory=list)
    fingerprints: list[int] = field(default_factory=list)
    cpu_s: float = 0.0  #: CPU seconds spent
    diagnostics: dict[str, float] = field(default_factory=dict)  #: The agent's own means at the moment the test began

    @property
    def episodes(self) -> int:
        """Test episodes done."""
        return len(self.solved)

    @property
    def successes(self) -> int:
        """Those that ended in success."""
        return self.solved.count("1")

    def add(self, played: EpisodeRecord) -> None:
        """Count one that is over."""
        self.starts.append(played.start)
        self.lengths.append(len(played.actions))
        self.actions += played.actions
        self.returns.append(played.total)
        self.solved += "1" if played.success else "0"
        self.faults.append(played.faults)
        self.fingerprints.append(played.fingerprint)

    def figures(self) -> TestFigures:
        """The fields of a :class:`.Checkpoint` that follow from the episodes."""
        return {
            "test_episodes": self.episodes,
            "successes": self.successes,
            "solved": self.solved,
            "mean_return": sum(self.returns) / self.episodes,
            "mean_length": len(self.actions) / self.episodes,
            "faults": sum(self.faults),
        }

    def kept(self) -> KeptEpisodes:
        """All of them as arrays."""
        return KeptEpisodes(
            starts=np.array(self.starts, dtype=np.int64),
            lengths=np.array(self.lengths, dtype=np.int64),
            actions=np.array(self.actions, dtype=np.int64),
            returns=np.array(self.returns, dtype=np.float64),
            success=np.array([each == "1" for each in self.solved]),
            faults=np.array(self.faults, dtype=np.int64),
            fingerprints=np.array(self.fingerprints, dtype=np.int64),
        )


class AsDict(gymnasium.ObservationWrapper[Any, Action, Observed]):
    """An observation of one part, as a dict of that part."""

    def __init__(self, env: Env, name: str) -> None:
        super().__init__(env)
        self._name = name
        self.observation_space = gymnasium.spaces.Dict({name: env.observation_space})

    def observation(self, observation: Observed) -> dict[str, Observed]:
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
            observation=before,
            action=action,
            reward=float(reward),
            next_observation=after,
            terminated=bool(terminated),
            truncated=bool(truncated),
        )
        yield transition, info
        before = after
        over = terminated or truncated


def _require_sound(env: Env, seen: Observed, reward: SupportsFloat) -> None:
    """Raise InvalidValueError for what no agent should be shown: a package's environment can give anything."""
    space = env.observation_space
    spaces = {"frame": space}
    parts = {"frame": seen}
    if isinstance(space, gymnasium.spaces.Dict) and isinstance(seen, dict):
        spaces = space.spaces
        parts = seen
    for name, wanted in spaces.items():
        part = parts.get(name)
        more = "'imagine-bench check --task' finds such faults."
        if isinstance(wanted, gymnasium.spaces.Box):
            given = (getattr(part, "shape", None), getattr(part, "dtype", type(part)))
            if given != (wanted.shape, wanted.dtype):
                raise InvalidValueError(
                    f"{env} gave a {name} of {given[1]} and shape {given[0]}; it declares {wanted.dtype} of shape "
                    f"{wanted.shape}. {more}"
                )
            if isinstance(part, np.ndarray) and part.dtype.kind == "f" and not np.isfinite(part).all():
                raise InvalidValueError(f"{env} gave a {name} with NaN or infinity. {more}")
    if not math.isfinite(float(reward)):
        raise InvalidValueError(f"{env} gave the reward {reward}; rewards are finite.")


def play_test_episode(counts: EvaluationCounts, env: Env, agent: Agent, *, privileged: bool, purpose: Purpose) -> None:
    """Play the next test episode of ``purpose`` greedily and count it; the count says which start it has."""
    start_s = time.process_time()
    begun = list[EpisodeRecord]()

    def begin(observation: Observation, info: Info) -> None:
        if not begun:
            begun.append(EpisodeRecord.begun(env, info))

    seed = episode_seed(purpose, 0, counts.episodes)
    for transition, info in play(env, agent, seed=seed, explore=False, privileged=privileged, before_acting=begin):
        begun[0].add(transition.action, transition.reward, info)
    counts.add(begun[0])
    counts.cpu_s += time.process_time() - start_s


def replay(env: Env, seed: int, actions: Sequence[int]) -> tuple[EpisodeRecord, bool]:
    """Play the macro-actions of an episode again, as far as it goes, and whether it ends with the last of them."""
    _, info = env.reset(seed=seed)
    played = EpisodeRecord.begun(env, info)
    over = False
    for action in actions:
        if over or action not in env.action_space:
            return played, False
        _, reward, terminated, truncated, info = env.step(action)
        played.add(action, float(reward), info)
        over = terminated or truncated
    return played, bool(over)


class StartFrom(Wrapper):
    """Starts every episode in one of some macrostates, equally likely, that its seed decides."""

    def __init__(self, env: Env, starts: Sequence[State]) -> None:
        super().__init__(env)
        self._starts = tuple(starts)

    def reset(self, *, seed: int | None = None, options: dict[str, State] | None = None) -> tuple[Observed, Info]:
        """Start an episode, where ``options`` say so if they do."""
        if options is None:
            rng = np.random.default_rng(seed)
            options = {"macrostate": self._starts[int(rng.integers(len(self._starts)))]}
        return self.env.reset(seed=seed, options=options)


class TrainingStarts(Wrapper):
    """Starts each training episode of a run where every agent of that seed starts it, whatever seed a loop asks for."""

    def __init__(self, env: Env, seed: int) -> None:
        super().__init__(env)
        self._seed = seed
        self._episode = 0

    def reset(self, *, seed: int | None = None, options: dict[str, State] | None = None) -> tuple[Observed, Info]:
        """Start the next training episode; ``seed`` changes nothing."""
        start = episode_seed("training", self._seed, self._episode)
        self._episode += 1
        return self.env.reset(seed=start, options=options)
