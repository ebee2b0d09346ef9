"""Results are verified by playing the test episodes again: true claims are said to hold, and every forgery is found."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np
import pytest
from forger import FORGERIES, IN_TRAINING, forged, share_weights
from forging import OpenRun, all_runs, of_second, oracle, rewrite_protocol
from guest_packages import Guests
from kinds import take_row
from small_runs import Inline, benched, collected, made_bench, small

from imagine_bench import registry
from imagine_bench.data.folder import write_dataset
from imagine_bench.errors import ArtefactError, SetupError, UnknownNameError
from imagine_bench.interfaces.environments import Wrapper
from imagine_bench.judge.verify import Replays, has_own_failures, verdicts
from imagine_bench.protocols.control import protocol
from imagine_bench.report.bench import bench_page
from imagine_bench.report.page import texts
from imagine_bench.rules import fewest_actions
from imagine_bench.running.bench import bench, load_bench
from imagine_bench.running.control import plan_control
from imagine_bench.running.evaluation import EvaluationCounts, play_test_episode, replay
from imagine_bench.running.retraining import Retraining
from imagine_bench.running.run_state import environments
from imagine_bench.seeding import episode_seed
from imagine_bench.store import encoders
from imagine_bench.store.files import read_sealed, sealed
from imagine_bench.tools.audits import verify, what_is_shown, with_report


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench of a learner and of one that is none, with its report."""
    wanted = small(agents=("table", "random"), evaluation_episodes=8)
    result = made_bench(wanted, tmp_path_factory.mktemp("bench"))
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


@pytest.fixture(scope="module")
def replays() -> Iterator[Replays]:
    with environments(small(), observation="state") as envs:
        yield Replays(*envs)


def test_every_kind_of_forgery_is_found(finished: Path, replays: Replays, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    missed = list[str]()
    for number, name in enumerate(2 * list(FORGERIES)):
        folder = tmp_path / str(number) / finished.name
        shutil.copytree(finished, folder, ignore=shutil.ignore_patterns("*.png"))
        FORGERIES[name](folder, rng)
        (changed,) = folder.parent.iterdir()
        try:
            found = with_report(changed, verdicts(changed, replays))
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
    "last tests dropped": "the number of tests is 8, and the file says",
    "last budget dropped": "the list of budgets is (4, 9), and the file says (4,)",
    "last episode dropped": "the number of training episodes is 9, and the file says 8",
}


@pytest.mark.usefixtures("own_names")
@pytest.mark.parametrize("offered", [{}, {registry.AGENT_GROUP: {"table": "their_module:gone"}}])
def test_a_bench_of_agents_that_are_not_installed_here_is_not_blamed(
    finished: Path, guests: Guests, offered: dict[str, dict[str, str]]
) -> None:
    guests.write("their_module", "", offered)
    del registry.AGENTS["table"]
    with pytest.raises(SetupError if offered else UnknownNameError):
        registry.agent_entry("table")
    first, *others, last = verify(finished)
    assert str(first).startswith("table seed 0: holds") and [each.complaint for each in others] == ["", ""]
    assert str(last) == "report: not compared; not shown: its words, for no package here offers table"


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


def test_a_forged_figure_is_named_where_there_is_no_report_too(
    finished: Path, replays: Replays, tmp_path: Path
) -> None:
    """Each figure and each coordinate by itself, whatever the others say."""
    for name, words in NAMED.items():
        folder = tmp_path / name
        shutil.copytree(finished, folder, ignore=shutil.ignore_patterns("report"))
        (FORGERIES | IN_TRAINING)[name](folder, np.random.default_rng(0))
        assert words in " ".join(each.complaint for each in verdicts(folder, replays)), name


