"""Environments as other tools use them: in processes, pickled, masked, for long."""

from __future__ import annotations

import pickle
import subprocess
import sys
import textwrap

import gymnasium
import numpy as np
import pytest
from worlds import WORLDS

from imagine_bench import registry

KINEMATIC = {"execution": "kinematic"}


def make(task, **options):
    return gymnasium.make(registry.TASKS[task].env_id, **options)


@pytest.mark.parametrize(
    ("task", "context"), [*((task, "fork") for task in WORLDS), (WORLDS[0], "spawn")], ids=lambda each: each
)
def test_async_vector_envs_match_single_ones(task, context):
    """Also after this process has drawn: nothing of its OpenGL is used by the children."""
    single = make(task, **KINEMATIC)
    expected = [single.reset(seed=5)[0], single.step(2)[0]]
    vector = gymnasium.make_vec(
        registry.TASKS[task].env_id, num_envs=2, vectorization_mode="async",
        vector_kwargs={"context": context}, **KINEMATIC,
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


@pytest.mark.parametrize("task", WORLDS)
def test_a_pickled_environment_goes_on_alike(task):
    env = make(task, **KINEMATIC, appearance="strong")
    env.reset(seed=1)
    twin = pickle.loads(pickle.dumps(env))
    for action in (0, 3, env.action_space.n - 1):
        one, other = env.step(action), twin.step(action)
        assert np.array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]
    env.close()
    twin.close()


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


def test_specs_are_cheap_and_importing_loads_nothing_heavy():
    script = (
        "import sys, imagine_bench; from imagine_bench import registry; "
        "[registry.task(name) for name in registry.TASKS]; "
        "print(sorted({'mujoco', 'dm_control', 'torch', 'mink', 'OpenGL'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


def test_maskable_ppo_trains_and_may_take_every_action():
    sb3_contrib = pytest.importorskip("sb3_contrib")
    env = make("arrow_puzzle", **KINEMATIC)
    learner = sb3_contrib.MaskablePPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0)
    assert learner.learn(64).num_timesteps == 64
    _, info = env.reset(seed=0)
    assert np.array_equal(env.unwrapped.action_masks(), info["action_mask"]) and info["action_mask"].all()
    env.close()
