"""Tools of a forger of results: an honest bench, the project's own way to write its files, and worlds to play in.

Nothing here rests on how ``verify`` checks. A forger opens a run, changes its claims, and seals it again at every
level: the table, the checkpoint, the mark of a finished run, the protocol in each configuration, the folder's name.
"""

from __future__ import annotations

import atexit
import functools
import itertools
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from small_runs import run_observed

from imagine_bench import registry
from imagine_bench.arrays import Arrays
from imagine_bench.errors import ImagineBenchError
from imagine_bench.interfaces import Agent, Observation
from imagine_bench.interfaces.environments import Env
from imagine_bench.protocols.control import Protocol, context_of
from imagine_bench.protocols.data import Failure, Job, Launcher, OnProgress, RunSpec
from imagine_bench.report.bench import bench_page
from imagine_bench.report.page import write_page
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.evaluation import EvaluationCounts, play, play_test_episode
from imagine_bench.running.run_state import Counters, CountVisits, make_env
from imagine_bench.seeding import episode_seed
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import bench_folder
from imagine_bench.store.files import read_json, sealed, write_json
from imagine_bench.store.loading import load_so_far
from imagine_bench.store.results import Checkpoint, KeptEpisodes
from imagine_bench.store.run_folder import Snapshot, training_arrays
from imagine_bench.values import grouped, pack, unpack

LEARNERS = ("dqn", "count_table")
SEEDS = (0, 1, 2)
BUDGETS = (10, 40)
TESTS = 10
WORLD = Protocol(task="arrow_puzzle", preset="smoke", execution="kinematic")


class Remembering:
    """A launcher in this process that does each run once: trained again, it gives the same bits."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        failures = []
        for job in jobs:
            done = self._root / job.spec.protocol.hash / job.spec.agent / str(job.spec.seed)
            try:
                if not run_folder.is_done(done):
                    run_observed(job.spec, done, on_progress)
                shutil.copytree(done, job.folder, dirs_exist_ok=True)
            except ImagineBenchError as error:
                failures.append(Failure(job=job, reason=str(error)))
        return tuple(failures)


def honest_bench(root: Path, launcher: Launcher, **changes: Any) -> Path:
    """A bench that ran as it says, two learners and the two that do not learn."""
    few: dict[str, Any] = {
        "agents": (*LEARNERS, "oracle", "random"),
        "seeds": SEEDS,
        "budgets": BUDGETS,
        "evaluation_episodes": TESTS,
        "execution": "kinematic",
        "open_loop_starts": 0,
        "recorded_episodes": 0,
    }
    wanted, encoders = plan("arrow_puzzle", "smoke", **{**few, **changes})
    return bench(wanted, encoders, root=root, launcher=launcher).folder


@functools.cache
def shared_bench() -> tuple[Path, Remembering]:
    """An honest bench that no test changes, and the launcher that knows its runs; made once a process."""
    root = Path(tempfile.mkdtemp(prefix="honest_bench_"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    launcher = Remembering(root / "trained")
    return honest_bench(root / "honest", launcher), launcher


@functools.cache
def world() -> Env:
    """The world in which a forger plays the episodes that are to be believed."""
    return make_env(WORLD, "arrow_puzzle")


@functools.cache
def oracle() -> Agent:
    return registry.make_agent("oracle", context_of(RunSpec(protocol=WORLD, agent="oracle", seed=0)))


class Hand:
    """The player in a learner's stead: the optimal macro-action with probability ``skill``, else any."""

    def __init__(self, skill: float, rng: np.random.Generator) -> None:
        self._oracle = oracle()
        self._skill = skill
        self._rng = rng

    def act(self, observation: Observation, *, explore: bool) -> int:
        if self._rng.random() < self._skill:
            return self._oracle.act(observation, explore=False)
        return int(self._rng.integers(6))


def tests_by(hand: Any, episodes: Sequence[int] = range(TESTS)) -> EvaluationCounts:
    """Test episodes as ``hand`` plays them."""
    played = EvaluationCounts()
    for episode in episodes:
        played.add(play_test_episode(world(), hand, seed=episode_seed("evaluation", 0, episode), privileged=True))
    return played


def mixed(sources: Sequence[EvaluationCounts]) -> EvaluationCounts:
    """Test episodes, each as another source has it."""
    merged = EvaluationCounts()
    for test, source in enumerate(sources):
        start = sum(source.lengths[:test])
        merged.actions += source.actions[start : start + source.lengths[test]]
        for name in ("starts", "lengths", "returns", "faults", "fingerprints", "sim_times_s"):
            getattr(merged, name).append(getattr(source, name)[test])
        merged.solved += source.solved[test]
    return merged


