"""Verification: every kept episode, of training and of tests, is played again, and all that follows is computed anew.

:data:`UNSHOWN` lists the claims that a replay cannot show. Training again (:mod:`imagine_bench.running.retraining`)
shows more.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError, brief, require
from imagine_bench.exact.certificate import Certificate
from imagine_bench.interfaces.environments import Env
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import digest
from imagine_bench.protocols.presets import PRESETS
from imagine_bench.registry.machine import commit
from imagine_bench.rules import fewest_actions
from imagine_bench.running.bench import certificate_of, counted
from imagine_bench.running.evaluation import EpisodeRecord, EvaluationCounts, replay
from imagine_bench.running.retraining import Verdict, judged, part_digest
from imagine_bench.running.run_state import Counters, CountVisits, environments
from imagine_bench.seeding import TUNING_SEEDS, Purpose, episode_seed, evaluation_split, is_tuning_seed, seed_range
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_facts, read_control
from imagine_bench.store.results import Checkpoint, KeptEpisodes, RunResult

_CLAIMS = {
    "lengths": "number of macro-actions",
    "starts": "start",
    "returns": "return",
    "success": "success",
    "faults": "number of faults",
    "fingerprints": "fingerprint",
    "sim_times_s": "simulated time in seconds",
}
"""The kept fields of an episode beside its actions, and their names in a complaint."""
_OF_OLDER_RUNS = (
    "its training episodes and its execution, which versions of before 2026-11-28 did not keep: env_steps, budgets and "
    "successes in training are claims"
)
_SAME_TIME = 0.05
"""Share by which simulated times may differ: kinds of CPU differ by a step of physics."""
_OF_DATASET = re.compile("-([0-9]+)@[0-9a-f]+$")
"""The number of its episodes in a dataset's identity."""
_SEEDS_OF_COMMAND = re.compile(" bench .*--seeds[ =]([0-9]+(?:[ -][0-9]+)*)")

UNSHOWN = (
    "that an agent chose the macro-actions that are kept as its own (another's, or an oracle's, play again as well)",
    "that runs were not chosen: the seeds that come last may have been left out everywhere",
    "CPU seconds, diagnostics, and the measures of observers",
    "pictures and recordings",
)
"""Claims of any bench that playing its episodes again cannot show."""


def verify_runs(folder: Path) -> list[Verdict]:
    """One verdict a run of the bench in ``folder`` and, where all hold, one on its protocol.

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
    store = BenchStore(folder, protocol)
    checks = [_RunCheck(store.run_folder(*pair), protocol, *pair, replays) for pair in protocol.runs]
    owners: dict[tuple[str, str, str], int] = {}
    found = []
    for check in counted(checks, "runs", total=len(checks)):
        found.append(judged(check.name, functools.partial(check.verify, owners)))
    if not any(each.complaint for each in found):
        runs = {check.agent: check.run for check in checks}
        found.append(judged("protocol", lambda: _verify_protocol(folder, protocol, runs)))
    return found


def cost(found: Sequence[Verdict], cpu_s: float) -> str:
    """The cost of playing episodes again, in a sentence."""
    return f"{sum(each.episodes for each in found):,} episodes; checked in {cpu_s:,.1f} CPU s."


class Replays:
    """Episodes played again in the protocol's own environments, each test once."""

    def __init__(self, env: Env, test_env: Env) -> None:
        self.training_env = env
        self._play_test = functools.cache(functools.partial(replay, test_env))

    def test(self, seed: int, actions: Sequence[int]) -> tuple[EpisodeRecord, bool]:
        """A test episode, and whether the actions are all of it."""
        return self._play_test(seed, tuple(actions))


def _agree(where: str, claimed: Mapping[str, object], found: Sequence[object]) -> None:
    """Raise ArtefactError for the first claim, by name, that differs from the value found in its place."""
    for (name, claim), value in zip(claimed.items(), found, strict=True):
        require(claim == value, f"{where}{name} is {brief(value)}, and the file says {brief(claim)}.")


