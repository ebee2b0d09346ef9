"""The targets of every registered environment, in both executions."""

from __future__ import annotations

import dataclasses
import itertools
import tempfile
import warnings

import gymnasium
import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.arrows.rules import Arrows
from imagine_bench.tasks.arrows.world import ArrowWorld
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
INFO_KEYS = {
    "action_mask",
    "fault_reason",
    "macrostate",
    "shown",
    "is_success",
    "success",
    "legal",
    "fault",
    "sim_time_s",
    "ik_error_m",
}
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


def check_info(info, spec, *, after_step):
    assert set(info) == INFO_KEYS
    assert bool(info["fault_reason"]) == info["fault"]
    assert info["action_mask"].dtype == np.int8 and info["action_mask"].shape == (spec.n_actions,)
    assert info["macrostate"].dtype == np.int64
    assert info["macrostate"].shape == (len(spec.macrostate_names),)
    assert all(type(info[key]) is np.bool_ for key in ("is_success", "success", "legal", "fault"))
    assert all(type(info[key]) is np.float64 for key in ("sim_time_s", "ik_error_m"))
    assert info["is_success"] == info["success"]
    assert after_step or info["sim_time_s"] == info["ik_error_m"] == 0.0


def reached(spec, before, action, info):
    """The rules' outcome that the environment reports; the next gesture of the human may be one of several."""
    after = tuple(info["macrostate"].tolist())
    (outcome,) = [each for each in spec.rules.outcomes(before, action) if each.macrostate == after]
    return outcome


def test_an_episode_keeps_the_contract(env):
    task = next(name for name, entry in registry.TASKS.items() if entry.env_id == env.spec.id)
    spec, physics = registry.task(task), env.spec.kwargs["execution"] == "physics"
    assert env.observation_space == gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert env.action_space == gymnasium.spaces.Discrete(spec.n_actions)
    names = env.unwrapped.action_names
    assert names == spec.action_names and len(set(names)) == spec.n_actions
    assert type(names) is tuple and all(type(name) is str for name in names)
    frame, info = env.reset(seed=3)
    check_info(info, spec, after_step=False)
    assert tuple(info["macrostate"].tolist()) in spec.rules.start_states
    assert info["action_mask"].all() and np.array_equal(env.unwrapped.action_masks(), info["action_mask"])
    for step in range(3):
        action = step % spec.n_actions
        before = tuple(info["macrostate"].tolist())
        new_frame, reward, terminated, truncated, new_info = env.step(np.int64(action))
        check_info(new_info, spec, after_step=True)
        expected = reached(spec, before, action, new_info)
        assert not new_info["fault"]
        assert (reward, terminated, truncated) == (expected.reward, expected.terminated, step + 1 >= spec.horizon)
        assert type(reward) is float
        assert new_info["success"] == expected.success
        assert (new_info["sim_time_s"] > 0.5) == (new_info["ik_error_m"] > 0.0) == physics
        assert env.observation_space.contains(new_frame)
        assert not np.shares_memory(frame, new_frame)
        assert new_info is not info
        assert new_info["macrostate"] is not info["macrostate"]
        frame, info = new_frame, new_info


@pytest.mark.parametrize("task", registry.TASKS)
def test_the_threshold_of_reward_follows_from_the_exact_optimum(task):
    """The share that the TaskSpec asks for, rounded down to a tenth; between blind choice and the optimum."""
    entry, spec = registry.TASKS[task], registry.task(task)
    optimal = spec.facts().optimal_return
    tables = tabulate(spec.rules)
    policy = np.full(tables.reward.shape, 1.0 / spec.n_actions)
    blind = evaluate(tables, policy, spec.horizon)
    for env_id in (entry.env_id, registry.vector_id(entry.env_id)):
        threshold = gymnasium.spec(env_id).reward_threshold
        assert threshold == pytest.approx(np.floor(10 * spec.success_threshold * optimal) / 10)
        assert blind.returns[tables.starts].mean() < threshold < optimal


def test_a_world_with_options_has_no_threshold_of_another():
    assert registry.task_entry("arrows:cubes=2").reward_threshold is None
    assert registry.task_entry("arrow_puzzle").reward_threshold == 45.8


