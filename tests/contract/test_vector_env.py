"""The vector environment: lanes are single environments to the bit, in every mode, whatever happens beside them."""

from __future__ import annotations

import copy
import functools
import os
import pickle
import subprocess
import sys
import textwrap
import threading
import time

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from same_values import assert_same

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, InvalidValueError
from imagine_bench.interfaces import EXECUTIONS

KINEMATIC = {"execution": "kinematic"}
MODES = tuple(AutoresetMode)
N_LANES = 3
START = (0, 1, 2, 0)
"""Of the arrow puzzle."""


def make(task="arrow_puzzle", n=N_LANES, **options):
    return gymnasium.make_vec(registry.vector_id(registry.TASKS[task].env_id), num_envs=n, **options)


def make_sync(mode, **options):
    options |= {"num_envs": N_LANES, "vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": mode}}
    return gymnasium.make_vec("imagine_bench/ArrowPuzzle-v0", **options)


def walk_both(envs, steps, *, mask):
    """Step two vector environments alike and compare their results: how many episodes ended by rule and limit."""
    assert_same(*(env.reset(seed=3) for env in envs))
    envs[0].action_space.seed(2)
    ended = np.zeros(2, dtype=int)
    for step in range(steps):
        actions = envs[0].action_space.sample()
        its, own = (env.step(actions) for env in envs)
        assert_same(its, own, f"step {step}")
        over = its[2] | its[3]
        ended += its[2].sum(), (its[3] & ~its[2]).sum()
        if mask and over.any():
            again = (env.reset(seed=step, options={"reset_mask": over.copy()}) for env in envs)
            assert_same(*again, f"reset after step {step}")
    return ended


SAME_STEP = AutoresetMode.SAME_STEP
SHORT = {"max_episode_steps": 2}
COMMANDS = {
    "observation": "hand,proprio,objects,state",
    "size": 32,
    "time_limit_s": 0.6,
    "slip": 0.5,
    "max_episode_steps": None,
}


@pytest.mark.parametrize(
    ("name", "execution", "mode", "steps", "world"),
    [
        ("Arrows", "kinematic", SAME_STEP, 16, {"cubes": 1, "appearance": "harsh"}),
        ("Arrows", "kinematic", SAME_STEP, 16, {"cubes": 5, "gesture": 0.5, "lag": 2, "slip": 0.3, "fickle": 0.3}),
        ("PickPlace", "kinematic", SAME_STEP, 16, {"gesture": "first", "distractors": 2}),
        ("Arrows", "physics", SAME_STEP, 3, {"cubes": 5, "coupling": "neighbour", "slip": 0.3, "distractors": 3}),
        ("PickPlace", "physics", SAME_STEP, 4, {"gesture": 0.5, "lag": 1, "slip": 0.5}),
        ("PickPlace", "kinematic", AutoresetMode.NEXT_STEP, 8, {"observation": "frame,state,proprio", "size": 32}),
        ("ArrowPuzzleMotion", "physics", SAME_STEP, 32, COMMANDS),
        ("PickPlaceMotion", "physics", SAME_STEP, 32, {**COMMANDS, "lag": 1}),
        *(("ArrowPuzzle", "kinematic", mode, 16, SHORT) for mode in MODES),
        ("PickPlace", "kinematic", MODES[0], 16, SHORT),
        *(pytest.param("PickPlace", "kinematic", mode, 16, SHORT, marks=pytest.mark.slow) for mode in MODES[1:]),
    ],
)
def test_lanes_of_any_world_step_as_sync_in_every_mode(name, execution, mode, steps, world):
    """Through ends by rule and by the limit, with any observation."""
    options = {"appearance": "strong", "max_episode_steps": 3, **world}
    options |= {} if name.endswith("Motion") else {"execution": execution}
    make_vec = functools.partial(gymnasium.make_vec, num_envs=2, **options)
    sync = make_vec(f"imagine_bench/{name}-v0", vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode})
    vector = make_vec(f"imagine_bench/{name}-vector-v0", threads=3, autoreset_mode=mode)
    ended = walk_both((sync, vector), steps, mask=mode == AutoresetMode.DISABLED)
    assert (ended > 0).all() if world == SHORT else ended.sum() > 0
    assert vector.action_names == sync.envs[0].unwrapped.action_names
    for field in ("qpos", "qvel", "mocap_pos"):
        assert_same(*([getattr(lane.unwrapped.data, field) for lane in env.envs] for env in (sync, vector)))
    last = vector.action_space.sample()
    assert mode == AutoresetMode.DISABLED or vector.observation_space.contains(vector.step(last)[0])
    sync.close()
    vector.close()


