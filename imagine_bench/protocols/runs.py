"""What a run is, how far it is, and what a type of task brings along so that its benches can be run and read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, TypeVar
from typing import Protocol as Interface

from imagine_bench import registry
from imagine_bench.exact.beliefs import optimal_policy_of
from imagine_bench.interfaces import PROPRIO_SIZE, AgentContext, ExactWorld, TaskSpec
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import ProtocolData
from imagine_bench.seeding import SeedTree
from imagine_bench.values import Setting

P = TypeVar("P", bound=ProtocolData)
P_co = TypeVar("P_co", bound=ProtocolData, covariant=True)
Phase = Literal["training", "training in the model", "testing", "imagining", "recording", "done", "failed"]


@dataclass(frozen=True, kw_only=True)
class RunSpec(Generic[P_co]):
    """What one run is."""

    protocol: P_co  #: The comparison it belongs to
    agent: str  #: Registered agent or regressor
    seed: int  #: One of the protocol's seeds
    encoder: Path | None = None  #: The encoder artefact, or None if the agent needs none
    dataset: Path | None = None  #: The folder of the dataset that comes first, or None
    until: int | None = None  #: Budget after which it pauses, or None to the end
    checkpoint_every_s: float = 20.0  #: Seconds of work that a kill may cost
    cores: int = 1  #: How many it may use; they change no result
    observers: tuple[str, ...] = ()  #: What looks at it, each the ``"module:attr"`` of a :class:`.runner.RunObserver`

    @property
    def work(self) -> int:
        """Parts of work to do, of whatever the protocol counts."""
        return self.protocol.work(self.agent, self.until)

    def context(self: RunSpec[Protocol]) -> AgentContext:
        """What the run's agent is built from."""
        protocol = self.protocol
        entry = registry.agent_entry(self.agent)
        task = registry.task(protocol.task)
        return AgentContext(
            n_actions=task.n_actions,
            preprocessing=task.preprocessing,
            encoder=self.encoder if entry.needs_encoder else None,
            seeds=SeedTree(self.seed).child("agent"),  # the same for every agent: runs of one seed are pairs
            config_group=protocol.config_group,
            hyperparameters=protocol.hyperparameters,
            overrides=registry.own_settings(self.agent, dict(protocol.overrides)),
            device=protocol.device,
            optimal_policy=optimal_policy_of(task) if entry.privileged else None,
            exact_world=ExactWorld.of(task, protocol.appearance) if entry.privileged else None,
            observation={part: _shape(part, task, protocol) for part in protocol.observation.split(",")},
        )


def _shape(part: str, task: TaskSpec, protocol: Protocol) -> tuple[int, ...]:
    vectors = {"state": sum(map(len, task.macrostate_values)), "proprio": PROPRIO_SIZE}
    return (vectors[part],) if part in vectors else (protocol.observation_size, protocol.observation_size, 3)


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a run is."""

    agent: str  #: Registered agent
    seed: int  #: The run's seed
    bench: str = ""  #: Hash of the run's protocol
    phase: Phase  #: What it is doing
    done: int  #: Episodes played, for training and for tests
    work: int  #: Episodes to play
    episode: int = 0  #: Training episodes done
    #: Share of successes among recent training episodes, or in the running test; None before the first.
    success: float | None = None
    #: What a run without episodes is doing, or why one failed, in words; None where episodes say it.
    detail: str | None = None


OnProgress = Callable[[Progress], None]

Encoders = Mapping[str, Path]
"""The encoder artefacts of a bench, by kind, none where nothing needs one, and its ``"dataset"``, a folder."""


class FinishedRun(Interface):
    """What runs of every type leave."""

    @property
    def recording(self) -> Path | None:
        """Its Rerun recording, or None."""


class Result(Interface):
    """What benches of every type measured: one run an agent and seed, in a folder."""

    @property
    def runs(self) -> Sequence[FinishedRun]:
        """One an agent and seed."""

    @property
    def folder(self) -> Path:
        """Where the bench's files lie."""

    @property
    def missing(self) -> Sequence[str]:
        """What an unfinished bench lacks, one sentence a run."""


@dataclass(frozen=True, kw_only=True)
class TaskType(Generic[P]):
    """What a type of task brings along."""

    tasks: Callable[[], Mapping[str, object]]  #: Gives its tasks, by name
    learners: Callable[[], Mapping[str, object]]  #: Gives its agents or regressors, by name
    draws: bool  #: Whether its runs need OpenGL
    protocol: type[P]  #: The class of its protocols
    presets: Mapping[str, Mapping[str, Setting]]  #: What each protocol preset changes, by name
    #: Makes a protocol from a task, a preset and changes to single fields, all checked, and finds its encoders.
    plan: Callable[..., tuple[P, Encoders]]
    run: Callable[[RunSpec[P], Path, OnProgress], object]  #: Carries out a run in a folder
    load_so_far: Callable[[Path], Result]  #: Reads a bench folder, as far as it can be reported


@dataclass(frozen=True, kw_only=True)
class Job:
    """A run and where its files go."""

    spec: RunSpec[ProtocolData]
    folder: Path

    @property
    def log(self) -> Path:
        """Everything the run printed."""
        return self.folder / "log.txt"


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A job that did not finish, and why in one sentence."""

    job: Job
    reason: str

    @property
    def progress(self) -> Progress:
        """What an observer is told of it."""
        spec = self.job.spec
        return Progress(
            agent=spec.agent, seed=spec.seed, bench=spec.protocol.hash, phase="failed", done=0, work=spec.work,
            detail=self.reason,
        )  # fmt: skip


class Launcher(Interface):
    """Carries out jobs, somewhere."""

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job, whatever becomes of the others, and return those that failed.

        Jobs are independent of one another, and each resumes by itself. ``on_progress`` is told now and then, from this
        process, how far each is, and at once of one that failed.
        """
