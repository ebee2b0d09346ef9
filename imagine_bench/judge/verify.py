"""Verification: every kept test episode is played again, and all that follows from them is computed anew.

What a replay cannot show is not vouched for: CPU times, diagnostics, what observers measured, pictures, and that the
agents would choose these actions again.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.environments import Env
from imagine_bench.errors import ArtefactError
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.bench import counted
from imagine_bench.running.evaluation import EpisodeRecord, EvaluationCounts, replay
from imagine_bench.running.run_state import environments
from imagine_bench.seeding import Purpose, episode_seed, evaluation_split
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import BenchStore, is_archive, read_control
from imagine_bench.store.results import Checkpoint

_CLAIMS = {
    "starts": "start",
    "returns": "return",
    "success": "success",
    "faults": "number of faults",
    "fingerprints": "fingerprint",
}
"""What is kept of a test episode beside its actions, and what it is called."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """What was found of a run, or of the bench's report."""

    what: str
    complaint: str = ""  # empty where all holds
    episodes: int = 0  # played again

    def __str__(self) -> str:
        holds = f"holds; {self.episodes:,} test episodes played again" if self.episodes else "holds"
        return f"{self.what}: {self.complaint or holds}"


def verify_runs(folder: Path) -> list[Verdict]:
    """One verdict a run of the bench in ``folder``.

    Raises:
        ArtefactError: It is no bench of agents with folders of their own, or its protocol is damaged.
    """
    protocol = read_control(folder)
    if is_archive(folder):
        raise ArtefactError(f"{folder} keeps results and no episodes; give a bench's folder, runs/<task>/<preset>-...")
    unseen = {"observation": "state"} if registry.is_own(protocol.task) else {}  # nobody looks at frames
    with environments(protocol, **unseen) as envs:
        return verdicts(folder, Replays(*envs))


def verdicts(folder: Path, replays: Replays) -> list[Verdict]:
    """As :func:`verify_runs`, in environments of the bench's protocol."""
    protocol = read_control(folder)
    found: list[Verdict] = []
    runs = [(agent, seed) for seed in protocol.seeds for agent in protocol.agents]
    for agent, seed in counted(runs, "runs", total=len(runs)):
        name = f"{agent} seed {seed}"
        run = BenchStore(folder, protocol).run_folder(agent, seed)
        try:
            run_folder.require_run_of(run, protocol, agent, seed)
            found.append(Verdict(what=name, episodes=_verify_run(run, protocol, seed, replays)))
        except ArtefactError as error:
            found.append(Verdict(what=name, complaint=str(error)))
    return found


def cost(found: Sequence[Verdict], cpu_s: float) -> str:
    """What playing test episodes again cost, in a sentence."""
    return f"{sum(each.episodes for each in found):,} test episodes; checked in {cpu_s:,.1f} CPU s."


class Replays:
    """Episodes begun and played again in the protocol's own environments, each test once."""

    def __init__(self, env: Env, test_env: Env) -> None:
        self._env = env
        self._play_test = functools.cache(functools.partial(replay, test_env))

    def start(self, seed: int) -> list[int]:
        """Where a training episode begins."""
        return replay(self._env, seed, [])[0].start

    def test(self, seed: int, actions: Sequence[int]) -> tuple[EpisodeRecord, bool]:
        """A test episode, and whether the actions are all of it."""
        return self._play_test(seed, tuple(actions))


def _verify_run(folder: Path, protocol: Protocol, seed: int, replays: Replays) -> int:
    """How many test episodes were played again. ArtefactError says in one sentence what does not hold."""
    if not run_folder.is_done(folder):
        raise ArtefactError("it is not finished.")
    run = run_folder.load_run(folder)
    rows = run.checkpoints
    starts = [] if run.training_starts is None else run.training_starts.tolist()
    if tuple(row.episodes for row in rows) != protocol.budgets:
        raise ArtefactError(f"it was not tested after {protocol.budgets} episodes, as its protocol says.")
    for episode, start in enumerate(starts, start=len(run.training_success) - len(starts)):
        if start != (found := replays.start(episode_seed("training", seed, episode))):
            raise ArtefactError(f"training episode {episode} of seed {seed} starts at {found}, and {start} was kept.")
    purpose = evaluation_split(seed)
    return sum(_verify_test(row, protocol.evaluation_episodes, purpose, replays) for row in rows)


def _verify_test(row: Checkpoint, count: int, purpose: Purpose, replays: Replays) -> int:
    where = f"after {row.episodes:,} episodes"
    kept = row.kept
    again = EvaluationCounts()
    if kept is None:
        raise ArtefactError("it keeps no test episodes, as no run of before 2026-11-24 does.")
    sizes = {len(kept.lengths), *(len(getattr(kept, name)) for name in _CLAIMS)}
    if sizes != {count} or kept.lengths.sum() != len(kept.actions):
        raise ArtefactError(f"{where} it does not keep {count} whole test episodes.")
    for test in range(count):
        played, ends = replays.test(episode_seed(purpose, 0, test), kept.actions_of(test))
        if not ends:
            raise ArtefactError(f"{where}, test {test}: its actions do not end an episode, or go on after its end.")
        again.add(played)
    for name, word in _CLAIMS.items():
        claimed = getattr(kept, name)
        replayed = getattr(again.kept(), name)
        wrong = np.flatnonzero((claimed != replayed).reshape(count, -1).any(axis=1))
        if len(wrong):
            test = int(wrong[0])
            raise ArtefactError(f"{where}, test {test}: the {word} is {replayed[test]}, and {claimed[test]} was kept.")
    for name, value in again.figures().items():
        if getattr(row, name) != value:
            raise ArtefactError(f"{where}: {name} is {value} by the test episodes, and {getattr(row, name)} was kept.")
    return count
