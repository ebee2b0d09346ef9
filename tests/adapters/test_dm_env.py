"""The tasks behind dm_env's interface and in dm_control's viewer, beside the same tasks in Gymnasium."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
import unittest
from unittest import mock

import gymnasium
import numpy as np
import pytest

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError

pytest.importorskip("dm_control", reason="dm_control needs Python below 3.13")
dm_env = pytest.importorskip("dm_env")

from dm_env import test_utils  # noqa: E402

from imagine_bench.adapters.dm_env import as_dm_env  # noqa: E402

ARROWS = "imagine_bench/ArrowPuzzle-v0"


class ContractTest(test_utils.EnvironmentTestMixin, unittest.TestCase):
    """dm_env's own tests, on episodes that end within the sequence."""

    def make_object_under_test(self):
        return as_dm_env(ARROWS, seed=0, execution="kinematic")

    def make_action_sequence(self):
        return iter([0, 2, 4, 1, 3, 5] * 4)


class MotionContractTest(ContractTest):
    """The same, where one step is one sample of a macro-action's motion."""

    def make_object_under_test(self):
        return as_dm_env(ARROWS, seed=0, motion_hz=2)

    def make_action_sequence(self):
        return iter([0, 2, 4, 1] * 4)


@pytest.mark.parametrize(
    ("task", "execution", "episodes"),
    [("arrow_puzzle", "kinematic", 12), ("arrow_puzzle", "physics", 3), ("pick_place", "kinematic", 3)],
)
def test_equals_gymnasium_and_a_time_limit_keeps_the_discount(task, execution, episodes):
    env_id = registry.TASKS[task].env_id
    ours = gymnasium.make(env_id, execution=execution)
    theirs = as_dm_env(env_id, seed=3, execution=execution)
    rng = np.random.default_rng(0)
    discounts = set()
    for episode in range(episodes):
        observation, info = ours.reset(seed=None if episode else 3)
        step = theirs.reset()
        assert step.first() and step.reward is None and step.discount is None
        steps = 0
        while not step.last():
            np.testing.assert_array_equal(step.observation, observation)
            np.testing.assert_array_equal(theirs.info["macrostate"], info["macrostate"])
            action = int(rng.integers(ours.action_space.n)) if episode % 2 else steps % 2  # a cube back and forth
            observation, reward, terminated, truncated, info = ours.step(action)
            step = theirs.step(action)
            steps += 1
            assert step.reward == reward
            assert step.last() == (terminated or truncated)
            assert step.discount == (0.0 if terminated else 1.0)
        np.testing.assert_array_equal(step.observation, observation)
        discounts.add(step.discount)
    assert discounts == {0.0, 1.0} or episodes == 3
    assert theirs.step(0).first()
    ours.close()
    theirs.close()


def test_physics_shows_the_scene_and_cannot_change_it():
    task = gymnasium.make(ARROWS)
    env, scene = as_dm_env(task, seed=0), task.unwrapped
    env.reset()
    for action in (1, 2):
        before_s = env.physics.data.time
        env.step(action)
        np.testing.assert_array_equal(env.physics.data.qpos, scene.data.qpos)
        np.testing.assert_allclose(env.physics.data.xpos, scene.data.xpos, atol=1e-12)
        assert env.physics.data.time == before_s + env.info["sim_time_s"] > before_s
    env.physics.data.qpos[:] = 0.0
    assert scene.data.qpos.any()
    env.close()
    other = as_dm_env("CartPole-v1", seed=1)
    other.reset()
    assert other.step(0).reward == 1.0
    with pytest.raises(InvalidValueError, match="no MuJoCo scene"):
        _ = other.physics
    other.close()


def test_dm_control_draws_the_same_whatever_was_drawn_before():
    env = as_dm_env(ARROWS, seed=0, execution="kinematic")
    env.reset()
    env.physics.render(32, 32)
    for action in (0, 2, 4):
        env.step(action)
        images = [env.physics.render(32, 32, camera_id="wrist") for _ in range(3)]
        assert np.ptp(images, axis=0).max() == 0 < np.std(images)
    env.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_plays_on_and_shows_its_own_scene(copied):
    env = as_dm_env("imagine_bench/PickPlace-v0", seed=1, execution="kinematic", appearance="strong")
    env.reset()
    env.step(0)
    assert env.physics.data.time == 1.0, "a macro-action that takes no time is shown for a second"
    twin = copied(env)
    for action in (1, 2, 3, 0, 1):
        np.testing.assert_equal(tuple(env.step(action)), tuple(twin.step(action)))
        np.testing.assert_array_equal(env.physics.data.qpos, twin.physics.data.qpos)
        np.testing.assert_array_equal(env.physics.model.light_diffuse, twin.physics.model.light_diffuse)
    env.close()
    twin.close()


