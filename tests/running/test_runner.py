"""One run: the observations of agents, the counts, and that a killed and resumed run ends in the same bits."""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest import mock

import bench_fakes
import numpy as np
import pytest
from imagine_bench.tasks.macro_env import MacroEnv
from small_runs import KilledError, do, final_arrays, run_observed, same_but_for_time, small, written

from imagine_bench import registry
from imagine_bench.cli import observers
from imagine_bench.errors import DivergedError, InvalidValueError
from imagine_bench.exact.splits import split_of
from imagine_bench.interfaces import Observation, Transition
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.protocols.data import Progress, RunSpec
from imagine_bench.recording import episodes
from imagine_bench.registry import AgentEntry
from imagine_bench.rules import states_of
from imagine_bench.running.evaluation import start_from
from imagine_bench.running.run_state import Counters, make_env
from imagine_bench.running.runner import run
from imagine_bench.seeding import TUNING_SEEDS, episode_seed
from imagine_bench.store.run_folder import load_newest, load_run


def test_a_repeated_action_keeps_the_episode_of_its_first_time() -> None:
    counters = Counters()
    counters.try_out((0, 3), 1)
    counters.add_episode(success=False, length=1)
    counters.try_out((0, 3), 1)
    counters.try_out((0, 3), 2)
    assert counters.tried == {"0 3 1": 0, "0 3 2": 1}


def test_an_episode_begins_by_seed_unless_a_start_is_given() -> None:
    starts, elsewhere = [(0, 1, 2, 1), (1, 2, 0, 1)], {"macrostate": (1, 2, 3, 0)}
    with closing(start_from(make_env(small(), "arrow_puzzle"), starts)) as env:
        one, other = ([tuple(env.reset(seed=seed)[1]["macrostate"]) for seed in range(12)] for _ in range(2))
        assert one == other and set(one) == set(starts)
        assert tuple(env.reset(seed=0, options=elsewhere)[1]["macrostate"]) == elsewhere["macrostate"]


@pytest.mark.parametrize(
    ("seed", "looks", "tests"),
    [
        (0, {"test_appearance": "mild"}, ("evaluation", "mild")),
        (0, {"test_appearance": "patched"}, ("evaluation", "photo_held_out")),
        (TUNING_SEEDS, {"appearance": "photo"}, ("tuning", "photo_held_out")),  # shown tuning starts alone
        (0, {"split": "values=3:0:1"}, ("evaluation", "clean")),
    ],
)
def test_tests_and_recordings_have_their_own_starts_and_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, looks: dict[str, str], tests: tuple[str, str]
) -> None:
    reset, seen, asked = MacroEnv.reset, set(), []
    held_out = set(split_of(registry.task("arrow_puzzle").rules, looks.get("split", "values=3:0:1")).test)

    def noted(env: MacroEnv, *, seed: int, options: Any = None) -> Any:
        begun = reset(env, seed=seed, options=options)
        is_held_out = tuple(begun[1]["macrostate"]) in held_out if "split" in looks else None
        seen.add((seed >> 56, env.world.level.name, is_held_out))
        return begun

    monkeypatch.setattr(MacroEnv, "reset", noted)
    for name in ("surviving_actions", "frames_to_ask_with", "examples", "imagine_sampled_rollouts"):
        asking = mock.Mock(side_effect=getattr(observers, name))
        monkeypatch.setattr(observers, name, asking)
        asked.append(asking)
    recorded = mock.Mock(side_effect=episodes.record_run)
    monkeypatch.setattr(episodes, "record_run", recorded)
    few = {"budgets": (4,), "evaluation_episodes": 1, "open_loop_starts": 2, "recorded_episodes": 1}
    do(tmp_path, "imaginer", seed, agents=("imaginer",), seeds=(seed,), **few, **looks)
    purpose, appearance = tests
    training, testing, recording = (episode_seed(each, 0, 0) >> 56 for each in ("training", purpose, "recording"))
    trained, tested = (False, True) if "split" in looks else (None, None)
    assert seen == {
        (training, looks.get("appearance", "clean"), trained),
        (testing, appearance, tested),
        (recording, appearance, tested),
    }
    assert {name: recorded.call_args.kwargs[name] for name in ("seed", "appearance")} == {
        "seed": seed,
        "appearance": appearance,
    }
    for each in asked:
        assert {(call.kwargs["purpose"], call.kwargs["appearance"]) for call in each.call_args_list} == {tests}