PAIRS = sorted((env_id, registry.vector_id(env_id)) for env_id in gymnasium.registry if "-vector-v" not in env_id)
PAIRS = [(single, vector) for single, vector in PAIRS if vector in gymnasium.registry]


def test_every_vector_id_has_the_limit_and_options_of_its_single_one():
    """Of macro-actions and of continuous control."""
    named = {}
    for single, vector in PAIRS:
        one, many = (gymnasium.spec(env_id) for env_id in (single, vector))
        assert many.max_episode_steps == one.max_episode_steps, vector
        assert many.reward_threshold == one.reward_threshold, vector
        assert many.kwargs == {**one.kwargs, "env": one.entry_point}, vector
        named["Motion" in single] = one.max_episode_steps
    assert named[True] is None and named[False] > 0


def quiet_plan(rules, state, length, rng):
    """Actions that end no episode."""
    actions = []
    for _ in range(length):
        going = [action for action in range(rules.n_actions) if not rules.outcomes(state, action)[0].terminated]
        actions.append(int(rng.choice(going)))
        state = rules.outcomes(state, actions[-1])[0].macrostate
    return actions


def test_each_lane_goes_its_own_pace_and_sees_what_it_would_alone():
    rules, rng = registry.task("arrow_puzzle").rules, np.random.default_rng(5)
    plans = [quiet_plan(rules, START, 3, rng) for _ in range(N_LANES)]
    vector = make(autoreset_mode="Disabled")
    seen, reached = [[frame] for frame in vector.reset(seed=7, options={"macrostate": START})[0]], [START] * N_LANES
    vector.send([plan[0] for plan in plans])
    for n in (2, 2, 1, 2, 1, 1):
        frames, *_, infos = vector.recv(n)
        lanes = infos["env_id"].tolist()
        for lane, frame in zip(lanes, frames, strict=True):
            (outcome,) = rules.outcomes(reached[lane], plans[lane][len(seen[lane]) - 1])
            reached[lane] = outcome.macrostate
            seen[lane].append(frame)
        assert infos["macrostate"].tolist() == [list(reached[lane]) for lane in lanes] and infos["_macrostate"].all()
        going = [lane for lane in lanes if len(seen[lane]) <= 3]
        if going:
            vector.send([plans[lane][len(seen[lane]) - 1] for lane in going], going)
    for lane, plan in enumerate(plans):
        alone = gymnasium.make("imagine_bench/ArrowPuzzle-v0")
        expected = [alone.reset(seed=7 + lane, options={"macrostate": START})[0]]
        assert_same(seen[lane], [*expected, *(alone.step(action)[0] for action in plan)])
        alone.close()
    vector.close()
    assert not [each.name for each in threading.enumerate() if each.name.startswith("simulation")]


@pytest.mark.parametrize("mode", [SAME_STEP, AutoresetMode.NEXT_STEP])
def test_lanes_that_are_received_a_few_at_a_time_are_those_of_a_step(mode):
    """In the order in which they end, through ends by rule and by the limit; what ended last is told with its lane."""
    sync, vector = make_sync(mode, **SHORT), make(autoreset_mode=mode, **SHORT)
    assert_same(*(env.reset(seed=[3, 1, 2]) for env in (sync, vector)))
    rng, orders = np.random.default_rng(1), set()
    for _ in range(8):
        actions = rng.integers(6, size=N_LANES)
        vector.send(actions)
        *its, infos = sync.step(actions)
        for n in (1, 2):
            *own, told = vector.recv(n)
            lanes = told.pop("env_id")
            assert_same(own, [each[lanes] for each in its])
            assert told["macrostate"].tolist() == infos["macrostate"][lanes].tolist()
            if "final_info" in told:
                over = told["_final_info"]
                assert_same(told["final_info"]["macrostate"][over], infos["final_info"]["macrostate"][lanes][over])
            orders.add(tuple(lanes))
    assert len(orders) > 4
    sync.close()
    vector.close()


def lasting(act, durations_s, action):
    """A macro-action that takes the next one of some durations."""
    *step, info = act(action)
    return (*step, {**info, "sim_time_s": next(durations_s)})


