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
    """Counts over test episodes; a checkpoint may carry them half way."""

    episodes: int = 0  #: Test episodes done
    solved: str = ""  #: ``1`` for each of them that ended in success, ``0`` for each other, in their order
    env_steps: int = 0  #: Macro-actions in them
    return_sum: float = 0.0  #: Sum of their undiscounted returns
    faults: int = 0  #: Macro-actions whose physics disagreed with the rules
    cpu_s: float = 0.0  #: CPU seconds spent
    diagnostics: dict[str, float] = field(default_factory=dict)  #: The agent's own means at the moment the test began

    @property
    def successes(self) -> int:
        """Test episodes that ended in success."""
        return self.solved.count("1")


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
    test: EvaluationCounts | None = None  #: The test that is going on, if one is

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
