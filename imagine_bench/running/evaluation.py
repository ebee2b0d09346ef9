"""How episodes are played, in training and in tests, and the episodes that a learner is given beside its own.

Test episodes are greedy: the same starts for every agent and seed, none of them ever a training start. A demonstration
is seen as frames, a label is a reward and whether the episode would end, and feedback is reward: none shows a
macrostate.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import operator
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Self, SupportsFloat, TypedDict

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Action, Info, Ints, Observed, State
from imagine_bench.errors import InvalidValueError, brief
from imagine_bench.interfaces import Agent, Observation, Rules, Transition
from imagine_bench.interfaces.capabilities import Label, QueryingAgent, begin_episode
from imagine_bench.interfaces.environments import Env, Wrapper
from imagine_bench.protocols.control import Protocol, context_of
from imagine_bench.protocols.data import RunSpec
from imagine_bench.rules import optimal_actions, tabulate
from imagine_bench.seeding import episode_seed
from imagine_bench.store.results import KeptEpisodes

Options = dict[str, State] | None
"""Of ``reset``: the macrostate where an episode begins, if it is given."""
_INTEGERS = ("starts", "lengths", "actions", "faults", "fingerprints")
"""Fields of :class:`EpisodeLog` that are integers of :class:`.KeptEpisodes`."""


@dataclass
class EpisodeRecord:
    """The record of an episode, while it is played; see :class:`.KeptEpisodes`."""

    start: list[int]
    at: list[int]  #: The newest macrostate
    fingerprint: int
    actions: list[int] = field(default_factory=list)
    total: float = 0.0
    faults: int = 0
    success: bool = False
    sim_time_s: float = 0.0
    over: bool = False


class TestFigures(TypedDict):
    """The fields of a :class:`.Checkpoint` that follow from its test episodes."""

    test_episodes: int
    successes: int
    solved: str
    mean_return: float
    mean_length: float
    faults: int


@dataclass
class EpisodeLog:
    """Episodes that are over, in their order, as :class:`.KeptEpisodes` has them."""

    starts: list[list[int]] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    solved: str = ""  #: ``1`` for each that ended in success, ``0`` for each other
    faults: list[int] = field(default_factory=list)
    fingerprints: list[int] = field(default_factory=list)
    sim_times_s: list[float] = field(default_factory=list)  #: Fewer where an earlier version began

    @classmethod
    def of(cls, kept: KeptEpisodes) -> Self:
        """The inverse of :meth:`kept`."""
        lists = {name: getattr(kept, name).tolist() for name in (*_INTEGERS, "returns")}
        sim_times_s = [] if kept.sim_times_s is None else kept.sim_times_s.tolist()
        return cls(**lists, sim_times_s=sim_times_s, solved="".join(map(str, kept.success.astype(int))))

    @property
    def episodes(self) -> int:
        """Episodes done."""
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
        self.solved += str(int(played.success))
        self.faults.append(played.faults)
        self.fingerprints.append(played.fingerprint)
        self.sim_times_s.append(played.sim_time_s)

    def kept(self) -> KeptEpisodes:
        """All of them as arrays."""
        counts = {name: np.array(getattr(self, name), dtype=np.int64) for name in _INTEGERS}
        is_whole = len(self.sim_times_s) == self.episodes
        return KeptEpisodes(
            **counts,
            returns=np.array(self.returns, dtype=np.float64),
            success=np.array([each == "1" for each in self.solved], dtype=bool),
            sim_times_s=np.array(self.sim_times_s, dtype=np.float64) if is_whole else None,
        )


@dataclass
class EvaluationCounts(EpisodeLog):
    """Test episodes; a checkpoint may carry them half way."""

    cpu_s: float = 0.0  #: CPU seconds spent
    diagnostics: dict[str, float] = field(default_factory=dict)  #: The agent's own means at the moment the test began

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


def play(
    env: Env,
    agent: Agent,
    *,
    seed: int,
    explore: bool,
    privileged: bool,
    before_acting: Callable[[Observation, Info], None] | None = None,
    options: Options = None,
) -> Iterator[tuple[Transition, Info]]:
    """One episode, a real transition at a time, each with the ``info`` that followed it; the agent learns nothing here.

    ``seed`` decides the whole episode but for the agent: the environment carries nothing over from the one before.
    Before each macro-action, ``before_acting`` is called with the agent's observation and the ``info`` that it does not
    see.
    ``options`` are those of the environment's ``reset``.
    """
    frame, info = env.reset(seed=seed, options=options)
    _require_sound(env, frame, 0.0)
    begin_episode(agent)
    before = Observation.of(frame, info, privileged=privileged)
    over = False
    while not over:
        if before_acting is not None:
            before_acting(before, info)
        action = _integer(agent.act(before, explore=explore))
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


def _integer(action: int) -> int:
    """An agent's action as a plain integer. Raises InvalidValueError: it is none, such as a float or an array."""
    try:
        return operator.index(action)
    except TypeError as error:
        raise InvalidValueError(
            f"The agent gave {brief(action)} as an action. An action is one integer; int(...) makes one."
        ) from error