def test_a_lane_begins_at_the_end_of_the_last_one_received():
    """Lanes that are still acting change nothing. Each macro-action takes a duration that is drawn here."""
    rng, n_lanes = np.random.default_rng(0), 4
    vector = make(n=n_lanes, **KINEMATIC)
    vector.reset(seed=0)
    durations_s = rng.uniform(1.0, 3.0, (n_lanes, 40))
    for env, each in zip(vector.envs, durations_s, strict=True):
        env.act = functools.partial(lasting, env.act, iter(each))
    now_s, due_s, begun = 0.0, {}, [0] * n_lanes
    for _ in range(40):
        idle = [lane for lane in range(n_lanes) if lane not in due_s]
        sent = rng.permutation(idle)[: rng.integers(not due_s, len(idle) + 1)].tolist()
        for lane in sent:
            due_s[lane] = now_s + durations_s[lane, begun[lane]]
            begun[lane] += 1
        if sent:
            vector.send(rng.integers(vector.single_action_space.n, size=len(sent)), sent)
        n = int(rng.integers(1, len(due_s) + 1))
        first = sorted(due_s, key=due_s.get)[:n]
        assert vector.recv(n)[-1]["env_id"].tolist() == first
        now_s = [due_s.pop(lane) for lane in first][-1]
    vector.close()


def blown_up(env, actions):
    """A step in which lane 1 blows up; its reason, which names a file, as whether there is one."""
    env.envs[1].unwrapped.world.data.joint("cube_2_joint").qpos[0] = 1e11
    *step, infos = env.step(actions)
    of_lane = infos.get("final_info", infos)
    of_lane["fault_reason"] = np.array(["diverged" in str(reason) for reason in of_lane["fault_reason"]])
    return [*step, infos]


@pytest.mark.usefixtures("own_folder")  # for MuJoCo's own log
@pytest.mark.parametrize("mode", MODES)
def test_a_lane_that_blows_up_ends_as_a_single_environment(mode):
    sync, vector = make_sync(mode), make(autoreset_mode=mode)
    first, action = quiet_plan(registry.task("arrow_puzzle").rules, START, 2, np.random.default_rng(0))
    for env in (sync, vector):
        env.reset(seed=0, options={"macrostate": START})
        before = env.step(np.full(3, first))[0]
    expected, found = (blown_up(env, np.full(3, action)) for env in (sync, vector))
    assert_same(found, expected)
    frames, rewards, terminated, truncated, infos = found
    assert truncated.tolist() == [False, True, False] and not terminated[1] and rewards[1] == 0.0
    last, seen = (infos["final_info"], infos["final_obs"][1]) if mode == AutoresetMode.SAME_STEP else (infos, frames[1])
    assert last["fault_reason"].tolist() == [False, True, False] and last["sim_time_s"][1] == 0.0
    assert np.array_equal(seen, before[1])
    if mode == AutoresetMode.DISABLED:
        with pytest.raises(InvalidValueError, match="Lane 1 has no episode to go on with; reset it first"):
            vector.step(np.zeros(3, dtype=int))
        for env in (sync, vector):
            env.reset(options={"reset_mask": truncated})
    assert_same(*(env.step(np.full(3, first)) for env in (sync, vector)))
    sync.close()
    vector.close()


def pickled(env):
    return pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize("execution", EXECUTIONS)
@pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
def test_copies_play_on_and_none_is_made_of_acting_lanes(copied, execution):
    vector = make("pick_place", n=2, execution=execution)
    vector.reset(seed=0)
    vector.step(np.array([0, 1]))
    twin = copied(RecordEpisodeStatistics(vector)).env
    for action in range(4):
        assert_same(*(env.step(np.full(2, action)) for env in (vector, twin)))
    vector.send([0], [1])
    with pytest.raises(InvalidValueError, match=r"Lanes \[1\] are acting; receive them before you copy or pickle"):
        copied(vector)
    vector.close()
    twin.close()


def test_what_cannot_be_made_is_refused():
    for options, message in (
        ({"n": 0}, "num_envs is 0; give an integer from 1 on"),
        ({"threads": 1.5}, r"threads is 1\.5; give an integer from 1 on"),
        ({"max_episode_steps": -1}, "max_episode_steps is -1; give an integer from 1 on"),
        ({"render_mode": "human"}, "No render mode 'human'. Known: rgb_array"),
        ({"autoreset_mode": "same_step"}, r"No autoreset mode 'same_step'\. Did you mean 'SameStep'\?"),
    ):
        with pytest.raises(ImagineBenchError, match=message):
            make(**options, **KINEMATIC)


