"""Agents of macro-actions learn through the same loop, by planner or by clone."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.continuous.spec import make_arrows
from imagine_bench_motion import flat
from imagine_bench_motion.__main__ import main
from imagine_bench_motion.cloned_env import BUNDLED
from imagine_bench_motion.flat import Point
from imagine_bench_motion.levels import CurvePoint, environment, expects_nothing, learn, make_agent, oracle_success

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.capabilities import ExpectedOutcomes

KEPT = Path(__file__).parents[4] / "docs" / "results" / "motion"


def test_unchanged_values_are_weighted_by_their_probability() -> None:
    """Nothing in three macro-actions of four, and success in the others."""

    def predict(frames: Any, rng: Any) -> ExpectedOutcomes:
        macrostates = np.zeros((len(frames), 4, 2, 4), dtype=np.int64)
        macrostates[:, :, 1] = 1
        p_continues = np.tile([0.75, 0.25], (len(frames), 4, 1))
        return ExpectedOutcomes(macrostates=macrostates, p_continues=p_continues, reward=np.zeros((len(frames), 4)))

    sticky = SimpleNamespace(read_frames=lambda frames: np.zeros((len(frames), 4), np.int64), predict_outcomes=predict)
    env = environment("planner", cubes=3, slip=0.0).env
    assert expects_nothing(env, sticky, 2) == pytest.approx(0.75)
    assert expects_nothing(env, object(), 2) is None


def test_the_planner_solves_what_the_rules_say_and_robot_time_adds_up() -> None:
    stage = environment("planner", cubes=1, slip=0.0)
    successes, macro_action_s = oracle_success(stage.env, stage.rules, tests=5, horizon=stage.horizon)
    assert successes == 5
    assert 1.5 < macro_action_s < 3.0
    told: list[CurvePoint] = []
    agent = make_agent("random", stage.spec, 0)
    (point,) = learn(stage.env, stage.env, agent, budgets=[4], tests=2, horizon=stage.horizon, seed=0, told=told.append)
    assert told == [point]
    assert 4 <= point.macro_actions <= 4 * stage.horizon
    assert point.robot_s == pytest.approx(point.macro_actions * macro_action_s, rel=0.2)


class _Rememberer:
    """Says what it is told, and trains in its model three times."""

    def __init__(self) -> None:
        self.told: list[Any] = []
        self.left = 3

    def begin_episode(self) -> None:
        self.told.append("begin")

    def act(self, observation: Any, *, explore: bool) -> int:
        self.told.append("explore" if explore else "test")
        return 0

    def observe(self, transition: Any, *, episode: int) -> None:
        frames = (each.frame.item(0) for each in (transition.observation, transition.next_observation))
        self.told.append((episode, *frames, transition.truncated))

    def train_in_model(self) -> bool:
        self.left -= 1
        self.told += ["model"] * (self.left >= 0)
        return self.left >= 0


def test_an_agent_hears_of_episodes_and_trains_before_tests() -> None:
    """Each training episode has a start of its own, each test always the same.

    In an episode one macro-action changes a cube, the next one nothing, and two are faults: what a fault changes is
    not counted.
    """

    def info(macrostate: int, fault: bool = False) -> dict[str, Any]:
        return {"macrostate": np.array([macrostate]), "sim_time_s": 2.0, "fault": fault, "is_success": False}

    def reset(seed: int) -> tuple[Any, dict[str, Any]]:
        agent.told.append(seed)
        return frame, info(0)

    def step(action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        place, told = next(steps)
        return np.full_like(frame, place), 0.0, False, False, told

    each = [info(1), info(1), info(1, fault=True), info(2, fault=True)]
    steps = iter([*enumerate(each, start=1)] * 2)
    frame = np.zeros((64, 64, 3), dtype=np.uint8)
    agent: Any = _Rememberer()
    env: Any = SimpleNamespace(reset=reset, step=step)
    test_env: Any = SimpleNamespace(reset=reset, step=lambda _: (frame, 0.0, True, False, info(0)))
    curve = learn(env, test_env, agent, budgets=[1, 2], tests=2, horizon=4, seed=3, told=lambda point: None)
    trained = [
        ["begin", *(word for place in range(4) for word in ("explore", (episode, place, place + 1, place == 3)))]
        for episode in (1, 2)
    ]  # the horizon truncates
    tested = [10**9, "begin", "test", 10**9 + 1, "begin", "test"]
    assert agent.told == [300_001, *trained[0], *["model"] * 3, *tested, 300_002, *trained[1], *tested]
    found = [(point.macro_actions, point.nothing, point.faults, point.robot_s) for point in curve]
    assert found == [(4, 1, 2, 8.0), (8, 2, 4, 16.0)]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("level out --agent random --execution planner --budgets 0", "tests is 50 and budgets [0]; give at least 1"),
        ("level out --agent oracle --execution planner --tests 0", "tests is 0; give an integer from 1 on."),
        ("level out --agent elimination --execution planner", "elimination is shown macrostates; give an"),
        ("level out --agent sb3_dqn --execution planner", "sb3_dqn has a training loop of its own; give an"),
        ("level out --agent random --execution planner --clone CLONE", "The planner needs no clone; leave out --clone"),
        ("level out --agent random --execution planner --seed 10000", "seed is 10000; give 0 to 9,999."),
        ("level FILE/out --agent random --execution planner", "Cannot write"),
        ("clone FILE FILE/clone.pt", "Cannot write"),
        ("clone FILE FILE", "FILE exists; give another file."),
        ("level FILE --agent random --execution planner", "FILE exists; give another file."),
        ("flat FILE", "FILE exists; give another file."),
        ("try CLONE --out FILE", "FILE exists; give another file."),
        ("demonstrate FILE", "FILE exists; give another file."),
        ("clone FILE clone.pt", "FILE is not a file of demonstrations"),
        ("flat out --steps 100 --every 2500", "steps is 100 and every 2500; give a multiple of every"),
        ("demonstrate FILE/demo", "Cannot write"),
        ("demonstrate demo --count 0", "count is 0; give an integer from 1 on."),
        ("demonstrate demo --observation hand,front", "observation is hand,front, images alone; give proprio too."),
        ("try CLONE --count 0", "count is 0; give an integer from 1 on."),
    ],
)
def test_a_wrong_command_ends_at_once_in_one_sentence(
    words: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("FILE").write_text("nothing")
    monkeypatch.setattr(sys, "argv", ["motion", *words.replace("CLONE", str(BUNDLED)).split()])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith(sentence)
    assert [path.name for path in tmp_path.iterdir()] == ["FILE"]


def test_an_agents_own_settings_reach_it() -> None:
    spec = environment("planner", cubes=3, slip=0.0).spec
    usual: Any = make_agent("dqn", spec, 0)
    other: Any = make_agent("dqn:controller.discount=0.5", spec, 0)
    assert other.settings.controller.discount == 0.5 != usual.settings.controller.discount
    first, again, second = (make_agent("random", spec, seed).state().values for seed in (0, 0, 1))
    assert first == again != second


@pytest.mark.parametrize("slip", [0.0, 0.25])
def test_grips_slip_as_often_as_is_said_and_no_rule_knows(slip: float) -> None:
    by_planner, by_clone = (environment(execution, cubes=3, slip=slip) for execution in ("planner", "clone"))
    assert by_planner.env.unwrapped.task.rules.world.slip == slip
    assert by_planner.rules.world.slip == by_clone.rules.world.slip == 0.0
    same = make_arrows(slip=slip, horizon=10, control="joint", observation=by_clone.env.clone.observation)
    for env in (same, by_clone.env.motion):
        env.reset(seed=0)
    by_clone.env.motion.set_state(same.get_state())  # which would refuse the state of another world


def test_a_kept_file_names_its_clone_and_its_world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "tries.json"
    words = "--count 1 --seed 5 --appearances mild --placement 0 --out".split()
    monkeypatch.setattr(sys, "argv", ["motion", "try", str(BUNDLED), *words, str(out)])
    main()
    kept = json.loads(out.read_text())
    asked = {"count": 1, "seed": 5, "appearances": ["mild"], "family": "arrows", "placement": 0.0, "swapped": False}
    clone = f"{BUNDLED.name}@{hashlib.sha256(BUNDLED.read_bytes()).hexdigest()[:12]}"
    assert kept == kept | asked | {"clone": clone}
    assert str(BUNDLED.parent) not in out.read_text()


@pytest.mark.parametrize(("settings", "at_once"), [("library", 4), ("tuned", 8)])
def test_sac_has_whole_tests_and_counted_training(settings: str, at_once: int) -> None:
    """Periods of training are those that the library made: 25, then 50, each made up to whole rounds of collection."""
    told: list[Point] = []
    short = {"reward": "dense", "time_limit_s": 0.4}
    curve = flat.learn(50, seed=3, settings=settings, every=25, tests=1, told=told.append, **short)
    made = [at_once * math.ceil(wanted / at_once) for wanted in (25, 50)]
    assert told == curve and [point.steps for point in curve] == made
    assert [point.robot_s for point in curve] == pytest.approx([0.04 * steps for steps in made])


class _Scripted(gymnasium.Env[Any, Any]):
    """Episodes of three periods: each test is of the given kind, of training every second one ends in a fault."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    period_s = 0.5

    def __init__(self, *tests: str) -> None:
        self.tests = tests
        self.trained = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        place = (seed or 0) - 10**9
        self.trained += place < 0
        self.kind = self.tests[place] if place >= 0 else ("success", "fault")[self.trained % 2]
        self.periods = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.periods += 1
        over = self.periods == 3
        info = {
            "event": self.kind in ("touch", "success") and self.periods == 2,
            "fault": self.kind == "fault" and over,
            "is_success": self.kind == "success" and over,
        }
        return np.zeros(2, np.float32), 5.0 * info["is_success"] - 1.0, False, over, info


