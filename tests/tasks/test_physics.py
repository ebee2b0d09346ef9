"""The physics of grasping: settings, their margins, blind moves, and collisions of the arm."""

import copy
import re

import gymnasium
import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.arrows.scene import compile_arrow_scene
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.motion.ik import ArmIK
from imagine_bench.tasks.motion.orientation import Sensing
from imagine_bench.tasks.pick_place.scene import compile_pick_scene
from imagine_bench.tasks.scenes.constants import HOME_QPOS_RAD, TABLE_HEIGHT_M

from imagine_bench import registry
from imagine_bench.interfaces import PhysicsSettings
from imagine_bench.testing.physics import as_ruled, walk

COMPILE = {"arrow_puzzle": compile_arrow_scene, "pick_place": compile_pick_scene}
TASKS = tuple(COMPILE)
_CLEAR_M, _ABOVE_M = 0.002, 0.1
"""No part of the arm comes nearer to anything; links before the forearm stay so far above the table."""


def make(task, **options):
    return gymnasium.make(registry.task(task).env_id, disable_env_checker=True, **options).unwrapped


@pytest.mark.parametrize("task", TASKS)
def test_a_setting_changes_the_part_that_it_names_alone(task):
    """The defaults are the scene as built."""
    built, compiled = make(task), COMPILE[task]()
    for name in ("geom_friction", "actuator_forcerange", "body_mass", "body_inertia", "dof_invweight0"):
        np.testing.assert_array_equal(getattr(built.model, name), getattr(compiled, name))
    env = make(task, physics={"object_mass": 5.0, "pad_friction": 0.6, "finger_force_n": 10.0})
    for name in registry.task(task).targets.objects:
        assert env.model.body(name).mass == 5 * built.model.body(name).mass
        np.testing.assert_allclose(5 * env.model.body(name).invweight0, built.model.body(name).invweight0)
    assert env.model.body("right_hand").mass == built.model.body("right_hand").mass
    tips = np.array(["_tip_" in built.model.geom(index).name for index in range(built.model.ngeom)])
    assert set(built.model.geom_friction[tips, 0]) == {PhysicsSettings().pad_friction}
    share = np.where(tips[:, None], [0.5, 0.5, 1.0], 1.0)  # sliding and turning, not rolling
    np.testing.assert_allclose(env.model.geom_friction, share * built.model.geom_friction)
    fingers = np.array(["finger" in built.model.actuator(index).name for index in range(built.model.nu)])
    force = np.where(fingers[:, None], [-10.0, 10.0], built.model.actuator_forcerange)
    np.testing.assert_array_equal(env.model.actuator_forcerange, force)


@pytest.mark.parametrize(
    ("task", "setting", "value", "low", "high"),
    [
        ("arrow_puzzle", "pad_friction", 0.01, 11, 12),  # flat jaws turn a box by its shape
        ("arrow_puzzle", "finger_force_n", 0.9, 12, 12),
        ("arrow_puzzle", "plan_error_deg", 45.0, 0, 0),
        ("pick_place", "pad_friction", 0.01, 0, 0),  # where something is lifted, friction decides
        ("pick_place", "finger_force_n", 0.3, 0, 0),
        ("pick_place", "plan_error_mm", 8.0, 12, 12),
        ("pick_place", "plan_error_mm", 40.0, 0, 0),
        *((task, "sense", "nominal", 12, 12) for task in TASKS),  # from good places
    ],
)
def test_what_decides_whether_a_grasp_holds(task, setting, value, low, high):
    assert low <= as_ruled(registry.task(task), PhysicsSettings.of({setting: value}), 12) <= high


