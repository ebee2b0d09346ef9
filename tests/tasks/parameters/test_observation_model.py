"""The observations under the world parameters gesture and lag: of every world, alone, in lanes, and as macrostates."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from imagine_bench.agents.encoders.training import classes_of, shown_states
from imagine_bench.tasks.motion import orientation
from imagine_bench.tasks.scenes.objects import standing_m

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError

KINEMATIC = {"execution": "kinematic"}
NAMES = {"imagine_bench/Arrows": "arrows", "imagine_bench/PickPlace": "pick_place"}
IDS = tuple(NAMES)


def make(id_, **options):
    return gymnasium.make(f"{id_}-v0", **{**KINEMATIC, **options}).unwrapped


def walk(env, steps, seed=0):
    """Observations, macrostates and generator states of an episode of random macro-actions, ends ignored."""
    observation, info = env.reset(seed=seed)
    seen, actions = [(observation, info["macrostate"])], np.random.default_rng(seed)
    for _ in range(steps):
        observation, _, _, _, info = env.step(int(actions.integers(env.action_space.n)))
        seen.append((observation, info["macrostate"]))
    return seen


@pytest.mark.parametrize("appearance", ["clean", "strong", "photo"])
def test_frames_tell_nothing_of_a_hidden_gesture(appearance):
    """Of pictures of everything else alike, both the agent's and people's are equal to the bit."""
    seen = []
    for pointed in range(3):
        env = make(IDS[0], gesture=0.0, appearance=appearance, observation="frame,human,state", size=96)
        seen.append(env.reset(seed=3, options={"macrostate": (0, 1, 2, pointed)}))
    for observation, info in seen[1:]:
        assert info["macrostate"][-1] != seen[0][1]["macrostate"][-1]
        for name, picture in observation.items():
            np.testing.assert_array_equal(picture, seen[0][0][name])
    shown, _ = make(IDS[0], appearance=appearance).reset(seed=3, options={"macrostate": (0, 1, 2, 0)})
    hidden, _ = make(IDS[0], appearance=appearance, gesture=0.0).reset(seed=3, options={"macrostate": (0, 1, 2, 0)})
    assert (shown != hidden).any(axis=-1).sum() > 50


def test_the_light_of_a_hidden_gesture_does_not_depend_on_the_row_before():
    spec = registry.task("arrows:gesture=0.5")
    rows = np.array([(0, 1, 2, -1), (0, 1, 2, 0), (0, 1, 2, -1)])
    again = spec.render_macrostates(rows[:1], "patched", np.random.default_rng(5))
    for before in rows[:2]:
        spec.render_macrostates(before[None], "patched", np.random.default_rng(1))
        np.testing.assert_array_equal(spec.render_macrostates(rows[2:], "patched", np.random.default_rng(5)), again)


@pytest.mark.parametrize("id_", IDS)
def test_a_gesture_is_seen_as_often_as_said(id_):
    """By the one-hot gesture: always, at first only, or within 3.5 standard deviations of a probability."""
    n_gestures = len(registry.task(NAMES[id_]).macrostate_values[-1])
    for gesture in ("always", "first", 0.3):
        env = make(id_, gesture=gesture, observation="state")
        walks = [walk(env, 8, seed) for seed in range(60 if gesture == 0.3 else 20)]
        seen = np.array([[state[-n_gestures:].any() for state, _ in each] for each in walks])
        assert all(len(truth) - 1 + state[-n_gestures:].any() == state.sum() for each in walks for state, truth in each)
        carried = np.array([[id_ == IDS[1] and 2 in state[:-1] for _, state in each] for each in walks])
        if gesture == 0.3:
            free = seen[~carried]
            assert abs(free.mean() - 0.3) <= 3.5 * np.sqrt(0.3 * 0.7 / free.size) and seen[carried].all()
        else:
            expected = np.ones_like(seen) if gesture == "always" else np.arange(9)[None] == carried * np.arange(9)
            np.testing.assert_array_equal(seen, expected)


@pytest.mark.parametrize("execution", ["kinematic", "physics"])
@pytest.mark.parametrize(
    ("id_", "world", "parameters"), [(IDS[0], {"coupling": "neighbour"}, {"gesture": 0.5}), (IDS[1], {}, {"lag": 1})]
)
def test_what_was_moved_stands_as_if_it_never_was(id_, world, parameters, execution):
    """Its pose is spread as after a reset, else frames would replace memory; a turn's yaw is off by 1 degree.
    That of the second object, of the two that are turned at once too.

    Where nothing is hidden it stands on its place. Both executions draw where it is put, behind the planner's errors.
    """
    start, actions = ((0, 1, 2, 0), (0,)) if id_ == IDS[0] else ((0, 0, 0, 1), (1, 1))
    spread = []
    hiding = {**parameters, "physics": {"plan_error_mm": 1e-6, "plan_error_deg": 1e-6}}
    for options, seeds in (({**hiding, "execution": execution}, 60), ({"execution": execution}, 6), (hiding, 6)):
        env = make(id_, **options, **world)
        found = []
        for seed in range(seeds):
            env.reset(seed=seed, options={"macrostate": start})
            before = offsets(env)[1]
            for action in actions:
                *_, info = env.step(action)
            assert not info["fault"]
            found.append([before, offsets(env)[1]])
        spread.append(np.transpose(found))  # [x y yaw, before after, seeds]
    for before, after in spread[0]:
        assert abs(before.mean()) < 0.3 and 0.8 < 3**0.5 * before.std() < 1.2  # uniform over -1 to 1
        assert abs(after.mean()) < 0.5 and 0.8 < 3**0.5 * after.std() < 1.2
        assert abs(np.corrcoef(before, after)[0, 1]) < 0.45
    assert np.abs(spread[1][:, 1]).max() < 0.4
    np.testing.assert_allclose(spread[0][:, 1, :6], spread[2][:, 1], atol=0.6, err_msg="where the arm is to put it")


def offsets(env):
    """How far objects stand off their places, as shares of the ranges of the appearance: x, y, yaw. Shape (N, 3)."""
    poses, level = env.world.object_poses(), env.world.level
    if hasattr(env.world, "layout"):
        places_m = np.array(env.world.layout.slots_xy_m)
    else:
        places_m = np.array([standing_m(index)[:2] for index in range(len(poses))])
    yaw_rad = np.array([orientation.yaw_rad(*pose[3:]) for pose in poses])
    yaw_rad -= np.round(yaw_rad / (np.pi / 2)) * np.pi / 2
    off = (poses[:, :2] - places_m) / level.object_offset_m, yaw_rad[:, None] / level.object_yaw_rad
    return np.concatenate(off, axis=1)


@pytest.mark.parametrize("id_", IDS)
def test_lag_shows_the_frame_of_so_many_macro_actions_ago(id_):
    lagging, prompt = make(id_, lag=3), make(id_)
    walk(lagging, 2, seed=8)  # nothing of an earlier episode is seen
    prompt._sight = lagging._sight  # has objects put down alike
    now, late = walk(prompt, 7), walk(lagging, 7)
    for step, (frame, macrostate) in enumerate(late):
        np.testing.assert_array_equal(frame, now[max(0, step - 3)][0])
        np.testing.assert_array_equal(macrostate, now[step][1])


@pytest.mark.parametrize(
    ("id_", "options", "actions"),
    [("Arrows", KINEMATIC, (0, 1, 0, 1)), ("ArrowsMotion", {"observation": "front"}, np.zeros((2, 7)))],
)
def test_who_writes_into_a_late_frame_changes_none_that_comes_after(id_, options, actions):
    env, other = (gymnasium.make(f"imagine_bench/{id_}-v0", lag=2, **options).unwrapped for _ in range(2))
    frames = [each.reset(seed=1)[0] for each in (env, other)]
    for action in actions:
        frames[0][:] = 0
        frames = [each.step(action)[0] for each in (env, other)]
        np.testing.assert_array_equal(*frames)


@pytest.mark.parametrize(("id_", "options"), [("Arrows-v0", KINEMATIC), ("ArrowsMotion-v0", {})])
def test_a_state_with_old_observations_is_not_of_an_environment_that_shows_others(id_, options):
    first, second, small = (
        gymnasium.make(f"imagine_bench/{id_}", lag=1, observation=seen, size=size, **options).unwrapped
        for seen, size in (("state", 64), ("proprio", 64), ("state", 32))
    )
    for env in (first, second, small):
        env.reset(seed=0)
    for env in (second, small):
        with pytest.raises(InvalidValueError, match="is no state of"):
            env.set_state(first.get_state())


def test_frames_of_macrostates_hide_what_the_environment_hides():
    """A palm that carries is seen, any other gesture may be hidden; both look as in the environment."""
    for name, id_ in (("arrows:gesture=first", IDS[0]), ("pick_place:gesture=first", IDS[1])):
        spec, env = registry.task(name), make(id_, gesture=0.0)
        hidden = np.array([(*state[:-1], -1) for state in spec.rules.states if 2 not in state[:-1]][:1])
        like = next(state for state in spec.rules.states if state[:-1] == tuple(hidden[0][:-1]))
        frame = spec.render_macrostates(hidden[:1], "clean", np.random.default_rng(2))[0]
        env.reset(options={"macrostate": like})
        env.world.place(like, np.random.default_rng(2))
        np.testing.assert_array_equal(env.agent_view(), frame)
        again = spec.render_macrostates(np.array([like]), "clean", np.random.default_rng(2))[0]
        assert not np.array_equal(again, frame)
        both, seen = (
            spec.render_macrostates(np.array(batch), "clean", np.random.default_rng(2))
            for batch in ([hidden[0], like, hidden[0]], [like] * 3)
        )
        assert [np.array_equal(*pair) for pair in zip(both, seen, strict=True)] == [False, True, False]
        assert (shown_states(spec)[:, -1] == -1).any() and classes_of(spec)[-1] == len(spec.macrostate_values[-1]) + 1
        read = spec.as_observed(hidden[0])
        assert read == (*hidden[0][:-1], len(spec.macrostate_values[-1]))
        assert {spec.value_names(each)[-1] for each in (hidden[0], read)} == {"not seen"}
        assert spec.encoder.endswith("_hidden")


def test_a_hidden_palm_still_takes_what_is_handed_over():
    env = make(IDS[1], gesture=0.0, execution="physics")
    env.reset(seed=0, options={"macrostate": (1, 0, 0, 3)})
    _, reward, terminated, _, info = env.step(3)
    assert terminated and info["is_success"] and not info["fault"] and reward == 5.0
    assert tuple(info["macrostate"]) == (2, 0, 0, 3) and env.world.observed((2, 0, 0, 3)) == (2, 0, 0, 3)
