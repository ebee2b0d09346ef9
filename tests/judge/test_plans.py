"""Plans: carried out blindly, counted against the rules, refused where the agent is uncertain."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_results import bench_result
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import Frame, PhysicsSettings, State
from imagine_bench.interfaces.capabilities import ImaginedRollout
from imagine_bench.judge.plans import PlanResult, carry_out, make_env, make_plans
from imagine_bench.protocols.control import protocol
from imagine_bench.protocols.runs import RunSpec
from imagine_bench.recording.plans import record_plans
from imagine_bench.report.plans import plan_table, summarise, write_plans
from imagine_bench.rules import fewest_actions
from imagine_bench.running.trained import Trained, best_run
from imagine_bench.store.checkpoints import load_newest
from imagine_bench.store.results import RunResult

TASK = registry.task("arrow_puzzle")


class Dreamer:
    """Plans by the rules from the true start, which a test lets it peep at, and imagines what ``lie`` makes of it."""

    def __init__(self, *, choose: Callable[[State], int], uncertainty: float = 0.1, accepts: bool = True) -> None:
        self.choose, self.uncertainty, self.accepts = choose, uncertainty, accepts
        self.env: Any = None
        self.frames: list[Frame] = []

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        assert actions is None
        self.frames.append(frame)
        state: State = self.env.unwrapped.world.read().macrostate
        chosen, states = [], []
        for _ in range(depth):
            chosen.append(self.choose(state))
            (outcome,) = TASK.rules.outcomes(state, chosen[-1])
            state = outcome.macrostate
            states.append(state)
            if outcome.success:
                break
        count = len(chosen)
        return ImaginedRollout(
            actions=np.array(chosen),
            frames=np.full((count, 64, 64), 0.5, dtype=np.float32),
            start_frame=np.zeros((64, 64), dtype=np.float32),
            rewards=np.zeros(count, dtype=np.float32),
            p_terminated=np.zeros(count, dtype=np.float32),
            q_values=np.zeros((count, 6), dtype=np.float32),
            epistemic=np.linspace(0.0, self.uncertainty, count, dtype=np.float32),
            aleatoric=np.zeros(count, dtype=np.float32),
            modal=np.zeros(count, dtype=np.float32),
            accepted=np.full(count, self.accepts),
            macrostates=np.array(states),
        )


def trained(dreamer: Any, seed: int = 0) -> Trained:
    spec = RunSpec(protocol=protocol("arrow_puzzle", "smoke", seeds=(seed,)), agent="imagination", seed=seed)
    return Trained(agent=dreamer, spec=spec, task=TASK, episodes=7, folder=Path("somewhere"))


def carried_out(dreamer: Dreamer, count: int, execution: str = "kinematic", **options: Any) -> list[PlanResult]:
    who = trained(dreamer)
    with closing(make_env(who, execution)) as env:
        dreamer.env = env
        return [carry_out(env, who, number, **options) for number in range(count)]


@pytest.mark.parametrize(("execution", "count"), [("kinematic", 24), ("physics", 4)])
def test_the_arm_solves_optimal_plans_without_a_second_look(execution: str, count: int) -> None:
    dreamer = Dreamer(choose=TASK.rules.optimal_action)
    done = carried_out(dreamer, count, execution)
    assert all(plan.solved and plan.optimal and plan.as_imagined.all() for plan in done)
    assert [plan.done for plan in done] == [plan.shortest for plan in done] == [plan.length for plan in done]
    assert len({plan.shortest for plan in done}) >= 2
    assert len(dreamer.frames) == count, "one look a plan"


@pytest.fixture(scope="module")
def wrong() -> list[PlanResult]:
    """Plans that always turn the left cube."""
    return carried_out(Dreamer(choose=lambda state: 0), 12)


def test_a_wrong_plan_stops_where_the_episode_does(wrong: list[PlanResult]) -> None:
    assert summarise(wrong).solved < 6
    failed = next(plan for plan in wrong if not plan.solved)
    assert failed.done < failed.length and failed.compared.real_terminated[-1]
    assert failed.outcome == f"failed at macro-action {failed.done}"


def test_a_detour_is_solved_but_not_optimal() -> None:
    """Turning a cube there and back first, where that is legal, costs two macro-actions."""
    path: list[int] = []

    def wander(state: State) -> int:
        if path:
            return path.pop()
        legal = [action for action in range(6) if not TASK.rules.outcomes(state, action)[0].terminated]
        if not wandered and legal:
            wandered.append(True)
            path.append(legal[0] ^ 1)  # the same cube the other way
            return legal[0]
        return TASK.rules.optimal_action(state)

    wandered: list[bool] = []
    (plan,) = carried_out(Dreamer(choose=wander), 1)
    assert plan.solved and not plan.optimal and plan.done == plan.shortest + 2
    assert plan.outcome == "solved, 2 longer than needed"


@pytest.mark.parametrize(
    ("dreams", "options", "words"),
    [
        ({"uncertainty": 0.9}, {"max_epistemic": 0.3}, r"0.9 at macro-action \d is above 0.3"),
        ({"accepts": False}, {}, r"the agent's filter discards macro-action \d"),
    ],
)
def test_an_uncertain_plan_is_refused_and_says_so(dreams: dict[str, Any], options: dict[str, Any], words: str) -> None:
    dreamer = Dreamer(choose=TASK.rules.optimal_action, **dreams)
    plan = next(plan for plan in carried_out(dreamer, 8, **options) if plan.length > 1)
    assert re.search(words, plan.refused) and not plan.solved and plan.done == 0
    assert plan.outcome.startswith("refused: ")
    assert summarise([plan]).refused == 1


def test_a_bound_on_uncertainty_replaces_the_agents_own_filter() -> None:
    dreamer = Dreamer(choose=TASK.rules.optimal_action, uncertainty=0.9, accepts=False)
    (refused,), (carried,) = carried_out(dreamer, 1), carried_out(dreamer, 1, max_epistemic=1.0)
    assert refused.refused and not carried.refused and carried.solved


def test_all_agents_have_the_same_starts_and_tuning_has_others() -> None:
    def starts(seed: int) -> list[State]:
        dreamer = Dreamer(choose=lambda state: 0)
        who = trained(dreamer, seed)
        with closing(make_env(who, "kinematic")) as env:
            dreamer.env = env
            return [carry_out(env, who, number).start for number in range(6)]

    assert starts(0) == starts(3) != starts(1000)


def test_plans_are_carried_out_in_the_world_of_the_tests() -> None:
    """Its physics, and the starts that are held out for tests."""
    whose = trained(Dreamer(choose=lambda state: 0))
    wanted = protocol("arrow_puzzle", "smoke", physics=(("object_mass", 2.0),), split="plan_length=2")
    whose = dataclasses.replace(whose, spec=dataclasses.replace(whose.spec, protocol=wanted))
    with closing(make_env(whose, "physics")) as env:
        assert env.unwrapped.get_state().kind[3] == PhysicsSettings(object_mass=2.0)  # type: ignore[attr-defined]
        _, info = env.reset(seed=3)
        assert tuple(info["macrostate"].tolist()) in wanted.spec(testing=True).rules.start_states


def test_the_fewest_macro_actions_are_the_optimal_agents() -> None:
    rules = TASK.rules
    lengths = [fewest_actions(rules, start) for start in rules.start_states]
    assert np.mean(lengths) == pytest.approx(TASK.facts().mean_plan_length)
    assert set(lengths) == {1, 2, 3, 4, 5}


def test_no_agent_without_imagination_and_no_empty_series() -> None:
    with pytest.raises(InvalidValueError, match="does not imagine; give the run of one that does"):
        next(make_plans(trained(object()), count=1, execution="kinematic"))
    with pytest.raises(InvalidValueError, match="0 plans show nothing"):
        next(make_plans(trained(object()), count=0, execution="kinematic"))


def test_what_is_written_holds_every_plan(wrong: list[PlanResult], tmp_path: Path) -> None:
    summary = write_plans(tmp_path / "plans", wrong, TASK, {"commit": "abc"}, filmstrips=3)
    rows = (tmp_path / "plans" / "plans.csv").read_text().splitlines()
    assert len(rows) == 13 and rows[0].startswith("plan,start,shortest,planned,done,solved,optimal,refused")
    kept = json.loads((tmp_path / "plans" / "summary.json").read_text())
    assert kept["commit"] == "abc" and kept["solved"] == summary.solved == sum(row.split(",")[5] == "1" for row in rows)
    table = plan_table(summary, TASK)
    assert table.rows[0] == ["plans", "12", "20"] and table.rows[1][2] == "17"
    assert (tmp_path / "plans" / "plans.png").stat().st_size > 5_000
    assert len(list((tmp_path / "plans").glob("failed_*.png"))) == min(12, summary.attempted - summary.solved) > 0


def test_what_is_written_is_json_where_no_plan_was_solved(tmp_path: Path) -> None:
    refused = carried_out(Dreamer(choose=lambda state: 0, accepts=False), 2)
    write_plans(tmp_path / "plans", refused, TASK, {}, filmstrips=1)
    text = (tmp_path / "plans" / "summary.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail)["mean_length"] is None


def test_new_plans_leave_nothing_of_the_old_ones(wrong: list[PlanResult], tmp_path: Path) -> None:
    folder = tmp_path / "plans"
    write_plans(folder, wrong[:4], TASK, {}, filmstrips=3)
    (folder / "recording.rrd").write_text("old")
    assert list(folder.glob("failed_*.png"))
    write_plans(folder, carried_out(Dreamer(choose=TASK.rules.optimal_action), 3), TASK, {}, filmstrips=3)
    assert sorted(path.name for path in folder.iterdir()) == ["plans.csv", "plans.md", "plans.png", "summary.json"]


def test_the_recording_shows_the_same_plans_and_the_arm_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dreamer = Dreamer(choose=TASK.rules.optimal_action)
    who = trained(dreamer)

    def env_for(*arguments: Any) -> Any:
        dreamer.env = make_env(*arguments)
        return dreamer.env

    monkeypatch.setattr("imagine_bench.recording.plans.make_env", env_for)
    path = record_plans(who, count=2, execution="physics", max_epistemic=None, path=tmp_path / "recording.rrd")
    command = [sys.executable, "-m", "rerun", "rrd", "verify", str(path)]
    checked = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert checked.returncode == 0, checked.stderr
    timelines: dict[str, set[str]] = {}
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        timelines.setdefault(chunk.entity_path, set()).update(chunk.timeline_names)
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    steps = sum(plan.done for plan in carried_out(Dreamer(choose=TASK.rules.optimal_action), 2))
    for path_ in ("/real/frame", "/imagined/frame", "/imagined/filmstrip", "/real/text"):
        assert timelines[path_] >= {"sim_time", "env_step", "plan"} and rows[path_] == steps + 2
    assert rows["/scene/right_l3"] > 20 * steps, "the arm must be seen moving"
    assert timelines["/scene/right_l3"] >= {"sim_time", "env_step", "plan"}


def test_of_runs_that_end_alike_the_earlier_one_is_taken(tmp_path: Path) -> None:
    quick = protocol("arrow_puzzle", agents=("imagination",), seeds=(0, 1), budgets=(1, 2, 3, 4))
    result = bench_result(tmp_path, protocol=quick)

    def solving(run: RunResult, shares: tuple[float, ...]) -> RunResult:
        tests = [
            dataclasses.replace(test, successes=round(share * test.test_episodes))
            for test, share in zip(run.checkpoints, shares, strict=True)
        ]
        return dataclasses.replace(run, checkpoints=tuple(tests))

    for first, second, best in (
        ((0.9, 0.9, 0.9, 1.0), (0.1, 0.1, 1.0, 1.0), 1),
        ((0.1, 0.1, 0.1, 1.0), (0.9, 0.9, 0.9, 0.9), 0),
        ((0.5, 0.5, 0.5, 0.5), (0.5, 0.5, 0.5, 0.5), 0),
    ):
        runs = tuple(map(solving, result.runs, (first, second)))
        assert best_run(dataclasses.replace(result, runs=runs)).seed == best


def test_a_real_agent_is_taken_up_as_its_run_left_it(tmp_path: Path) -> None:
    from imagine_bench.running.runner import run
    from imagine_bench.running.trained import load_trained
    from imagine_bench.store import encoders

    tiny = (("imagination.weight_samples", 3), ("model.batch_size", 8), ("model.dynamics_hidden", (16,)))
    encoder = encoders.resolve(TASK, "clean")
    spec = RunSpec(
        protocol=protocol(
            "arrow_puzzle", "smoke", agents=("imagination_uncertainty",), budgets=(3,), evaluation_episodes=1,
            execution="kinematic", open_loop_starts=0, recorded_episodes=0, overrides=tiny,
            encoder=encoders.identity(encoder),
        ),
        agent="imagination_uncertainty",
        seed=0,
        encoder=encoder,
    )  # fmt: skip
    folder = tmp_path / "run"
    run(spec, folder, lambda progress: None)
    who = load_trained(folder)
    assert who.episodes == 3 and who.task.id == "arrow_puzzle"
    left = load_newest(folder / "checkpoints")
    assert left is not None
    taken_up = who.agent.state().arrays
    assert set(taken_up) == set(left.agent.arrays)
    assert all(np.array_equal(array, taken_up[name]) for name, array in left.agent.arrays.items())
    first, again = (next(make_plans(load_trained(folder), count=1, execution="kinematic")) for _ in range(2))
    assert np.array_equal(first.compared.rollout.actions, again.compared.rollout.actions)
    assert np.array_equal(first.compared.rollout.q_values, again.compared.rollout.q_values)
    with pytest.raises(ArtefactError, match=r"There is no .*config\.json, a run's configuration; give a run's folder"):
        load_trained(tmp_path)
    with pytest.raises(ArtefactError, match=r"saw through encoder arrow_puzzle-clean@.*give the right file"):
        load_trained(folder, encoder="arrow_puzzle-mild")
    other = dataclasses.replace(spec, encoder=encoders.resolve(TASK, "mild"))
    with pytest.raises(ArtefactError, match=r"is encoder arrow_puzzle-mild@.*, and this bench is of .*-clean@"):
        run(other, tmp_path / "another node", lambda progress: None)