def test_what_cannot_be_done_moves_nothing():
    """Calls whose arguments are numbers, texts and lists of them are in tests/whole."""
    vector = make(**KINEMATIC)
    with pytest.raises(InvalidValueError, match="Lane 0 has no episode to go on with; reset it first"):
        vector.step(np.zeros(3, dtype=int))
    with pytest.raises(InvalidValueError, match="leaves out lanes that were never reset"):
        vector.reset(options={"reset_mask": np.array([True, False, False])})
    vector.reset(seed=0)
    before = [lane.get_state().world.physics for lane in vector.envs]
    for actions in (np.ma.masked_all(3, int), {0, 1, 2}):
        with pytest.raises(InvalidValueError, match=r"Actions .*: give a sequence of 3|Action .*not exist"):
            vector.step(actions)
    assert_same([lane.get_state().world.physics for lane in vector.envs], before)
    vector.send([0], [1])
    with pytest.raises(InvalidValueError, match="Lane 1 is acting; receive it first"):
        vector.step(np.zeros(3, dtype=int))
    vector.close()


def test_numbers_of_numpy_are_numbers():
    world = {"cubes": np.int64(2), "lag": np.int32(0), "slip": np.float32(0), "horizon": np.uint8(9)}
    seen = {"size": np.uint8(40), "motion_hz": np.float32(5), "appearance": {"light": np.float32(0.5)}}
    physics = {"pad_friction": np.float32(1), "object_mass": np.int64(1)}
    vector = make("arrows", threads=np.int64(1), physics=physics, **world, **seen)
    expected = [vector.reset(seed=[7, 8, 9])[0], vector.step([0, 1, 2])[0]]
    for seed, actions in (
        (np.uint8(7), (0, 1, 2)),
        ([np.int32(7), None, 9], [np.int8(0), np.uint64(1), 2]),
        (np.array([7, 8, 9]), np.array([0, 1, 2], np.uint8)),
    ):
        found = [vector.reset(seed=seed)[0], vector.step(actions)[0]]
        assert_same([each[0] for each in found], [each[0] for each in expected])
    vector.close()


def test_a_reset_forgets_what_a_lane_was_doing():
    """But waits for it: the lane's data is in use until then."""
    ended = []

    def late(act, action):
        time.sleep(0.05)
        ended.append(act(action))
        return ended[-1]

    vector = make(n=2)
    first, _ = vector.reset(seed=4)
    expected = vector.step(np.array([0, 2]))[0]
    vector.reset(seed=4)
    for lane in vector.envs:
        lane.act = functools.partial(late, lane.act)
    vector.send([0, 2])
    again, _ = vector.reset(seed=4)
    assert len(ended) == 2 and np.array_equal(first, again)
    assert np.array_equal(vector.step(np.array([0, 2]))[0], expected)
    vector.reset(seed=4)
    vector.send([0, 2])
    vector.reset(options={"reset_mask": np.array([True, False])})
    seen, *_, infos = vector.recv()
    assert infos["env_id"].tolist() == [1] and np.array_equal(seen, expected[1:]), "the other lane goes on"
    vector.close()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a matter of forks")
def test_a_forked_child_simulates_too():
    """A parent's threads, idle by then, do not survive the fork."""
    script = """
        import os, signal, time, gymnasium, imagine_bench
        vector = gymnasium.make_vec("imagine_bench/ArrowPuzzle-vector-v0", num_envs=2)
        vector.reset(seed=0)
        vector.step([0, 1])
        time.sleep(0.2)
        child = os.fork()
        if not child:
            signal.alarm(30)
        seen = int(vector.step([2, 3])[0].sum()) % 251
        if not child:
            os._exit(seen)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == seen)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_sixty_four_lanes_fit_into_little_memory():
    script = """
        import gymnasium, imagine_bench, numpy as np
        vector = gymnasium.make_vec("imagine_bench/ArrowPuzzle-vector-v0", num_envs=64)
        vector.reset(seed=0)
        for action in range(3):
            vector.step(np.full(64, action))
        print(next(int(line.split()[1]) / 1024 for line in open("/proc/self/status") if line.startswith("VmHWM")))
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 1300