def test_a_run_counts_what_happens(tmp_path: Path) -> None:
    spec = RunSpec(protocol=small(budgets=(4, 60)), agent="table", seed=3)
    heard: list[Progress] = []
    result = run_observed(spec, tmp_path / "run", heard.append)
    assert [row.episodes for row in result.checkpoints] == [4, 60]
    assert result.training_length.shape == result.training_success.shape == (60,)
    recent = result.training_success[10:].mean()
    assert heard[-1].success == recent != result.training_success.mean(), "of the last 50"
    steps = [row.env_steps for row in result.checkpoints]
    assert steps == [result.training_length[:4].sum(), result.training_length.sum()]
    assert [row.diagnostics["real_transitions"] for row in result.checkpoints] == steps
    assert all(row.test_episodes == 5 and 1 <= row.mean_length <= 10 for row in result.checkpoints)
    assert (result.agent, result.seed, result.settings) == ("table", 3, {"rate": 0.5})


class Slow(bench_fakes.TableAgent):
    """Takes so long over each episode that all news of its run are told."""

    def begin_episode(self) -> None:
        time.sleep(0.26)


@pytest.mark.usefixtures("own_names")
def test_news_say_what_is_done_and_the_share_solved_in_this_phase(tmp_path: Path) -> None:
    """Both demonstrations are solved, and few of the tests."""
    registry.AGENTS["slow"] = dataclasses.replace(registry.AGENTS["table"], make=f"{__name__}:Slow")
    wanted = small(agents=("slow",), budgets=(2,), demonstrations=2, evaluation_episodes=4)
    heard: list[Progress] = []
    run(RunSpec(protocol=wanted, agent="slow", seed=0), tmp_path, heard.append)
    solved = load_run(tmp_path).checkpoints[0].solved
    assert solved is not None and "0" in solved
    shares = [solved[:count].count("1") / count for count in (1, 2, 3, 4)]
    assert [(each.phase, each.episode, each.done, each.success) for each in heard] == [
        ("training", 1, 1, 1.0),
        ("training", 2, 2, 1.0),
        *(("testing", 2, 2 + count, share) for count, share in enumerate(shares, start=1)),
        ("done", 2, 6, 1.0),
    ]


@pytest.mark.parametrize("agent", ["table", "random"])
def test_a_run_is_through_with_its_work_at_its_end(tmp_path: Path, agent: str) -> None:
    """Episodes on tasks before count; the one test of an agent that does not learn stands at both budgets."""
    after = {"after": ("arrow_puzzle_hard",), "after_episodes": 3, "unannounced": True}
    spec = RunSpec(protocol=small(agents=("table", "random"), evaluation_episodes=2, **after), agent=agent, seed=0)
    heard: list[Progress] = []
    run_observed(spec, tmp_path, heard.append)
    assert heard[-1].phase == "done" and heard[-1].done == heard[-1].work
    assert [each.done for each in heard] == sorted(each.done for each in heard)
    snapshot = load_newest(tmp_path / "checkpoints")
    assert snapshot is not None and snapshot.values["before"] == (3 if agent == "table" else 0)


def test_only_the_privileged_are_shown_more_than_frames(tmp_path: Path) -> None:
    bench_fakes.Pupil.made.clear()
    for name in ("pupil", "pupil_privileged"):
        after = {"after": ("arrow_puzzle_hard",), "after_episodes": 2, "unannounced": True}
        do(tmp_path / name, name, agents=(name,), recorded_episodes=1, **after)
    plain, privileged = bench_fakes.Pupil.made
    assert len(plain.seen) > 20 and all(observation.macrostate is None for observation in plain.seen)
    assert plain.optimal_policy is None and callable(privileged.optimal_policy)
    assert all(np.shape(observation.macrostate) == (4,) for observation in privileged.seen)