def test_a_report_follows_from_the_runs(finished: Path, tmp_path: Path) -> None:
    """Each part that is missing, cut short or of other words; one that cannot be made; in time that grows with it."""
    folder = forged(finished, tmp_path)
    assert [each.complaint for each in with_report(folder, [])] == [""]

    def complaint(name: str, text: str | None) -> str:
        path = folder / "report" / name
        honest = path.read_text()
        path.unlink()
        if text is not None:
            path.write_text(text)
        (found,) = with_report(folder, [])
        path.write_text(honest)
        return found.complaint

    for path in (finished / "report").iterdir():
        whole = path.read_text()
        for text in (None, whole[: len(whole) // 2]):
            assert complaint(path.name, text).startswith(f"{path.name} has ")
    page = (folder / "report" / "index.html").read_text()
    assert "It is compared" in complaint("index.html", page.replace("<li>Nothing is compared", "<li>It is compared"))
    begun_s = time.process_time()
    assert complaint("index.html", "<tr><td" * 60_000 + "<td>" * 60_000)
    assert time.process_time() - begun_s < 5.0
    (folder / "why").mkdir()
    (folder / "why" / "causes.csv").write_text("agent,seed\ntable,zero\n")
    assert "causes.csv" in with_report(folder, [])[0].complaint


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


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        (
            "arrow_puzzle",
            {
                "agents": ("table",),
                "unannounced": True,
                "after_episodes": 2,
                "after": ("arrow_puzzle_hard", "arrow_puzzle_toward"),
            },
        ),
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
    run, *others = verify(made_bench(protocol(task, "smoke", **few), tmp_path).folder)
    (agent,) = few["agents"]
    assert str(run).startswith(f"{agent} seed 0: holds; {8 if agent == 'random' else 28} episodes")
    assert [each for each in run.unshown if " before" in each] == [
        f"its training on {', '.join(few['after'])} before" for _ in few.get("after", ())[:1]
    ]
    assert not any(each.complaint for each in others)


def share_cpu_seconds(one: OpenRun, other: OpenRun) -> None:
    for row, known in zip(other.rows, one.rows, strict=True):
        row["train_cpu_s"] = known["train_cpu_s"]


def share_first_tests(one: OpenRun, other: OpenRun) -> None:
    assert has_own_failures(one.tests(0).kept(), small())
    take_row(other, 0, one, 0, with_figures=True)


@pytest.mark.parametrize(
    ("what", "forge"),
    [("weights", share_weights), ("CPU s", of_second(share_cpu_seconds)), ("tests", of_second(share_first_tests))],
)
def test_two_seeds_of_a_learner_share_nothing(pair: Path, tmp_path: Path, what: str, forge: Any) -> None:
    one, other, *_ = verify(forged(pair, tmp_path, forge))
    assert not one.complaint
    assert other.complaint.startswith(f"its {what}") and "those of seed 0" in other.complaint


@pytest.mark.parametrize("name", IN_TRAINING)
def test_claims_of_training_follow_from_its_macro_actions(pair: Path, tmp_path: Path, name: str) -> None:
    folder = forged(pair, tmp_path, lambda folder: IN_TRAINING[name](folder, np.random.default_rng(0)))
    assert any(each.complaint for each in verify(folder))


@pytest.mark.parametrize(
    ("claim", "complaint"),
    [
        ({"execution": "physics"}, "the simulated time in seconds is"),
        ({"settings_digest": "0123456789ab"}, "and the file says '0123456789ab'"),
        ({"encoder": "other@0123456789ab"}, "it names the encoder other@0123456789ab, and no agent reads latents"),
        ({"codes": "other@0123456789ab"}, "it names the encoder other@0123456789ab, and no agent reads codes"),
        ({"encoder": "other@0123456789ab", "codes": "other@0123456789ab"}, "and no agent reads latents"),
    ],
)
def test_what_a_protocol_says_follows_from_its_runs(
    pair: Path, tmp_path: Path, claim: dict[str, str], complaint: str
) -> None:
    folder = rewrite_protocol(forged(pair, tmp_path), **claim)
    assert complaint in " ".join(each.complaint for each in verify(folder))


def test_a_name_that_no_agent_can_have_is_a_complaint(pair: Path, tmp_path: Path) -> None:
    folder = forged(pair, tmp_path)
    for run in all_runs(folder):
        run.config["agent"] = "person"
        run.write()
    (folder / "table").rename(folder / "person")
    folder = rewrite_protocol(folder, agents=["person"])
    assert "person alone is no name" in " ".join(each.complaint for each in verify(folder))


@pytest.mark.parametrize("agents", [("dqn",), ("factored:given",), ("dqn", "factored:given")])
def test_a_bench_that_was_given_codes_holds_whatever_its_agents_read(agents: tuple[str, ...], tmp_path: Path) -> None:
    """An encoder of codes is also the encoder of agents that read latents, such as ``dqn``."""
    few = {"budgets": (1,), "evaluation_episodes": 1}
    codes = str(encoders.bundled()["arrow_puzzle-clean-codes"])
    result = benched(tmp_path, "arrow_puzzle", *agents, encoder=codes, **few)
    assert [each.complaint for each in verify(result.folder)] == [""] * (len(agents) + 1)


class Lasting(Wrapper):
    """Each macro-action takes so long, as in contact physics."""

    each_s = 0.0

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        frame, reward, terminated, truncated, info = self.env.step(action)
        return frame, reward, terminated, truncated, {**info, "sim_time_s": self.each_s}


@pytest.mark.parametrize("group", ["training", "rows/0/kept"])
def test_simulated_times_may_differ_by_a_share(pair: Path, tmp_path: Path, group: str) -> None:
    """By that by which kinds of CPU differ, 5 %, however long episodes are; what takes no time takes none."""
    folder = forged(pair, tmp_path)
    shutil.rmtree(folder / "table" / "seed_0")
    run = OpenRun.read(folder / "table" / "seed_1")
    times = [name for name in run.arrays if name.endswith("/sim_times_s")]
    with environments(small(), observation="state") as envs:
        lasting = [Lasting(env) for env in envs]
        for each_s, factor, more_s, holds in (
            *((each_s, factor, 0.0, True) for each_s in (0.01, 30.0) for factor in (0.96, 1.0, 1.04)),
            *((each_s, factor, 0.0, False) for each_s in (0.01, 30.0) for factor in (0.9, 1.06)),
            (0.0, 1.0, 0.04, False),
        ):
            for name in times:
                run.arrays[name] = each_s * run.arrays[name.replace("sim_times_s", "lengths")]
            run.arrays[f"{group}/sim_times_s"][-1] *= factor
            run.arrays[f"{group}/sim_times_s"][-1] += more_s
            run.write()
            for env in lasting:
                env.each_s = each_s
            _, found, *_ = verdicts(folder, Replays(*lasting))
            assert ("simulated time" in found.complaint) != holds and bool(found.complaint) != holds, (each_s, factor)


@pytest.mark.parametrize(
    ("own", "task", "failed", "solved"),
    [
        (True, "arrows", [[0, 1, 2]], "1"),
        (True, "arrows", [[0, 1], [2]], "1"),  # together
        (False, "arrows", [[0, 1, 0]], "1"),
        (False, "arrows", [[0, 1, 2]], "0"),  # nothing is solved
        (False, "arrows:slip=0.3", [[0, 1, 2]], "1"),
        (False, "arrows:gesture=first", [[0, 1, 2]], "1"),
        (False, "arrows:lag=1", [[0, 1, 2]], "1"),
        (False, "arrows:horizon=1", [[0, 1, 2]], "1"),  # no plan is short enough
    ],
)
def test_failures_are_a_seeds_own_unless_equal_plans_fail_alike(
    own: bool, task: str, failed: list[list[int]], solved: str
) -> None:
    wanted = protocol(task, "smoke", agents=("random",))
    played = [[0], *failed]
    none = [0] * len(played)
    rules = registry.task("arrows").rules
    start = next(list(each) for each in rules.start_states if fewest_actions(rules, each) > 1)
    counts = EvaluationCounts(
        starts=[start] * len(played), lengths=[*map(len, played)], returns=none, faults=none, fingerprints=none,
        actions=np.concatenate(played).tolist(), solved=solved + "0" * len(failed),
    )  # fmt: skip
    assert has_own_failures(counts.kept(), wanted) == own


def test_an_earlier_run_holds_and_names_its_missing_facts(tmp_path: Path) -> None:
    older = Path(__file__).parents[1] / "store" / "of_abcb05c" / "whole"
    run, *_ = verify(forged(older, tmp_path))
    assert str(run).startswith("table seed 0: holds; 10 episodes")
    assert "env_steps, budgets and successes in training are claims" in str(run)


def test_a_changed_sealed_file_is_a_complaint_in_one_line(pair: Path, replays: Replays, tmp_path: Path) -> None:
    """Texts, numbers of 4,000 digits, and parts that are missing: none of them ends in a raw error."""
    folder = forged(pair, tmp_path)
    run = OpenRun.read(folder / "table" / "seed_1")
    row = run.rows[0]
    spots = [(row, name) for name in row if name not in ("beliefs", "open_loop", "diagnostics")]
    spots += [(run.values, name) for name in ("success", "length", "tried", "rows")]
    for number, (place, name) in enumerate(spots):
        honest = place[name]
        place[name] = ("text", 10**4000, [], {}, float("nan"), -1)[number % 6]
        run.write_state()
        run.seal()
        _, other, *_ = with_report(folder, verdicts(folder, replays))
        assert other.complaint and "\n" not in str(other) and len(str(other)) < 2000, name
        place[name] = honest


@pytest.mark.parametrize(("episodes", "complaint"), [(6, ""), (7, "those of seed 0")])
def test_two_seeds_may_learn_the_same_from_a_dataset_alone(tmp_path: Path, episodes: int, complaint: str) -> None:
    """Episodes are numbered from the first of the dataset, which are not played again."""
    few = {"agents": ("table",), "seeds": (0, 1), "budgets": (episodes,), "evaluation_episodes": 4}
    how = {"execution": "kinematic", "appearance": "mild", "open_loop_starts": 0, "recorded_episodes": 0}
    played, apart, card = collected()
    # the policy is a file whose name ends like the number of a dataset's episodes
    card = {**card, "policy": "program:laws-2@0123456789ab"}
    dataset = write_dataset(tmp_path / "set", played, apart, card, "npz").folder
    wanted, paths = plan_control("arrow_puzzle", "smoke", **few, **how, dataset=dataset)
    folder = bench(wanted, paths, root=tmp_path, launcher=Inline()).folder
    counts = EvaluationCounts()
    first, *others = (episode_seed("evaluation", 0, test) for test in range(4))
    with environments(wanted, observation="state") as (_, env):
        counts.add(play_test_episode(env, oracle(), seed=first, privileged=True))
        for seed in others:
            counts.add(replay(env, seed, [1, 0, 3, 2, 5, 4] * 2)[0])
    for seed in (0, 1):
        run = OpenRun.read(folder / "table" / f"seed_{seed}")
        run.set_tests(0, counts)
        run.write()
    assert has_own_failures(counts.kept(), wanted)
    one, second, *_ = verify(folder)
    assert one.episodes == episodes - 6 + 4
    assert one.unshown == (f"the training episodes that are those of the dataset {wanted.dataset}",)
    assert not one.complaint and complaint in second.complaint and bool(complaint) == bool(second.complaint)


def test_an_episode_cut_off_before_its_end_is_found(pair: Path, replays: Replays, tmp_path: Path) -> None:
    """Everything that is claimed of it is true of the played part, which is not all of it."""
    tests = list[int]()

    def cut(_: OpenRun, run: OpenRun) -> None:
        own, cut = run.tests(0), EvaluationCounts()
        tests.append(next(test for test, length in enumerate(own.lengths) if length > 1))
        for test in range(8):
            actions = own.kept().actions_of(test)
            seed = episode_seed("evaluation", 0, test)
            cut.add(replays.test(seed, actions[:-1] if test == tests[0] else actions)[0])
            beyond = [replays.test(seed, [*actions, more])[1] for more in range(6)]
            assert not any(beyond), "nothing ends an episode that is over"
        run.set_tests(0, cut)

    _, other, *_ = verify(forged(pair, tmp_path, of_second(cut)))
    assert f"test {tests[0]}: its actions do not end an episode" in other.complaint