@pytest.mark.parametrize("task", WORLDS)
def test_the_horizon_truncates_and_does_not_terminate(task):
    """Ends by rule are ignored, so that the walk is long enough: the two never depend on each other."""
    entry, spec = registry.TASKS[task], registry.task(task)
    assert (spec.horizon, spec.env_id) == (entry.horizon, entry.env_id)
    env, horizon, rules = make(task, **KINEMATIC), entry.horizon, spec.rules
    _, info = env.reset(seed=0)
    for step in range(horizon):
        *_, terminated, truncated, info = env.step(step % rules.n_actions)
        assert truncated == (step == horizon - 1)
        assert terminated == rules.is_terminal(tuple(info["macrostate"].tolist()))
    env.close()


@pytest.mark.parametrize("field", ["horizon", "id", "macrostate_values"])
def test_a_task_unlike_its_registry_line_or_its_rules_is_named(field, monkeypatch):
    spec = registry.task("arrow_puzzle")
    wrong = {"horizon": 20, "id": "y"}.get(field) or spec.macrostate_values[:-1]
    changed = dataclasses.replace(spec, **{field: wrong})
    monkeypatch.setattr("imagine_bench.tasks.arrows.spec.spec_of", lambda **world: changed)
    what = r"values \(4, 4, 4\)" if field == "macrostate_values" else f"{field} {wrong!r}"
    with pytest.raises(InvalidValueError, match=rf"{what} where the registry line or the rules of arrow_puzzle say"):
        registry.task("arrow_puzzle")


@pytest.mark.parametrize("task", WORLDS)
def test_starts_are_spread_over_the_start_states(task):
    env, starts = make(task, **KINEMATIC).unwrapped, registry.task(task).rules.start_states
    env.reset(seed=0)
    counts = dict.fromkeys(starts, 0)
    n = 12 * len(starts)
    for _ in range(n):
        _, info = env.reset()
        counts[tuple(info["macrostate"].tolist())] += 1
    env.close()
    assert min(counts.values()) > 0
    chi_square = sum((count - 12) ** 2 / 12 for count in counts.values())
    assert chi_square < len(starts) + 5 * np.sqrt(2 * len(starts))


def test_views_draw_no_random_number():
    env = make(appearance="strong", render_mode="rgb_array", width=80, height=60, camera="wrist", **KINEMATIC).unwrapped
    env.reset(seed=0)
    before = env.np_random.bit_generator.state
    first, again = env.render(), env.render()
    assert first.shape == (60, 80, 3) and np.array_equal(first, again) and not np.shares_memory(first, again)
    assert env.human_view(64, 48).std() > 20, "the whole scene"
    assert [env.human_view(*size).shape for size in ((32, 24), (64, 48))] == [(24, 32, 3), (48, 64, 3)]
    env.shapes()
    env.motion()
    assert env.np_random.bit_generator.state == before
    with pytest.raises(InvalidValueError, match="Image width -1"):
        env.human_view(-1, 48)
    env.close()


# --- faults ------------------------------------------------------------------------------------------------------


def test_rewards_follow_what_was_read_where_a_cube_does_not_turn():
    """Fingers that touch nothing: the arm turns, the cube stays, and the environment says so."""
    env = make().unwrapped
    model = env.world.model
    arm = np.flatnonzero((model.geom_group == ARM_GROUP) | (model.geom_contype == 2))
    model.geom_contype[arm] = model.geom_conaffinity[arm] = 0
    env.reset(seed=0, options={"macrostate": (3, 1, 2, 0)})
    _, reward, terminated, _, info = env.step(0)  # a good turn would reach the goal
    env.close()
    assert info["fault"] and info["fault_reason"]
    assert info["macrostate"].tolist() == [3, 1, 2, 0]
    assert not info["success"]
    assert (reward, terminated) == (-1.0, False)


def test_a_pushed_cube_is_a_fault(monkeypatch):
    env = make().unwrapped
    env.reset(seed=0, options={"macrostate": (3, 1, 2, 0)})
    assert not env.step(0)[4]["fault"]
    turn = env.world.executor.turn

    def clumsy(**arguments):
        result = turn(**arguments)
        env.data.joint("cube_2_joint").qpos[0] += 0.006
        return result

    monkeypatch.setattr(env.world.executor, "turn", clumsy)
    *_, info = env.step(0)
    env.close()
    assert info["fault_reason"] == "cube 2 was pushed 6 mm while cube 0 was turned"


