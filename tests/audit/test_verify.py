"""Results are verified by playing the test episodes again: true claims are said to hold, and every forgery is found."""

from __future__ import annotations

import dataclasses
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bench_fakes
import gymnasium
import numpy as np
import pytest
from forger import FORGERIES, IN_TRAINING, forged, mend, rewrite, rewrite_protocol, share_weights
from small_runs import Inline, context, small, written

from imagine_bench import registry
from imagine_bench.errors import ArtefactError
from imagine_bench.judge.verify import Replays, has_own_failures, verdicts, verify_tests
from imagine_bench.protocols.control import Protocol, context_of, protocol
from imagine_bench.protocols.data import RunSpec
from imagine_bench.report import bench_page
from imagine_bench.report.page import texts
from imagine_bench.running.bench import bench, load_bench
from imagine_bench.running.control import plan_control
from imagine_bench.running.evaluation import EvaluationCounts, play_test_episode, replay
from imagine_bench.running.retraining import Retraining
from imagine_bench.running.run_state import environments
from imagine_bench.seeding import episode_seed
from imagine_bench.store.files import read_sealed, sealed
from imagine_bench.store.results import KeptEpisodes
from imagine_bench.store.run_folder import load_newest, load_run, save_snapshot
from imagine_bench.tools.audits import verify, what_is_shown, with_report


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench of a learner and of one that is none, with its report."""
    wanted = small(agents=("table", "random"), evaluation_episodes=8)
    result = bench(wanted, {}, root=tmp_path_factory.mktemp("bench"), launcher=Inline())
    (result.folder / "report").mkdir()
    for name, text in texts(bench_page(result), images=False).items():  # type: ignore[arg-type]
        (result.folder / "report" / name).write_text(text)
    return result.folder


def test_a_bench_that_was_not_touched_holds(finished: Path) -> None:
    assert [str(each) for each in verify(finished)] == [
        "table seed 0: holds; 25 episodes played again",
        "random seed 0: holds; 16 episodes played again",
        "protocol: holds; not shown: that settings are those that were planned, of which the protocol has no digest",
        "report: holds",
    ]


def test_every_kind_of_forgery_is_found(finished: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    missed = list[str]()
    with environments(small(), observation="state") as envs:
        replays = Replays(*envs)
        for number, name in enumerate(2 * list(FORGERIES)):
            folder = tmp_path / str(number) / finished.name
            shutil.copytree(finished, folder, ignore=shutil.ignore_patterns("*.png"))
            FORGERIES[name](folder, rng)
            (forged,) = folder.parent.iterdir()
            try:
                found = with_report(forged, verdicts(forged, replays))
            except ArtefactError:
                continue
            if not any(each.complaint for each in found):
                missed.append(name)
            assert all("\n" not in str(each) for each in found)
    assert not missed


NAMED = {
    "successes": "successes is",
    "mean return": "mean_return is",
    "mean length": "mean_length is",
    "sum of faults": "faults is",
    "start": "the start is",
    "return": "the return is",
    "success": "the success is",
    "faults": "the number of faults is",
    "fingerprint": "the fingerprint is",
    "training return": "the return is",
}


def test_a_forged_figure_is_named_where_there_is_no_report_too(finished: Path, tmp_path: Path) -> None:
    """Each figure and each coordinate by itself, whatever the others say."""
    rng = np.random.default_rng(0)
    with environments(small(), observation="state") as envs:
        replays = Replays(*envs)
        for name, words in NAMED.items():
            folder = tmp_path / name / finished.name
            shutil.copytree(finished, folder, ignore=shutil.ignore_patterns("report"))
            (FORGERIES | IN_TRAINING)[name](folder, rng)
            assert words in " ".join(each.complaint for each in verdicts(folder, replays)), name


@pytest.mark.parametrize("name", ["index.html", "summary.csv", "results.csv"])
def test_a_part_of_a_report_that_is_missing_or_cut_short_is_found(finished: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / finished.name
    shutil.copytree(finished, folder)
    assert [each.complaint for each in with_report(folder, [])] == [""]
    path = folder / "report" / name
    path.write_text(path.read_text()[: len(path.read_text()) // 2])
    assert with_report(folder, [])[0].complaint.startswith(f"{name} has ")
    path.unlink()
    assert with_report(folder, [])[0].complaint.startswith(f"{name} has ")


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        ("arrow_puzzle", {"observation": "frame,proprio", "observation_size": 96}),
        ("arrow_puzzle", {"test_appearance": "mild"}),
        ("arrows:cubes=2,gesture=0.5,lag=1,slip=0.2,horizon=3", {}),
        ("arrows:cubes=1,slip=0.3", {"execution": "physics"}),
        ("arrow_puzzle", {"agents": ("table",), "appearance": "mild", "demonstrations": 2}),
        ("arrow_puzzle", {"agents": ("table",), "split": "plan_length=2"}),
    ],
)
def test_benches_of_every_kind_hold(task: str, changes: dict[str, Any], tmp_path: Path) -> None:
    few = {"agents": ("random",), "evaluation_episodes": 4, "execution": "kinematic", "recorded_episodes": 0, **changes}
    folder = bench(protocol(task, "smoke", **few), {}, root=tmp_path, launcher=Inline()).folder
    run, *others = verify(folder)
    assert str(run).startswith(
        f"{few['agents'][0]} seed 0: holds; {8 if few['agents'] == ('random',) else 28} episodes"
    )
    assert not any(each.complaint for each in others)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench of two seeds of a learner, without a report."""
    wanted = small(seeds=(0, 1), budgets=(3, 8), evaluation_episodes=8)
    return bench(wanted, {}, root=tmp_path_factory.mktemp("pair"), launcher=Inline()).folder


