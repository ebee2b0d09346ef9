"""A run that goes on: its agent, environment and counters, how they are saved, and how far it is."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium

from imagine_bench import registry
from imagine_bench.arrays import Action, Info, Observed
from imagine_bench.data.folder import read_dataset
from imagine_bench.errors import ArtefactError, UnableError
from imagine_bench.interfaces import OBSERVATIONS, Agent, AgentState
from imagine_bench.interfaces.capabilities import ExternalTrainer, QueryingAgent, TransferLearner
from imagine_bench.interfaces.environments import Env
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.protocols.control import Protocol, context_of
from imagine_bench.protocols.data import RECENT, OnProgress, Phase, Progress, RunSpec
from imagine_bench.running.evaluation import (
    EpisodeLog,
    EvaluationCounts,
    Options,
    RecordedEnv,
    Teacher,
    demonstrator,
    start_from,
)
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.files import reading
from imagine_bench.store.results import Checkpoint
from imagine_bench.store.run_folder import Snapshot, load_newest, save_snapshot
from imagine_bench.values import pack, unpack

_REPORT_EVERY_S = 0.25


@dataclass
class Counters:
    """The runner's own state."""

    before: int = 0  #: Training episodes on earlier tasks done
    episode: int = 0  #: Training episodes done
    env_steps: int = 0  #: Macro-actions in them
    train_cpu_s: float = 0.0  #: CPU seconds of training
    rows: list[Checkpoint] = field(default_factory=list)  #: One a budget done
    success: list[bool] = field(default_factory=list)  #: Whether each training episode succeeded
    length: list[int] = field(default_factory=list)  #: Macro-actions of each training episode
    queries: list[int] = field(default_factory=list)  #: Oracle queries in each training episode
    #: Where training episodes began that a version of before 2026-11-28 played, which kept nothing else of them
    starts: list[list[int]] = field(default_factory=list)
    #: The episode in which each macro-action was first tried in a macrostate, by both, separated by blanks
    tried: dict[str, int] = field(default_factory=dict)
    test: EvaluationCounts | None = None  #: The test that is going on, if one is
    training: EpisodeLog = field(default_factory=EpisodeLog)  #: The training episodes, but those of a dataset

    def add_episode(self, success: bool, length: int, queries: int = 0) -> None:
        """Count a training episode of so many macro-actions, and queries in it."""
        self.episode += 1
        self.env_steps += length
        self.success.append(success)
        self.length.append(length)
        self.queries.append(queries)

    def try_out(self, macrostate: Sequence[int], action: int) -> None:
        """Count a macro-action of the training episode that goes on."""
        self.tried.setdefault(" ".join(map(str, (*macrostate, action))), self.episode)

    def snapshot(self, agent: AgentState) -> Snapshot:
        """Everything, with the agent's state, as a checkpoint."""
        values, arrays = pack({name: value for name, value in vars(self).items() if name != run_folder.TRAINING})
        arrays |= run_folder.training_arrays(self.training.kept())
        return Snapshot(episode=self.episode, agent=agent, arrays=arrays, values=values)

    @classmethod
    def of(cls, snapshot: Snapshot) -> Counters:
        """The inverse of :meth:`snapshot`."""
        kept = run_folder.training_of(snapshot)
        others = {
            name: array for name, array in snapshot.arrays.items() if not name.startswith(f"{run_folder.TRAINING}/")
        }
        counters: Counters = unpack(cls, snapshot.values, others)
        counters.training = EpisodeLog() if kept is None else EpisodeLog.of(kept)
        return counters


class CountVisits(RecordedEnv):
    """Keeps training episodes, and counts which macro-actions are tried where; the agent is told nothing."""

    def __init__(self, env: Env, counters: Counters) -> None:
        super().__init__(env)
        self._counters = counters
        self._is_open = False

    def reset(self, *, seed: int | None = None, options: Options = None) -> tuple[Observed, Info]:
        """As the environment's; an episode that was left before its end is kept as far as it came."""
        self._close()
        self._is_open = True
        return super().reset(seed=seed, options=options)

    def step(self, action: Action) -> tuple[Observed, SupportsFloat, bool, bool, Info]:
        """As the environment's."""
        before = self.episode.at
        after = super().step(action)
        self._counters.try_out(before, int(action))
        if self.episode.over:
            self._close()
        return after

    def _close(self) -> None:
        """Keep the newest episode, unless it was kept."""
        if self._is_open:
            self._counters.training.add(self.episode)
        self._is_open = False


def make_env(protocol: Protocol, task: str, *, testing: bool = False, **options: Any) -> Env:
    """The environment of a task as a protocol has it, for training or for tests; ``options`` replace its own."""
    env = gymnasium.make(
        registry.task_entry(task).env_id,
        **{**protocol.world, **options},
        appearance=protocol.appearance_in_tests if testing else protocol.appearance,
        disable_env_checker=True,  # the tests run it; here it would only cost time
    )
    if protocol.observation in OBSERVATIONS[1:]:
        parts = gymnasium.spaces.Dict({protocol.observation: env.observation_space})
        env = gymnasium.wrappers.TransformObservation(env, lambda seen: {protocol.observation: seen}, parts)
    if protocol.split is None or task != protocol.task:
        return env
    return start_from(env, protocol.spec(testing=testing).rules.start_states)


@contextmanager
def environments(protocol: Protocol, **options: Any) -> Iterator[tuple[Env, Env]]:
    """The environments of training and of tests; one and the same unless tests have looks or starts of their own."""
    with closing(make_env(protocol, protocol.task, **options)) as env:
        if protocol.appearance_in_tests == protocol.appearance and protocol.split is None:
            yield env, env
            return
        with closing(make_env(protocol, protocol.task, testing=True, **options)) as test_env:
            yield env, test_env