def test_yaw_and_tilt_are_those_of_the_axes():
    """Of any pose, also where its quaternion is not of unit length; and an error moves and turns it, no more."""
    sensing, rng = Sensing(aside_m=(0.003, -0.002), turned_rad=0.1), np.random.default_rng(0)
    for _ in range(50):
        qpos, axes = rng.standard_normal(7), np.empty(9)
        mujoco.mju_quat2Mat(axes, qpos[3:] / np.linalg.norm(qpos[3:]))
        pose = sensing.pose(qpos, np.zeros(3))
        x, z = axes.reshape(3, 3).T[[0, 2]]
        assert (pose.yaw_rad, pose.tilt_rad) == pytest.approx((np.arctan2(x[1], x[0]), np.arccos(z[2])), abs=1e-7)
        erring = sensing.erring(pose)
        assert (erring.yaw_rad, erring.tilt_rad) == (pose.yaw_rad + 0.1, pose.tilt_rad)
        np.testing.assert_allclose(erring.position_m - qpos[:3], (0.003, -0.002, 0.0), atol=1e-12)


def test_errors_of_the_planner_point_everywhere():
    """As far as said, in each quadrant equally often, and to both sides about the vertical."""
    sensing, rng = Sensing(settings=PhysicsSettings(plan_error_mm=5.0, plan_error_deg=2.0)), np.random.default_rng(0)
    drawn = []
    for _ in range(2000):
        sensing.draw(rng)
        drawn.append([*sensing.aside_m, sensing.turned_rad])
    x_m, y_m, turned_rad = np.transpose(drawn)
    np.testing.assert_allclose(np.hypot(x_m, y_m), 0.005)
    np.testing.assert_allclose(np.abs(np.degrees(turned_rad)), 2.0)
    octants = np.unique([x_m > 0, y_m > 0, turned_rad > 0], axis=1, return_counts=True)[1] / 2000
    assert octants == pytest.approx([1 / 8] * 8, abs=0.03)


@pytest.mark.parametrize(("task", "body"), [("arrow_puzzle", "cube_1"), ("pick_place", "car")])
def test_a_blind_move_goes_where_the_object_should_be(task, body):
    """An object 30 mm off its place is found by true poses and missed by nominal ones."""
    faults = {}
    for sense in ("true", "nominal"):
        env = make(task, physics={"sense": sense})
        start = next(s for s in registry.task(task).rules.start_states if s[-1] == 1)
        env.reset(seed=0, options={"macrostate": start})
        env.data.qpos[int(env.model.joint(f"{body}_joint").qposadr[0])] -= 0.03
        faults[sense] = env.step({"arrow_puzzle": 2, "pick_place": 1}[task])[-1]["fault"]
    assert faults == {"true": False, "nominal": True}


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_errors_do_not_accumulate_where_poses_are_measured(task):
    found = walk(registry.task(task), "true")
    assert found["as_ruled"] == found["actions"] == 1000


# --- clearance ---------------------------------------------------------------------------------------------------


def near_misses(task, actions):
    """Pairs of geoms, one of the arm behind the fingertips, that come near in random macro-actions; and samples."""
    env, spec = make(task), registry.task(task)
    env.capture_motion_hz = 25.0
    model = copy.copy(env.model)
    names = [model.geom(index).name for index in range(model.ngeom)]
    upper = [index for index, name in enumerate(names) if name.startswith(("l2_", "l3_"))]
    model.geom_margin[model.geom_contype == 2] = _CLEAR_M
    model.geom_contype[upper], model.geom_margin[upper] = 2, _ABOVE_M
    data, rng, found, samples, over = mujoco.MjData(model), np.random.default_rng(5), set(), 0, True
    for step in range(actions):
        if over:
            env.reset(seed=step)
        people = env.data.mocap_pos.copy()
        _, _, over, _, info = env.step(int(rng.integers(spec.n_actions)))
        assert not info["fault"], info["fault_reason"]
        data.mocap_pos[:] = people
        for qpos in env.latest.motion.qpos:
            found |= touching(model, data, qpos, names)
            samples += 1
    return found, samples