def share_cpu_seconds(folder: Path) -> None:
    one, other = (load_run(folder / "table" / seed) for seed in ("seed_0", "seed_1"))
    pairs = zip(other.checkpoints, one.checkpoints, strict=True)
    rewrite(other.folder, [dataclasses.replace(row, train_cpu_s=known.train_cpu_s) for row, known in pairs])


def share_first_tests(folder: Path) -> None:
    one, other = (load_run(folder / "table" / seed) for seed in ("seed_0", "seed_1"))
    first, *rows = other.checkpoints
    theirs = one.checkpoints[0]
    assert rows and theirs.kept is not None and has_own_failures(theirs.kept, small())
    theirs = dataclasses.replace(theirs, env_steps=first.env_steps, train_cpu_s=first.train_cpu_s)
    rewrite(other.folder, [theirs, *rows])


@pytest.mark.parametrize(
    ("what", "forge"),
    [("weights", share_weights), ("CPU seconds", share_cpu_seconds), ("tests", share_first_tests)],
)
def test_two_seeds_of_a_learner_share_nothing(
    pair: Path, tmp_path: Path, what: str, forge: Callable[[Path], None]
) -> None:
    one, other, *_ = verify(forged(pair, tmp_path, forge))
    assert not one.complaint
    assert other.complaint.startswith(f"its {what}") and "those of seed 0" in other.complaint


@pytest.mark.parametrize("name", IN_TRAINING)
def test_whatever_is_claimed_of_training_follows_from_its_macro_actions(pair: Path, tmp_path: Path, name: str) -> None:
    folder = forged(pair, tmp_path, lambda folder: IN_TRAINING[name](folder, np.random.default_rng(0)))
    assert any(each.complaint for each in verify(folder))


@pytest.mark.parametrize(
    ("claim", "complaint"),
    [
        ({"execution": "physics"}, "the simulated time in seconds is"),
        ({"settings_digest": "0123456789ab"}, "and the file says '0123456789ab'"),
        ({"encoder": "other@0123456789ab"}, "it names the encoder other@0123456789ab, and no agent reads latents"),
    ],
)
def test_what_a_protocol_says_follows_from_its_runs(
    pair: Path, tmp_path: Path, claim: dict[str, str], complaint: str
) -> None:
    folder = rewrite_protocol(forged(pair, tmp_path, lambda folder: None), **claim)
    assert complaint in " ".join(each.complaint for each in verify(folder))


