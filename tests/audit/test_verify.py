"""Results are verified by playing the test episodes again: what holds is said to hold, and every forgery is found."""

from __future__ import annotations

import dataclasses
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import bench_fakes
import gymnasium
import numpy as np
import pytest
from forger import FORGERIES
from report_pages import without_images
from small_runs import Inline, context, small

from imagine_bench.errors import ArtefactError
from imagine_bench.judge.verify import Replays, _verify_test, verdicts
from imagine_bench.protocols.control import protocol
from imagine_bench.report import bench_page
from imagine_bench.report.audits import verify, with_report
from imagine_bench.report.page import texts
from imagine_bench.running.bench import bench, load_bench
from imagine_bench.running.evaluation import EvaluationCounts, play_test_episode, replay
from imagine_bench.running.run_state import environments
from imagine_bench.seeding import episode_seed


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench of a learner and of one that is none, with its report."""
    wanted = small(agents=("table", "random"), evaluation_episodes=8)
    result = bench(wanted, {}, root=tmp_path_factory.mktemp("bench"), launcher=Inline())
    (result.folder / "report").mkdir()
    for name, text in texts(without_images(bench_page(result))).items():  # type: ignore[arg-type]
        (result.folder / "report" / name).write_text(text)
    return result.folder


def test_a_bench_that_was_not_touched_holds(finished: Path) -> None:
    assert [str(each) for each in verify(finished)] == [
        "table seed 0: holds; 25 episodes played again",
        "random seed 0: holds; 16 episodes played again",
        "protocol: holds; not shown: that settings are those that were planned, of which the protocol has no digest",
        "report: holds",
    ]


def test_two_hundred_forgeries_are_found(finished: Path, tmp_path: Path) -> None:
    rng, tried, missed = np.random.default_rng(0), Counter[str](), list[str]()
    with environments(small(), observation="state") as envs:
        replays = Replays(*envs)
        for number in range(200):
            name = str(rng.choice(list(FORGERIES)))
            folder = tmp_path / str(number) / finished.name
            shutil.copytree(finished, folder, ignore=shutil.ignore_patterns("*.png"))
            FORGERIES[name](folder, rng)
            (forged,) = folder.parent.iterdir()
            tried[name] += 1
            try:
                found = with_report(forged, verdicts(forged, replays))
            except ArtefactError:
                continue
            if not any(each.complaint for each in found):
                missed.append(name)
            assert all("\n" not in str(each) for each in found)
    assert not missed and set(tried) == set(FORGERIES)


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        ("arrow_puzzle", {"observation": "frame,proprio", "observation_size": 96}),
        ("arrow_puzzle", {"test_appearance": "mild"}),
        ("arrows:cubes=2,gesture=0.5,lag=1,slip=0.2,horizon=3", {}),
        ("arrows:cubes=1,slip=0.3", {"execution": "physics"}),
    ],
)
def test_benches_of_every_kind_hold(task: str, changes: dict[str, Any], tmp_path: Path) -> None:
    few = {"agents": ("random",), "evaluation_episodes": 4, "execution": "kinematic", "recorded_episodes": 0, **changes}
    folder = bench(protocol(task, "smoke", **few), {}, root=tmp_path, launcher=Inline()).folder
    assert [str(each) for each in verify(folder)] == ["random seed 0: holds; 8 episodes played again"]


@pytest.mark.parametrize(
    ("env_id", "execution", "appearance"),
    [
        ("imagine_bench/ArrowPuzzle-v0", "kinematic", "clean"),
        ("imagine_bench/ArrowPuzzle-v0", "kinematic", "mild"),
        ("imagine_bench/PickPlace-v0", "physics", "mild"),
    ],
)
def test_a_policy_cannot_shift_the_starts_of_tests(env_id: str, execution: str, appearance: str) -> None:
    """Whatever was played before, and however long it took: test k starts the same, in every pixel."""

    class Constant(bench_fakes.TableAgent):
        chosen = 0

        def act(self, observation: bench_fakes.Observation, *, explore: bool) -> int:
            return self.chosen

    starts, played = [], []
    env = gymnasium.make(env_id, execution=execution, appearance=appearance)
    for chosen in range(3):
        agent, counts = Constant(context()), EvaluationCounts()
        agent.chosen = chosen
        for _ in range(6):
            seed = episode_seed("evaluation", 0, counts.episodes)
            counts.add(play_test_episode(env, agent, seed=seed, privileged=False))
        starts.append(counts.starts)
        played.append(counts.fingerprints)
        seed = episode_seed("evaluation", 0, 5)
        assert replay(env, seed, counts.kept().actions_of(5))[0].fingerprint == counts.fingerprints[5]
    frames = {env.reset(seed=episode_seed("evaluation", 0, 3))[0].tobytes() for _ in range(3)}
    env.close()
    assert len(frames) == 1 and starts[0] == starts[1] == starts[2]
    assert len({tuple(each) for each in played}) == 3


def test_an_episode_cut_off_before_its_end_is_found(finished: Path) -> None:
    """Everything that is claimed of it is true of what was played, which is not all of it."""
    row, counts = load_bench(finished).runs[0].checkpoints[0], EvaluationCounts()
    assert row.kept is not None
    cut_off = int(np.flatnonzero(row.kept.lengths > 1)[0])
    with environments(small(), observation="state") as (env, test_env):
        replays = Replays(env, test_env)
        for test in range(8):
            actions = row.kept.actions_of(test)
            counts.add(
                replays.test(episode_seed("evaluation", 0, test), actions[: len(actions) - (test == cut_off)])[0]
            )
        cut = dataclasses.replace(row, kept=counts.kept(), **counts.figures())
        with pytest.raises(ArtefactError, match=f"test {cut_off}: its actions do not end an episode"):
            _verify_test(cut, 8, "evaluation", replays)
        with pytest.raises(ArtefactError, match="keeps no test"):
            _verify_test(dataclasses.replace(row, kept=None), 8, "evaluation", replays)


def test_what_is_not_there_is_said_in_a_line_a_run(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / finished.name
    shutil.copytree(finished, folder)
    (folder / "table" / "seed_0" / "DONE").unlink()
    shutil.rmtree(folder / "random")
    one, other = verify(folder)
    assert str(one) == "table seed 0: it is not finished." and "random" in other.complaint
    with pytest.raises(ArtefactError, match="keeps results and no episodes"):
        verify(Path("docs/results/arrow_puzzle-quick"))
    assert load_bench(finished)