def _require_sound(env: Env, seen: Observed, reward: SupportsFloat) -> None:
    """Raise InvalidValueError for an observation that no agent should be shown: a package's environment can give
    anything.
    """
    if not env.observation_space.contains(seen):
        raise InvalidValueError(
            f"{env} gave an observation that is not in its space {env.observation_space}; 'imagine-bench check --task' "
            "finds such faults."
        )
    if not math.isfinite(reward):
        raise InvalidValueError(f"{env} gave the reward {reward}; rewards are finite.")


class RecordedEnv(Wrapper):
    """Keeps the record of its newest episode as ``episode``."""

    episode: EpisodeRecord

    def reset(self, *, seed: int | None = None, options: Options = None) -> tuple[Observed, Info]:
        """As the environment's; begins a new record."""
        seen, info = self.env.reset(seed=seed, options=options)
        start = [int(value) for value in info["macrostate"]]
        draws = self.env.unwrapped.np_random.bit_generator.state
        self.episode = EpisodeRecord(start, start, zlib.crc32(f"{start} {draws}".encode()))
        return seen, info

    def step(self, action: Action) -> tuple[Observed, SupportsFloat, bool, bool, Info]:
        """As the environment's; adds to the record."""
        after = self.env.step(action)
        _, reward, terminated, truncated, info = after
        played = self.episode
        played.at = np.asarray(info["macrostate"]).tolist()
        played.actions.append(int(action))
        played.total += float(reward)
        played.faults += bool(info["fault"])
        played.success = bool(info["is_success"])
        played.sim_time_s += float(info.get("sim_time_s", 0.0))
        played.over = bool(terminated or truncated)
        happened = np.array([*played.at, reward], dtype=np.float64)
        played.fingerprint = zlib.crc32(happened.tobytes(), played.fingerprint)
        return after


def play_test_episode(env: Env, agent: Agent, *, seed: int, privileged: bool) -> EpisodeRecord:
    """Play a test episode greedily."""
    recorded = RecordedEnv(env)
    for _ in play(recorded, agent, seed=seed, explore=False, privileged=privileged):
        pass
    return recorded.episode


def replay(env: Env, seed: int, actions: Sequence[int]) -> tuple[EpisodeRecord, bool]:
    """Play the macro-actions of an episode again, as far as it goes, and whether it ends with the last of them."""
    recorded = RecordedEnv(env)
    recorded.reset(seed=seed)
    for action in actions:
        if recorded.episode.over or action not in env.action_space:
            return recorded.episode, False
        recorded.step(action)
    return recorded.episode, recorded.episode.over


class ResetBy(Wrapper):
    """Begins episodes as ``begin`` has them: it makes another seed and other options of those that are asked for."""

    def __init__(self, env: Env, begin: Callable[[int | None, Options], tuple[int | None, Options]]) -> None:
        super().__init__(env)
        self._begin = begin

    def reset(self, *, seed: int | None = None, options: Options = None) -> tuple[Observed, Info]:
        """Begin an episode."""
        seed, options = self._begin(seed, options)
        return self.env.reset(seed=seed, options=options)


