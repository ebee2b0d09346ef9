"""Verification: every kept episode, of training and of tests, is played again, and all that follows is computed anew.

:data:`UNSHOWN` lists the claims that a replay cannot show. Training again (:mod:`imagine_bench.running.retraining`)
shows more.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.environments import Env
from imagine_bench.errors import ArtefactError, InvalidValueError, UnknownNameError, brief, plain
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import digest
from imagine_bench.registry.entries import AgentEntry
from imagine_bench.rules import fewest_actions
from imagine_bench.running.bench import counted
from imagine_bench.running.evaluation import EpisodeRecord, EvaluationCounts, replay
from imagine_bench.running.retraining import Repeat, part_digest
from imagine_bench.running.run_state import Counters, CountVisits, environments
from imagine_bench.seeding import Purpose, episode_seed, evaluation_split
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.bench_folder import BenchStore, read_control
from imagine_bench.store.results import Checkpoint, KeptEpisodes, RunResult
from imagine_bench.values import Json

_CLAIMS = {
    "starts": "start",
    "returns": "return",
    "success": "success",
    "faults": "number of faults",
    "fingerprints": "fingerprint",
    "sim_times_s": "simulated time in seconds",
}
"""The kept fields of an episode beside its actions, and their names in a complaint."""
_SAME_TIME = 0.05
"""Share by which simulated times may differ: kinds of CPU differ by a step of physics."""
_OF_DATASET = re.compile("-([0-9]+)@")
"""The number of its episodes in a dataset's identity."""

UNSHOWN = (
    "that an agent chose the macro-actions that are kept as its own (another's, or an oracle's, play again as well)",
    "that runs were not chosen: a seed that failed may have been left out everywhere",
    "CPU seconds, diagnostics, and what observers measured",
    "pictures and recordings",
)
"""Claims of any bench that playing its episodes again cannot show."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """What was found of a run, or of the bench's report."""

    what: str
    complaint: str = ""  # empty where all holds
    episodes: int = 0  # played again
    unshown: tuple[str, ...] = ()  # claims that the kept files cannot show
    holds: str = "holds"  # the words where there is no complaint
    of_training: bool = False  # whether it is on a run that was trained again

    def __str__(self) -> str:
        if self.complaint:
            return f"{self.what}: {self.complaint}"
        played = f"; {self.episodes:,} episodes played again" if self.episodes else ""
        return f"{self.what}: {self.holds}{played}{''.join(f'; not shown: {each}' for each in self.unshown)}"

    @classmethod
    def of(cls, repeat: Repeat) -> Verdict:
        """That on a run which was trained again."""
        name = f"{repeat.agent} seed {repeat.seed}, trained again"
        return cls(what=name, complaint=brief_lines(repeat.complaint), holds=repeat.remark, of_training=True)


def verify_runs(folder: Path) -> list[Verdict]:
    """One verdict a run of the bench in ``folder``.

    Raises:
        ArtefactError: It is no bench of agents with folders of their own, or its protocol is damaged.
    """
    protocol = read_control(folder)
    unseen = {"observation": "state"} if registry.is_own(protocol.task) else {}  # nobody looks at frames
    with environments(protocol, **unseen) as envs:
        return verdicts(folder, Replays(*envs))


def verdicts(folder: Path, replays: Replays) -> list[Verdict]:
    """As :func:`verify_runs`, in environments of the bench's protocol."""
    protocol = read_control(folder)
    found: list[Verdict] = []
    owners: dict[tuple[str, str, str], int] = {}
    results: dict[str, RunResult] = {}
    for agent, seed in counted(protocol.runs, "runs", total=len(protocol.runs)):
        name = f"{agent} seed {seed}"
        check = _RunCheck(BenchStore(folder, protocol).run_folder(agent, seed), protocol, agent, seed, replays)
        try:
            results[agent] = check.load()
            episodes, unshown = check.play()
            check.require_own(owners)
            found.append(Verdict(what=name, episodes=episodes, unshown=tuple(unshown)))
        except ArtefactError as error:
            found.append(Verdict(what=name, complaint=brief_lines(error)))
        except Exception as error:  # whoever forges a file can write anything
            found.append(Verdict(what=name, complaint=does_not_fit(error)))
    if not any(each.complaint for each in found):
        try:
            found += _of_protocol(protocol, results)
        except Exception as error:  # likewise
            found.append(Verdict(what="protocol", complaint=does_not_fit(error)))
    return found