def reuse_outcomes(env: Env) -> None:
    """Let an environment that can set known outcomes again, to the bit, simulate no macro-action twice."""
    reuse = getattr(env.unwrapped, "reuse_outcomes", None)
    if reuse is not None:
        reuse()


def require_able(agent: object, name: str, protocol: Protocol) -> None:
    """Raise UnableError where a learner cannot carry over to the next task, watch or ask, as a protocol wants."""
    external = isinstance(agent, ExternalTrainer)
    privileged = registry.agent_entry(name).privileged
    own_loop = "trains in a loop of its own"
    reasons = {
        "dataset": own_loop if external else "is shown true macrostates" if privileged else "",
        "after": ""
        if isinstance(agent, TransferLearner) or (protocol.unannounced and not external)
        else "has no model of the world to carry over",
        "after_episodes": "",  # as "after", without which it is refused
        "queries": "" if isinstance(agent, QueryingAgent) else "cannot query an oracle",
    }
    for option in protocol.helps:
        reason = reasons.get(option, own_loop if external else "")
        if reason:
            raise UnableError(f"Agent {name!r} {reason}; leave --{option.replace('_', '-')} out, or that agent.")


class Run:
    """A run as far as it has come: a new one, or the state of the newest checkpoint in its folder.

    Raises:
        ArtefactError: The folder was begun with something else, or the encoder is not the protocol's.
        UnableError: The agent lacks an ability that the protocol asks for.
    """

    def __init__(self, spec: RunSpec[Protocol], folder: Path, on_progress: OnProgress, env: Env, test_env: Env) -> None:
        self.spec = spec
        self.protocol = spec.protocol
        self.folder = folder
        self.env = env
        self.test_env = test_env
        self.task = registry.task(spec.protocol.task)
        self.entry = registry.agent_entry(spec.agent)
        self.dataset: Episodes | None = None
        if self.entry.needs_encoder and spec.encoder is not None:
            self._require(
                spec.encoder, encoders.identity(spec.encoder), spec.protocol.encoder_of(self.entry.encoder_kind)
            )
        if self.entry.learns and spec.dataset is not None:
            found = read_dataset(spec.dataset)
            self._require(spec.dataset, found.identity, spec.protocol.dataset)
            self.dataset = found.episodes
        self.agent: Agent = registry.make_agent(spec.agent, context_of(spec))
        if self.entry.learns:
            require_able(self.agent, spec.agent, spec.protocol)
        self.teacher: Teacher | None = None
        if spec.protocol.feedback:
            self.teacher = Teacher(self.task.rules, spec.protocol.feedback, spec.protocol.feedback_error)
        self.counters = Counters()
        self._on_progress = on_progress
        run_folder.check_config(folder, spec, self.agent)
        if self.entry.external_training_loop:
            run_folder.forget(folder)  # an earlier attempt cannot be gone on with
        snapshot = load_newest(folder / run_folder.CHECKPOINTS)
        if snapshot is not None:
            with reading(folder / run_folder.CHECKPOINTS, f"a checkpoint of {spec.agent!r}"):
                self.agent.restore(snapshot.agent)
                self.counters = Counters.of(snapshot)
            if self.counters.rows:  # a kill between a test's checkpoint and its table would leave the table behind
                run_folder.write_metrics(folder, self.counters.rows)
        self._saved_s = self._reported_s = time.monotonic()

    @staticmethod
    def _require(path: Path, found: str, wanted: str | None) -> None:
        """Refuse another file than the protocol's, such as an older one on another node, or one changed since."""
        if wanted not in (None, found):
            raise ArtefactError(f"{path} is {found}, and this bench is of {wanted}.")

    @cached_property
    def demonstrator(self) -> Agent:
        """See :func:`.evaluation.demonstrator`; it holds nothing from one episode to the next."""
        return demonstrator(self.spec)

    @contextmanager
    def training_time(self) -> Iterator[None]:
        """Count the CPU seconds of the block as training."""
        start_s = time.process_time()
        yield
        self.counters.train_cpu_s += time.process_time() - start_s

    def made_progress(self, phase: Phase) -> None:
        """Tell how far the run is and save it, each if the last time is long enough ago."""
        self.tell(phase)
        if time.monotonic() - self._saved_s >= self.spec.checkpoint_every_s:
            self.save()

    def save(self, folder: str = "checkpoints") -> Path:
        """Save everything that is needed to go on; returns where it lies."""
        where = save_snapshot(self.folder / folder, self.counters.snapshot(self.agent.state()))
        self._saved_s = time.monotonic()
        return where

    def tell(self, phase: Phase, *, at_once: bool = False) -> None:
        """Tell how far the run is, unless it was told a moment ago."""
        now_s = time.monotonic()
        if not at_once and now_s - self._reported_s < _REPORT_EVERY_S:
            return
        self._reported_s = now_s
        counters = self.counters
        solved = counters.test.solved if counters.test else ""
        tested = len(counters.rows) if self.entry.learns else min(1, len(counters.rows))
        recent = [each == "1" for each in solved] if phase == "testing" else counters.success[-RECENT:]
        where = Progress(
            agent=self.spec.agent,
            seed=self.spec.seed,
            bench=self.protocol.hash,
            phase=phase,
            done=counters.before + counters.episode + tested * self.protocol.evaluation_episodes + len(solved),
            work=self.spec.work,
            episode=counters.episode,
            success=sum(recent) / len(recent) if recent else None,
        )
        self._on_progress(where)
