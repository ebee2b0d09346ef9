"""Pick-and-place with a human in the simulation: parts, reading, carrying in contact, the human's answers."""

from __future__ import annotations

import math

import gymnasium
import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.motion import orientation
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.motion.orientation import yaw_rad
from imagine_bench.tasks.pick_place.rules import HAND_OVER, OPEN_PALM, WITHDRAWN
from imagine_bench.tasks.pick_place.scene import PALM_M, TIMESTEP_S
from imagine_bench.tasks.pick_place.spec import SPEC
from imagine_bench.tasks.pick_place.world import PickWorld
from imagine_bench.tasks.scenes import constants as c
from imagine_bench.tasks.scenes.appearance import appearance
from imagine_bench.tasks.scenes.objects import OBJECTS, standing_m

FIXED = appearance("clean").__class__(name="fixed", object_offset_m=0.0, object_yaw_rad=0.0)
RULES = SPEC.rules
EVERY_MOTION = {
    "pick ball": ((0, 0, 0, 0), 0),
    "pick car": ((0, 0, 0, 1), 1),
    "pick cup unasked": ((0, 0, 0, 0), 2),
    "place ball": ((1, 0, 0, 2), 0),
    "place cup unasked": ((0, 0, 1, 3), 2),
    "hand over ball": ((1, 0, 0, 3), HAND_OVER),
    "hand over cup": ((0, 0, 1, 3), HAND_OVER),
    "offer without palm": ((0, 1, 0, 2), HAND_OVER),
    "offer nothing": ((0, 0, 0, 1), HAND_OVER),
    "second object": ((1, 0, 0, 1), 1),
}


@pytest.fixture(scope="module")
def world():
    return PickWorld(FIXED)


def rng():
    return np.random.default_rng(0)


def turn(world, index, axis, angle_deg):
    """Turn an object about an axis, 0 for x to 2 for z, from how it stands upright."""
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, np.eye(3)[axis], math.radians(angle_deg))
    world.data.qpos[world.object_qpos[index][3:]] = quat


@pytest.mark.parametrize(
    ("index", "moved_m", "angle_deg", "problem"),
    [(1, 0, 14, "tipped by 14 degrees"), (2, 0, 14, "tipped by 14 degrees"), (0, 1.0, 0, "out of reach: The gripper")],
)
def test_what_cannot_be_picked_is_a_fault(world, index, moved_m, angle_deg, problem):
    world.place((0, 0, 0, 0), rng())
    world.data.qpos[world.object_qpos[index][0]] += moved_m
    turn(world, index, 1, angle_deg)
    result = world.executor.pick(index=index)
    assert result.fault.startswith(f"the {OBJECTS[index].name} is {problem}") and result.sim_time_s == 0.0


FAR_M = np.array([1.3, 0.2, 0.1])


@pytest.mark.parametrize(
    ("motion", "arguments", "words"),
    [
        ("place", {"index": 1, "noise": (0.8, 0.0, 0.0)}, "the car cannot be put there"),
        ("hand_over", {"index": 1, "palm_m": FAR_M}, "the car cannot be put there"),
        ("visit", {"held": 1, "place_m": FAR_M}, "there is no reaching out"),
    ],
)
def test_what_is_held_is_kept_where_there_is_no_reach(world, motion, arguments, words):
    world.place((0, 1, 0, 0), rng())
    before = world.data.qpos.copy(), world.data.ctrl.copy()
    result = getattr(world.executor, motion)(**arguments)
    assert result.fault.startswith(f"{words}: The gripper cannot reach [1.") and result.sim_time_s == 0.0
    for array, then in zip((world.data.qpos, world.data.ctrl), before, strict=True):
        np.testing.assert_allclose(array, then, atol=1e-9)


# --- acting ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("state", "action"), EVERY_MOTION.values(), ids=EVERY_MOTION)
def test_motions_follow_the_rules_within_the_robot_s_limits(world, state, action):
    intended = RULES.outcomes(state, action)[-1].macrostate
    world.place(state, rng())
    before = world.object_poses()
    world.executor.capture_motion_hz = 1 / TIMESTEP_S
    result = world.execute(action, intended)
    assert result.fault is None
    assert (world.read().macrostate, world.read().problem) == (intended, None)
    joints = [int(world.model.joint(f"right_j{index}").qposadr[0]) for index in range(7)]
    arm, speed_rad_s = ArmModel(), np.abs(np.diff(result.motion.qpos[:, joints], axis=0)) / TIMESTEP_S
    assert (speed_rad_s.max(axis=0) <= arm.speed_limit_rad_s).all()
    assert np.abs(result.motion.qpos[-1, joints] - c.OBSERVATION_QPOS_RAD).max() < 2e-3
    if intended[:3] == state[:3]:  # it reaches out in vain, to 165 mm above what it cannot do
        above_m = np.add(PALM_M if action == HAND_OVER else standing_m(action), (0.0, 0.0, 0.165))
        away_m = [np.linalg.norm(arm.tcp_in_base(qpos)[0] - above_m) for qpos in result.motion.qpos[:, joints]]
        assert min(away_m) < 5e-3
    untouched = [index for index in range(3) if state[index] == intended[index] == 0]
    assert np.abs(world.object_poses()[untouched, :3] - before[untouched, :3]).max(initial=0.0) < 1e-4


