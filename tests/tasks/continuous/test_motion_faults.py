"""Fault injection in continuous control: hostile actions, options and states; copies and lanes to the bit."""

from __future__ import annotations

import copy
import functools
import pickle
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from by_hand import FAMILIES, STARTS
from imagine_bench.tasks.continuous.controls import CONTROL_NAMES
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench.tasks.continuous.spec import make_arrows
from imagine_bench.tasks.scene_env import SceneEnv
from same_values import assert_same
from storms import hostile, one_sentence

from imagine_bench.errors import ImagineBenchError, InvalidValueError


def wrong_actions(n: int) -> Iterator[Any]:
    """Values that are no n real numbers."""
    zeros = np.zeros(n)
    for value in (np.nan, np.inf, -np.inf):
        yield np.append(zeros[1:], value)
    yield from (zeros[1:], np.zeros(n + 1), zeros[None], 0.0, None, "left", b"\0" * n, {}, len)
    yield from (["0"] * n, np.array(["0.5"] * n), [None] * n, [[0], *[0] * (n - 1)], [10**400] * n, [1j] * n)
    yield from (zeros.astype(kind) for kind in (complex, "datetime64[s]", "timedelta64[s]", [("a", float)], object))
    yield np.ma.masked_array(zeros, mask=[True] + [False] * (n - 1))


@pytest.mark.parametrize("control", CONTROL_NAMES)
def test_an_action_without_real_numbers_is_refused(control: str) -> None:
    env = make_arrows(control=control, observation="proprio")
    env.reset(seed=0)
    before = pickle.dumps(env.get_state())
    for action in wrong_actions(len(env.control_names)):
        with pytest.raises(InvalidValueError) as refusal:
            env.step(action)
        one_sentence(refusal.value)
        assert pickle.dumps(env.get_state()) == before
    for size in (1e300, -1e300, 1):
        assert np.isfinite(env.step(np.full(len(env.control_names), size))[0]).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_hostile_values_of_options_are_refused_in_a_sentence(family: str) -> None:
    rng = np.random.default_rng(0)
    names = [*MotionEnv.KEYWORDS, "slip", "lag", "gesture", "goal_change", "distractors", "horizon", "cubes", "x" * 99]
    refused = 0
    for name in names:
        for value in (hostile(rng) for _ in range(8)):
            try:
                FAMILIES[family](**{"observation": "proprio", name: value}).reset(seed=0)
            except ImagineBenchError as error:
                one_sentence(error)
                refused += 1
    assert refused > 6 * len(names)


def damaged(state: Any) -> Iterator[Any]:
    """States of the same kind with a part that is missing, of another shape, or impossible."""
    world = state.world
    worlds: list[dict[str, Any]] = [
        *({"physics": each} for each in (None, world.physics[1:], world.physics[None], world.physics * np.nan)),
        *({"looks": each} for each in (None, world.looks[1:], (world.looks[0] * np.inf, *world.looks[1:]))),
        {"sensing": None},
        {"sleep": {"nothing": 1}},
    ]
    yield from (replace(state, world=replace(world, **each)) for each in worlds)
    other = np.random.Generator(np.random.MT19937(0)).bit_generator.state
    yield from (replace(state, **each) for each in ({"world": None}, {"generator": other}, {"episode": None}))
    for macrostate in ((), (9, 9, 9, 9), (0, 0)):
        if hasattr(state, "macrostate"):
            yield replace(state, macrostate=macrostate)
        else:
            yield replace(state, episode=replace(state.episode, macrostate=macrostate))
    yield from (None, pickle.dumps(state), replace(state, kind=("another",)))


@pytest.mark.parametrize("name", ["arrows", "pick_place", "macro-actions"])
def test_a_damaged_state_is_refused_and_changes_nothing(name: str) -> None:
    def made() -> Any:
        if name in FAMILIES:
            return FAMILIES[name](observation="proprio")
        return gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic").unwrapped

    source: SceneEnv = made()
    env: SceneEnv = made()
    for each, seed in ((source, 0), (env, 1)):
        each.reset(seed=seed)
    before = pickle.dumps(env.get_state())
    for state in damaged(source.get_state()):
        with pytest.raises(InvalidValueError) as refusal:
            env.set_state(state)
        one_sentence(refusal.value)
        assert pickle.dumps(env.get_state()) == before


@pytest.mark.parametrize(
    "option",
    [
        {"control": "joint"},
        {"rate_hz": 12.5},
        {"appearance": "mild"},
        {"reward": "dense"},
        {"physics": {"object_mass": 2.0}},
        {"slip": 0.1},
        {"told": True},
        {"placement": 0.01},
        {"distractors": 1},
        {"cubes": 2},
    ],
    ids=str,
)
def test_a_state_of_an_environment_that_goes_on_otherwise_is_refused(option: dict[str, Any]) -> None:
    envs = [make_arrows(observation="proprio", **given) for given in ({}, option)]
    for env in envs:
        env.reset(seed=0)
    for env, other in (envs, envs[::-1]):
        with pytest.raises(InvalidValueError, match="give one of get_state"):
            env.set_state(other.get_state())


@pytest.mark.parametrize("family", FAMILIES)
def test_an_episode_knows_nothing_of_the_one_before(family: str) -> None:
    """Which was left in the middle of a grip that slipped, after a motion of its own."""
    options = {"observation": "hand,proprio,objects,state", "size": 32, "slip": 0.99, "gesture": "first", "lag": 1}
    options |= {"placement": 0.03, "appearance": "strong", "reward": "dense"}
    left, fresh = (FAMILIES[family](**options) for _ in range(2))
    left.reset(seed=6, options={"macrostate": STARTS[family]})
    expert = Expert(left)
    expert.begin(0)
    while not left.episode.slipping:
        left.step(expert.act())
    closing = np.array([[0.1, 0, 0, 0, 0, 0.2, -1]] * 10, dtype=np.float32)
    for env in (left, fresh):
        env.reset(seed=4)
    for action in closing:
        assert_same(*(env.step(action) for env in (left, fresh)))
    assert pickle.dumps(left.get_state()) == pickle.dumps(fresh.get_state())


@pytest.mark.parametrize("control", CONTROL_NAMES)
@pytest.mark.parametrize("family", FAMILIES)
def test_copies_and_states_in_the_middle_of_a_grasp_go_on_to_the_bit(family: str, control: str) -> None:
    """Up to the grasp's event and beyond it; by joints the grip slips instead. The next reward is counted from the
    potential of the latest moment.
    """
    slips = control == "joint"
    options = {"observation": "hand,proprio,objects", "size": 32, "slip": 0.99 * slips, "reward": "dense"}
    make = functools.partial(FAMILIES[family], control=control, **options)
    env = make()
    env.reset(seed=6, options={"macrostate": STARTS[family]})
    expert = Expert(env)
    expert.begin(0)
    while not (env.episode.slipping if slips else env.referee.touched().any()):
        env.step(expert.act())
    env.step(expert.act())
    another = make()
    another.reset(seed=9)
    another.set_state(env.get_state())
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env)), another]
    while not expert.is_done and (env.episode.events == 0 or env.episode.latest):
        action = expert.act()
        seen, *results, info = env.step(action)
        for each in copies:
            also, *same, info_also = each.step(action)
            assert same == results
            for name, array in (*seen.items(), *info.items()):
                np.testing.assert_array_equal({**also, **info_also}[name], array)
    assert env.episode.events == 1 - slips