def brief_lines(error: object) -> str:
    """The message of an error, on one line."""
    return " ".join(plain(error).split())


def does_not_fit(error: Exception) -> str:
    """The complaint for an error that no check foresees, in a file that somebody changed and sealed again."""
    return f"its parts do not fit together ({type(error).__name__}: {brief_lines(error)})."


def cost(found: Sequence[Verdict], cpu_s: float) -> str:
    """The cost of playing episodes again, in a sentence."""
    return f"{sum(each.episodes for each in found):,} episodes; checked in {cpu_s:,.1f} CPU s."


class Replays:
    """Episodes played again in the protocol's own environments, each test once."""

    def __init__(self, env: Env, test_env: Env) -> None:
        self.training_env = env
        self._play_test = functools.cache(functools.partial(replay, test_env))

    def start(self, seed: int) -> list[int]:
        """Where a training episode begins."""
        return replay(self.training_env, seed, [])[0].start

    def test(self, seed: int, actions: Sequence[int]) -> tuple[EpisodeRecord, bool]:
        """A test episode, and whether the actions are all of it."""
        return self._play_test(seed, tuple(actions))


@dataclasses.dataclass
class _RunCheck:
    """One run that is verified. An ArtefactError names in one sentence the first claim that does not hold."""

    folder: Path
    protocol: Protocol
    agent: str
    seed: int
    replays: Replays

    def load(self) -> RunResult:
        """Read the run, and check all claims that need no replay."""
        run_folder.require_run_of(self.folder, self.protocol, self.agent, self.seed)
        if not run_folder.is_done(self.folder):
            raise ArtefactError("it is not finished.")
        self.run = run = run_folder.load_run(self.folder)
        self.is_older = run_folder.read_config(self.folder)["format"] == run_folder.WITHOUT_TRAINING
        self.entry = _entry_of(self.agent)
        if tuple(row.episodes for row in run.checkpoints) != self.protocol.budgets:
            raise ArtefactError(f"it was not tested after {self.protocol.budgets} episodes, as its protocol says.")
        learns = len(run.training_success) > 0 if self.entry is None else self.entry.learns
        self.trained = self.protocol.budgets[-1] if learns else 0
        if not len(run.training_success) == len(run.training_length) == self.trained:
            raise ArtefactError(f"it does not keep {self.trained} training episodes, as its protocol says.")
        for row in run.checkpoints:
            steps = int(run.training_length[: row.episodes].sum())
            if row.env_steps != steps:
                where = f"after {row.episodes:,} episodes"
                raise ArtefactError(f"{where}: env_steps is {steps}, and {brief(row.env_steps)} was kept.")
        spent_s = [0.0, *(row.train_cpu_s for row in run.checkpoints)]
        tests_s = [row.eval_cpu_s for row in run.checkpoints]
        if spent_s != sorted(spent_s) or not all(0.0 <= each < math.inf for each in (spent_s[-1], *tests_s)):
            raise ArtefactError(f"its CPU seconds are {brief(spent_s[1:])} of training and {brief(tests_s)} of tests.")
        return run

    def play(self) -> tuple[int, list[str]]:
        """Play all episodes again. Returns their number, and the claims of the run that cannot be shown."""
        count = self.protocol.evaluation_episodes
        purpose = evaluation_split(self.seed)
        kept = [self.run.training, *(row.kept for row in self.run.checkpoints)]
        if not self.is_older and any(each is None or each.sim_times_s is None for each in kept):
            raise ArtefactError("it does not keep all episodes of training and tests, as a run of its format does.")
        trained = self._play_training()
        for row in self.run.checkpoints:
            _verify_test(row, count, purpose, self.replays)
        return trained + count * len(self.run.checkpoints), self._unshown()

    def _play_training(self) -> int:
        kept = self.run.training
        starts = [] if self.run.training_starts is None else self.run.training_starts.tolist()
        count = 0 if kept is None else len(kept.lengths)
        first = self.trained - len(starts) if self.is_older else min(_of_dataset(self.protocol), self.trained)
        for episode, start in enumerate(starts[: len(starts) - count], start=first):
            if start != (found := self.replays.start(episode_seed("training", self.seed, episode))):
                where = f"training episode {episode} of seed {self.seed}"
                raise ArtefactError(f"{where} starts at {found}, and {brief(start)} was kept.")
        if kept is not None:
            self._compare_training(kept, first + len(starts) - count)
        return count

    def _compare_training(self, kept: KeptEpisodes, first: int) -> None:
        """Play the kept training episodes, of which the first is number ``first`` of the run, and compare."""
        again = Counters(episode=first)
        env = CountVisits(self.replays.training_env, again)
        _require_whole(kept, len(kept.lengths), "in training")
        for number in range(len(kept.lengths)):
            seed = episode_seed("training", self.seed, first + number)
            played, ends = replay(env, seed, kept.actions_of(number))
            if ends:  # a library's loop may leave an episode
                again.add_episode(played.success, len(played.actions))
        if again.episode != self.trained:
            raise ArtefactError(
                f"{again.episode - first} training episodes end with their macro-actions, not {self.trained - first}."
            )
        _compare(kept, again.training.kept(), "training episode", first)
        claims = {"success": self.run.training_success, "length": self.run.training_length}
        for name, claimed in claims.items():
            if claimed[first:].tolist() != getattr(again, name):
                raise ArtefactError(f"the {name} of a training episode is not that of its macro-actions.")
        tried = run_folder.tried_pairs(again.tried)
        if not self.is_older and sorted(tried) != sorted([] if self.run.tried is None else self.run.tried.tolist()):
            raise ArtefactError("which macro-actions were tried where does not follow from its training episodes.")

    def _unshown(self) -> list[str]:
        """The claims of this run that cannot be shown, such as training episodes that were not kept."""
        protocol = self.protocol
        unshown = []
        if self.is_older:
            unshown.append(
                f"its {self.trained:,} training episodes and its execution, which versions of before 2026-11-28 did "
                "not keep: env_steps, budgets and successes in training are claims"
            )
        if self.trained and protocol.dataset is not None:
            unshown.append(f"the training episodes that are those of the dataset {protocol.dataset}")
        if self.trained and protocol.after:
            unshown.append(f"its training on {', '.join(protocol.after)} before")
        if self.entry is None:
            unshown.append("whether it learns, for no package here offers it")
        return unshown

    def require_own(self, owners: dict[tuple[str, str, str], int]) -> None:
        """Compare the run's marks with those of the seeds before, which ``owners`` holds; no two seeds share one."""
        if not self.trained:
            return
        for name, mark in self._marks().items():
            owner = owners.setdefault((self.agent, name, mark), self.seed)
            if owner != self.seed:
                raise ArtefactError(f"its {name} are those of seed {owner}, and no two seeds of a learner share them.")

    def _marks(self) -> dict[str, str]:
        """Results that no two seeds of a learner share, by name: weights, CPU seconds, and tests with own failures.

        Two seeds that have learned from the same dataset alone may share weights and tests: these are left out then.
        """
        shared = _of_dataset(self.protocol)
        snapshot = run_folder.load_newest(self.folder / run_folder.CHECKPOINTS)
        marks = {}
        if snapshot is not None and snapshot.agent.arrays and self.trained > shared:
            marks["weights"] = part_digest(snapshot.agent)
        for row in self.run.checkpoints:
            where = f"after {row.episodes:,} episodes"
            if row.train_cpu_s:
                marks[f"CPU seconds {where}"] = repr(row.train_cpu_s)
            if row.kept is not None and row.episodes > shared and has_own_failures(row.kept, self.protocol):
                marks[f"tests {where}"] = part_digest(row.kept.actions)
        return marks


