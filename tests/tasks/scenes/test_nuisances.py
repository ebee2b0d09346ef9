"""Nuisances: each changes its own property, by its own amount, and nothing else; other appearances stay to the bit."""

from __future__ import annotations

import copy
import hashlib
import pickle

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.scenes.appearance import appearance, looks_of

import imagine_bench  # noqa: F401  (registers the environments)
from imagine_bench import registry
from imagine_bench.data.folder import read_dataset, write_dataset
from imagine_bench.running.collect import collect, policy_of

START = (0, 1, 2, 1)
BEFORE = {
    ("ArrowPuzzle", "clean"): "cb4644ae35bf993c",
    ("ArrowPuzzle", "mild"): "058b8aa14af817e4",
    ("ArrowPuzzle", "strong"): "812b6afbbe79afd8",
    ("ArrowPuzzle", "photo"): "fd511c6563130b65",
    ("PickPlace", "clean"): "492c45832163d5b8",
    ("PickPlace", "mild"): "061fec8d51e0ba38",
    ("PickPlace", "strong"): "603c9c2e1ef6885f",
    ("PickPlace", "photo"): "652f0f79921ac992",
}
"""Digests of all that was drawn in twelve steps, made with the commit before there were nuisances, eec9080b."""


def make(given, task="ArrowPuzzle", **options):
    return gymnasium.make(
        f"imagine_bench/{task}-v0", execution="kinematic", appearance=given, disable_env_checker=True, **options
    )


def walked(task, given):
    """A digest of poses, hands, looks, rewards and the generator along twelve random macro-actions."""
    found = hashlib.sha256()
    with make(given, task) as env:
        plain = env.unwrapped
        env.reset(seed=7)
        for _ in range(12):
            _, reward, terminated, truncated, _ = env.step(int(plain.np_random.integers(plain.action_space.n)))
            hands = (plain.data.mocap_pos, plain.data.mocap_quat)
            for part in (plain.world.object_poses(), *hands, *looks_of(plain.model), reward):
                found.update(np.round(np.asarray(part, dtype=np.float64), 9).tobytes())
            if terminated or truncated:
                env.reset()
        found.update(str(plain.np_random.bit_generator.state["state"]["state"]).encode())
    return found.hexdigest()[:16]


def frames_of(given):
    """Three frames of each of some episodes from one start: the second turns a cube on, the third turns it back."""
    with make(given) as env:
        seen = []
        for seed in (3, 4, 5):
            frame, _ = env.reset(seed=seed, options={"macrostate": START})
            seen += [frame, *(env.step(action)[0] for action in (0, 1))]
    return np.array(seen, dtype=float)


@pytest.mark.parametrize(("task", "given"), BEFORE)
def test_other_appearances_draw_as_before_there_were_nuisances(task, given):
    assert walked(task, given) == BEFORE[task, given]
    assert walked(task, "harsh") not in BEFORE.values()


def scene(given, **options):
    """A world of an appearance, as an episode of it begins; and the generator that its frames follow."""
    with make(given, **options) as env:
        world, rng = env.unwrapped.world, np.random.default_rng(0)
    world.place(START, rng)
    return world, rng


def gray(level=128, size=64):
    return np.full((size, size, 3), level, dtype=np.uint8)


def test_a_shift_moves_all_frames_of_an_episode_alike_and_never_too_far():
    world, rng = scene("shift=1.5")
    spot, found = gray(0), []
    spot[30, 30] = 255
    for _ in range(300):
        world.place(START, rng)
        places = []
        for _ in range(2):
            world.vary(rng)
            places.append(np.argwhere(world.composite(spot)[..., 0]))
        assert np.array_equal(*places) and places[0].shape == (1, 2)
        found.append(places[0][0] - 30)
    assert {*np.unique(found)} == {*range(-6, 7)}, "up to 1.5 times four pixels either way, each of them"
    assert np.abs(np.mean(found, axis=0)).max() < 1.0


def test_a_shadow_is_soft_moves_and_takes_half_of_the_light():
    world, rng = scene("shadow=1")
    seen = []
    for _ in range(6):
        world.vary(rng)
        seen.append(world.composite(gray(200))[..., 0].astype(float))
    assert len({each.argmin() for each in seen}) == 6, "it moves with each frame"
    assert all(99 <= each.min() <= 110 for each in seen)
    assert max(np.abs(np.diff(each, axis=axis)).max() for each in seen for axis in (0, 1)) < 8, "no edge is hard"
    assert frames_of("shadow=1").mean() < 0.95 * frames_of("clean").mean()
    assert appearance("shadow=2").shadow_depth < 1.0, "no shadow is black"


