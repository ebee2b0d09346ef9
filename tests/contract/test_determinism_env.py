"""Equal seeds give equal bits, whatever was before, in processes, pickled and masked; executions walk alike."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from same_values import assert_same
from worlds import WORLDS

import imagine_bench  # noqa: F401  (registers the environments)
from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import EXECUTIONS

SHADE = 16
"""Gray levels of 256: a ball that was turned a little is shaded differently all over."""
STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION.value)


def make(task="arrow_puzzle", **options):
    return gymnasium.make(registry.TASKS[task].env_id, **options).unwrapped


def full_state(env):
    model, data = env.world.model, env.world.data
    state = np.empty(mujoco.mj_stateSize(model, STATE))
    mujoco.mj_getState(model, data, state, STATE)
    return state


def walk(env, actions):
    """The results of each step, and the full state after it."""
    return [(env.step(action % int(env.action_space.n)), full_state(env)) for action in actions]


@pytest.mark.parametrize("appearance", ["clean", "photo"])
@pytest.mark.parametrize("task", WORLDS)
def test_other_seeds_give_other_frames(task, appearance):
    env = make(task, execution="kinematic", appearance=appearance)
    options = {"macrostate": registry.task(task).rules.start_states[0]}
    frames = {env.reset(seed=seed, options=options)[0].tobytes() for seed in range(8)}
    env.close()
    assert len(frames) == 8


@pytest.mark.parametrize(
    ("execution", "appearance"), [("physics", "strong"), ("kinematic", "strong"), ("kinematic", "photo")]
)
@pytest.mark.parametrize("task", WORLDS)
def test_equal_seeds_give_equal_bits_whatever_was_before(task, execution, appearance):
    """Including velocities, warm starts, controls and time, and looks."""
    dirty, fresh = (make(task, execution=execution, appearance=appearance) for _ in range(2))
    dirty.reset(seed=1)
    walk(dirty, (0, 2, 5))
    dirty.world.data.qvel[:] = 0.3
    dirty.world.data.qacc_warmstart[:] = 7.0
    dirty.world.data.ctrl[:] = 0.1
    assert_same(*((env.reset(seed=4), full_state(env), walk(env, (1, 4))) for env in (dirty, fresh)))
    dirty.close()
    fresh.close()


@pytest.mark.parametrize("task", WORLDS)
def test_a_reused_outcome_has_the_bits_of_a_simulated_one(task):
    """A bench reuses outcomes; whatever repeats an earlier episode then simulates nothing."""
    env = make(task, execution="physics")

    def episodes():
        found = []
        for actions in ((0, 4, 2), (1, 0, 4)):
            found.append((env.reset(seed=3), walk(env, actions), env.latest.sim_time_s))
        return found

    simulated = episodes()
    env.reuse_outcomes()
    assert_same(episodes(), simulated)
    env.capture_motion_hz = 20.0
    assert_same(episodes(), simulated)
    assert len(env.arm_motion().time_s) > 10, "a motion that is recorded is simulated"
    env.capture_motion_hz = 0.0
    env.world.model.opt.timestep /= 2  # any simulation from now on has other bits
    assert_same(episodes(), simulated)
    assert env.latest.sim_time_s > 0.1
    env.close()


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("arrows:slip=0.5", {"slip": 0.5}),
        ("arrows:gesture=first", {"gesture": "first"}),
        ("arrow_puzzle", {"physics": {"plan_error_mm": 2.0}}),
        ("arrow_puzzle", {"physics": {"plan_error_deg": 2.0}}),
        ("pick_place", {}),
    ],
    ids=["slip", "where it is put down", "error of place", "error of angle", "gesture"],
)
def test_chance_decides_where_outcomes_are_reused(task, options):
    """From one state in physics, to the bit, a macro-action leads where the seed says, as without reuse."""
    spec = registry.task(task)
    alone, reusing = (gymnasium.make(spec.env_id, execution="physics", **options).unwrapped for _ in range(2))
    reusing.reuse_outcomes()
    start = spec.rules.start_states[0]
    action = max(range(spec.n_actions), key=lambda action: len(spec.rules.outcomes(start, action)))
    found = []
    for env in (alone, reusing):
        env.reset(seed=0, options={"macrostate": start})
        here = env.world.get_state()
        for seed in range(6):
            env.reset(seed=seed, options={"macrostate": start})
            env.world.set_state(here)
            found.append((env.step(action)[4]["macrostate"].tolist(), full_state(env).tobytes()))
        env.close()
    assert found[:6] == found[6:] and any(each != found[0] for each in found)


def test_an_outcome_is_not_reused_in_other_physics():
    """Environments of one process with objects of several masses share no outcome."""
    usual, heavy, alone = (make(execution="physics", physics={"object_mass": mass}) for mass in (1.0, 2.0, 2.0))
    for env in (usual, heavy):
        env.reuse_outcomes()
    found = []
    for env in (usual, heavy, alone):
        env.reset(seed=3)
        found.append((full_state(env), walk(env, (0, 4))))
        env.close()
    assert_same(found[1], found[2])
    assert_same(found[0][0], found[1][0])
    assert not np.array_equal(found[0][1][0][1], found[1][1][0][1]), "the mass decides"


@pytest.mark.parametrize("task", WORLDS)
def test_both_executions_walk_the_same_macrostates(task):
    envs = [make(task, execution=execution) for execution in EXECUTIONS]
    generator, moved = np.random.default_rng(5), 0
    for seed in range(3):
        (_, start), (before, again) = (env.reset(seed=seed) for env in envs)
        assert_same(start["macrostate"], again["macrostate"])
        at = start["macrostate"].tolist()
        for action in generator.integers(registry.task(task).n_actions, size=5):
            one, other = (env.step(int(action)) for env in envs)
            assert one[1:4] == other[1:4]
            assert not one[4]["fault"]
            assert_same(one[4]["macrostate"], other[4]["macrostate"])
            apart = share_of_other_pixels(one[0], other[0])
            assert apart < 0.03
            if at != one[4]["macrostate"].tolist():
                assert apart < 0.5 * share_of_other_pixels(one[0], before), "the frame of the step before is further"
                moved += 1
            at = one[4]["macrostate"].tolist()
            before = other[0]
    assert moved > 0
    for env in envs:
        env.close()


def share_of_other_pixels(one, other):
    return (np.abs(one.astype(int) - other).max(axis=2) > SHADE).mean()


HIDING = {"gesture": 0.5, "lag": 2, "fickle": 0.4, "distractors": 3}


@pytest.mark.parametrize("task", WORLDS)
@pytest.mark.parametrize(
    ("execution", "appearance", "world"),
    [
        ("physics", "strong", {}),
        ("kinematic", "strong", {"distractors": 3}),
        ("kinematic", "photo", HIDING),
        ("kinematic", "harsh", {}),
    ],
)
def test_a_state_goes_on_to_the_same_bits(task, execution, appearance, world):
    """In the middle of an episode, after something else was done, and in another environment."""
    options = {"execution": execution, "appearance": appearance, "physics": {"plan_error_mm": 1.0, "plan_error_deg": 1}}
    options["motion_hz"] = 5.0
    env, other, stranger = (make(each, **options, **world) for each in (task, task, WORLDS[task == WORLDS[0]]))
    for seed, each in enumerate((env, other, stranger)):
        each.reset(seed=seed)
    env.step(1)
    actions = (0, 2, 1) if execution == "physics" else (0, 2, 1, 3, 0)

    def goes_on(each):
        before = [each.agent_view(), each.motion().poses_in_world]
        return [*before, *(each.step(action) for action in actions), each.reset(), each.data.qpos.copy()]

    state = pickle.loads(pickle.dumps(env.get_state()))
    expected = goes_on(env)
    for each in (env, other):
        each.step(3)
        each.set_state(state)
        assert_same(*(dataclasses.asdict(one) for one in (each.get_state(), state)))
        assert_same(goes_on(each), expected)
    for wrong in (stranger.get_state(), None):
        with pytest.raises(InvalidValueError, match=r"is no state of"):
            env.set_state(wrong)
    for each in (env, other, stranger):
        each.close()


@pytest.mark.parametrize(
    "options",
    [
        {"appearance": "mild"},
        {"execution": "physics"},
        {"physics": {"pad_friction": 0.5}},
        {"physics": {"object_mass": 2.0}},
        {"physics": {"finger_force_n": 10.0}},
    ],
    ids=str,
)
def test_a_state_of_other_looks_or_physics_is_refused(options):
    """Whoever went on from it would play in another world under the name of this one."""
    env, other = (make(**{"execution": "kinematic", **given}) for given in ({}, options))
    for each in (env, other):
        each.reset(seed=0)
    before = full_state(env)
    with pytest.raises(InvalidValueError, match="is no state of"):
        env.set_state(other.get_state())
    assert np.array_equal(full_state(env), before)
    env.close()
    other.close()


# As other tools use environments ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "context"),
    [
        *((task, "fork") for task in WORLDS),
        (WORLDS[0], "spawn"),
        pytest.param(WORLDS[1], "forkserver", marks=pytest.mark.slow),
    ],
    ids=lambda each: each,
)
def test_async_vector_envs_match_single_ones(task, context):
    """Other processes draw the same, also after this one has drawn: nothing of its OpenGL is used by them."""
    single = make(task, execution="kinematic")
    expected = [single.reset(seed=5)[0], single.step(2)[0]]
    vector = gymnasium.make_vec(
        registry.TASKS[task].env_id, num_envs=2, vectorization_mode="async",
        vector_kwargs={"context": context}, execution="kinematic",
    )  # fmt: skip
    try:
        frames, infos = vector.reset(seed=[5, 6])
        assert np.array_equal(frames[0], expected[0])
        assert infos["macrostate"].shape == (2, len(registry.task(task).macrostate_names))
        frames, *_ = vector.step(np.array([2, 3]))
        assert np.array_equal(frames[0], expected[1])
    finally:
        vector.close()
    single.close()


def assert_copies_play_on(task, **options):
    """Copies made in the middle of an episode take ten steps as the original does, through ends and starts."""
    spec = registry.task(task)
    env = gymnasium.make(spec.env_id, **options)
    twins = []
    _, info = env.reset(seed=3)
    for step in range(12):
        state = tuple(info["macrostate"].tolist())
        action = 0 if spec.rules.is_terminal(state) else spec.rules.optimal_action(state)
        *after, info = env.step(action)
        for twin in twins:
            assert_same((*after, info), twin.step(action), f"{task}, step {step}")
        if after[2] or after[3]:
            began = env.reset()
            info = began[1]
            for twin in twins:
                assert_same(began, twin.reset(), f"{task}, start after step {step}")
        if step == 1:
            twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for each in (env, *twins):
        each.close()


COMMON = ("lag=2", "gesture=first", "gesture=0.5", "slip=0.3", "goal_change=0.3", "distractors=3")
OF_ARROWS = ("cubes=5", "goal=clockwise", "forbid=neighbours", "coupling=neighbour", "shuffle=3", "horizon=4")
NAMES = (
    *registry.TASKS,
    *(f"pick_place:{each}" for each in COMMON),
    *(f"arrows:{each}" for each in (*COMMON, *OF_ARROWS)),
)
ALL_PARTS = {"observation": "frame,state,proprio", "appearance": "strong", "size": 32}
FEW = ("pick_place:gesture=0.5", "arrow_puzzle")


def test_every_parameter_of_a_task_is_copied():
    for task, values in (("pick_place", COMMON), ("arrows", (*COMMON, *OF_ARROWS))):
        fields = dataclasses.fields(registry.load(registry.TASKS[task].world))
        assert {each.name for each in fields} == {each.partition("=")[0] for each in values}


@pytest.mark.parametrize("task", NAMES)
def test_copies_and_pickles_play_on_to_the_bit(task):
    assert_copies_play_on(task, execution="kinematic", **ALL_PARTS)


@pytest.mark.parametrize(
    "task", [each if each in FEW else pytest.param(each, marks=pytest.mark.slow) for each in NAMES]
)
def test_copies_and_pickles_play_on_in_physics(task):
    """With a planner that errs, and the motion kept."""
    assert_copies_play_on(task, execution="physics", physics={"plan_error_mm": 1.0}, motion_hz=5.0, **ALL_PARTS)


@pytest.mark.parametrize("appearance", ["clean", "photo", "harsh", {"light": 0.5}])
@pytest.mark.parametrize("task", WORLDS)
def test_copies_and_pickles_play_on_at_any_appearance(task, appearance):
    assert_copies_play_on(task, execution="kinematic", appearance=appearance, observation="frame")


def test_copies_and_pickles_of_guests_play_on(guests, tmp_path):
    guests.new("task", "lights_out")
    frozen = Path(__file__).parent / "frozen" / "five_cubes"
    guests.add(Path(shutil.copytree(frozen, tmp_path / "five_cubes")))
    for task in ("lights_out", "five_cubes", "five_cubes_covered"):
        assert_copies_play_on(task)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("task", [WORLDS[0], *(pytest.param(task, marks=pytest.mark.slow) for task in WORLDS[1:])])
def test_memory_stays_flat_over_resets(task):
    script = """
        import sys, gymnasium, imagine_bench
        def peak():  # the resource module would count the parent's peak, too
            return next(int(line.split()[1]) / 1024 for line in open("/proc/self/status") if line.startswith("VmHWM"))
        env = gymnasium.make(sys.argv[1], execution="kinematic", appearance="strong")
        env.reset(seed=0)
        before = peak()
        for _ in range(2000):
            env.reset()
        print(before, peak())
    """
    command = [sys.executable, "-c", textwrap.dedent(script), registry.TASKS[task].env_id]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    before_mb, after_mb = map(float, done.stdout.split())
    assert after_mb < 300
    assert after_mb - before_mb < 4


def test_a_state_brings_the_people_that_stood_by_its_motion():
    """Also to an environment whose own people stood elsewhere; they move on when the motion is over."""
    one, other = (
        gymnasium.make("imagine_bench/Arrows-v0", disable_env_checker=True, goal_change=1.0).unwrapped for _ in "ab"
    )
    one.capture_motion_hz = other.capture_motion_hz = 10.0
    moved = []
    for seed in range(3):
        one.reset(seed=seed)
        one.step(seed)
        other.reset(seed=seed + 30)
        other.set_state(one.get_state())
        motions = [env.motion() for env in (one, other)]
        np.testing.assert_array_equal(*[motion.poses_in_world for motion in motions])
        np.testing.assert_array_equal(*[motion.time_s for motion in motions])
        moved.append(not np.array_equal(*motions[0].poses_in_world[-2:]))
    assert any(moved)
    one.close()
    other.close()