@dataclasses.dataclass
class _RunCheck:
    """One run that is verified. An ArtefactError names in one sentence the first claim that does not hold."""

    folder: Path
    protocol: Protocol
    agent: str
    seed: int
    replays: Replays

    @property
    def name(self) -> str:
        """The run in words."""
        return f"{self.agent} seed {self.seed}"

    def verify(self, owners: dict[tuple[str, str, str], int]) -> Verdict:
        """Check everything; ``owners`` holds the marks of the seeds before."""
        self._load()
        run = self.run
        episodes = 0 if self.is_older or run.training is None else self._play_training(run.training)
        for row in run.checkpoints:
            steps = int(run.training_length[: row.episodes].sum())
            episodes += verify_tests(row, self.protocol, evaluation_split(self.seed), self.replays, env_steps=steps)
        self._require_own(owners)
        return Verdict(what=self.name, episodes=episodes, unshown=self._unshown())

    def _load(self) -> None:
        """Read the run, and check the claims that need no replay."""
        run_folder.require_run_of(self.folder, self.protocol, self.agent, self.seed)
        require(run_folder.is_done(self.folder), "it is not finished.")
        self.run = run = run_folder.load_run(self.folder)
        self.snapshot = snapshot = run_folder.load_newest(self.folder / run_folder.CHECKPOINTS)
        self.is_older = run_folder.read_config(self.folder)["format"] == run_folder.WITHOUT_TRAINING
        self.entry = registry.known_entry(self.agent)
        budgets = self.protocol.budgets
        learns = len(run.training_success) > 0 if self.entry is None else self.entry.learns
        self.trained = budgets[-1] if learns else 0
        claimed = {
            "list of budgets": tuple(row.episodes for row in run.checkpoints),
            "number of training episodes": len(run.training_success),
            "number of their lengths": len(run.training_length),
            "number of training episodes on earlier tasks": 0 if snapshot is None else snapshot.values["before"],
        }
        _agree("the ", claimed, (budgets, self.trained, self.trained, self.protocol.episodes_before if learns else 0))
        kept = [run.training, *(row.kept for row in run.checkpoints)]
        is_whole = not any(each is None or each.sim_times_s is None for each in kept)
        require(is_whole or self.is_older, "it does not keep all episodes, as a run of its format does.")
        spent_s = [0.0, *(row.train_cpu_s for row in run.checkpoints)]
        tests_s = [row.eval_cpu_s for row in run.checkpoints]
        is_time = spent_s == sorted(spent_s) and all(0.0 <= each < math.inf for each in (spent_s[-1], *tests_s))
        require(is_time, f"its CPU seconds are {brief(spent_s[1:])} of training and {brief(tests_s)} of tests.")

    def _play_training(self, kept: KeptEpisodes) -> int:
        """Play the training episodes again, but those of a dataset. Returns their number."""
        first = min(_of_dataset(self.protocol), self.trained)
        again = Counters(episode=first)
        env = CountVisits(self.replays.training_env, again)
        for number in range(len(kept.lengths)):
            seed = episode_seed("training", self.seed, first + number)
            played, ends = replay(env, seed, kept.actions_of(number))
            if ends:  # a library's loop may leave an episode
                again.add_episode(played.success, len(played.actions))
        _compare(kept, again.training.kept(), "training episode", first)
        claimed = {
            "number of training episodes that end": self.trained,
            "list of their successes": self.run.training_success[first:].tolist(),
            "list of their lengths": self.run.training_length[first:].tolist(),
            "list of the macro-actions that they tried where": []
            if self.run.tried is None
            else sorted(self.run.tried.tolist()),
        }
        tried = sorted(run_folder.tried_pairs(again.tried))
        _agree("the ", claimed, (again.episode, again.success, again.length, tried))
        return len(kept.lengths)

    def _unshown(self) -> tuple[str, ...]:
        """The claims of this run that cannot be shown, such as training episodes that were not kept."""
        protocol = self.protocol
        claims = {
            _OF_OLDER_RUNS: self.is_older,
            f"the training episodes that are those of the dataset {protocol.dataset}": protocol.dataset
            and self.trained,
            f"its training on {', '.join(protocol.after)} before": protocol.after and self.trained,
            f"whether {self.agent} learns, for no package here offers it": self.entry is None,
        }
        return tuple(claim for claim, is_unshown in claims.items() if is_unshown)

    def _require_own(self, owners: dict[tuple[str, str, str], int]) -> None:
        """Compare the run's marks with those of the seeds before; no two seeds share one."""
        for name, mark in self._marks().items():
            owner = owners.setdefault((self.agent, name, mark), self.seed)
            shared = f"its {name} are those of seed {owner}, and no two seeds of a learner share them."
            require(owner == self.seed, shared)

    def _marks(self) -> dict[str, str]:
        """Results that no two seeds of a learner share, by name: weights, CPU seconds, and tests with own failures.

        Two seeds that have learned from the same dataset alone may share weights and tests: these are left out then.
        """
        shared = _of_dataset(self.protocol)
        marks = {}
        if self.snapshot is not None and self.snapshot.agent.arrays and self.trained > shared:
            marks["weights"] = part_digest(self.snapshot.agent)
        for row in self.run.checkpoints if self.trained else ():
            where = f"after {row.episodes:,} episodes"
            if row.train_cpu_s:
                marks[f"CPU seconds {where}"] = repr(row.train_cpu_s)
            if row.kept is not None and row.episodes > shared and has_own_failures(row.kept, self.protocol):
                marks[f"tests {where}"] = part_digest(row.kept.actions)
        return marks


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
    if has_chance or task.sight is not None or not kept.success.any():
        return False
    found: set[int] = set()
    for test in np.flatnonzero(~kept.success).tolist():
        with suppress(InvalidValueError):  # nothing is solved from there
            if fewest_actions(rules, tuple(kept.starts[test].tolist())) <= task.horizon:
                found |= {*kept.actions_of(test)}
    return len(found) > 2