def test_a_grip_halves_how_far_an_object_is_off_and_a_palm_does_not():
    """Along the pads and turned; between the pads it is held midway. The same draw on the table, held, and given."""
    varied = PickWorld(appearance("strong"))
    for seed in range(3):
        off = []
        for state, place_m in (((0, 0, 0, 1), standing_m(0)), ((1, 0, 0, 1), None), ((2, 0, 0, 3), PALM_M)):
            varied.place(state, np.random.default_rng(seed))
            pose = varied.object_poses()[0]
            middle_m = varied.data.site("tcp").xpos if place_m is None else np.array(place_m)
            off.append([*(pose[:2] - middle_m[:2]), yaw_rad(*pose[3:])])
        x_m, _, turned_rad = off[0]
        np.testing.assert_allclose(off[1:], [(x_m / 2, 0.0, turned_rad / 2), off[0]], atol=1e-9)
        assert min(abs(x_m), abs(turned_rad)) > 1e-4


def test_a_ball_is_picked_alike_however_it_has_rolled(world):
    """It has no heading, so that the commands are the same to the bit."""
    world.executor.capture_motion_hz = 20.0
    commands = []
    for angle_deg in (0, 40):
        world.place((0, 0, 0, 0), rng())
        turn(world, 0, 2, angle_deg)
        result = world.executor.pick(index=0)
        assert result.fault is None
        commands.append(result.motion.ctrl)
    world.executor.capture_motion_hz = 0.0
    np.testing.assert_array_equal(*commands)


@pytest.mark.parametrize(("index", "aside_m", "turned_deg"), [(1, 0.004, 0), (2, 0.0, 10)])
def test_an_object_held_off_the_grips_middle_comes_down_on_its_place(world, index, aside_m, turned_deg):
    """Flat sides are held aside, and round ones turned; it is put 3 mm and 2 mm off its place and turned by 0.3 rad."""
    world.place((*(int(each == index) for each in range(3)), 0), rng())
    turn(world, index, 2, turned_deg)
    row = world.object_qpos[index]
    world.data.qpos[row[0]] += aside_m
    assert world.executor.place(index=index, noise=(0.003, -0.002, 0.3)).fault is None
    assert np.linalg.norm(world.data.qpos[row[:2]] - standing_m(index)[:2] - (0.003, -0.002)) < 1e-3
    assert orientation.yaw_rad(*world.data.qpos[row[3:]]) == pytest.approx(0.3, abs=0.02)


def slippery_tips(model):
    tips = [index for index in range(model.ngeom) if "_tip_" in model.geom(index).name]
    model.geom_friction[tips] = (0.02, 0.001, 0.0001)


@pytest.mark.parametrize(
    ("macrostate", "action", "reason"),
    [
        ((0, 1, 0, OPEN_PALM), HAND_OVER, ""),
        ((1, 0, 0, 1), 0, ""),
        ((0, 0, 1, 0), 2, ""),
        *(((0, 0, 0, index), index, f"closed and do not hold the {OBJECTS[index].name}") for index in range(3)),
    ],
)
def test_only_friction_holds_and_a_slip_ends_the_episode(macrostate, action, reason):
    """No weld, no teleport; wherever it lies then, the human does not take it for the wanted object."""
    env = gymnasium.make(SPEC.env_id).unwrapped
    env.reset(seed=0, options={"macrostate": macrostate})
    slippery_tips(env.world.model)
    _, reward, terminated, _, info = env.step(action)
    env.close()
    assert info["fault"] and reason in info["fault_reason"]
    assert not reason or info["macrostate"][action] == 0
    assert (reward, terminated, info["success"]) == (-5.0, True, False)
    assert info["macrostate"][3] == WITHDRAWN


def test_an_end_against_the_draw_is_judged_from_its_beginning():
    """The handover should have slipped, and the car came into the palm all the same: a fault, and the wish is
    fulfilled.
    """
    env = gymnasium.make("imagine_bench/PickPlace-v0", slip=0.99).unwrapped
    env.reset(seed=0, options={"macrostate": (0, 1, 0, OPEN_PALM)})
    executor = env.world.executor
    executor.visit = lambda **_: executor.hand_over(index=1, palm_m=np.array(PALM_M))
    _, reward, terminated, _, info = env.step(HAND_OVER)
    env.close()
    assert info["macrostate"].tolist() == [0, 2, 0, OPEN_PALM] and info["fault"]
    assert info["fault_reason"] == "the scene reads (0, 2, 0, 3), the rules say (0, 1, 0, 3)"
    assert (reward, terminated, info["success"]) == (5.0, True, True)