def _entry_of(agent: str) -> AgentEntry | None:
    """The registry line of an agent; None where its package is not here."""
    try:
        return registry.agent_entry(agent)
    except UnknownNameError:
        return None


def _of_dataset(protocol: Protocol) -> int:
    """The episodes of the dataset that comes first in training."""
    found = _OF_DATASET.search(protocol.dataset or "")
    return int(found[1]) if found else 0


def has_own_failures(kept: KeptEpisodes, protocol: Protocol) -> bool:
    """Whether tests failed in more ways than two seeds have in common.

    Learners that know nothing may repeat one macro-action or two. Equal plans fail alike where chance decides, where
    frames do not show all, and where no plan is short enough.
    """
    task = protocol.spec(testing=True)
    rules = task.rules
    starts = {tuple(start) for start in kept.starts.tolist()}
    has_chance = any(len(rules.outcomes(start, action)) > 1 for start in starts for action in range(rules.n_actions))
    if has_chance or task.sight is not None or kept.success.all() or not kept.success.any():
        return False
    found: set[int] = set()
    for test in np.flatnonzero(~kept.success).tolist():
        with suppress(InvalidValueError):  # nothing is solved from there
            if fewest_actions(rules, tuple(kept.starts[test].tolist())) <= task.horizon:
                found |= {*kept.actions_of(test)}
        if len(found) > 2:
            return True
    return False