# The protocol ------------------------------------------------------------------------------------------------------


def _verify_protocol(folder: Path, protocol: Protocol, runs: Mapping[str, RunResult]) -> Verdict:
    """Check the claims of a bench that are no run's."""
    facts = bench_facts(folder)
    is_older = any(run.training is None for run in runs.values())
    unshown = [*_settings(protocol, runs), *_seeds(protocol, facts["environment"]["sessions"])]
    entries = [registry.known_entry(agent) for agent in protocol.agents]
    codes = protocol.codes if protocol.codes != protocol.encoder else None  # one file may serve both kinds
    for kind, used in (("latents", protocol.encoder), ("codes", codes)):
        is_read = any(entry is None or (entry.needs_encoder and entry.encoder_kind == kind) for entry in entries)
        require(used is None or is_read or is_older, f"it names the encoder {used}, and no agent reads {kind}.")
        if used is not None and encoders.find(used) is None:
            unshown.append(f"the kind of encoder {used}, which is not here")
    if _rounded(facts.get("certificate")) != _rounded(certificate_of(protocol.task, protocol.split)):
        made_at = facts["environment"].get("commit")
        differ = "exact facts of its world, such as chance and optimum"
        require(is_older or made_at != commit(), f"it says other {differ}, than its rules have.")
        unshown.append(f"{differ}: commit {made_at}, as it says, computed others than this version")
    return Verdict(what="protocol", unshown=tuple(unshown))


def _rounded(certificate: Certificate | None) -> object:
    """The exact facts of a world, to six digits."""
    values = None if certificate is None else dataclasses.asdict(certificate)
    return json.loads(json.dumps(values), parse_float=lambda text: f"{float(text):.6g}")


