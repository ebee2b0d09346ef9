"""The targets of every registered environment, in both executions."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import warnings
from collections import Counter

import gymnasium
import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.arrows.rules import Arrows
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.rendering import Renderer
from imagine_bench.tasks.rendering.cameras import human_camera_view
from imagine_bench.tasks.scenes.appearance import appearance
from imagine_bench.tasks.scenes.constants import ARM_GROUP
from worlds import WORLDS

import imagine_bench  # noqa: F401  (registers the environments)
from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, InvalidValueError
from imagine_bench.interfaces import EXECUTIONS, SceneReader
from imagine_bench.rules import evaluate, tabulate
from imagine_bench.testing.contract import checks, report

TASKS = tuple(name for name in registry.TASKS if name != "arrows")  # which is arrow_puzzle once more
KINEMATIC = {"execution": "kinematic"}


def make(task="arrow_puzzle", **options):
    return gymnasium.make(registry.TASKS[task].env_id, **options)


@pytest.fixture(params=[(task, execution) for task in TASKS for execution in EXECUTIONS], ids="-".join)
def env(request):
    task, execution = request.param
    env = make(task, execution=execution)
    yield env
    env.close()


# --- checkers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", WORLDS)
def test_the_contracts_checks_and_stable_baselines_are_content(task):
    """Every macrostate is begun in and told, and the next one is one of those of the rules."""
    assert report(checks(task)) == 0
    env = make(task, render_mode="rgb_array", width=64, height=48, **KINEMATIC)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pytest.importorskip("stable_baselines3.common.env_checker").check_env(env, warn=True)
    env.close()


# --- spaces, info, ends ------------------------------------------------------------------------------------------


KINDS = {
    "macrostate": np.int64,
    "shown": np.int64,
    "action_mask": np.int8,
    **dict.fromkeys(("is_success", "success", "legal", "fault"), np.bool_),
    **dict.fromkeys(("sim_time_s", "ik_error_m"), np.float64),
    "fault_reason": str,
}
"""The kind of number of each entry of ``info``."""


def check_info(info, spec):
    assert {name: getattr(value, "dtype", str) for name, value in info.items()} == KINDS
    assert info["action_mask"].shape == (spec.n_actions,)
    assert info["macrostate"].shape == (len(spec.macrostate_names),)
    assert bool(info["fault_reason"]) == info["fault"]
    assert info["is_success"] == info["success"]


def test_an_episode_keeps_the_contract(env):
    task = next(name for name, entry in registry.TASKS.items() if entry.env_id == env.spec.id)
    spec, physics = registry.task(task), env.spec.kwargs["execution"] == "physics"
    assert env.observation_space == gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert env.action_space == gymnasium.spaces.Discrete(spec.n_actions)
    names = env.unwrapped.action_names
    assert names == spec.action_names and len(set(names)) == spec.n_actions
    frame, info = env.reset(seed=3)
    check_info(info, spec)
    assert info["sim_time_s"] == info["ik_error_m"] == 0.0
    assert info["action_mask"].all() and np.array_equal(env.unwrapped.action_masks(), info["action_mask"])
    for step in range(3):
        action = step % spec.n_actions
        outcomes = spec.rules.outcomes(tuple(info["macrostate"].tolist()), action)
        new_frame, reward, terminated, truncated, new_info = env.step(np.int64(action))
        check_info(new_info, spec)
        after = tuple(new_info["macrostate"].tolist())  # the human's next gesture may be one of several
        (expected,) = [each for each in outcomes if each.macrostate == after]
        assert not new_info["fault"]
        assert (reward, terminated, truncated) == (expected.reward, expected.terminated, step + 1 >= spec.horizon)
        assert type(reward) is float
        assert new_info["success"] == expected.success
        assert (new_info["sim_time_s"] > 0.5) == (new_info["ik_error_m"] > 0.0) == physics
        assert env.observation_space.contains(new_frame)
        assert not np.shares_memory(frame, new_frame)
        assert new_info["macrostate"] is not info["macrostate"]
        frame, info = new_frame, new_info


@pytest.mark.parametrize("task", registry.TASKS)
def test_the_threshold_of_reward_follows_from_the_exact_optimum(task):
    """The share that the TaskSpec asks for, rounded down to a tenth; between blind choice and the optimum."""
    entry, spec = registry.TASKS[task], registry.task(task)
    optimal = spec.facts().optimal_return
    tables = tabulate(spec.rules)
    policy = np.full(tables.reward.shape, 1.0 / spec.n_actions)
    blind = evaluate(tables, policy, spec.horizon).returns[tables.starts].mean()
    for env_id in (entry.env_id, registry.vector_id(entry.env_id)):
        threshold = gymnasium.spec(env_id).reward_threshold
        assert threshold == pytest.approx(np.floor(10 * spec.success_threshold * optimal) / 10)
        assert blind < threshold < optimal
    assert registry.task_entry("arrows:cubes=2").reward_threshold is None, "another world has another"


@pytest.mark.parametrize("task", WORLDS)
def test_the_horizon_truncates_and_does_not_terminate(task):
    """Ends by rule are ignored, so that the walk is long enough: the two never depend on each other."""
    rules, horizon = registry.task(task).rules, registry.TASKS[task].horizon
    env = make(task, **KINEMATIC)
    env.reset(seed=0)
    for step in range(horizon):
        *_, terminated, truncated, info = env.step(step % rules.n_actions)
        assert truncated == (step == horizon - 1)
        assert terminated == rules.is_terminal(tuple(info["macrostate"].tolist()))
    env.close()


class Wrong:
    """Specs that contradict the registry line or the rules of the arrow puzzle, by the field that does."""

    horizon, id, macrostate_values = (
        dataclasses.replace(registry.task("arrow_puzzle"), **change)
        for change in ({"horizon": 20}, {"id": "y"}, {"macrostate_values": ("abcd",) * 3})
    )


@pytest.mark.usefixtures("own_names")
@pytest.mark.parametrize(
    ("field", "named"),
    [("horizon", "horizon 20"), ("id", "id 'y'"), ("macrostate_values", r"values \(4, 4, 4\)")],
)
def test_a_task_unlike_its_registry_line_or_its_rules_is_named(field, named):
    line = registry.TASKS["arrow_puzzle"]
    registry.TASKS["arrow_puzzle"] = dataclasses.replace(line, spec=f"{__name__}:Wrong.{field}")
    with pytest.raises(InvalidValueError, match=f"{named} where the registry line or the rules of arrow_puzzle say"):
        registry.task("arrow_puzzle")


@pytest.mark.parametrize("task", WORLDS)
def test_starts_are_spread_over_the_start_states(task):
    env, starts = make(task, **KINEMATIC).unwrapped, registry.task(task).rules.start_states
    env.reset(seed=0)
    begun = Counter(tuple(env.reset()[1]["macrostate"].tolist()) for _ in range(12 * len(starts)))
    env.close()
    assert set(begun) == set(starts)
    chi_square = sum((count - 12) ** 2 / 12 for count in begun.values())
    assert chi_square < len(starts) + 5 * np.sqrt(2 * len(starts))


def test_views_for_people_draw_no_random_number():
    env = make(appearance="strong", render_mode="rgb_array", width=80, height=60, camera="far", **KINEMATIC).unwrapped
    env.reset(seed=0)
    before = env.np_random.bit_generator.state
    with contextlib.closing(Renderer(env.model, human_camera_view("far", 80, 60))) as renderer:
        drawn = renderer.frame(env.data)
    first, again = env.render(), env.render()
    assert first.shape == (60, 80, 3) and not np.shares_memory(first, again)
    assert all(np.array_equal(image, drawn) for image in (first, again, env.human_view(80, 60)))
    for width, height in ((32, 24), (64, 48)):
        view = env.human_view(width, height)
        assert view.shape == (height, width, 3) and view.std() > 20, "the whole scene"
    env.shapes()
    env.motion()
    assert env.np_random.bit_generator.state == before
    env.close()


# --- faults ------------------------------------------------------------------------------------------------------


def test_a_cube_that_is_turned_the_other_way_is_judged_by_where_it_is():
    env = make().unwrapped
    env.reset(seed=0, options={"macrostate": (1, 2, 0, 1)})
    turn = env.world.executor.turn
    env.world.executor.turn = lambda clockwise, **others: turn(clockwise=not clockwise, **others)
    _, reward, terminated, _, info = env.step(4)
    env.close()
    assert info["fault_reason"] == "the scene reads (1, 2, 3, 1), the rules say (1, 2, 1, 1)"
    assert (reward, terminated, info["legal"], info["success"]) == (-1.0, False, True, False)


def test_rewards_follow_what_was_read_where_a_cube_does_not_turn():
    """No weld, no teleport: fingers that touch nothing leave the cube as it is, and the robot feels it holds none."""
    env = make().unwrapped
    model = env.world.model
    arm = np.flatnonzero((model.geom_group == ARM_GROUP) | (model.geom_contype == 2))
    model.geom_contype[arm] = model.geom_conaffinity[arm] = 0
    env.reset(seed=0, options={"macrostate": (3, 1, 2, 0)})
    before = env.world.object_poses()
    _, reward, terminated, _, info = env.step(0)  # a good turn would reach the goal
    np.testing.assert_allclose(env.world.object_poses(), before, atol=1e-3)
    env.close()
    assert info["fault"] and info["fault_reason"] == "the fingers closed past cube 0"
    assert info["macrostate"].tolist() == [3, 1, 2, 0]
    assert not info["success"]
    assert (reward, terminated) == (-1.0, False)


@pytest.mark.parametrize("shift_m", [0.0, 0.004, 0.006])
@pytest.mark.parametrize(
    ("task", "start", "motion", "pushed", "words"),
    [
        ("arrow_puzzle", (3, 1, 2, 0), "turn", "cube_2", "cube 2 was pushed 6 mm while cube 0 was turned"),
        ("pick_place", (0, 0, 0, 0), "pick", "cup", "the cup was pushed 6 mm by the way"),
    ],
)
def test_an_object_that_was_pushed_by_more_than_5_mm_is_a_fault(task, start, motion, pushed, words, shift_m):
    env = make(task).unwrapped
    env.reset(seed=0, options={"macrostate": start})
    move = getattr(env.world.executor, motion)

    def clumsy(**arguments):
        result = move(**arguments)
        env.data.joint(f"{pushed}_joint").qpos[0] += shift_m
        return result

    setattr(env.world.executor, motion, clumsy)
    *_, info = env.step(0)
    env.close()
    assert info["fault_reason"] == words * (shift_m > 0.005)


def test_a_cube_that_slips_and_is_shoved_along_is_a_fault():
    """It should have stayed, so that it counts among those that must not move."""
    world = ArrowWorld(appearance("clean"), Arrows(cubes=2, forbid="none", slip=0.2))
    world.place((1, 3, 0), np.random.default_rng(0))
    turn = world.executor.turn
    for shove_m in (0.0, 0.006):

        def clumsy(shove_m=shove_m, **arguments):
            result = turn(**arguments)
            world.data.joint("cube_0_joint").qpos[0] += shove_m
            return result

        world.executor.turn = clumsy
        fault = world.execute(0, (1, 3, 0)).fault
        assert (fault or "").startswith("cube 0 was pushed 6 mm" if shove_m else "")
        assert bool(fault) == bool(shove_m)


# --- bad input ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": np.array(["human", "wrist"])}, "No camera "),
        ({"execution": np.ma.masked}, "No execution "),
        ({"render_mode": b"clean"}, "No render mode "),
    ],
    ids=str,
)
def test_options_that_no_text_could_hold_are_refused(options, message):
    make_env = registry.load(registry.TASKS["arrow_puzzle"].env)
    with pytest.raises(ImagineBenchError, match=message):
        make_env(**options)


@pytest.fixture(scope="module")
def kinematic():
    env = make(**KINEMATIC).unwrapped
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.parametrize(("start", "legal"), [((3, 1, 2, 0), True), ((0, 1, 2, 0), True), ((1, 1, 2, 0), False)])
def test_a_start_is_as_legal_as_its_macrostate_and_no_success(kinematic, start, legal):
    _, info = kinematic.reset(options={"macrostate": start})
    assert (info["legal"], info["success"], info["fault"]) == (legal, False, False)


@pytest.mark.parametrize("given", [(np.ma.masked,) * 4, (0,) * 10**6, itertools.repeat(0)])
def test_a_wrong_macrostate_is_refused(kinematic, given):
    with pytest.raises(InvalidValueError, match=r"No macrostate .*; give one of the 192 of imagine_b") as caught:
        kinematic.reset(options={"macrostate": given})
    assert len(str(caught.value)) < 500


@pytest.mark.usefixtures("own_folder")  # for MuJoCo's own log
@pytest.mark.parametrize("task", ["arrow_puzzle", "arrows:lag=2"])
def test_a_simulation_that_blows_up_truncates(task):
    """The scene stands as before, and what was seen last is seen once more, however late it is."""
    env = gymnasium.make(registry.task(task).env_id)
    scene = env.unwrapped
    with pytest.raises(InvalidValueError, match=r"call reset\(\) first"):
        scene.step(0)
    env.reset(seed=0, options={"macrostate": (1, 2, 0, 1)})
    seen, *_, start = env.step(2)
    assert start["legal"] and not start["success"]
    scene.data.joint("cube_2_joint").qpos[0] = 1e11
    standing = scene.data.qpos.copy()
    after, reward, terminated, truncated, info = env.step(0)
    assert (reward, terminated, truncated) == (0.0, False, True)
    check_info(info, registry.task(task))
    assert info["fault"] and "diverged" in info["fault_reason"] and info["sim_time_s"] == 0.0
    assert np.array_equal(after, seen)
    assert all(np.array_equal(info[name], start[name]) for name in ("macrostate", "shown"))
    assert np.array_equal(scene.data.qpos, standing) and len(scene.motion().time_s) == 1
    with pytest.raises(InvalidValueError, match=r"call reset\(\) first"):
        env.step(0)
    env.reset(seed=0)
    assert not env.step(0)[4]["fault"]
    env.close()


@pytest.mark.parametrize("env_id", [entry.env_id for entry in registry.TASKS.values()])
def test_an_unknown_keyword_is_a_type_error_as_pythons_own(env_id):
    for make_any, known_as in ((gymnasium.make, env_id), (gymnasium.make_vec, registry.vector_id(env_id))):
        with pytest.raises(TypeError, match=r"unexpected keyword argument 'apearance'.* mean 'appearance'\?"):
            make_any(known_as, apearance="mild")


def test_arrays_that_are_no_action_or_seed_are_refused(kinematic):
    for action in (np.array([1, 2]), np.ma.masked):
        with pytest.raises(InvalidValueError, match="does not exist; give an integer from 0 to 5"):
            kinematic.step(action)
    with pytest.raises(InvalidValueError, match=r"seed is .*; give an integer from 0 on"):
        kinematic.reset(seed=np.float64(3))


@pytest.mark.parametrize(
    ("macrostates", "message"),
    [
        *((np.zeros(shape, np.int64), r"of shape \(N, 4\), not int64 of shape") for shape in ((4,), (2, 3), (2, 5))),
        (np.zeros((2, 4)), r"must be integers of shape \(N, \d\), not float64 of shape \(2, 4\)"),
        (np.full((1, 4), -1), r"No macrostate \(-1, -1, -1, -1\); give one of 192, such as \(0, 0, 0, 0\)"),
    ],
)
def test_render_macrostates_refuses_what_is_none(macrostates, message):
    with pytest.raises(InvalidValueError, match=message):
        registry.task("arrow_puzzle").render_macrostates(macrostates, "clean", np.random.default_rng(0))


# --- scene reader ------------------------------------------------------------------------------------------------


def test_the_motion_describes_the_scene():
    """Its shapes, their places and colors are in the kept recording of tests/whole."""
    env = make().unwrapped
    assert isinstance(env, SceneReader)
    env.reset(seed=0, options={"macrostate": (0, 1, 2, 1)})
    still = env.motion()
    shapes = env.shapes()
    assert {"right_l3"} <= {shape.body for shape in shapes} <= set(still.body_names)
    env.world.hide_gesture(True)
    assert "hand" in {shape.body for shape in env.shapes()}
    assert [shape.rgba.tolist() for shape in env.shapes()] == [[*shape.rgba[:3], 1.0] for shape in shapes], "and people"
    assert all(shape.faces is None or shape.faces.max() < len(shape.vertices) for shape in shapes)
    for name, pose in zip(still.body_names, still.poses_in_world[0], strict=True):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, pose[3:])
        np.testing.assert_allclose(matrix, env.data.body(name).xmat, atol=1e-9)
    env.capture_motion_hz = 20.0
    env.step(2)
    motion = env.motion()
    env.close()
    moved = np.ptp(motion.poses_in_world[:, :, :3], axis=0).max(axis=1)
    by_name = dict(zip(motion.body_names, moved, strict=True))
    assert by_name["right_hand"] > 0.1
    assert by_name["cube_0"] < 1e-3
    assert by_name["hand"] == by_name["world"] == 0.0