def training_by(hand: Any, seed: int, episodes: int) -> Counters:
    """Training episodes as ``hand`` plays them, with all that a run counts of them."""
    counters = Counters()
    env = CountVisits(world(), counters)
    for episode in range(episodes):
        at = episode_seed("training", seed, episode)
        lived = list(play(env, hand, seed=at, explore=True, privileged=True))
        counters.add_episode(bool(lived[-1][1]["is_success"]), len(lived))
    return counters


@dataclass
class OpenRun:
    """A run's files as values that can be changed."""

    folder: Path
    config: dict[str, Any]
    episode: int
    agent: Any
    arrays: dict[str, Any]
    values: dict[str, Any]

    @classmethod
    def read(cls, folder: Path) -> OpenRun:
        snapshot = run_folder.load_newest(folder / run_folder.CHECKPOINTS)
        assert snapshot is not None
        return cls(
            folder, run_folder.read_config(folder), snapshot.episode, snapshot.agent, dict(snapshot.arrays),
            dict(snapshot.values),
        )  # fmt: skip

    @property
    def seed(self) -> int:
        return int(self.config["seed"])

    @property
    def rows(self) -> list[dict[str, Any]]:
        return self.values["rows"]

    def write(self) -> None:
        """Write and seal everything again."""
        self.write_state()
        self.write_table()

    def write_state(self) -> None:
        shutil.rmtree(self.folder / run_folder.CHECKPOINTS)
        write_json(self.folder / "config.json", sealed(self.config))
        snapshot = Snapshot(episode=self.episode, agent=self.agent, arrays=self.arrays, values=self.values)
        run_folder.save_snapshot(self.folder / run_folder.CHECKPOINTS, snapshot)

    def write_table(self) -> None:
        """Write the table alone, and seal everything again."""
        rows = unpack(tuple[Checkpoint, ...], self.rows, grouped(self.arrays).get("rows", {}))
        run_folder.write_metrics(self.folder, rows)
        self.seal()

    def seal(self) -> None:
        (state,) = self.folder.glob("checkpoints/*/state.json")
        names = ["config.json", "metrics.csv", "imagined.npz", state.relative_to(self.folder).as_posix()]
        run_folder.mark_done(self.folder, names)

    def drop(self, *prefixes: str, suffix: str = "") -> None:
        """Forget arrays, and their places in the state."""
        for name in [name for name in self.arrays if name.startswith(prefixes) and name.endswith(suffix)]:
            del self.arrays[name]
            group, _, field = name.rpartition("/")
            if group.startswith("rows/") and group.endswith("/kept"):
                self.rows[int(group.split("/")[1])]["kept"].pop(field)

    def set_tests(self, row: int, tests: EvaluationCounts) -> None:
        """Let a budget's tests be others, with every figure that follows from them."""
        self.drop(f"rows/{row}/kept/")
        self.rows[row]["kept"], arrays = pack(tests.kept(), f"rows/{row}/kept")
        self.arrays |= arrays
        self.rows[row] |= tests.figures()

    def kept(self, row: int) -> Arrays:
        """The arrays of a budget's tests."""
        start = f"rows/{row}/kept/"
        return {name.removeprefix(start): array for name, array in self.arrays.items() if name.startswith(start)}

    def tests(self, row: int) -> EvaluationCounts:
        """A budget's tests."""
        return EvaluationCounts.of(unpack(KeptEpisodes, None, self.kept(row)))

    def training_actions(self) -> list[list[int]]:
        """The macro-actions of each training episode."""
        flat = iter(self.arrays["training/actions"].tolist())
        return [list(itertools.islice(flat, int(length))) for length in self.arrays["training/lengths"]]

    def set_training(self, counters: Counters) -> None:
        """Let training be another, with the steps that follow from it."""
        self.drop("training/")
        self.arrays |= training_arrays(counters.training.kept())
        told = {name: getattr(counters, name) for name in ("success", "length", "queries", "tried", "env_steps")}
        self.values |= told
        for row in self.rows:
            row["env_steps"] = sum(counters.length[: row["episodes"]])
            self.say_steps(row)

    def say_steps(self, row: dict[str, Any]) -> None:
        """Make the agent's own counts of its steps agree with the run's."""
        for name in ("real_transitions", "gradient_updates"):
            if name in row["diagnostics"]:
                row["diagnostics"][name] = float(row["env_steps"])

    def call_older(self) -> None:
        """Call the run one of a version that kept less."""
        self.config["format"] = run_folder.WITHOUT_TRAINING
        self.values["starts"] = self.arrays["training/starts"].tolist() if "training/starts" in self.arrays else []
        self.drop("training/")
        self.drop("rows/", suffix="/sim_times_s")


