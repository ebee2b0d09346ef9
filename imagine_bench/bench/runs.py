"""What a run is, how far it is, and all that its runner must remember to go on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.bench.evaluation import EvaluationCounts
from imagine_bench.interfaces import AgentContext, AgentState
from imagine_bench.seeding import SeedTree
from imagine_bench.store import run_folder
from imagine_bench.store.checkpoints import Snapshot
from imagine_bench.store.results import Checkpoint

_FUTURES = "futures/"
Phase = Literal["training", "rehearsing", "testing", "imagining", "recording", "done", "failed"]


@dataclass(frozen=True, kw_only=True)
class RunSpec:
    """What one run is.

    Attributes:
        protocol: The comparison it belongs to, of any kind.
        agent: Registered agent or regressor.
        seed: One of the protocol's seeds.
        encoder: The encoder artefact, or None if the agent needs none.
        until: Budget after which it rests, or None to the end.
        checkpoint_every_s: Seconds of work that a kill may cost.
    """

    protocol: Any
    agent: str
    seed: int
    encoder: Path | None = None
    until: int | None = None
    checkpoint_every_s: float = 20.0

    @property
    def budgets(self) -> tuple[int, ...]:
        """The protocol's budgets up to where the run rests."""
        budgets = self.protocol.budgets
        return tuple(budget for budget in budgets if self.until is None or budget <= self.until)

    @property
    def work(self) -> int:
        """Parts of work to do, of whatever the protocol counts."""
        parts: int = self.protocol.work(self.agent, self.until)
        return parts

    def context(self) -> AgentContext:
        """What the run's agent is built from."""
        protocol, entry = self.protocol, registry.agent_entry(self.agent)
        task = registry.task(protocol.task)
        return AgentContext(
            n_actions=task.n_actions,
            preprocessing=task.preprocessing,
            encoder=self.encoder if entry.needs_encoder else None,
            seeds=SeedTree(self.seed).child("agent"),  # the same for every agent: runs of one seed are pairs
            settings=protocol.settings,
            preset=protocol.preset,
            overrides=registry.own_settings(self.agent, dict(protocol.overrides)),
            device=protocol.device,
            optimal_action=task.rules.optimal_action if entry.privileged else None,
        )


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a run is.

    Attributes:
        agent: Registered agent.
        seed: The run's seed.
        phase: What it is doing.
        done: Episodes played, for training and for tests.
        work: Episodes to play.
        episode: Training episodes done.
        success: Share of successes among recent training episodes, or in the running test; None before the first.
        detail: What a run without episodes is doing, or why one failed, in words; None where episodes say it.
    """

    agent: str
    seed: int
    phase: Phase
    done: int
    work: int
    episode: int = 0
    success: float | None = None
    detail: str | None = None


Observer = Callable[[Progress], None]


@dataclass
class Counters:
    """The runner's own state, all of it in every checkpoint.

    Attributes:
        before: Training episodes on earlier tasks done.
        episode: Training episodes done.
        env_steps: Macro-actions in them.
        train_cpu_s: CPU seconds of training.
        rows: One a budget done.
        success: Whether each training episode succeeded.
        length: Macro-actions of each training episode.
        questions: Questions asked in each training episode.
        test: The test that is going on, if one is.
    """

    before: int = 0
    episode: int = 0
    env_steps: int = 0
    train_cpu_s: float = 0.0
    rows: list[Checkpoint] = field(default_factory=list)
    success: list[bool] = field(default_factory=list)
    length: list[int] = field(default_factory=list)
    questions: list[int] = field(default_factory=list)
    test: EvaluationCounts | None = None

    def add_episode(self, success: bool, length: int, questions: int = 0) -> None:
        """Count a training episode of so many macro-actions, and questions asked in it."""
        self.episode += 1
        self.env_steps += length
        self.success.append(success)
        self.length.append(length)
        self.questions.append(questions)

    def training(self) -> dict[str, NDArray[Any]]:
        """``success``, ``length`` and ``questions`` of every training episode. Each of shape (episodes,)."""
        return {
            "success": np.array(self.success, dtype=np.bool_),
            "length": np.array(self.length, dtype=np.int64),
            "questions": np.array(self.questions, dtype=np.int64),
        }

    def snapshot(self, agent: AgentState) -> Snapshot:
        """Everything, with the agent's state, as a checkpoint."""
        values = {
            "before": self.before,
            "env_steps": self.env_steps,
            "train_cpu_s": self.train_cpu_s,
            "rows": [run_folder.checkpoint_to_json(row) for row in self.rows],
            "test": None if self.test is None else dataclasses.asdict(self.test),
        }
        futures = {_FUTURES + name: array for name, array in run_folder.futures_arrays(self.rows).items()}
        return Snapshot(episode=self.episode, agent=agent, arrays={**self.training(), **futures}, values=values)

    @classmethod
    def of(cls, snapshot: Snapshot) -> Counters:
        """The inverse of :meth:`snapshot`."""
        values = snapshot.values
        futures = {
            name.removeprefix(_FUTURES): array for name, array in snapshot.arrays.items() if name.startswith(_FUTURES)
        }
        rows = [run_folder.checkpoint_from_json(row) for row in values["rows"]]
        length = snapshot.arrays["length"].tolist()
        return cls(
            before=values.get("before", 0),  # absent, as are questions, in snapshots from before there were any
            episode=snapshot.episode,
            env_steps=values["env_steps"],
            train_cpu_s=values["train_cpu_s"],
            rows=list(run_folder.with_futures(rows, futures)),
            success=snapshot.arrays["success"].tolist(),
            length=length,
            questions=snapshot.arrays["questions"].tolist() if "questions" in snapshot.arrays else [0] * len(length),
            test=None if values["test"] is None else EvaluationCounts(**values["test"]),
        )