def test_each_test_of_sac_counts_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """An event or a success belongs to its own episode, and to none of those after it."""
    kinds = ("nothing", "touch", "nothing", "success", "nothing")
    monkeypatch.setattr(flat, "flat_env", lambda: _Scripted(*kinds))
    curve = flat.learn(6, seed=3, every=3, tests=5, told=lambda point: None)
    assert [(point.touched, point.successes, point.tests) for point in curve] == [(2, 1, 5)] * 2
    assert [point.mean_return for point in curve] == pytest.approx([-3.0 + 5.0 / 5] * 2)
    assert [(point.train_faults, point.train_successes) for point in curve] == [(1, 0), (1, 1)]


@pytest.mark.parametrize(("every", "made"), [(3, [4, 8, 12, 12, 16]), (2, [4, 4, 8, 8, 12, 12])])
def test_rounds_of_sac_never_add_up_to_more_training(
    every: int, made: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four periods are made at once: before the fourth test 12 are wanted, and 12 were made."""
    monkeypatch.setattr(flat, "flat_env", lambda: _Scripted("nothing"))
    curve = flat.learn(every * len(made), seed=3, every=every, tests=1, told=lambda point: None)
    assert [point.steps for point in curve] == made


@pytest.mark.parametrize("seed", [-1, 10**9])
def test_sac_is_never_trained_on_the_seed_of_a_test(seed: int) -> None:
    with pytest.raises(InvalidValueError, match=f"seed is {seed}; give 0 to 999,999,999"):
        flat.learn(10, seed=seed, every=5, told=lambda point: None)


def test_kept_numbers_of_the_page_are_those_of_the_kept_files() -> None:
    page = (KEPT.parents[1] / "how_to" / "clone.md").read_text()
    for pattern, done, count in (("tries_*.json", "done", "count"), ("level_*_oracle.json", "successes", "tests")):
        for file in sorted(KEPT.glob(pattern)):
            kept = json.loads(file.read_text())
            assert f"{kept[done]} of {kept[count]}" in page, file.name