def _seeds(protocol: Protocol, sessions: Sequence[Mapping[str, str]]) -> list[str]:
    """Compare the seeds with those of the commands, and say where others were planned or left out."""
    seeds = protocol.seeds
    for session in sessions:
        said = _SEEDS_OF_COMMAND.search(session["command"])
        if "--until-decided" in session["command"]:  # later stages have further seeds
            said = None
        planned = seeds if said is None else tuple(sorted(chain.from_iterable(map(seed_range, said[1].split()))))
        require(planned == seeds, f"it has the seeds {brief(seeds)}, and {brief(session['command'])} ran others.")
    task = registry.task(protocol.task)
    preset = {**PRESETS.get(protocol.preset, {}), **task.presets.get(protocol.preset, {})}
    is_of_player = all(map(registry.is_player, protocol.agents))  # whose run is one
    usual = seeds[:1] if is_of_player else preset.get("seeds", Protocol.seeds)
    few = {(agent, seeds[:most][-1]) for agent, most in preset.get("few_seeds", {}).items()}
    first = TUNING_SEEDS if is_tuning_seed(seeds[0]) else 0
    is_whole = seeds == tuple(range(first, first + len(seeds))) and len(seeds) >= len(usual)
    if is_whole and few.issuperset(protocol.few_seeds):
        return []
    fewer = f", fewer of {', '.join(agent for agent, _ in protocol.few_seeds)}" if protocol.few_seeds else ""
    return [f"whether seeds were left out: it has {brief(seeds)}{fewer}; its preset {protocol.preset} {brief(usual)}"]


def _settings(protocol: Protocol, runs: Mapping[str, RunResult]) -> list[str]:
    """Compare the learners' settings with the protocol's digest. Returns claims that cannot be shown."""
    learners = {agent: run for agent, run in runs.items() if len(run.training_success)}
    entries = {agent: registry.known_entry(agent) for agent in learners}
    able = {agent for agent, entry in entries.items() if entry is None or entry.settings}
    silent = [agent for agent in learners if agent in able and not learners[agent].settings]
    if silent:
        return [f"the settings that {', '.join(silent)} had"]
    if learners and not protocol.settings_digest:
        return ["that settings are those that were planned, of which the protocol has no digest"]
    found = digest({agent: dict(run.settings) if agent in able else {} for agent, run in learners.items()})
    if learners:
        _agree("", {"the settings_digest": protocol.settings_digest}, (found,))
    return []


# Episodes ----------------------------------------------------------------------------------------------------------


def verify_tests(
    row: Checkpoint, protocol: Protocol, purpose: Purpose, replays: Replays, *, env_steps: int, starts: int = 0
) -> int:
    """Play the tests of a budget again, at the starts of the seed ``starts``. Returns their number.

    Raises ArtefactError: the row, or a test, does not follow from the macro-actions, or from training in ``env_steps``.
    """
    where = f"after {row.episodes:,} episodes"
    kept = row.kept
    again = EvaluationCounts()
    if kept is None:
        raise ArtefactError("it keeps no test episodes, as no run of before 2026-11-24 does.")
    _agree(f"{where}: the ", {"number of tests": len(kept.lengths)}, (protocol.evaluation_episodes,))
    for test in range(protocol.evaluation_episodes):
        played, ends = replays.test(episode_seed(purpose, starts, test), kept.actions_of(test))
        require(ends, f"{where}, test {test}: its actions do not end an episode, or go on after its end.")
        again.add(played)
    _compare(kept, again.kept(), f"{where}, test")
    figures = {**again.figures(), "env_steps": env_steps}
    _agree(f"{where}: ", {name: getattr(row, name) for name in figures}, [*figures.values()])
    return again.episodes


def _compare(kept: KeptEpisodes, again: KeptEpisodes, what: str, first: int = 0) -> None:
    """Raise ArtefactError for the first of all episodes that is not as it was kept; ``first`` is its number."""
    require(kept.actions.shape == again.actions.shape, f"{what}s are not all of the macro-actions in the file.")
    for name, word in _CLAIMS.items():
        claimed = getattr(kept, name)
        replayed = getattr(again, name)
        if claimed is None:  # in an older run
            continue
        shapes = f"{what}s have {word} of shape {replayed.shape}, and the file has {claimed.shape}."
        require(claimed.shape == replayed.shape, shapes)
        differs = claimed != replayed
        if name == "sim_times_s":
            differs = ~np.isclose(claimed, replayed, rtol=_SAME_TIME)
        if differs.any():
            number = int(differs.reshape(len(differs), -1).any(axis=1).argmax())
            found = f"the {word} is {replayed[number]}, and the file says {claimed[number]}"
            raise ArtefactError(f"{what} {first + number}: {found}.")