def noting(log: list[str], word: str, function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def noted(*given: Any, **named: Any) -> Any:
        log.append(word)
        return function(*given, **named)

    return noted


@pytest.mark.parametrize("first", ["dataset", "demonstrations", "own episodes"])
def test_an_agent_is_told_of_each_episode_that_it_begins(
    first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a dataset's, those that it watches, its own on each task, tests and recordings; before it sees any of it."""
    log: list[str] = []
    agent = bench_fakes.TableAgent
    monkeypatch.setattr(agent, "begin_episode", noting(log, "told", lambda agent: None), raising=False)
    for kind, name, word in (
        (agent, "act", "sees"), (agent, "observe", "sees"), (MacroEnv, "reset", "new"), (Episodes, "transitions", "new")
    ):  # fmt: skip
        monkeypatch.setattr(kind, name, noting(log, word, getattr(kind, name)))
    changes: dict[str, Any] = {"after": ("arrow_puzzle_hard",), "after_episodes": 2, "unannounced": True}
    changes |= {"budgets": (8,), "evaluation_episodes": 2, "recorded_episodes": 2}
    dataset = written(tmp_path / "set") if first == "dataset" else None
    if dataset is not None:
        changes |= {"dataset": dataset.identity, "appearance": "mild"}
    changes |= {"demonstrations": 3} if first == "demonstrations" else {}
    log.clear()
    folder = None if dataset is None else dataset.folder
    spec = RunSpec(protocol=small(**changes), agent="table", seed=0, dataset=folder)
    run_observed(spec, tmp_path / "run", lambda progress: None)
    heard = [words for words in " ".join(log).split("sees") if "new" in words]
    assert len(heard) == 2 + 8 + 2 + 2 and all("told" in words for words in heard)


class Elsewhere(bench_fakes.TableAgent):
    """Trains in a loop of its own: leaves its first episode, and begins another in a macrostate that it chooses."""

    clock_s = 0.0
    given: dict[str, int] = {}  # noqa: RUF012 - how a test finds it

    def act(self, observation: Observation, *, explore: bool) -> int:
        Elsewhere.clock_s += 100.0
        return super().act(observation, explore=explore)

    def train(self, env: Any, *, episodes: int, horizon: int, on_episode: Callable[[bool, int], bool]) -> None:
        env.reset()
        env.step(0)
        goes_on, played = True, 0
        while goes_on:
            env.reset(seed=7, options={"macrostate": (1, 2, 3, 0)} if played == 1 else None)
            length, over = 0, False
            while not over:
                _, _, terminated, truncated, info = env.step(length % 6)
                length, over = length + 1, terminated or truncated
            played += 1
            Elsewhere.clock_s += 1.0
            goes_on = on_episode(bool(info["is_success"]), length)
        Elsewhere.given = {"episodes": episodes, "horizon": horizon, "played": played}


def test_a_loop_of_its_own_has_all_agents_starts_and_own_cpu_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own_names: None
) -> None:
    made = AgentEntry(make=f"{__name__}:Elsewhere", needs_encoder=False, external_training_loop=True)
    registry.AGENTS["elsewhere"] = made
    of: dict[str, Any] = {"task": "arrows:horizon=7", "budgets": (2, 5), "evaluation_episodes": 2, "seeds": (3,)}
    usual = do(tmp_path / "usual", "table", 3, **of)
    monkeypatch.setattr(time, "process_time", lambda: Elsewhere.clock_s)
    result = do(tmp_path / "own", "elsewhere", 3, agents=("elsewhere",), **of)
    assert Elsewhere.given == {"episodes": 5, "horizon": 7, "played": 5}
    rules = registry.task(of["task"]).rules
    asked = sum(not rules.is_terminal(state) for state in states_of(rules))
    for row, train_cpu_s in zip(result.checkpoints, (2.0, 5.0), strict=True):
        assert row.kept is not None and row.train_cpu_s == train_cpu_s
        assert row.eval_cpu_s == 100.0 * (row.kept.lengths.sum() + asked), "of tests, and of its beliefs"
    assert usual.training is not None and result.training is not None
    starts, others = result.training.starts.tolist(), usual.training.starts.tolist()
    assert starts == [*others[:2], [1, 2, 3, 0], *others[3:], starts[-1]] and len(starts) == 6
    assert result.training.lengths.tolist() == [1, *result.training_length.tolist()]


class StopsEarly(bench_fakes.TableAgent):
    """Ends its loop when its own budget is spent, whatever it is told."""

    def train(self, env: Any, *, episodes: int, horizon: int, on_episode: Callable[[bool, int], bool]) -> None:
        for _ in range(3):
            env.reset()
            on_episode(False, 1)


@pytest.mark.usefixtures("own_names")
def test_a_loop_that_ends_early_is_no_finished_run(tmp_path: Path) -> None:
    made = AgentEntry(make=f"{__name__}:StopsEarly", needs_encoder=False, external_training_loop=True)
    registry.AGENTS["early"] = made
    with pytest.raises(InvalidValueError, match=r"agent 'early' ended after 3 of 5 episodes"):
        do(tmp_path / "run", "early", agents=("early",), budgets=(2, 5), evaluation_episodes=1)
    assert not (tmp_path / "run" / "DONE").exists()
    registry.AGENTS["early"] = dataclasses.replace(made, make=f"{__name__}:Elsewhere")
    again = do(tmp_path / "run", "early", agents=("early",), budgets=(2, 5), evaluation_episodes=1)
    assert [row.episodes for row in again.checkpoints] == [2, 5], "the next attempt begins anew"
    assert len(again.training_length) == Elsewhere.given["played"] == 5


def test_an_agent_that_does_not_learn_is_tested_once(tmp_path: Path) -> None:
    first, second = do(tmp_path / "run", "oracle", agents=("oracle",)).checkpoints
    assert dataclasses.replace(first, episodes=9) == second
    assert (first.env_steps, first.success_rate, first.mean_length > 1) == (0, 1.0, True)


class Diverging(bench_fakes.TableAgent):
    """Diverges in its third episode."""

    def observe(self, transition: Transition, *, episode: int) -> None:
        if episode == 2:
            raise DivergedError("The loss is NaN.")


@pytest.mark.usefixtures("own_names")
def test_divergence_leaves_its_state_for_inspection(tmp_path: Path) -> None:
    registry.AGENTS["diverging"] = AgentEntry(make=f"{__name__}:Diverging", needs_encoder=False)
    with pytest.raises(DivergedError, match=r"The loss is NaN\. The agent's state lies in .*diverged"):
        do(tmp_path / "run", "diverging", agents=("diverging",))
    saved = load_newest(tmp_path / "run" / "diverged")
    assert saved is not None and saved.episode == 2


_CHILD = """
import json, signal, sys
from pathlib import Path
import bench_fakes
from imagine_bench.running import run_state, runner
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import RunSpec

save, saves = run_state.save_snapshot, iter(range(int(sys.argv[3])))
def saying(folder, snapshot):
    if next(saves, None) is None:
        signal.pause()  # whoever is to kill this is late
    print("saving", flush=True)
    return save(folder, snapshot)

run_state.save_snapshot = saying
spec = RunSpec(protocol=Protocol.from_dict(json.loads(sys.argv[2])), agent="table", seed=0, checkpoint_every_s=0.0)
runner.run(spec, Path(sys.argv[1]), lambda progress: None)
"""


def test_kill_9_of_a_real_process_changes_nothing(tmp_path: Path) -> None:
    changes: dict[str, Any] = {"budgets": (40, 80), "evaluation_episodes": 10}
    whole = do(tmp_path / "whole", **changes)
    folder, settings = tmp_path / "run", json.dumps(small(**changes).as_dict())
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1] / "fakes")}
    for saves, delay_s in ((31, 0.002), (26, 0.009)):  # in a test, and in the midst of writing
        command = [sys.executable, "-c", _CHILD, str(folder), settings, str(saves)]
        with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            lines = [child.stdout.readline() for _ in range(saves)]
            time.sleep(delay_s)
            child.kill()
        assert lines == [b"saving\n"] * saves and child.returncode == -signal.SIGKILL
        snapshot = load_newest(folder / "checkpoints")
        assert snapshot is not None and not (folder / "DONE").exists()
    assert 40 < snapshot.episode < 80  # non-vacuous: the last kill came half way
    assert same_but_for_time(whole, do(folder, **changes))
    assert final_arrays(tmp_path / "whole")["table"].tobytes() == final_arrays(folder)["table"].tobytes()


