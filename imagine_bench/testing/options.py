"""The contract of an agent and every option of a protocol: the option has an effect on it, or is refused.

A row for each option: two short runs from equal seeds, with it and without, must differ in the agent's actions, rewards
or learned arrays. Fields of the protocol without a row are in :data:`WITHOUT_ROW`, each with the reason; a new field
that is in neither fails the contract.
"""

from __future__ import annotations

import atexit
import copy
import dataclasses
import functools
import hashlib
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from imagine_bench import registry
from imagine_bench.data.folder import write_dataset
from imagine_bench.errors import ImagineBenchError, UnableError
from imagine_bench.interfaces import Agent, Observation, Transition
from imagine_bench.interfaces.capabilities import ExternalTrainer, begin_episode
from imagine_bench.interfaces.environments import Env
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import RunSpec
from imagine_bench.running import runner
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.running.control import plan_control
from imagine_bench.running.evaluation import play
from imagine_bench.running.run_state import Counters, Run, make_env
from imagine_bench.store import encoders
from imagine_bench.testing.checks import CheckedAgent, NotOffered, greedy, require, same_arrays, same_state

_EPISODES = 2
_TESTS = 4
"""Test episodes of an agent whose training is a library's or none: some end with their first macro-action."""
Changes = Mapping[str, Any]
_Items = tuple[tuple[str, Any], ...]


@dataclass(frozen=True, kw_only=True)
class OptionRow:
    """One option of a bench."""

    fields: tuple[str, ...]  #: Fields of the protocol that it stands for
    changes: Changes  #: The values of the bench with the option
    without: Changes = field(default_factory=dict)  #: The values of the bench that it is compared with
    world: str = ""  #: An option of the task's world, ``key=value``, in place of a field
    episodes: int = 2  #: Training episodes of either run
    #: Whether it acts through the part that the agent is shown: an agent may learn the same from it, as it should of
    #: light.
    shown: bool = False


class _Left(NamedTuple):
    """The results of a run, as digests."""

    shown: str
    learned: str


_SEEN = ("execution", "split", "appearance", "physics", "observation", "observation_size")  # of environments
_TASK = "the task that is checked"
OPTION_ROWS: Mapping[str, OptionRow] = {
    "dataset": OptionRow(fields=("dataset",), changes={"dataset": "a folder of two episodes"}),
    "demonstrations": OptionRow(fields=("demonstrations",), changes={"demonstrations": _EPISODES}),
    "queries": OptionRow(fields=("queries",), changes={"queries": 1}, episodes=8),
    "feedback": OptionRow(fields=("feedback",), changes={"feedback": 1.0}),
    "feedback error": OptionRow(
        fields=("feedback_error",),
        without={"feedback": 1.0},
        changes={"feedback": 1.0, "feedback_error": 0.5},
        episodes=6,
    ),
    "transfer": OptionRow(fields=("after", "after_episodes"), changes={"after": (_TASK,), "after_episodes": 1}),
    "unannounced": OptionRow(
        fields=("unannounced",),
        without={"after": (_TASK,), "after_episodes": 8},
        changes={"after": (_TASK,), "after_episodes": 8, "unannounced": True},
        episodes=8,
    ),
    "split": OptionRow(fields=("split",), changes={"split": "plan_length=1"}, shown=True),
    "physics": OptionRow(
        fields=("physics", "execution"),
        without={"execution": "physics"},
        changes={"execution": "physics", "physics": (("plan_error_mm", 10.0),)},
        shown=True,
    ),
    "observation": OptionRow(fields=("observation",), changes={"observation": "human"}, shown=True),
    "observation size": OptionRow(fields=("observation_size",), changes={"observation_size": 96}, shown=True),
    "appearance": OptionRow(fields=("appearance",), changes={"appearance": "mild"}, shown=True),
    "gesture": OptionRow(fields=(), changes={}, world="gesture=0.5", shown=True),
    "lag": OptionRow(fields=(), changes={}, world="lag=1", shown=True),
}
"""The options, by their names in the contract."""

