"""Whole worlds: exact facts of the suite's experiments, and episodes, step by step.

Each step of an episode is held to the rules, and facts to those that kept results have; the rules themselves are
worked out by hand in ``tests/tasks``.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter

import gymnasium
import numpy as np
import pytest
from kept import table
from same_values import assert_same
from storms import one_sentence
from whole_outputs import Expected, questions, rounded, tabulated

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError
from imagine_bench.rules import shortest_plans, tabulate
from imagine_bench.sweep.grid import GRIDS, SUITE

LARGE = 1_500  # macrostates, as of more than four cubes: they take seconds
EPISODES = (
    "arrow_puzzle",
    "arrow_puzzle_hard",
    "arrow_puzzle_toward",
    "arrow_puzzle_clockwise",
    "arrow_puzzle_easy",
    "pick_place",
    "arrows:slip=0.3,goal_change=0.4",
    "arrows:cubes=4,goal=0123,forbid=none,coupling=neighbour",
    "arrows:cubes=2,goal=all,forbid=none",
    "arrows:shuffle=7,goal=toward_agent,horizon=5",
    "arrows:lag=2,gesture=0.5",
    "arrows:gesture=first,distractors=2",
    "pick_place:slip=0.2,fickle=0.5",
    "pick_place:gesture=first,lag=1",
)


def test_exact_facts_of_all_experiments(expected: Expected) -> None:
    kept = {(row["task"], round(float(row["chance"]), 9)) for row in table("suite/levels.csv")}
    columns = ["world", "macrostates", "ends", "starts", "horizon", "chance", "seen", "return", "length"]
    rows: list[list[object]] = [[*columns, "plans: starts"]]
    compared = 0
    experiments = (*GRIDS[SUITE].experiments, *GRIDS["separating"].experiments)
    for task in sorted({level.task for experiment in experiments for level in experiment.levels}):
        spec = registry.task(task)
        tables = tabulate(spec.rules)
        if len(tables.index) > LARGE:
            continue
        found = spec.facts()
        compared += (task, round(found.chance_level, 9)) in kept  # levels of a split have another
        lengths = Counter(shortest_plans(tables)[tables.starts].tolist())
        plans = " ".join(f"{length}:{lengths[length]}" for length in sorted(lengths))
        ends = sum(map(spec.rules.is_terminal, tables.index))
        sizes = [len(tables.index), ends, len(tables.starts), spec.horizon]
        means = (found.chance_level, found.optimum, found.optimal_return, found.mean_plan_length)
        rows.append([spec.id, *sizes, *(f"{mean:.5f}" for mean in means), plans])
    assert compared > 20
    expected("facts_of_experiments", tabulated(rows), exactly=False)


def test_episodes_step_by_step(expected: Expected) -> None:
    """Of macro-actions, optimal or random: each outcome is one that the rules have, and is rewarded as they say."""
    expected("episodes", "\n\n".join(map(episodes, EPISODES)))


def episodes(task: str) -> str:
    """Three episodes of a task as a table."""
    spec = registry.task(task)
    rng = np.random.default_rng(5)
    lines: list[list[object]] = [["action", "macrostate", "shown", "reward", "end"]]
    with contextlib.closing(
        gymnasium.make(spec.env_id, execution="kinematic", observation="state", disable_env_checker=True)
    ) as env:
        for seed in range(3):
            state, info = env.reset(seed=seed)
            lines.append(["reset", info["macrostate"], info["shown"], "", np.flatnonzero(state)])
            ended = False
            while not ended:
                before = tuple(info["macrostate"].tolist())
                action = spec.rules.optimal_action(before) if rng.random() < 0.6 else int(rng.integers(spec.n_actions))
                state, reward, terminated, truncated, info = env.step(action)
                after = tuple(info["macrostate"].tolist())
                (outcome,) = (each for each in spec.rules.outcomes(before, action) if each.macrostate == after)
                found = (reward, terminated, info["is_success"], info["legal"])
                legal = outcome.success or not outcome.terminated
                assert found == (outcome.reward, outcome.terminated, outcome.success, legal)
                ended = terminated or truncated
                words = "success" if info["is_success"] else "failure" if terminated else "cut" if truncated else ""
                lines.append([action, info["macrostate"], info["shown"], reward, words])
    return f"{spec.id}: {spec.description}\n{tabulated(lines)}"


VIEWS = ("clean", "mild", "strong", "patched", "harsh", "light=0.5,camera=0.2")


@pytest.mark.parametrize("task", ["ArrowPuzzle", "PickPlace"])
def test_frames_in_coarse_cells(task: str, expected: Expected) -> None:
    """Each channel of a frame in four by four cells, as tenths of a gray level of 25; renderers differ by less."""
    lines = []
    for appearance in VIEWS:
        options = {"execution": "kinematic", "appearance": appearance, "disable_env_checker": True}
        with contextlib.closing(gymnasium.make(f"imagine_bench/{task}-v0", **options)) as env:
            frame, _ = env.reset(seed=4)
            for _ in range(2):
                frame, *_ = env.step(1)
        assert frame.shape == (64, 64, 3)
        cells = frame.reshape(4, 16, 4, 16, 3).mean(axis=(1, 3)) / 25.0
        lines += [appearance, *(" ".join(f"{each:4.1f}" for each in row) for row in cells.reshape(4, 12))]
    expected(f"frames_{task}", "\n".join(lines), exactly=False)


@pytest.mark.parametrize(("task", "actions"), [("ArrowPuzzle", (0, 2, 5)), ("PickPlace", (2, 2, 1))])
def test_macro_actions_in_contact_physics(task: str, actions: tuple[int, ...], expected: Expected) -> None:
    """How long each takes, where the hand ends and how far objects are from where they should be."""
    lines: list[list[object]] = [["action", "macrostate", "fault", "s", "hand m", "objects: x y z m"]]
    with contextlib.closing(
        gymnasium.make(f"imagine_bench/{task}-v0", observation="state", disable_env_checker=True)
    ) as env:
        env.reset(seed=8)
        for action in actions:
            *_, info = env.step(action)
            scene = env.unwrapped
            names = [scene.model.body(index).name for index in range(scene.model.nbody)]
            moved = [name for name in names if name.startswith(("cube", "ball", "car", "cup"))]
            places = [rounded(np.round(scene.data.body(name).xpos, 3)) for name in moved]
            hand = rounded(np.round(scene.data.body(next(each for each in names if "hand" in each)).xpos, 3))
            lines.append([action, info["macrostate"], info["fault_reason"], f"{info['sim_time_s']:.2f}", hand, *places])
    expected(f"physics_{task}", tabulated(lines), exactly=False)


def test_calls_that_environments_and_lanes_refuse(expected: Expected) -> None:
    """A line of the kept file is a method and its arguments as JSON; nothing moves."""
    with (
        contextlib.closing(gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic").unwrapped) as env,
        contextlib.closing(
            gymnasium.make_vec("imagine_bench/ArrowPuzzle-vector-v0", num_envs=3, execution="kinematic")
        ) as lanes,
    ):
        doors = {"env": env, "lanes": lanes}
        for each in doors.values():
            each.reset(seed=0)
        before = [each.get_state().world.physics for each in (env, *lanes.envs)]
        answers = []
        for call in questions("refused_calls"):
            door, method, given = call.split(" ", 2)
            with pytest.raises(ImagineBenchError) as caught:
                getattr(doors[door], method)(**json.loads(given))
            answers += [f"$ {call}", one_sentence(caught.value)]
        assert_same([each.get_state().world.physics for each in (env, *lanes.envs)], before)
    expected("refused_calls", "\n".join(answers))
