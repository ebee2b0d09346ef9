"""The observations of an environment: parts of one moment, of any size, and macrostates that nobody visits."""

from __future__ import annotations

import gymnasium
import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.rendering import Renderer, View
from imagine_bench.tasks.rendering.cameras import DRAWN_GROUPS, control_view
from worlds import WORLDS

from imagine_bench import registry
from imagine_bench.interfaces import EXECUTIONS

KINEMATIC = {"execution": "kinematic"}
ALL = "frame,human,state,proprio"


pytestmark = pytest.mark.usefixtures("without_shadows")


def make(task="arrow_puzzle", **options):
    return gymnasium.make(registry.TASKS[task].env_id, disable_env_checker=True, **options)


def decoded(one_hot, task):
    """The macrostate that one one-hot vector a coordinate says; each must have exactly one 1."""
    cuts = np.cumsum([len(values) for values in registry.task(task).macrostate_values])[:-1]
    vectors = np.split(one_hot, cuts)
    assert all(sorted(vector.tolist()) == [0.0] * (len(vector) - 1) + [1.0] for vector in vectors)
    return [int(vector.argmax()) for vector in vectors]


@pytest.mark.parametrize(("task", "execution"), list(zip(WORLDS, EXECUTIONS, strict=True)))
def test_all_parts_are_of_one_moment_of_the_same_walk(task, execution):
    """The fragments, light and noise of a photograph are of the agent's camera alone: people see none."""
    options = {"execution": execution, "appearance": "photo" if execution == "kinematic" else "mild", "size": 48}
    plain, whole = make(task, **options), make(task, observation=ALL, **options)
    assert plain.observation_space == gymnasium.spaces.Box(0, 255, (48, 48, 3), np.uint8)
    scene, told = whole.unwrapped, set()
    for go in (lambda env: env.reset(seed=2), lambda env: env.step(1), lambda env: env.step(0)):
        (frame, *_, info), (parts, *_, info_too) = go(plain), go(whole)
        motion = scene.arm_motion()
        sense = [*motion.joint_rad[-1], *motion.gripper_m[-1], *motion.tcp_in_world[-1]]
        np.testing.assert_array_equal(parts["proprio"], np.array(sense, dtype=np.float32))
        np.testing.assert_array_equal(parts["human"], scene.human_view(48, 48))
        np.testing.assert_array_equal(parts["frame"], frame)
        np.testing.assert_equal(info, info_too)
        assert parts in whole.observation_space
        assert decoded(parts["state"], task) == info["macrostate"].tolist()
        told.add(parts["state"].tobytes())
    assert len(told) > 1
    plain.close()
    whole.close()


def test_every_size_shows_the_same_view():
    images = []
    for size in (32, 64, 256):
        env = make(size=size, appearance="photo", **KINEMATIC)
        image, _ = env.reset(seed=3)
        rendered = env.unwrapped._observer._cameras["frame"].frame(env.unwrapped.data)
        assert np.abs(image.astype(int) - rendered).mean() > 3  # it is a photograph
        env.close()
        assert image.shape == env.observation_space.shape == (size, size, 3)
        block = size // 32
        images.append(image.reshape(32, block, 32, block, 3).mean(axis=(1, 3)))
    contrast = np.abs(images[2] - images[2].mean(axis=(0, 1))).mean()
    for image in images[:2]:
        assert np.abs(image - images[2]).mean() < 0.4 * contrast  # sensor noise is each pixel's own


JOINTS = (*(f"right_j{index}" for index in range(7)), "finger_left_slide", "finger_right_slide")


@pytest.mark.parametrize("task", WORLDS)
def test_parts_of_continuous_control_are_of_one_moment(task):
    env = gymnasium.make(
        registry.TASKS[task].env_id.replace("-v0", "Motion-v0"),
        observation="front,state,objects,hand,proprio", size=48, appearance="strong", disable_env_checker=True,
    )  # fmt: skip
    model, data = env.unwrapped.model, env.unwrapped.data
    cameras = {name: Renderer(model, control_view(name, 48)) for name in ("front", "hand")}
    quat = np.empty(4)
    moments = [lambda: env.reset(seed=2), *[lambda: env.step(np.array([0.3, 0.2, -0.4, 0.1, 0, 0.5, -0.5]))[::4]] * 3]
    for moment in moments:
        seen, info = moment()
        assert seen in env.observation_space
        for name, camera in cameras.items():
            np.testing.assert_array_equal(seen[name], camera.frame(data))
        assert decoded(seen["state"], task) == info["macrostate"].tolist()
        mujoco.mju_mat2Quat(quat, data.site("tcp").xmat)
        sense = [*(data.joint(name).qpos[0] for name in JOINTS), *data.site("tcp").xpos, *quat]
        np.testing.assert_allclose(seen["proprio"], sense, atol=1e-6)
        objects = [[*data.body(name).xpos, *data.body(name).xquat] for name in registry.task(task).targets.objects]
        np.testing.assert_allclose(seen["objects"], objects, atol=1e-6)
    env.close()


@pytest.mark.parametrize(
    ("name", "cameras"), [("ArrowPuzzle", ("human", "far", "wrist")), ("PickPlaceMotion", ("human", "far"))]
)
def test_an_image_for_people_has_the_camera_and_the_size_that_were_asked_for(name, cameras):
    """Of a single environment, and of each lane its own."""
    for camera in cameras:
        options = {"render_mode": "rgb_array", "camera": camera, "width": 80, "height": 60, "appearance": "strong"}
        one = gymnasium.make(f"imagine_bench/{name}-v0", disable_env_checker=True, **options)
        many = gymnasium.make_vec(f"imagine_bench/{name}-vector-v0", num_envs=2, **options)
        one.reset(seed=5)
        many.reset(seed=4)
        scenes = [*many.unwrapped.envs, one.unwrapped]
        view = View(camera=camera, width=80, height=60, groups=DRAWN_GROUPS)
        expected = [Renderer(scene.model, view).frame(scene.data) for scene in scenes]
        np.testing.assert_array_equal([*many.render(), one.render()], expected)
        assert not np.array_equal(expected[0], expected[1])
        one.close()
        many.close()
