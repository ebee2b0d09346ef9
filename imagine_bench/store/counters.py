"""What a runner must remember to go on: counts over training and test episodes, all of them in every checkpoint."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentState
from imagine_bench.store.checkpoints import Snapshot
from imagine_bench.store.codec import pack, unpack
from imagine_bench.store.results import Checkpoint


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


@dataclass
class Counters:
    """The runner's own state.

    Attributes:
        before: Training episodes on earlier tasks done.
        episode: Training episodes done.
        env_steps: Macro-actions in them.
        train_cpu_s: CPU seconds of training.
        rows: One a budget done.
        success: Whether each training episode succeeded.
        length: Macro-actions of each training episode.
        queries: Oracle queries in each training episode.
        test: The test that is going on, if one is.
    """

    before: int = 0
    episode: int = 0
    env_steps: int = 0
    train_cpu_s: float = 0.0
    rows: list[Checkpoint] = field(default_factory=list)
    success: list[bool] = field(default_factory=list)
    length: list[int] = field(default_factory=list)
    queries: list[int] = field(default_factory=list)
    test: EvaluationCounts | None = None

    def add_episode(self, success: bool, length: int, queries: int = 0) -> None:
        """Count a training episode of so many macro-actions, and queries in it."""
        self.episode += 1
        self.env_steps += length
        self.success.append(success)
        self.length.append(length)
        self.queries.append(queries)

    def training(self) -> dict[str, NDArray[Any]]:
        """``success``, ``length`` and ``queries`` of every training episode. Each of shape (episodes,)."""
        return {
            "success": np.array(self.success, dtype=np.bool_),
            "length": np.array(self.length, dtype=np.int64),
            "queries": np.array(self.queries, dtype=np.int64),
        }

    def snapshot(self, agent: AgentState) -> Snapshot:
        """Everything, with the agent's state, as a checkpoint."""
        values, arrays = pack(self)
        return Snapshot(episode=self.episode, agent=agent, arrays=arrays, values=values)

    @classmethod
    def of(cls, snapshot: Snapshot) -> Counters:
        """The inverse of :meth:`snapshot`."""
        return unpack(cls, snapshot.values, snapshot.arrays)