def test_failures_are_a_seeds_own_unless_it_knows_nothing_or_chance_decides() -> None:
    def kept(task: Protocol, *failed: list[int]) -> KeptEpisodes:
        played = [[0], *failed]
        starts = np.array([task.spec(testing=True).rules.start_states[0]] * len(played))
        none = np.zeros(len(played), dtype=np.int64)
        return KeptEpisodes(
            starts=starts, lengths=np.array([*map(len, played)]), actions=np.concatenate(played), returns=none * 1.0,
            success=none == np.arange(len(played)), faults=none, fingerprints=none,
        )  # fmt: skip

    certain = small()
    slips = protocol("arrows:slip=0.3", "smoke", agents=("random",))
    assert has_own_failures(kept(certain, [0, 1, 2]), certain)
    assert has_own_failures(kept(certain, [0, 1], [2]), certain), "together"
    assert not has_own_failures(kept(certain, [0, 1, 0]), certain)
    assert not has_own_failures(kept(slips, [0, 1, 2]), slips)


def test_a_run_of_an_earlier_version_holds_and_says_what_it_does_not_keep(tmp_path: Path) -> None:
    older = Path(__file__).parents[1] / "store" / "of_abcb05c" / "whole"
    run, *_ = verify(forged(older, tmp_path, lambda folder: None))
    assert str(run).startswith("table seed 0: holds; 10 episodes")
    assert "env_steps, budgets and successes in training are claims" in str(run)


def test_whatever_is_written_into_a_sealed_file_is_a_complaint_in_one_line(pair: Path, tmp_path: Path) -> None:
    """Texts, numbers of 4,000 digits, and parts that are missing: none of them ends in a raw error."""
    folder = forged(pair, tmp_path, lambda folder: None)
    run = folder / "table" / "seed_1"
    snapshot = load_newest(run / "checkpoints")
    assert snapshot is not None
    row = snapshot.values["rows"][0]
    spots = [(row, name) for name in row if name not in ("beliefs", "open_loop", "diagnostics")]
    spots += [(snapshot.values, name) for name in ("success", "length", "tried", "rows")]
    with environments(small(), observation="state") as envs:
        replays = Replays(*envs)
        for number, (place, name) in enumerate(spots):
            honest = place[name]
            place[name] = ("text", 10**4000, [], {}, float("nan"), -1)[number % 6]
            save_snapshot(run / "checkpoints", snapshot)
            mend(run)
            _, other, *_ = with_report(folder, verdicts(folder, replays))
            assert other.complaint and "\n" not in str(other) and len(str(other)) < 2000, name
            place[name] = honest


def test_a_sentence_of_the_report_follows_from_the_runs(finished: Path, tmp_path: Path) -> None:
    def edit(folder: Path) -> None:
        page = folder / "report" / "index.html"
        page.write_text(page.read_text().replace("<li>Nothing is compared", "<li>It is compared"))

    *runs, report = verify(forged(finished, tmp_path, edit))
    assert not any(each.complaint for each in runs) and "It is compared" in report.complaint


def test_a_report_of_another_version_is_not_compared(finished: Path, tmp_path: Path) -> None:
    """Its words may have been others; the runs are compared all the same, and the way to a new report is said."""

    def edit(folder: Path) -> None:
        page, sessions = folder / "report" / "index.html", folder / "sessions.json"
        page.write_text(page.read_text().replace("<li>Nothing is compared", "<li>Nothing was compared"))
        facts = read_sealed(sessions, "sessions")
        facts["environment"]["commit"] = "0123456789ab"
        sessions.write_text(json.dumps(sealed(facts)))

    *runs, report = verify(forged(finished, tmp_path, edit))
    assert not any(each.complaint for each in [*runs, report])
    assert "commit 0123456789ab" in report.unshown[0] and "imagine-bench report" in report.unshown[0]