def test_a_cube_that_slips_and_is_shoved_along_is_a_fault(monkeypatch):
    """It should have stayed, so that it counts among those that must not move."""
    world = ArrowWorld(appearance("clean"), Arrows(cubes=2, forbid="none", slip=0.2))
    world.place((1, 3, 0), np.random.default_rng(0))
    turn = world.executor.turn
    for shove_m in (0.0, 0.006):

        def clumsy(shove_m=shove_m, **arguments):
            result = turn(**arguments)
            world.data.joint("cube_0_joint").qpos[0] += shove_m
            return result

        monkeypatch.setattr(world.executor, "turn", clumsy)
        fault = world.execute(0, (1, 3, 0)).fault
        assert (fault or "").startswith("cube 0 was pushed 6 mm" if shove_m else "")
        assert bool(fault) == bool(shove_m)


# --- bad input ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"execution": "kinematik"},
            r"No execution 'kinematik'\. Did you mean 'kinematic'\? Known: physics, kinematic",
        ),
        ({"appearance": "wild"}, r"No appearance 'wild'\..*Known: clean, mild, strong"),
        ({"render_mode": "ansi"}, r"No render mode 'ansi'\..*Known: rgb_array, human"),
        ({"camera": "hunam"}, r"No camera 'hunam'\. Did you mean 'human'\? Known: .*human"),
        ({"width": 0}, r"Image width 0 must be an integer from 1 to 4096 pixels"),
        ({"height": 64.5}, r"Image height 64\.5 must be an integer"),
        ({"camera": np.array(["human", "wrist"])}, "No camera "),
        ({"execution": np.ma.masked}, "No execution "),
        ({"appearance": ["clean"]}, "No appearance "),
        ({"render_mode": b"clean"}, "No render mode "),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_wrong_options_name_what_is_allowed(options, message):
    make_env = registry.load(registry.TASKS["arrow_puzzle"].env)
    with pytest.raises(ImagineBenchError, match=message):
        make_env(**options)