def test_motion_turns_the_cube_before_the_reward():
    env = as_dm_env(ARROWS, seed=0, motion_hz=10)
    start, yaws, steps, times_s = env.reset(), [], [], []
    while not steps or steps[-1].reward == 0.0:  # every macro-action has a reward
        steps.append(env.step(0))
        times_s.append(env.physics.data.time)
        yaws.append(np.arctan2(*env.physics.named.data.xmat["cube_0"][[3, 0]]))
    assert 10 < len(steps) < 60
    assert all(step.mid() and step.observation is start.observation for step in steps[:-1])
    turned = np.abs((np.array(yaws) - yaws[0] + np.pi) % (2 * np.pi) - np.pi)
    assert turned[-1] == pytest.approx(np.pi / 2, abs=np.radians(5))
    assert ((turned > 0.3) & (turned < 1.3)).any()
    assert times_s == sorted(times_s) and times_s[-1] == env.info["sim_time_s"] and np.diff(times_s).max() < 0.11
    env.reset()
    assert env.step(0).mid()
    assert env.reset().first(), "in the middle of a motion"
    step, begun_s = env.step(1), env.physics.data.time
    assert begun_s > times_s[-1], "the clock goes on over episodes"
    while step.reward == 0.0:  # of no first step, whose reward is None, and of no old motion
        step = env.step(1)
    assert env.physics.data.time == pytest.approx(begun_s + env.info["sim_time_s"])
    assert not step.first() and step.reward in (-5.0, -1.0, 50.0)
    env.close()


def test_viewer_runs_and_the_scene_moves():
    from dm_control.viewer import application, runtime

    env = as_dm_env(ARROWS, seed=0, motion_hz=30)
    pixels, times = [], []

    def frames(tick_func):
        app._pause_subject.value = False
        app._frame_timer.tick = lambda: 0.1
        for _ in range(20):
            pixels.append(tick_func().copy())
            times.append(env.physics.data.time)

    with mock.patch.object(application, "gui"):  # the window alone: no display is needed
        app = application.Application()
        app._window.shape, app._window.event_loop.side_effect = (320, 240), frames
        app.launch(env, policy=lambda step: 0)
    assert app._runtime.state is runtime.State.RUNNING
    assert times == sorted(times)
    assert times[-1] - times[1] == pytest.approx(1.8, abs=0.1)  # in real time
    assert pixels[-1].shape == (240, 320, 3) and (pixels[-1] != pixels[1]).any(axis=2).mean() > 0.01
    app._renderer.release()
    app._render_surface.free()
    env.close()


@pytest.mark.parametrize("drawn_before", [False, True])
def test_open_renderers_end_quietly(drawn_before):
    code = (
        "import gymnasium, imagine_bench\n"
        f"{drawn_before} and gymnasium.make({ARROWS!r}, execution='kinematic').reset()\n"
        "from imagine_bench.adapters.dm_env import as_dm_env\n"
        f"env = as_dm_env({ARROWS!r}, execution='kinematic')\n"
        "from dm_control import _render\n"
        "surface = _render.Renderer(64, 64)\n"  # as the viewer does, before it asks for physics
        "surface.make_current(); env.physics.render(64, 64, camera_id='human'); env.reset()"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert ended.stderr == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": ARROWS, "motion_hz": -1.0}, "No motion at -1.0 Hz"),
        ({"env": ARROWS, "motion_hz": float("nan")}, "No motion at nan Hz"),
        ({"env": gymnasium.make("CartPole-v1"), "render_mode": None}, "give them with an id"),
        ({"env": "Pendulum-v1"}, "No adapter for the spaces"),
    ],
)
def test_what_cannot_be_is_one_clear_error(arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        as_dm_env(**arguments)


def test_missing_dm_control_is_one_clear_error():
    code = (
        "import sys; sys.modules['dm_control'] = None\n"
        "from imagine_bench.errors import SetupError\n"
        "try:\n    import imagine_bench.adapters.dm_env\n"
        "except SetupError as error:\n    print(error)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60).stdout
    assert "dm_control is not installed" in said and "Python 3.11 or 3.12" in said


def test_an_end_at_the_time_limit_is_an_end():
    env = as_dm_env(registry.TASKS["arrow_puzzle"].env_id, seed=0, execution="kinematic", max_episode_steps=3)
    env.reset()
    *_, last = (env.step(action) for action in (1, 5, 3))
    assert (last.last(), last.reward, last.discount) == (True, 50.0, 0.0)
    env.close()