def all_runs(bench: Path) -> Iterator[OpenRun]:
    for path in sorted(bench.glob("*/seed_*/DONE")):
        yield OpenRun.read(path.parent)


def rewrite_protocol(bench: Path, **values: Any) -> Path:
    """Other values in every copy of a bench's protocol, and in its hash; returns where the bench lies then."""
    wanted = Protocol.from_dict(read_json(bench / "protocol.json", "") | values)
    write_json(bench / "protocol.json", wanted.as_dict())
    for run in all_runs(bench):
        run.config |= {"protocol": wanted.as_dict(), "protocol_hash": wanted.hash}
        run.write()
    return bench.rename(bench.with_name(bench_folder(bench, wanted).name))


def of_second(change: Callable[[OpenRun, OpenRun], object]) -> Callable[[Path], None]:
    """Of two seeds of the learner ``table`` the second is changed, as the first one is."""

    def forge(folder: Path) -> None:
        one, other = (OpenRun.read(folder / "table" / f"seed_{seed}") for seed in (0, 1))
        change(one, other)
        other.write()

    return forge


class Repeats:
    """Plays given macro-actions, and any where they are used up or an episode goes on."""

    def __init__(self, actions: Sequence[int], rng: np.random.Generator) -> None:
        self._actions = iter(actions)
        self._rng = rng

    def act(self, observation: Observation, *, explore: bool) -> int:
        return next(self._actions, int(self._rng.integers(6)))


class Forger:
    """A copy of a bench, open for changes.

    Args:
        source: The honest bench.
        root: Where the copy goes.
        rng: Draws the variant.
        every: Every run of an agent is forged, or one run.
    """

    def __init__(self, source: Path, root: Path, rng: np.random.Generator, *, every: bool) -> None:
        self.folder = root / source.parent.name / source.name
        shutil.copytree(source, self.folder)
        self.rng = rng
        self.every = every
        self.drawn: list[Any] = []
        self.protocol: dict[str, Any] = read_json(self.folder / "protocol.json", "")
        agent = self.chance(0.5)
        self.agents = list(LEARNERS) if every else [LEARNERS[int(agent)]]
        if every and self.chance(0.5):
            self.agents = [LEARNERS[int(agent)]]
        seeds = list(self.protocol["seeds"])
        self.seeds = seeds if every else [int(rng.choice(seeds))]

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def pick(self, *of: Any) -> Any:
        self.drawn.append(of[int(self.rng.integers(len(of)))])
        return self.drawn[-1]

    def run(self, agent: str, seed: int) -> OpenRun:
        return OpenRun.read(self.folder / agent / f"seed_{seed}")

    def chosen(self) -> list[OpenRun]:
        """The runs to be forged."""
        return [self.run(agent, seed) for agent in self.agents for seed in self.seeds]

    def rows(self) -> list[int]:
        """Budgets to be forged: one, or all."""
        return self.pick([0], [1], [0, 1])

    def edit(self, change: Callable[[OpenRun], None], *, older: float = 0.15) -> None:
        """Change the chosen runs, and seal them; now and then they are called older than they are."""
        is_older = self.chance(older)
        self.drawn += ["called older"] * is_older
        for run in self.chosen():
            change(run)
            if is_older:
                run.call_older()
            run.write()

    def set_protocol(self, **changes: Any) -> None:
        """Let the bench be of another protocol, in each copy and in its name."""
        self.protocol |= changes
        self.folder = rewrite_protocol(self.folder, **changes)

    def rename_seeds(self, names: dict[int, int]) -> None:
        """Call seeds otherwise, in each copy."""
        for run in all_runs(self.folder):
            if run.seed in names:
                run.config["seed"] = names[run.seed]
                run.write()
                run.folder.rename(run.folder.with_name(f"new_{run.seed}"))
        for path in list(self.folder.glob("*/new_*")):
            path.rename(path.with_name(path.name.replace("new_", "seed_")))
        self.set_protocol(seeds=[names.get(seed, seed) for seed in self.protocol["seeds"]])

    def sessions(self, change: Callable[[dict[str, Any]], None]) -> None:
        """Change the bench's record of its sessions."""
        path = self.folder / "sessions.json"
        found = read_json(path, "")
        found.pop("seal")
        change(found)
        write_json(path, sealed(found))

    def finish(self, cpu: str = "") -> Path:
        """The forged bench, now and then with its report made again, and made on ``cpu`` if that is to be said.

        Raises ArtefactError: a report cannot read it.
        """
        if cpu:
            self.sessions(lambda found: found["environment"]["machine"].update(cpu=cpu))
        result = load_so_far(self.folder)
        if self.chance(0.1):
            self.drawn.append("report made again")
            write_page(self.folder / "report", bench_page(result))
        return self.folder
