"""What a runner must remember to go on: counts over training and test episodes, all of them in every checkpoint."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentState
from imagine_bench.store.checkpoints import Snapshot
from imagine_bench.store.codec import pack, unpack
from imagine_bench.store.results import Checkpoint, KeptEpisodes


@dataclass
class Played:
    """What is kept of a test episode, while it is played; see :class:`.KeptEpisodes`."""

    start: list[int]
    fingerprint: int
    actions: list[int] = field(default_factory=list)
    total: float = 0.0
    faults: int = 0
    success: bool = False

    @classmethod
    def begun(cls, env: gymnasium.Env[Any, Any], info: Mapping[str, Any]) -> Played:
        """One that has just been reset."""
        start = [int(value) for value in info["macrostate"]]
        return cls(start, zlib.crc32(f"{start} {env.unwrapped.np_random.bit_generator.state}".encode()))

    def add(self, action: int, reward: float, info: Mapping[str, Any]) -> None:
        """Take in one macro-action."""
        self.actions.append(int(action))
        self.total += reward
        self.faults += bool(info["fault"])
        self.success = bool(info["is_success"])
        happened = np.array([*info["macrostate"], reward], dtype=np.float64)
        self.fingerprint = zlib.crc32(happened.tobytes(), self.fingerprint)


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

    def add(self, played: Played) -> None:
        """Count one that is over."""
        self.starts.append(played.start)
        self.lengths.append(len(played.actions))
        self.actions += played.actions
        self.returns.append(played.total)
        self.solved += "1" if played.success else "0"
        self.faults.append(played.faults)
        self.fingerprints.append(played.fingerprint)

    def figures(self) -> dict[str, Any]:
        """The fields of a :class:`.Checkpoint` that follow from the episodes."""
        return {
            "test_episodes": self.episodes, "successes": self.successes, "solved": self.solved,
            "mean_return": sum(self.returns) / self.episodes, "mean_length": len(self.actions) / self.episodes,
            "faults": sum(self.faults),
        }  # fmt: skip

    def kept(self) -> KeptEpisodes:
        """All of them as arrays."""
        return KeptEpisodes(
            starts=np.array(self.starts, dtype=np.int64), lengths=np.array(self.lengths, dtype=np.int64),
            actions=np.array(self.actions, dtype=np.int64), returns=np.array(self.returns, dtype=np.float64),
            success=np.array([each == "1" for each in self.solved]), faults=np.array(self.faults, dtype=np.int64),
            fingerprints=np.array(self.fingerprints, dtype=np.int64),
        )  # fmt: skip


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
    starts: list[list[int]] = field(default_factory=list)  #: Where training episodes began, but those of a dataset
    #: The episode in which each macro-action was first tried in a macrostate, by both, separated by blanks
    tried: dict[str, int] = field(default_factory=dict)
    test: EvaluationCounts | None = None  #: The test that is going on, if one is

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

    def training(self) -> dict[str, NDArray[Any]]:
        """What ``training.npz`` holds.

        ``success``, ``length`` and ``queries`` of every training episode, shape (episodes,); ``starts`` of those that
        were played, (played, M); and ``tried``, a row a macrostate, macro-action and first episode, (pairs, M + 2).
        """
        pairs = [[*map(int, pair.split()), episode] for pair, episode in self.tried.items()]
        return {
            "success": np.array(self.success, dtype=np.bool_),
            "length": np.array(self.length, dtype=np.int64),
            "queries": np.array(self.queries, dtype=np.int64),
            "starts": np.array(self.starts[: self.episode], dtype=np.int16),  # a library begins one more at its end
            "tried": np.array(pairs, dtype=np.int32),
        }

    def snapshot(self, agent: AgentState) -> Snapshot:
        """Everything, with the agent's state, as a checkpoint."""
        values, arrays = pack(self)
        return Snapshot(episode=self.episode, agent=agent, arrays=arrays, values=values)

    @classmethod
    def of(cls, snapshot: Snapshot) -> Counters:
        """The inverse of :meth:`snapshot`."""
        return unpack(cls, snapshot.values, snapshot.arrays)
