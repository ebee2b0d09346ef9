"""Runs on a real Ray cluster and by submitit: the same bits as at home, also when they are cut off in the middle."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import psutil
import pytest
from small_runs import same_but_for_time, small

from imagine_bench import registry
from imagine_bench.errors import SetupError
from imagine_bench.protocols.control import protocol
from imagine_bench.protocols.data import Job, Progress, RunSpec
from imagine_bench.running.launchers.jobs import LocalPool, absolute, launcher
from imagine_bench.store import encoders
from imagine_bench.store.run_folder import load_run

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="Ray is an optional extra: pip install 'imagine-bench[ray]'"
)


def jobs(root: Path, seeds: tuple[int, ...], episodes: int) -> list[Job]:
    """Small real learners that take a few seconds each and checkpoint often."""
    encoder = encoders.own(registry.task("arrow_puzzle"), "clean")
    wanted = protocol(
        "arrow_puzzle", "smoke", agents=("dqn",), seeds=seeds, budgets=(episodes // 2, episodes),
        evaluation_episodes=5, execution="kinematic", open_loop_starts=0, recorded_episodes=0,
        overrides=(("controller.hidden", (32, 32)),), encoder=encoders.identity(encoder),
    )  # fmt: skip
    return [
        Job(
            spec=RunSpec(protocol=wanted, agent="dqn", seed=seed, encoder=encoder, checkpoint_every_s=0.2),
            folder=root / f"seed_{seed}",
        )
        for seed in seeds
    ]


def same_results(root: Path, name: str, jobs_of: dict[str, Any]) -> bool:
    """Whether jobs that a launcher carried out end as they do at home, to the bit."""
    assert LocalPool(2).launch(jobs(root / "home", **jobs_of), lambda _: None) == ()
    seeds = jobs_of["seeds"]
    there, here = ([load_run(root / where / f"seed_{seed}") for seed in seeds] for where in (name, "home"))
    return all(map(same_but_for_time, there, here))


@pytest.mark.parametrize(("name", "module"), [("ray", "ray"), ("slurm", "submitit")])
def test_a_launcher_that_is_not_installed_says_how_to_install_it(name: str, module: str) -> None:
    absent = f"import sys; sys.modules[{module!r}] = None; from imagine_bench.running.launchers.jobs import launcher; "
    done = subprocess.run([sys.executable, "-c", f"{absent}launcher({name!r})"], capture_output=True, check=False)
    said = done.stderr.decode()
    assert f"needs {module}, which is not installed: pip install 'imagine-bench[{name}]'" in said, said


@pytest.mark.slow
def test_submitted_jobs_give_the_same_bits_also_when_preempted(tmp_path: Path) -> None:
    """submitit's executor for one machine, with the signal that Slurm sends before it takes a node away."""
    told: list[Progress] = []
    preempted: list[int] = []

    def preempt(progress: Progress) -> None:
        told.append(progress)
        if progress.episode >= 20 and not preempted:
            for child in psutil.Process().children(recursive=True):
                if "submitit.core._submit" in " ".join(child.cmdline()):
                    child.send_signal(signal.SIGUSR2)
                    preempted.append(progress.episode)

    few: dict[str, Any] = {"seeds": (0,), "episodes": 600}
    assert launcher("slurm", 1).launch(jobs(tmp_path / "slurm", **few), preempt) == ()
    assert preempted and (tmp_path / "slurm" / "seed_0" / "log.txt").read_text().count("begins or goes on") == 2
    assert same_results(tmp_path, "slurm", few) and told[-1].phase == "done"


def test_a_submitted_job_that_fails_says_why(tmp_path: Path) -> None:
    (job,) = jobs(tmp_path, (0,), 60)
    lost = dataclasses.replace(job, spec=dataclasses.replace(job.spec, encoder=tmp_path / "no.safetensors"))
    (failure,) = launcher("slurm", 1).launch([lost], lambda _: None)
    assert "no.safetensors" in failure.reason and failure.job.spec.seed == 0


@needs_ray
@pytest.mark.slow
def test_a_cluster_started_here_gives_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    told: list[Progress] = []
    few: dict[str, Any] = {"seeds": (0,), "episodes": 60}
    assert launcher("ray", 1).launch(jobs(tmp_path / "ray", **few), told.append) == ()
    assert same_results(tmp_path, "ray", few) and told[-1].phase == "done"