@pytest.mark.parametrize("share", [0.5, 1.0, 1.5])
def test_noise_has_the_deviation_that_it_says(share):
    world, rng = scene({"noise": share})
    world.vary(rng)
    once = world.composite(gray())
    assert np.array_equal(once, world.composite(gray())), "a moment that is seen twice is the same"
    assert once.std() == pytest.approx(20.0 * share, rel=0.05)
    world.vary(rng)
    assert not np.array_equal(once, world.composite(gray()))


@pytest.mark.parametrize("size", [64, 128])
def test_an_occluder_is_one_gray_square_somewhere_in_each_frame(size):
    world, rng = scene("occlusion=1", size=size)
    frame, edge = gray((9, 99, 199), size), size // 8
    places = []
    for _ in range(10 * size):
        world.vary(rng)
        changed = (world.composite(frame) != frame).any(axis=-1)
        rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
        assert len(rows) == len(columns) == edge and changed.sum() == edge**2
        places.append((rows[0], columns[0]))
    assert np.min(places) == 0 and np.max(places) == size - edge, "anywhere, up to the border"


@pytest.mark.parametrize("given", ["reward_noise=1", "reward_steps=1", "reward_noise=2,reward_steps=0.5"])
def test_noisy_rewards_are_on_average_those_of_the_rules(given):
    level = appearance(given)
    rng = np.random.default_rng(0)
    with make(given) as env:
        found = np.array([env.unwrapped.world.reward(-1.0, rng) for _ in range(4000)])
    expected = np.sqrt(level.reward_std**2 + level.reward_step**2 * 2 / 3)
    assert found.mean() == pytest.approx(-1.0, abs=4 * expected / np.sqrt(len(found)))
    assert found.std() == pytest.approx(expected, rel=0.05)
    if given == "reward_steps=1":
        assert set(found) == {-1.5, -1.0, -0.5}


def test_truth_stays_as_it_is():
    """Macrostates, ends and legal states are those without nuisances; so chance and optimum are, too."""
    walks = []
    for given in ("clean", "harsh"):
        with make(given) as env:
            env.reset(seed=5, options={"macrostate": START})
            steps = [env.step(action)[2:] for action in (0, 1)]
            walks.append([(*step[:2], *step[2]["macrostate"].tolist(), bool(step[2]["legal"])) for step in steps])
    assert walks[0] == walks[1]


def test_states_copies_and_pickles_go_on_to_the_bit():
    with make("harsh") as env:
        env.reset(seed=1, options={"macrostate": START})
        env.step(0)
        state = pickle.loads(pickle.dumps(env.unwrapped.get_state()))
        twin = copy.deepcopy(env)
        walks = [[each.step(action)[:2] for action in (1, 0)] for each in (env, twin)]
        env.unwrapped.set_state(state)
        walks.append([env.step(action)[:2] for action in (1, 0)])
    for walk in walks:
        np.testing.assert_equal(walk, walks[0])
        assert walk[-1][1] != round(walk[-1][1])


def test_lanes_equal_single_environments():
    lanes = gymnasium.make_vec(
        "imagine_bench/ArrowPuzzle-vector-v0", num_envs=2, execution="kinematic", appearance="harsh"
    )
    seen, _ = lanes.reset(seed=4)
    after = lanes.step(np.array([0, 3]))
    for lane, action in enumerate((0, 3)):
        with make("harsh") as env:
            assert np.array_equal(env.reset(seed=4 + lane)[0], seen[lane])
            assert env.step(action)[1] == after[1][lane]
    lanes.close()


def test_a_dataset_holds_noisy_rewards_and_frames(tmp_path):
    spec = registry.task("arrow_puzzle")
    policy = policy_of("random", spec, 1)
    episodes, apart, card = collect(spec, policy, episodes=3, seed=1, execution="kinematic", appearance="harsh")
    dataset = read_dataset(write_dataset(tmp_path / "data", episodes, apart, card, "npz").folder)
    assert np.array_equal(dataset.episodes.frames, episodes.frames)
    assert all(reward != round(reward) for reward in dataset.episodes.rewards.tolist())