@pytest.mark.parametrize("save", range(1, 11))
def test_a_kill_after_any_checkpoint_changes_nothing(
    tmp_path: Path, die_after_saves: Callable[..., None], save: int
) -> None:
    """A checkpoint of training, one within a test, the one at its end, and the last one of the run."""
    changes: dict[str, Any] = {"budgets": (2, 4), "evaluation_episodes": 2}
    whole = do(tmp_path / "whole", **changes)
    die_after_saves(save)
    with pytest.raises(KilledError):
        do(tmp_path / "run", every_s=0.0, **changes)
    resumed = do(tmp_path / "run", every_s=0.0, **changes)
    assert same_but_for_time(whole, resumed)
    assert final_arrays(tmp_path / "whole")["table"].tobytes() == final_arrays(tmp_path / "run")["table"].tobytes()


def test_a_table_that_a_kill_left_behind_comes_with_the_run(tmp_path: Path) -> None:
    """The checkpoint of a test is written before its row of the table."""
    do(tmp_path)
    table = (tmp_path / "metrics.csv").read_text()
    for name in ("DONE", "metrics.csv"):
        (tmp_path / name).unlink()
    do(tmp_path)
    assert (tmp_path / "metrics.csv").read_text() == table


def test_test_episodes_are_greedy_and_training_explores(tmp_path: Path) -> None:
    acting = mock.patch.object(bench_fakes.TableAgent, "act", autospec=True, side_effect=bench_fakes.TableAgent.act)
    with acting as act:
        result = do(tmp_path / "run", open_loop_starts=0)
    explored = [call.kwargs["explore"] for call in act.call_args_list]
    assert sum(explored) == result.training_length.sum(), "each training step explores, and no step of a test"
    assert len(explored) > sum(explored)