WITHOUT_ROW: Mapping[str, str] = {
    "task": "names the world",
    "preset": "names the protocol",
    "agents": "the other side of each pair",
    "agent_names": "says how names are spelled in files",
    "seeds": "the runs that are compared have equal ones",
    "budgets": "how long is trained",
    "evaluation_episodes": "how often is tested",
    "test_appearance": "the appearance in tests, which change no agent",
    "open_loop_starts": "of observers, which change no agent",
    "sampled_futures": "read in older files only",
    "recorded_episodes": "of recordings",
    "recorded_seeds": "which runs are recorded",
    "headlines": "of the report, which changes no agent",
    "most_looks": "how strictly it decides",
    "few_seeds": "how many runs an agent has",
    "encoder": "found by the bench",
    "codes": "found by the bench",
    "overrides": "settings of an agent, each tested with it",
    "config_group": "settings of an agent, named by the task",
    "hyperparameters": "settings of an agent, each tested with it",
    "settings_digest": "follows from the settings",
    "code": "follows from the code of the agents",
    "device": "where is computed",
}
"""Why no pair of runs is compared for the other fields of a protocol."""


def require_every_field() -> None:
    """Raise InvalidValueError for a field of the protocol that is neither in a row nor in :data:`WITHOUT_ROW`."""
    known = {name for row in OPTION_ROWS.values() for name in row.fields} | WITHOUT_ROW.keys()
    fields = {each.name for each in dataclasses.fields(Protocol)}
    require(fields == known, f"these fields of a protocol have no row, or are none: {sorted(fields ^ known)}")


class CheckedOptions:
    """An agent whose options are checked in a task; each run is carried out once."""

    def __init__(self, agent: str, task: str) -> None:
        self.agent = agent
        self.task = task
        self.entry = registry.agent_entry(agent)
        self.run = functools.cache(self._run)

    def check(self, option: str) -> None:
        """Raise InvalidValueError if the option changes nothing; NotOffered, with the sentence, if it is refused, or if
        the task of another package is the same with it.
        """
        row = OPTION_ROWS[option]
        try:
            changed = self.run(self._task_of(row), self._given(row), row.episodes)
            base = self._without(row)
        except ImagineBenchError as refusal:
            raise NotOffered(f"it is refused: {refusal}") from refusal
        effect = base != changed if row.shown else base.learned != changed.learned
        if not effect and row.shown and not registry.is_own(self.task):  # no fault of the agent's
            raise NotOffered(f"with it task {self.task} shows nothing else")
        require(effect, f"{option} changes nothing that {self.agent} does, earns or learns")

    def _without(self, row: OptionRow) -> _Left:
        """The run that the option's is compared with: one without any option where the row's own is refused."""
        try:
            return self.run(self.task, self._in_task(row.without), row.episodes)
        except UnableError:
            return self.run(self.task, (), row.episodes)

    def _given(self, row: OptionRow) -> _Items:
        if "dataset" in row.changes:
            return self._in_task({"dataset": _dataset(self.task)})
        if row.world and self.entry.needs_encoder:  # that of the task: one of its own would have to be trained
            encoder = encoders.own(registry.task(self.task), "clean", self.entry.encoder_kind)
            return self._in_task({**row.changes, "encoder": str(encoder)})
        return self._in_task(row.changes)

    def _in_task(self, changes: Changes) -> _Items:
        """The values of a bench, with the task that is checked as the one that comes before."""
        return tuple({**changes, "after": (self.task,)}.items() if "after" in changes else changes.items())

    def _task_of(self, row: OptionRow) -> str:
        if not row.world:
            return self.task
        base = self.task.partition(":")[0]
        world = registry.task_entry(base).world
        names = {each.name for each in dataclasses.fields(registry.load(world))} if world else set()
        if row.world.partition("=")[0] not in names:
            raise NotOffered(f"{base} has no such option")
        return f"{self.task}{',' if ':' in self.task else ':'}{row.world}"

    def _run(self, task: str, changes: _Items, episodes: int) -> _Left:
        """The results of some episodes of training, or of tests for one that learns nothing, as a digest."""
        given: dict[str, Any] = {"execution": registry.task(task).executions[-1], **dict(changes)}
        wanted, paths = plan_control(
            task, "smoke", agents=(self.agent,), seeds=(0,), budgets=(episodes,), evaluation_episodes=_TESTS,
            open_loop_starts=0, recorded_episodes=0, **given,
        )  # fmt: skip
        encoder = paths[self.entry.encoder_kind] if self.entry.needs_encoder else None
        spec = RunSpec(
            protocol=wanted, agent=self.agent, seed=0, encoder=encoder, dataset=paths.get("dataset"),
            checkpoint_every_s=1e9,
        )  # fmt: skip
        world = Protocol(task=wanted.task, preset="check", agents=("random",), **{n: getattr(wanted, n) for n in _SEEN})
        env, test_env = (_environment(world, testing=testing) for testing in (False, True))
        with tempfile.TemporaryDirectory() as folder:
            return _carried_out(Run(spec, Path(folder), lambda progress: None, env, test_env))