@pytest.fixture(scope="module")
def kinematic():
    env = make(**KINEMATIC).unwrapped
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.parametrize(
    "given",
    [
        (0, 1, 2),
        (0, 1, 4, 0),
        (0.5, 1, 2, 0),
        "0120",
        None,
        (np.ma.masked,) * 4,
        np.array([["x"]]),
        (0,) * 10**6,
        itertools.repeat(0),
    ],
)
def test_a_wrong_macrostate_is_refused(kinematic, given):
    with pytest.raises(InvalidValueError, match=r"No macrostate .*; give one of the 192 of imagine_b") as caught:
        kinematic.reset(options={"macrostate": given})
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("task", ["arrow_puzzle", "arrows:lag=2"])
def test_a_simulation_that_blows_up_truncates_and_only_a_reset_begins_an_episode(task, monkeypatch, tmp_path):
    """The scene stands as before."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)  # MuJoCo's own log
    env = gymnasium.make(registry.task(task).env_id)
    scene = env.unwrapped
    with pytest.raises(InvalidValueError, match=r"call reset\(\) first"):
        scene.step(0)
    seen, start = env.reset(seed=0)
    scene.data.joint("cube_2_joint").qpos[0] = 1e11
    standing = scene.data.qpos.copy()
    after, reward, terminated, truncated, info = env.step(0)
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert "diverged" in info["fault_reason"]
    assert np.array_equal(after, seen)
    assert np.array_equal(info["macrostate"], start["macrostate"])
    check_info({**info, "fault_reason": ""} | {"fault": np.bool_(False)}, registry.task(task), after_step=False)
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


def test_wrong_actions_and_reset_options_are_refused(kinematic):
    for action in (6, -1, 1.5, "left", None, np.array([1, 2]), {0: 1}, np.ma.masked):
        with pytest.raises(InvalidValueError, match="does not exist; give an integer from 0 to 5"):
            kinematic.step(action)
    with pytest.raises(ImagineBenchError, match=r"No reset option 'macrostat'\. Did you mean 'macrostate'\?"):
        kinematic.reset(options={"macrostat": (0, 1, 2, 0)})
    for seed in (1.5, -1, "a", [1], {}, np.float64(3)):
        with pytest.raises(InvalidValueError, match=r"seed is .*; give an integer from 0 on"):
            kinematic.reset(seed=seed)
    for options in ("abc", [1], 0, ""):
        with pytest.raises(ImagineBenchError, match="are no mapping; give"):
            kinematic.reset(options=options)


def test_numbers_of_numpy_are_numbers():
    made_of = {"cubes": np.int64(2), "lag": np.int32(0), "slip": np.float32(0), "horizon": np.uint8(9)}
    seen_by = {"width": np.int64(32), "height": np.int16(24), "size": np.uint8(40), "motion_hz": np.float32(5)}
    physics = {"pad_friction": np.float32(1), "object_mass": np.int64(1)}
    env = make("arrows", physics=physics, appearance={"light": np.float32(0.5)}, **made_of, **seen_by)
    first, _ = env.reset(seed=3)
    for seed in (np.int64(3), np.uint8(3), np.array(3)):
        assert np.array_equal(env.reset(seed=seed)[0], first)
    env.close()


@pytest.mark.parametrize(
    ("macrostates", "message"),
    [
        (np.zeros((2, 3), np.int64), r"of shape \(N, 4\), not int64 of shape \(2, 3\)"),
        (np.zeros((2, 4)), r"must be integers of shape \(N, \d\), not float64 of shape \(2, 4\)"),
        (np.full((1, 4), 3), r"No macrostate \(3, 3, 3, 3\); give one of 192, such as \(0, 0, 0, 0\)"),
        (np.full((1, 4), -1), r"No macrostate \(-1, -1, -1, -1\)"),
    ],
)
def test_render_macrostates_refuses_what_is_none(macrostates, message):
    with pytest.raises(InvalidValueError, match=message):
        registry.task("arrow_puzzle").render_macrostates(macrostates, "clean", np.random.default_rng(0))


# --- scene reader ------------------------------------------------------------------------------------------------


def test_shapes_and_motion_describe_the_scene():
    env = make().unwrapped
    assert isinstance(env, SceneReader)
    env.reset(seed=0, options={"macrostate": (0, 1, 2, 1)})
    shapes, still = env.shapes(), env.motion()
    names = {shape.name for shape in shapes}
    assert len(names) == len(shapes) and {"cube_0_box", "hand_smooth_skin", "floor"} <= names
    assert {"right_l3"} <= {shape.body for shape in shapes} <= set(still.body_names)
    for shape in shapes:
        assert (shape.vertices is None) == (shape.faces is None) == (shape.kind != "mesh")
        assert shape.faces is None or shape.faces.max() < len(shape.vertices)
        assert (*shape.rgba.shape, *shape.pose_in_body.shape) == (4, 7)
        geom = env.model.geom(shape.name)
        is_plane = geom.type[0] == mujoco.mjtGeom.mjGEOM_PLANE
        below_m = np.array([0.0, 0.0, shape.size[2] if is_plane else 0.0])  # a plane is the top of a thin box
        np.testing.assert_array_equal(shape.pose_in_body, [*(geom.pos - below_m), *geom.quat])
    assert still.poses_in_world.shape == (1, len(still.body_names), 7)
    for name, pose in zip(still.body_names, still.poses_in_world[0], strict=True):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, pose[3:])
        np.testing.assert_allclose(matrix, env.data.body(name).xmat, atol=1e-9)
    env.capture_motion_hz = 20.0
    *_, info = env.step(2)
    motion = env.motion()
    env.close()
    assert np.all(np.diff(motion.time_s) > 0) and motion.time_s[0] == 0.0
    assert motion.time_s[-1] == pytest.approx(info["sim_time_s"], abs=0.06)
    assert motion.poses_in_world.shape == (len(motion.time_s), len(motion.body_names), 7)
    moved = np.ptp(motion.poses_in_world[:, :, :3], axis=0).max(axis=1)
    by_name = dict(zip(motion.body_names, moved, strict=True))
    assert by_name["right_hand"] > 0.1
    assert by_name["cube_0"] < 1e-3
    assert by_name["hand"] == by_name["world"] == 0.0
