"""Plans: carried out blindly, counted against the rules, refused where the agent is uncertain."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, SupportsFloat
from unittest import mock

import numpy as np
import pytest
from bench_fakes import RulesImaginer
from imagine_bench.tasks.arrows.rules import ArrowRules
from numpy.typing import NDArray
from recordings import contents, logged
from small_runs import context, made_bench, small
from whole_outputs import Expected, rounded

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Frame, PhysicsSettings, State
from imagine_bench.interfaces.capabilities import ImaginedRollout
from imagine_bench.interfaces.environments import Wrapper
from imagine_bench.judge.plans import PlanResult, carry_out, make_env, make_plans
from imagine_bench.protocols.control import protocol
from imagine_bench.protocols.data import RunSpec
from imagine_bench.recording.plans import record_plans
from imagine_bench.rules import Outcome, fewest_actions
from imagine_bench.running.trained import Trained
from imagine_bench.tools.audits import plan_report, summarise, write_plans

TASK = registry.task("arrow_puzzle")


class Dreamer(RulesImaginer):
    """Plans by the rules from the true start, which a test lets it peep at, and imagines that all goes well."""

    env: Any = None

    def __init__(self, choose: Callable[[State], int], uncertainty: float = 0.1, accepts: bool = True) -> None:
        super().__init__(context())
        self.choose = choose
        self.uncertainty = uncertainty
        self.accepts = accepts
        self.looks = self.begun = 0

    def begin_episode(self) -> None:
        self.begun += 1

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        assert actions is None
        self.looks += 1
        state: State = self.env.unwrapped.world.read().macrostate
        chosen: list[int] = []
        states = list[State]()
        success = False
        while len(chosen) < depth and not success:
            chosen.append(self.choose(state))
            (outcome,) = TASK.rules.outcomes(state, chosen[-1])
            state, success = outcome.macrostate, outcome.success
            states.append(state)
        count = len(chosen)
        return dataclasses.replace(
            super().imagine(frame, actions=np.array(chosen), depth=count, rng=rng),
            epistemic=np.linspace(0.0, self.uncertainty, count, dtype=np.float32),
            accepted=np.full(count, self.accepts),
            macrostates=np.array(states),
        )


def trained(dreamer: Any, seed: int = 0, **changes: Any) -> Trained:
    spec = RunSpec(protocol=protocol("arrow_puzzle", "smoke", seeds=(seed,), **changes), agent="imagination", seed=seed)
    return Trained(agent=dreamer, spec=spec, task=TASK, episodes=7, folder=Path("somewhere"))


@pytest.fixture(scope="module", autouse=True)
def _world() -> Iterator[None]:
    """The kinematic world of all plans."""
    with closing(make_env(trained(None), "kinematic")) as env:
        Dreamer.env = env
        yield


class Hopeless(ArrowRules):
    """The rules of the task, which say of no outcome that it is a success."""

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        return tuple(dataclasses.replace(each, success=False) for each in super().outcomes(macrostate, action))


def test_a_start_that_the_rules_cannot_solve_has_no_shortest_plan(tmp_path: Path) -> None:
    task = dataclasses.replace(TASK, rules=Hopeless())
    whose = dataclasses.replace(trained(Dreamer(TASK.rules.optimal_action)), task=task)
    plan = carry_out(Dreamer.env, whose, 0)
    assert (plan.shortest, plan.outcome, plan.optimal) == (None, "solved", False)
    write_plans(tmp_path, [plan], TASK, {})
    (row,) = csv.DictReader((tmp_path / "plans.csv").read_text().splitlines())
    assert (row["shortest"], row["solved"], row["optimal"]) == ("", "1", "0")


class Faulty(Wrapper):
    """Each macro-action but the first has a fault."""

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        *after, info = self.env.step(action)
        is_first, self.begun = not self.begun, True
        return *after, {**info, "fault": "" if is_first else "it slipped"}  # type: ignore[return-value]

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        self.begun = False
        return self.env.reset(**options)


def test_the_faults_of_a_plan_are_those_of_its_macro_actions() -> None:
    plans = [carry_out(Faulty(Dreamer.env), trained(optimal()), number) for number in range(3)]
    assert [plan.faults for plan in plans] == [plan.done - 1 for plan in plans] and max(p.done for p in plans) > 2


def carried_out(dreamer: Dreamer, count: int, seed: int = 0, **options: Any) -> list[PlanResult]:
    return [carry_out(dreamer.env, trained(dreamer, seed), number, **options) for number in range(count)]


def optimal(**changes: Any) -> Dreamer:
    return Dreamer(TASK.rules.optimal_action, **changes)


@pytest.fixture(scope="module")
def wrong() -> list[PlanResult]:
    """Plans that always turn the left cube."""
    return carried_out(Dreamer(lambda state: 0), 12)


@pytest.fixture(scope="module")
def right() -> list[PlanResult]:
    """Optimal plans."""
    return carried_out(optimal(), 12)


def test_optimal_plans_are_solved_without_a_second_look(right: list[PlanResult]) -> None:
    assert [plan.done for plan in right] == [fewest_actions(TASK.rules, plan.start) for plan in right]
    dreamer = optimal()
    carried_out(dreamer, 3)
    assert dreamer.looks == dreamer.begun == 3, "one with memory begins anew"


def test_every_plan_is_written_and_stops_with_its_episode(
    wrong: list[PlanResult], right: list[PlanResult], tmp_path: Path, expected: Expected
) -> None:
    failed = next(plan for plan in wrong if not plan.solved)
    assert failed.done < failed.length and failed.compared.real_terminated[-1]
    said = write_plans(tmp_path, [*wrong, *right], TASK, {"commit": "abc"}).replace(str(tmp_path), "HERE")
    write_plans(tmp_path, wrong, TASK, {"commit": "abc"})
    outcomes = [plan.outcome for plan in (*wrong, *right)]
    written = [(tmp_path / name).read_text() for name in ("plans.csv", "summary.json")]
    expected("plans", "\n".join([*written, *outcomes, rounded(summarise(right)), said]))
    (tmp_path / "recording.rrd").write_text("old")
    write_plans(tmp_path, right[:1], TASK, {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plans.csv", "plans.png", "summary.json"]
    with_faults = summarise([dataclasses.replace(plan, faults=3) for plan in right])
    assert (with_faults["faults"], with_faults["steps"]) == (36, sum(plan.done for plan in right))


def texts_of(path: Path) -> list[str]:
    """The texts of a recording, in their order."""
    return [text for _, (text,) in logged(path, "/real/text", "TextDocument:text", "env_step")]


def test_the_recording_shows_the_same_plans_and_the_arm_moves(
    right: list[PlanResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dreamer = optimal()
    executions = []

    def env_for(whose: Trained, execution: str) -> Any:
        executions.append(execution)
        dreamer.env = make_env(whose, execution)
        return dreamer.env

    monkeypatch.setattr("imagine_bench.recording.plans.make_env", env_for)
    path = tmp_path / "recording.rrd"
    record_plans(trained(dreamer), count=2, execution="physics", max_epistemic=None, path=path)
    timelines = contents(path)
    texts = texts_of(path)
    done = [sum(line.endswith(" done") for line in text.splitlines()) for text in texts]
    for entity in ("/real/frame", "/imagined/frame", "/imagined/filmstrip", "/real/text", "/scene/right_l3"):
        assert timelines[entity] >= {"sim_time", "env_step", "plan"}
    steps = sum(plan.done for plan in right[:2])
    frames, poses = (
        len(logged(path, entity, column, "env_step"))
        for entity, column in (("/real/frame", "Image:buffer"), ("/scene/right_l3", "Transform3D:translation"))
    )
    assert frames == steps + 2, "the physical arm solves the same plans"
    assert poses > 20 * steps, "the arm must be seen moving"
    assert sorted(done) == sorted(number for plan in right[:2] for number in range(plan.done + 1))
    record_plans(trained(dreamer), count=2, execution="kinematic", max_epistemic=0.05, path=path)
    long = [plan.number for plan in right[:2] if plan.length > 1]  # the first imagined step is certain
    refused = {text.split()[2] for text in texts_of(path) if "**Refused:**" in text}
    assert refused == {str(number) for number in long} != set() and executions == ["physics", "kinematic"]
    dreamer.choose = lambda state: 0
    record_plans(trained(dreamer), count=1, execution="kinematic", max_epistemic=None, path=path)
    first, *others = (f"{step}. turn the left cube clockwise " for step in range(1, 11))
    begun, over = (text.splitlines()[2:] for text in texts_of(path))
    assert begun == [f"{first}**now**", *others, "", "The arm does this without looking again."]
    assert over == [f"{first}done", *others, "", "**Failed at macro-action 1.** The shortest possible: 2."]


@pytest.mark.parametrize(
    ("dreams", "bound", "words"),
    [
        ({"uncertainty": 0.9}, 0.3, "epistemic uncertainty 0.45 at macro-action 2 is above 0.3"),
        (
            {"accepts": False},
            None,
            "the agent's filter discards macro-action 1 "
            "(epistemic uncertainty of the state 0, probability of the end 0.1)",
        ),
        ({"accepts": False, "uncertainty": 0.9}, 1.0, ""),  # the bound replaces the agent's own filter
        ({"uncertainty": 0.9}, 0.5, "epistemic uncertainty 0.9 at macro-action 3 is above 0.5"),
        ({"uncertainty": 0.9}, 0.0, "epistemic uncertainty 0.45 at macro-action 2 is above 0"),
        ({"accepts": False, "uncertainty": 0.0}, 0.0, ""),
    ],
)
def test_an_uncertain_plan_is_refused_and_says_so(dreams: dict[str, Any], bound: float | None, words: str) -> None:
    plan = next(plan for plan in carried_out(optimal(**dreams), 8, max_epistemic=bound) if plan.length == 3)
    assert plan.refused == words and bool(words) != plan.solved
    assert plan.done == (0 if words else plan.length) and summarise([plan])["refused"] == bool(words)
    assert plan.outcome.startswith("refused: " if words else "solved")


def test_a_detour_is_solved_but_not_optimal() -> None:
    """Turning a cube there and back first, where that is legal, costs two macro-actions."""
    path: list[int] = []

    def wander(state: State) -> int:
        legal = [action for action in range(6) if not TASK.rules.outcomes(state, action)[0].terminated]
        if not path and legal:
            path.extend([legal[0], legal[0] ^ 1])  # the same cube the other way
            return path[0]
        return path.pop() if len(path) == 2 else TASK.rules.optimal_action(state)

    (plan,) = carried_out(Dreamer(wander), 1)
    assert plan.solved and not plan.optimal
    assert plan.outcome == "solved, 2 longer than needed"
    beyond = dataclasses.replace(plan.compared.rollout, actions=np.append(plan.compared.rollout.actions, 0))
    longer = dataclasses.replace(plan, compared=dataclasses.replace(plan.compared, rollout=beyond))
    assert longer.outcome == plan.outcome, "what was not carried out costs nothing"


class Cautious(RulesImaginer):
    """Plans three macro-actions that end nothing, from the true start."""

    env: Any = None

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        world, rules = self.env.unwrapped.world, registry.task("arrows:cubes=2").rules
        state, chosen = world.read().macrostate, list[int]()
        for _ in range(3):
            outcomes = [rules.outcomes(state, action)[0] for action in range(4)]
            chosen.append(next(action for action, outcome in enumerate(outcomes) if not outcome.terminated))
            state = outcomes[chosen[-1]].macrostate
        rollout = super().imagine(frame, actions=np.array(chosen), depth=3, rng=rng)
        return dataclasses.replace(rollout, accepted=np.ones(3, dtype=bool))


@pytest.mark.parametrize(("first", "lag"), [(False, 1), (False, 2), (True, 0), (True, 1)])
def test_a_plan_is_compared_with_what_its_frames_show(first: bool, lag: int) -> None:
    """A late frame shows what was, and a hidden gesture is read as one more than the last one."""
    plain = registry.task("arrows:cubes=2")
    name = f"{plain.id}{',gesture=first' if first else ''}{f',lag={lag}' if lag else ''}"
    whose = RunSpec(protocol=protocol(name, "smoke", seeds=(0,)), agent="imagination", seed=0)
    agent = Cautious(context())
    plans = Trained(agent=agent, spec=whose, task=registry.task(name), episodes=7, folder=Path("somewhere"))
    with closing(make_env(plans, "kinematic")) as agent.env:
        plan = carry_out(agent.env, plans, 0)
    assert plan.outcome == "over before anything was solved"
    states = [plan.start]
    for action in plan.compared.rollout.actions.tolist():
        states.append(plain.rules.outcomes(states[-1], action)[0].macrostate)
    hidden = len(plain.macrostate_values[-1])
    seen = [(*state[:-1], hidden if first and step else state[-1]) for step, state in enumerate(states)]
    assert list(map(tuple, plan.compared.real_macrostates.tolist())) == [seen[max(0, t - lag)] for t in (1, 2, 3)]


def test_all_agents_have_the_same_starts_and_tuning_has_others() -> None:
    starts = [
        [plan.start for plan in carried_out(Dreamer(lambda state: 0, accepts=False), 6, seed)] for seed in (0, 3, 1000)
    ]
    assert starts[0] == starts[1] != starts[2]


def test_plans_are_carried_out_in_the_world_of_the_tests() -> None:
    """Its physics, and the starts that are held out for tests."""
    whose = trained(None, physics=(("object_mass", 2.0),), split="plan_length=2")
    with closing(make_env(whose, "physics")) as env:
        assert env.unwrapped.get_state().kind[3] == PhysicsSettings(object_mass=2.0)  # type: ignore[attr-defined]
        _, info = env.reset(seed=3)
        assert tuple(info["macrostate"].tolist()) in whose.spec.protocol.spec(testing=True).rules.start_states


def test_no_agent_without_imagination() -> None:
    with pytest.raises(InvalidValueError, match="does not imagine; give the run of one that does"):
        next(make_plans(trained(object()), count=1, execution="kinematic"))


def test_plans_of_other_options_lie_in_other_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that none overwrites the table and the films of those before; each names the world that it was tried in."""
    imaginer = small(agents=("imaginer",), budgets=(2,), evaluation_episodes=1, test_appearance="mild")
    folder = made_bench(imaginer, tmp_path).folder
    recording = mock.Mock()
    monkeypatch.setattr("imagine_bench.recording.plans.record_plans", recording)
    for count, bound in [(1, None), (1, 0.3), (1, 0.0), (2, None)]:
        how: dict[str, Any] = {"count": count, "execution": "kinematic", "max_epistemic": bound}
        plan_report(folder, root=tmp_path, task=None, encoder=None, recorded=1, **how)
        assert recording.call_args.kwargs == {**how, "count": 1, "path": mock.ANY}
    kept = [json.loads(path.read_text()) for path in folder.glob("imaginer/seed_0/plans/*/summary.json")]
    assert {(each["attempted"], each["max_epistemic"]) for each in kept} == {(1, None), (1, 0.3), (1, 0.0), (2, None)}
    assert {(each["appearance"], each["execution"]) for each in kept} == {("mild", "kinematic")}