def _of_protocol(protocol: Protocol, results: Mapping[str, RunResult]) -> Iterator[Verdict]:
    """A verdict on the encoders and settings of a protocol, if there is a complaint or an unshown claim."""
    complaint, unshown = _settings(protocol, results)
    entries = [_entry_of(agent) for agent in protocol.agents]
    is_older = any(run.training is None for run in results.values())
    codes = protocol.codes if protocol.codes != protocol.encoder else None  # one file may serve both kinds
    for kind, used in (("latents", protocol.encoder), ("codes", codes)):
        is_read = any(entry is None or (entry.needs_encoder and entry.encoder_kind == kind) for entry in entries)
        if used is not None and not is_read and not is_older:
            complaint = f"it names the encoder {used}, and no agent reads {kind}."
        elif used is not None and encoders.find(used) is None:
            unshown.append(f"what encoder {used} is, which is not here")
    if complaint or unshown:
        yield Verdict(what="protocol", complaint=complaint, unshown=tuple(unshown))


def _settings(protocol: Protocol, results: Mapping[str, RunResult]) -> tuple[str, list[str]]:
    """A complaint about the settings of learners, or an empty text, and the unshown claims about them."""
    settings: dict[str, Json] = {}
    silent = []
    for agent, run in results.items():
        entry = _entry_of(agent)
        if not len(run.training_success):
            continue
        has_settings = entry is None or bool(entry.settings)
        settings[agent] = dict(run.settings) if has_settings else {}
        if has_settings and not run.settings:
            silent.append(agent)
    if silent:
        return "", [f"what settings {', '.join(silent)} had"]
    if settings and not protocol.settings_digest:
        return "", ["that settings are those that were planned, of which the protocol has no digest"]
    found = digest(settings)
    if settings and found != protocol.settings_digest:
        return f"its settings_digest is {protocol.settings_digest}, and that of its runs is {found}.", []
    return "", []


def _verify_test(row: Checkpoint, count: int, purpose: Purpose, replays: Replays) -> None:
    """Raise ArtefactError where a row, or one of its ``count`` tests, does not follow from its macro-actions."""
    where = f"after {row.episodes:,} episodes"
    kept = row.kept
    again = EvaluationCounts()
    if kept is None:
        raise ArtefactError("it keeps no test episodes, as no run of before 2026-11-24 does.")
    _require_whole(kept, count, where)
    for test in range(count):
        played, ends = replays.test(episode_seed(purpose, 0, test), kept.actions_of(test))
        if not ends:
            raise ArtefactError(f"{where}, test {test}: its actions do not end an episode, or go on after its end.")
        again.add(played)
    _compare(kept, again.kept(), f"{where}, test")
    for name, value in again.figures().items():
        if getattr(row, name) != value:
            claimed = brief(getattr(row, name))
            raise ArtefactError(f"{where}: {name} is {brief(value)} by the test episodes, and {claimed} was kept.")


def _require_whole(kept: KeptEpisodes, count: int, where: str) -> None:
    claims = [getattr(kept, name) for name in _CLAIMS]
    sizes = {len(kept.lengths), *(len(claim) for claim in claims if claim is not None)}
    is_natural = kept.lengths.ndim == kept.actions.ndim == 1 and not (kept.lengths < 0).any()
    if sizes != {count} or not is_natural or kept.lengths.sum() != len(kept.actions):
        raise ArtefactError(f"{where} it does not keep {count} whole episodes.")


def _compare(kept: KeptEpisodes, again: KeptEpisodes, what: str, first: int = 0) -> None:
    """Raise ArtefactError for the first of all episodes that is not as it was kept; ``first`` is its number."""
    count = len(kept.lengths)
    for name, word in _CLAIMS.items():
        claimed = getattr(kept, name)
        replayed = getattr(again, name)
        if claimed is None:
            continue
        if claimed.shape != replayed.shape:
            raise ArtefactError(f"{what}s have {word} of shape {replayed.shape}, and {claimed.shape} was kept.")
        differs = claimed != replayed
        if name == "sim_times_s":
            differs = ~np.isclose(claimed, replayed, rtol=_SAME_TIME)
        if count and differs.any():
            number = int(differs.reshape(count, -1).any(axis=1).argmax())
            found = f"the {word} is {replayed[number]}, and {claimed[number]} was kept"
            raise ArtefactError(f"{what} {first + number}: {found}.")