@functools.cache
def _environment(world: Protocol, *, testing: bool) -> Env:
    """The environment of a world, made once: episodes carry nothing over to the next."""
    env = make_env(world, world.task, testing=testing)
    atexit.register(env.close)
    return env


def _carried_out(run: Run) -> _Left:
    """Train, or test one whose training is a library's or none; a digest of its actions, rewards and learned arrays."""
    watched: Any = _WatchedAgent(run.agent)  # all that it has not is the agent's
    if isinstance(run.agent, ExternalTrainer):
        runner.train_externally(run, run.agent, lambda budget: None)
    run.agent = watched
    if run.entry.learns and not run.entry.external_training_loop:
        runner.transfer(run)
        runner.train(run, run.protocol.budgets[-1])
        episodes = run.protocol.episodes_before + run.protocol.budgets[-1]
        require(watched.begun >= episodes, f"told of {watched.begun} beginnings of {episodes} training episodes")
    else:
        runner.test(run)
    left: _Left = watched.left(run.counters)
    return left


class _WatchedAgent:
    """An agent, its actions and rewards, and how often it was told that an episode begins."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._shown = hashlib.sha256()
        self._lived = hashlib.sha256()
        self.begun = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._agent, name)

    def begin_episode(self) -> None:
        """Count, and tell the agent."""
        self.begun += 1
        begin_episode(self._agent)

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Act as the agent does."""
        self._is_shown(observation)
        action = self._agent.act(observation, explore=explore)
        self._lived.update(str(action).encode())
        return action

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Learn as the agent does."""
        self._is_shown(transition.next_observation)
        self._lived.update(f"{transition.action} {transition.reward}".encode())
        self._agent.observe(transition, episode=episode)

    def _is_shown(self, observation: Observation) -> None:
        for part in (observation.frame, observation.macrostate):
            self._shown.update(np.asarray(part).tobytes() if part is not None else b"")
        for name in sorted(observation.more):
            self._shown.update(observation.more[name].tobytes())

    def left(self, counters: Counters) -> _Left:
        """Digests of its observations, and of actions, rewards and learned arrays; times are in none of them."""
        found = self._lived.copy()
        arrays = self._agent.state().arrays
        for name in sorted(arrays):
            found.update(f"{name} {arrays[name].shape}".encode())
            found.update(arrays[name].tobytes())
        lived = (counters.success, counters.length, counters.queries, counters.training, counters.tried)
        found.update(repr(lived).encode())
        return _Left(self._shown.hexdigest(), found.hexdigest())


@functools.cache
def _dataset(task: str) -> Path:
    """A dataset of two episodes of an optimal policy, kept until the process ends."""
    spec = registry.task(task)
    folder = Path(tempfile.mkdtemp(prefix="imagine-bench-check-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    policy = policy_of("mixed", spec, seed=1)
    episodes, files, card = collect(
        spec, policy, episodes=_EPISODES, seed=1, execution=spec.executions[-1], appearance="clean"
    )
    write_dataset(folder / "episodes", episodes, files, card, "npz")
    return folder / "episodes"


def watching_teaches_as_living(one: CheckedAgent) -> None:
    """Raise InvalidValueError if an agent learns otherwise from episodes that it was only shown than from its own."""
    if one.entry.external_training_loop or not one.entry.learns:
        raise NotOffered("it does not learn from episodes that are shown to it")
    actor, watcher = one.make(), one.make()
    starts: list[Observation] = []
    world = Protocol(task=one.spec.id, preset="check", agents=("random",), execution=one.spec.executions[-1])
    env = _environment(world, testing=False)
    for episode in range(_EPISODES):
        begin_episode(watcher)
        for transition, _ in play(env, actor, seed=episode, explore=True, privileged=one.entry.privileged):
            starts.append(transition.observation)
            actor.observe(transition, episode=episode)
            watcher.observe(transition, episode=episode)
    require(same_arrays(actor.state(), watcher.state()), "it learned otherwise from episodes that it was only shown")
    learned = copy.deepcopy(actor.state())
    require(greedy(actor, starts) == greedy(watcher, starts), "it then acts otherwise")
    require(same_state(learned, actor.state()), "acting with explore=False changes its state")