def test_a_report_on_agents_that_are_not_installed_here_is_not_blamed(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(registry.AGENTS, "table")
    *_, last = verify(finished)
    assert str(last) == "report: not compared; not shown: its words, for no package here offers table"


def test_a_report_that_cannot_be_made_is_a_complaint(finished: Path, tmp_path: Path) -> None:
    folder = forged(finished, tmp_path, lambda folder: None)
    (folder / "why").mkdir()
    (folder / "why" / "causes.csv").write_text("agent,seed\ntable,zero\n")
    assert "causes.csv" in with_report(folder, [])[0].complaint


def test_a_page_is_compared_in_time_that_grows_with_its_length(pair: Path, tmp_path: Path) -> None:
    def write(folder: Path) -> None:
        (folder / "report").mkdir()
        (folder / "report" / "index.html").write_text("<tr><td" * 60_000 + "<td>" * 60_000)

    folder = forged(pair, tmp_path, write)
    begun_s = time.process_time()
    (report,) = with_report(folder, [])
    assert report.complaint and time.process_time() - begun_s < 5.0


def test_a_bench_whose_training_began_with_a_dataset_holds(tmp_path: Path) -> None:
    """Episodes are numbered from the first of the dataset, which are not played again."""
    few = {"agents": ("table",), "seeds": (0,), "budgets": (9,), "evaluation_episodes": 2, "recorded_episodes": 0}
    how = {"appearance": "mild", "execution": "kinematic", "open_loop_starts": 0}
    wanted, paths = plan_control("arrow_puzzle", "smoke", **few, **how, dataset=written(tmp_path / "set").folder)
    (found, *_) = verify(bench(wanted, paths, root=tmp_path, launcher=Inline()).folder)
    assert not found.complaint and found.episodes == 9 - 6 + 2


@pytest.mark.parametrize(("episodes", "complaint"), [(6, ""), (7, "those of seed 0")])
def test_two_seeds_may_learn_the_same_from_a_dataset_alone(tmp_path: Path, episodes: int, complaint: str) -> None:
    few = {"agents": ("table",), "seeds": (0, 1), "budgets": (episodes,), "evaluation_episodes": 4}
    how = {"execution": "kinematic", "appearance": "mild", "open_loop_starts": 0, "recorded_episodes": 0}
    wanted, paths = plan_control("arrow_puzzle", "smoke", **few, **how, dataset=written(tmp_path / "set").folder)
    folder = bench(wanted, paths, root=tmp_path, launcher=Inline()).folder
    counts = EvaluationCounts()
    with environments(wanted, observation="state") as (_, env):
        oracle = registry.make_agent("oracle", context_of(RunSpec(protocol=wanted, agent="oracle", seed=0)))
        counts.add(play_test_episode(env, oracle, seed=episode_seed("evaluation", 0, 0), privileged=True))
        for test in (1, 2, 3):
            counts.add(replay(env, episode_seed("evaluation", 0, test), [1, 0, 3, 2, 5, 4] * 2)[0])
    for seed in (0, 1):
        run = load_run(folder / "table" / f"seed_{seed}")
        rewrite(run.folder, [dataclasses.replace(r, kept=counts.kept(), **counts.figures()) for r in run.checkpoints])
    assert has_own_failures(counts.kept(), wanted)
    first, second, *_ = verify(folder)
    assert not first.complaint and complaint in second.complaint and bool(complaint) == bool(second.complaint)


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
    """Everything that is claimed of it is true of the played part, which is not all of it."""
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
        whole = row.kept.actions_of(cut_off)
        beyond = [replays.test(episode_seed("evaluation", 0, cut_off), [*whole, more])[1] for more in range(6)]
        assert not any(beyond), "nothing ends an episode that is over"
        cut = dataclasses.replace(row, kept=counts.kept(), **counts.figures())
        with pytest.raises(ArtefactError, match=f"test {cut_off}: its actions do not end an episode"):
            verify_tests(cut, small(evaluation_episodes=8), "evaluation", replays, env_steps=row.env_steps)
        with pytest.raises(ArtefactError, match="keeps no test"):
            nothing = dataclasses.replace(row, kept=None)
            verify_tests(nothing, small(evaluation_episodes=8), "evaluation", replays, env_steps=row.env_steps)


def test_what_is_not_there_is_said_in_a_line_a_run(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / finished.name
    shutil.copytree(finished, folder)
    (folder / "table" / "seed_0" / "DONE").unlink()
    shutil.rmtree(folder / "random")
    one, other, *_ = verify(folder)
    assert str(one) == "table seed 0: it is not finished." and "random" in other.complaint
    kept = Path(__file__).parents[2] / "docs" / "results" / "arrow_puzzle-quick"
    found = verify(kept)
    assert "no episode is kept" in " ".join(map(str, found))
    assert what_is_shown(kept, found).endswith("Made at commit 2898baf91de0, as it says."), (
        "there is nothing to train again"
    )
    with pytest.raises(ArtefactError, match="keeps results and no runs"):
        verify(kept, Retraining(runs=1, nonce="", launcher=Inline()))
    assert load_bench(finished)