def touching(model, data, qpos, names):
    """Contacts at some positions in which a part of the arm takes part."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    pairs = [contact.geom for contact in data.contact[: data.ncon]]
    return {tuple(names[geom] for geom in pair) for pair in pairs if (model.geom_contype[pair] == 2).any()}


@pytest.mark.parametrize("actions", [50, pytest.param(2_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("task", TASKS)
def test_the_planner_keeps_the_arm_clear(task, actions):
    found, samples = near_misses(task, actions)
    assert samples > 20 * actions
    assert found == set()


def test_the_arm_does_touch_what_is_in_its_way():
    env = make("arrow_puzzle")
    names = [env.model.geom(index).name for index in range(env.model.ngeom)]
    qpos = env.data.qpos.copy()
    backs = {"finger_left_back", "finger_right_back"}
    for depth_m, expected in ((-0.05, backs), (-0.12, {*backs, "hand_rail"}), (0.05, set())):
        place_m = np.array([0.55, 0.3, TABLE_HEIGHT_M + depth_m])
        reach = ArmIK(ArmModel()).solve(place_m, 0.0, np.array(HOME_QPOS_RAD))
        qpos[: len(reach.qpos_rad)] = reach.qpos_rad
        found = touching(env.model, mujoco.MjData(env.model), qpos, names)
        assert {name for pair in found for name in pair} >= ({*expected, "table_top"} if expected else set())
        assert bool(found) == bool(expected)


ARM = r"l[456]_.*|hand_(mount|rail)|finger_(left|right)_back"
TIPS = "finger_.*_tip_.*"
THINGS = r"table_top|cube_._box|ball_skin|car_(box|wheel_.)|cup_(wall|foot_.)|palm_(plate|rim_.)"


@pytest.mark.parametrize("task", TASKS)
def test_arm_and_hand_touch_each_thing_and_not_each_other(task):
    """Fingertips touch each other too. No pointing hand touches anything, nor does what is only drawn."""
    scene = COMPILE[task](distractors=2, control=True)
    names = [scene.geom(index).name for index in range(scene.ngeom)]
    arm, tips, things = ([bool(re.fullmatch(parts, name)) for name in names] for parts in (ARM, TIPS, THINGS))
    assert (sum(arm), sum(tips)) == (10, 4)
    grips = np.logical_or(tips, things)
    touch = scene.geom_contype[:, None] & scene.geom_conaffinity > 0
    expected = np.outer(grips, grips) | np.outer(arm, things)
    np.testing.assert_array_equal(touch | touch.T, expected | expected.T)


def deepest_in_hand_m(level, actions):
    """How far parts of the fingers are inside the human's pointing hand at most, in random macro-actions."""
    env, rng, deepest_m = make("arrow_puzzle", appearance=level), np.random.default_rng(5), 0.0
    env.capture_motion_hz = 50.0
    hand = env.model.geom("hand_skin").id
    fingers = [index for index in range(env.model.ngeom) if env.model.geom(index).name.startswith("finger_")]
    for step in range(actions):
        env.reset(seed=step)
        hands = env.data.mocap_pos.copy(), env.data.mocap_quat.copy()
        env.step(int(rng.integers(env.action_space.n)))
        data = mujoco.MjData(env.model)
        data.mocap_pos[:], data.mocap_quat[:] = hands
        for data.qpos[:] in env.latest.motion.qpos:
            mujoco.mj_kinematics(env.model, data)
            near_m = [mujoco.mj_geomDistance(env.model, data, hand, part, 0.01, None) for part in fingers]
            deepest_m = max(deepest_m, -min(near_m))
    return deepest_m


@pytest.mark.parametrize("actions", [40, pytest.param(2_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("level", "most_m"), [("clean", 0.0025), ("mild", 0.009), ("strong", 0.016)])
def test_the_pointing_hand_gives_way_to_a_finger(level, most_m, actions):
    """As docs/reference/physics.md says; it does come to that."""
    assert 0.0 < deepest_in_hand_m(level, actions) < most_m