@needs_ray
@pytest.mark.slow
def test_a_node_and_a_worker_killed_in_the_middle_cost_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two raylets; the second, with the runs on it, is killed outright, and a worker of the first by signal 9."""
    from ray.cluster_utils import Cluster

    few: dict[str, Any] = {"seeds": (0, 1, 2), "episodes": 240}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    doomed = cluster.add_node(num_cpus=2)
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    killed: dict[str, list[int]] = {"node": [], "worker": []}
    begun: set[int] = set()

    def kill(progress: Progress) -> None:
        if progress.episode >= 20:
            begun.add(progress.seed)
        if len(begun) == 3 and not killed["node"]:
            killed["node"] = [progress.episode]
            cluster.remove_node(doomed, allow_graceful=False)
        elif killed["node"] and not killed["worker"] and progress.episode > killed["node"][0] + 40:
            holder = (tmp_path / "ray" / f"seed_{progress.seed}" / ".lock.holder").read_text()  # "process N on HOST"
            os.kill(int(holder.split()[1]), signal.SIGKILL)
            killed["worker"] = [progress.episode]

    try:
        assert launcher("ray", 1).launch(jobs(tmp_path / "ray", **few), kill) == ()
    finally:
        cluster.shutdown()
    assert killed["node"] and killed["worker"], "both must really have been killed in the middle"
    logs = "".join(log.read_text() for log in tmp_path.glob("ray/*/log.txt"))
    assert logs.count("begins or goes on") >= 3 + 2, "the lost runs must have been started again"
    assert same_results(tmp_path, "ray", few)


class Sent:
    """The result of a task, or of a method of an actor, which is there at once."""

    def __init__(self, function: Callable[..., object], *given: object) -> None:
        self.value = function(*given)


class Remote:
    """A function that runs in this process, or a class whose objects are here."""

    def __init__(self, thing: Callable[..., object]) -> None:
        self._thing = thing

    def options(self, **options: object) -> Remote:
        return self

    def remote(self, *given: object) -> object:
        return Actor(self._thing(*given)) if isinstance(self._thing, type) else Sent(self._thing, *given)


class Actor:
    """An object whose methods are called as those of one elsewhere."""

    def __init__(self, held: object) -> None:
        self._held = held

    def __getattr__(self, name: str) -> Remote:
        return Remote(getattr(self._held, name))


@pytest.fixture
def ray_here(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Ray need not be installed: tasks are carried out in this process when they are sent, before any news is taken."""
    ray = mock.MagicMock()
    ray.cluster_resources.return_value = {}
    ray.get.side_effect = lambda sent: sent.value
    ray.wait.side_effect = lambda tasks, timeout: (tasks, [])
    ray.remote.side_effect = lambda *thing, **options: Remote(*thing) if thing else Remote
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.delitem(sys.modules, "imagine_bench.running.launchers.ray", raising=False)
    for name, module in (("ray", ray), ("ray.actor", ray.actor)):
        monkeypatch.setitem(sys.modules, name, module)
    outputs = [os.dup(number) for number in (1, 2)]  # a task's output goes to the log of its run
    yield
    for number, output in enumerate(outputs, 1):
        os.dup2(output, number)
        os.close(output)
    sys.modules.pop("imagine_bench.running.launchers.ray", None)


@pytest.mark.usefixtures("ray_here")
def test_the_end_of_every_run_of_several_benches_is_told_once(tmp_path: Path) -> None:
    """The benches of a study have the same agents and seeds. One run cannot begin."""
    benches = [small(agents=("random", "table"), seeds=(0, 1), evaluation_episodes=count) for count in (1, 2)]
    every = [
        Job(spec=RunSpec(protocol=bench, agent=agent, seed=seed), folder=tmp_path / bench.hash / f"{agent}_{seed}")
        for bench in benches
        for agent, seed in bench.runs
    ]
    every[0].folder.parent.mkdir()
    every[0].folder.touch()  # a file stands where the run's folder should be
    told: list[Progress] = []
    failures = launcher("ray", 1).launch(every, told.append)
    assert [failure.job for failure in failures] == every[:1]
    runs = [(job.spec.protocol.hash, job.spec.agent, job.spec.seed) for job in every]
    ended = {(each.bench, each.agent, each.seed): each.phase for each in told}
    assert ended == dict(zip(runs, ["failed"] + ["done"] * 7, strict=True))
    assert len(told) == len(runs), "no news is told twice"


@needs_ray
@pytest.mark.slow
def test_a_cluster_without_a_gpu_does_not_wait_for_one_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "num_gpus": 0, "include_dashboard": False})
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    (here,) = jobs(tmp_path, (0,), 10)
    spec = dataclasses.replace(here.spec, protocol=dataclasses.replace(here.spec.protocol, device="cuda"))
    try:
        with pytest.raises(SetupError, match="No node of the Ray cluster has a GPU for device 'cuda'"):
            launcher("ray", 1).launch([dataclasses.replace(here, spec=spec)], lambda _: None)
    finally:
        cluster.shutdown()
    assert list(tmp_path.iterdir()) == []


@needs_ray
@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_an_address_without_a_cluster_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scheme: str) -> None:
    monkeypatch.setenv("RAY_ADDRESS", f"{scheme}127.0.0.1:1")
    with pytest.raises(SetupError, match=rf"No Ray cluster answers at RAY_ADDRESS={scheme}127\.0\.0\.1:1 "):
        launcher("ray", 1).launch(jobs(tmp_path, (0,), 10), lambda _: None)
    assert list(tmp_path.iterdir()) == []


def test_paths_of_a_job_mean_the_same_on_every_node() -> None:
    here = Path.cwd()
    wanted = protocol("arrow_puzzle", "smoke", agents=("dqn",))
    spec = RunSpec(protocol=wanted, agent="dqn", seed=0, encoder=Path("e.safetensors"), dataset=Path("mixed"))
    job = absolute(Job(spec=spec, folder=Path("runs")))
    assert (job.spec.encoder, job.spec.dataset) == (here / "e.safetensors", here / "mixed")
    assert job.folder == here / "runs"