def test_held_objects_go_with_the_arm_to_the_canonical_start(world):
    """However the arm ended, the object keeps its pose in the gripper, and the arm is at its observation pose."""
    world.place((0, 1, 0, 0), rng())
    joint = int(world.model.joint("right_j1").qposadr[0])
    world.data.qpos[joint] += 0.01

    def in_gripper():
        mujoco.mj_kinematics(world.model, world.data)
        tcp, car = world.data.site("tcp"), world.data.body("car")
        turn = tcp.xmat.reshape(3, 3).T
        return np.hstack([turn @ car.xmat.reshape(3, 3), turn @ np.vstack(car.xpos - tcp.xpos)])

    held, before = in_gripper(), world.object_poses()
    world.executor.rest_holding(1)
    np.testing.assert_allclose(in_gripper(), held, atol=1e-12)
    assert np.abs(world.object_poses() - before).max() > 1e-3  # the arm really was elsewhere
    assert world.data.qpos[joint] == c.OBSERVATION_QPOS_RAD[1]


@pytest.mark.parametrize("seed", [83393, 3046])
def test_the_palm_stays_under_what_was_laid_into_it(seed: int) -> None:
    """With these seeds the palm lies so far from its nominal place that going back there would leave the object."""
    env = gymnasium.make("imagine_bench/PickPlace-v0", appearance="strong")
    env.reset(seed=seed, options={"macrostate": (0, 1, 0, OPEN_PALM)})
    data = env.unwrapped.world.data
    before_m = data.mocap_pos.copy()
    _, reward, terminated, _, info = env.step(HAND_OVER)
    assert (reward, terminated, info["is_success"], info["fault"]) == (5.0, True, True, False)
    assert np.array_equal(data.mocap_pos, before_m)
    lies = data.qpos.copy()
    *_, info = env.step(0)
    assert not info["fault"] and np.abs(data.qpos - lies).max() < 1e-5, "a later action changes nothing"
    env.close()


@pytest.mark.parametrize(("state", "action"), [((1, 0, 0, OPEN_PALM), HAND_OVER), ((0, 1, 0, 2), 1)])
def test_a_gripper_that_has_let_go_is_open_in_both_executions(state, action):
    """After a handover or a put-back the gripper is as wide open as if it had never held anything."""
    for execution in ("kinematic", "physics"):
        env = gymnasium.make(SPEC.env_id, execution=execution, observation="proprio").unwrapped
        empty, _ = env.reset(seed=0, options={"macrostate": (0, 0, 0, 2)})
        held, _ = env.reset(seed=0, options={"macrostate": state})
        assert (held[7:9] < empty[7:9] - 0.002).all()
        after, *_, info = env.step(action)
        assert not info["fault"] and info["macrostate"][: len(OBJECTS)].max() != 1
        np.testing.assert_allclose(after[7:9], empty[7:9], atol=1e-3)
        env.close()


# --- the camera's frames -----------------------------------------------------------------------------------------


def pixels(frame, color):
    """Pixels whose channels differ as those of a color do: ``"red"``, ``"green"`` or ``"blue"``."""
    channel = ("red", "green", "blue").index(color)
    others = [each for each in range(3) if each != channel]
    return frame[..., channel].astype(int) - frame[..., others].max(axis=-1) > 80


def test_the_frame_shows_each_object_where_it_is():
    """In the row, left to right; at the bottom when it is held, then missing in the row; on the palm in the end."""
    colors = ("blue", "red", "green")
    frames = dict(zip(RULES.states, SPEC.render_macrostates(np.array(RULES.states), "clean", rng()), strict=True))
    for state, frame in frames.items():
        for index, color in enumerate(colors):
            rows, columns = np.nonzero(pixels(frame, color))
            if state[index] == 0:
                assert 28 < rows.mean() < 40
                assert abs(columns.mean() - (16, 32, 48)[index]) < 4
            elif state[index] == 1:
                assert rows.min() > 42
                assert rows.max() == 63
            else:
                assert rows.max() < 20


# --- recordings --------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("without_shadows")
def test_a_recording_shows_the_human_s_answer_after_the_motion():
    env = gymnasium.make(SPEC.env_id).unwrapped
    env.capture_motion_hz = 20.0
    env.reset(seed=0, options={"macrostate": (0, 0, 0, 1)})
    *_, info = env.step(1)
    motion, film = env.motion(), env.film(64, 48)
    hand = motion.poses_in_world[:, motion.body_names.index("hand")]
    car = motion.poses_in_world[:, motion.body_names.index("car")]
    env.close()
    assert info["macrostate"][3] != 1
    assert np.array_equal(hand[:-1], np.repeat(hand[:1], len(hand) - 1, axis=0))
    assert np.linalg.norm(hand[-1, :3] - hand[0, :3]) > 0.05
    assert np.linalg.norm(car[-1, :3] - car[-2, :3]) < 0.002
    assert (np.diff(motion.time_s) > 0).all() and motion.time_s[-1] == pytest.approx(info["sim_time_s"] + 0.05)
    assert len(film) == len(motion.time_s) - 1