def start_from(env: Env, starts: Sequence[State]) -> Env:
    """An environment whose episodes begin in one of some macrostates, equally likely, that their seed decides."""

    def begin(seed: int | None, options: Options) -> tuple[int | None, Options]:
        rng = np.random.default_rng(seed)
        drawn = starts[int(rng.integers(len(starts)))]
        return seed, {"macrostate": drawn} if options is None else options

    return ResetBy(env, begin)


def training_starts(env: Env, seed: int) -> Env:
    """An environment that begins each training episode where every agent of a seed begins it, whatever a loop asks."""
    episodes = itertools.count()
    return ResetBy(env, lambda _, options: (episode_seed("training", seed, next(episodes)), options))


def demonstrator(spec: RunSpec[Protocol]) -> Agent:
    """The reference agent that plays the demonstrated episodes of a run; it has to be shown macrostates."""
    of_demonstrator = dataclasses.replace(spec, agent=registry.DEMONSTRATOR)
    return registry.make_agent(registry.DEMONSTRATOR, context_of(of_demonstrator))


def as_seen(transition: Transition) -> Transition:
    """A demonstrated transition as a learner may see it: without macrostates."""
    before, after = (
        dataclasses.replace(seen, macrostate=None, shown=None)
        for seen in (transition.observation, transition.next_observation)
    )
    return dataclasses.replace(transition, observation=before, next_observation=after)


@dataclass(frozen=True)
class LabelOracle:
    """Labels the outcomes of actions, from the rules and the true macrostate, where these allow one outcome."""

    rules: Rules

    def label(self, macrostate: tuple[int, ...], actions: Ints) -> Label | None:
        """The outcome of the last of ``actions`` (D,) from ``macrostate``.

        The scene goes on obeying its dynamics through the ends of episodes. Where chance decides on the way, all that
        may happen is looked at; None where that differs in reward or end: a matter of chance has no label. Raises
        InvalidValueError: no action, or one that does not exist.
        """
        planned = [int(action) for action in actions]
        if not planned or not all(0 <= action < self.rules.n_actions for action in planned):
            raise InvalidValueError(
                f"Asked about the actions {planned}; give at least one, each from 0 to {self.rules.n_actions - 1}."
            )
        possible = {macrostate}
        for action in planned[:-1]:
            possible = {each.macrostate for state in possible for each in self.rules.outcomes(state, action)}
        labels = {
            Label(outcome.reward, outcome.terminated)
            for state in possible
            for outcome in self.rules.outcomes(state, planned[-1])
        }
        return labels.pop() if len(labels) == 1 else None


class Teacher:
    """Watches a learner, and tells after each macro-action whether it was optimal (thesis 6: teacher feedback).

    The learner sees that as reward on top of the world's own: ``feedback`` where an optimal agent could have chosen the
    action, else minus that. With probability ``error`` the teacher says the opposite.
    """

    def __init__(self, rules: Rules, feedback: float, error: float) -> None:
        tables = tabulate(rules)
        self._rows = tables.index
        self._optimal = optimal_actions(tables)
        self._feedback = feedback
        self._error = error

    def begin(self, seed: int) -> None:
        """A new episode, of which ``seed`` decides the errors."""
        self._rng = np.random.default_rng(seed)

    def __call__(self, observation: Observation, info: Info) -> None:
        """See where the learner is about to act."""
        self._row = self._rows[tuple(int(value) for value in info["macrostate"])]

    def told(self, transition: Transition) -> Transition:
        """The transition that followed, with the teacher's feedback in its reward."""
        right = bool(self._optimal[transition.action, self._row]) != bool(self._rng.random() < self._error)
        return dataclasses.replace(
            transition, reward=transition.reward + (self._feedback if right else -self._feedback)
        )


@dataclass
class QueryBudget:
    """The ``queries`` that ``learner`` may ask in one episode, before each of its macro-actions."""

    learner: Agent
    oracle: LabelOracle
    queries: int
    asked: int = 0

    def __call__(self, observation: Observation, info: Info) -> None:
        """Let the learner ask at a real frame until it has nothing to ask or may not any more."""
        while self.asked < self.queries and isinstance(self.learner, QueryingAgent):
            actions = self.learner.query(observation)
            if actions is None:
                return
            macrostate = tuple(int(value) for value in info["macrostate"])
            self.learner.learn_label(observation, actions, self.oracle.label(macrostate, actions))
            self.asked += 1
