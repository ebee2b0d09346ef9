"""Continuous control: the effects of motions on macrostates, and effects that no motion can have."""

from __future__ import annotations

import functools
import math
from typing import Any

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.arrows.rules import Arrows
from imagine_bench.tasks.arrows.world import MAX_OFF_SLOT_M
from imagine_bench.tasks.continuous.controls import CONTROL_NAMES
from imagine_bench.tasks.continuous.env import MotionEnv, steps_in_period
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench.tasks.continuous.segments import least_seconds, measure
from imagine_bench.tasks.continuous.spec import make_arrows, make_pick_place
from imagine_bench.tasks.parameters.parameters import WorldParameters
from imagine_bench.tasks.pick_place.rules import PickPlace
from imagine_bench.tasks.scenes.appearance import appearance
from imagine_bench.tasks.specs import world_maker
from imagine_bench.tasks.world import Reading

from imagine_bench.errors import InvalidValueError, UnknownKeywordError

FREE = {"goal": "000", "forbid": "none"}
"""Arrow puzzle in which nothing but the goal ends an episode."""


@functools.cache
def environment(family: str, control: str = "twist", **options: Any) -> tuple[MotionEnv, Expert]:
    """An environment without images, and an expert of it."""
    make = make_arrows if family == "arrows" else make_pick_place
    env = make(control=control, observation="proprio,objects", **options)
    kind: type[WorldParameters] = Arrows if family == "arrows" else PickPlace
    return env, Expert(env, world_maker(kind())(appearance("clean"), control=True))


def carry_out(env: MotionEnv, expert: Expert, action: int) -> list[dict[str, Any]]:
    """A macro-action by the expert; the info of every event, and the last one."""
    expert.begin(action)
    seen = []
    while not expert.is_done:
        _, reward, terminated, truncated, info = env.step(expert.act())
        if info["event"]:
            seen.append({**info, "reward": reward})
        if terminated or truncated:
            break
    return seen


@pytest.mark.parametrize("control", CONTROL_NAMES)
def test_each_turn_by_hand_is_one_event_and_that_macro_action(control: str) -> None:
    env, expert = environment("arrows", control, **FREE)
    env.reset(seed=3, options={"macrostate": (1, 2, 3, 0)})
    for action in (0, 3, 4):
        expected = env.task.rules.outcomes(env.episode.macrostate, action)[0]
        (event,) = carry_out(env, expert, action)
        assert event["macro_action"] == action
        assert tuple(event["macrostate"]) == expected.macrostate
        assert event["reward"] == expected.reward
        assert not event["fault"]


@pytest.mark.parametrize("control", CONTROL_NAMES)
def test_pick_and_hand_over_by_hand(control: str) -> None:
    env, expert = environment("pick_place", control)
    env.reset(seed=1, options={"macrostate": (0, 0, 0, 1)})
    total = 0.0
    for _ in range(12):
        action = env.task.rules.optimal_action(env.episode.macrostate)
        (event,) = carry_out(env, expert, action)
        assert event["macro_action"] == action
        total += event["reward"]
        if event["success"]:
            break
    assert event["success"]
    assert total >= 6.0


def test_a_grasp_that_turns_twice_passes_the_state_between() -> None:
    """Turned by half a turn in one grasp: the first quarter is judged while the cube is held."""
    env, expert = environment("arrows", "joint", **FREE)
    env.reset(seed=0, options={"macrostate": (1, 1, 2, 0)})
    expert.begin(1)  # counter-clockwise
    due = list(expert._due)
    turned = [target.joints_rad[-1] for target in due]
    held = max(index for index, target in enumerate(due) if target.opening_m < 0.0255)
    target = due[held]
    for each in due[: held + 1]:
        env.step(np.append(each.joints_rad, 2.0 * each.opening_m / 0.045 - 1.0).astype(np.float32))
    assert env.episode.events == 0
    sense = math.copysign(1.0, turned[held] - turned[0])
    events = []
    for step in range(1, 40):
        joints_rad = target.joints_rad.copy()
        joints_rad[-1] += sense * min(0.08 * step, 1.4)
        *_, info = env.step(np.append(joints_rad, 2.0 * target.opening_m / 0.045 - 1.0).astype(np.float32))
        if info["event"]:
            events.append(info["macro_action"])
    assert events == [1]
    assert env.episode.macrostate[0] == 0


@pytest.mark.parametrize(
    ("rate_hz", "named"), [(30.0, "25 or 31.25"), (26, "25 or 31.25"), (0, "number"), ("x", "number")]
)
def test_a_rate_that_is_no_whole_number_of_steps_names_the_nearest(rate_hz: Any, named: str) -> None:
    with pytest.raises(InvalidValueError, match=named):
        steps_in_period(rate_hz, 0.008)
    assert steps_in_period(25.0, 0.008) == 5
    assert steps_in_period(1 / 0.064, 0.008) == 8


@pytest.mark.parametrize("control", CONTROL_NAMES)
def test_commands_keep_the_limits_of_speed_and_range_whatever_is_asked(control: str) -> None:
    env, _ = environment("arrows", control, **FREE)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    columns = env._columns.ctrl
    most_rad = env.controls._most_rad + 1e-12
    before = env.data.ctrl[columns].copy()
    for _ in range(60):
        low, high = env.action_space.low, env.action_space.high
        _, _, terminated, _, _ = env.step(np.where(rng.random(len(low)) < 0.5, low, high))
        now = env.data.ctrl[columns].copy()
        assert (np.abs(now - before)[:7] <= most_rad).all()
        assert (now[:7] >= env.model.jnt_range[:7, 0]).all()
        assert (now[:7] <= env.model.jnt_range[:7, 1]).all()
        before = now
        if terminated:
            env.reset()
            before = env.data.ctrl[columns].copy()


@pytest.mark.parametrize("name", ["ArrowPuzzle", "ArrowPuzzleHard", "PickPlace", "Arrows"])
def test_ids_are_known_to_gymnasium(name: str) -> None:
    env = gymnasium.make(f"imagine_bench/{name}Motion-v0", observation="proprio")
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    env.close()


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"shuffle": 3}, "leave it out"),
    ({"coupling": "neighbour"}, "leave it out"),
    ({"appearance": "patched"}, "'patched' patches images"),
    ({"split": "plan_length=2"}, "unexpected keyword argument 'split'"),
    ({"execution": "kinematic"}, "unexpected keyword argument 'execution'"),
    ({"cubes": 7}, "give an integer from 1 to 6"),
    ({"goal": "all", "forbid": "equal"}, "no start"),
    ({"rate_hz": 2}, "from 5 to 125"),
    ({"placement": 0.05}, "give metres from 0 to 0.04"),
    ({"placement": "far"}, "give metres from 0 to 0.04"),
]


@pytest.mark.parametrize(("option", "words"), REFUSED)
def test_options_without_meaning_for_a_hand_are_refused(option: dict[str, Any], words: str) -> None:
    with pytest.raises((InvalidValueError, UnknownKeywordError), match=words):
        make_arrows(**option)


@pytest.mark.parametrize("name", ["arrows", "pick_place"])
@pytest.mark.parametrize(
    "option",
    [
        {"goal_change": 1.0},
        {"gesture": "first"},
        {"gesture": 0.0},
        {"distractors": 2},
        {"lag": 1},
        {"appearance": "strong"},
        {"slip": 0.5},
        {"told": True},
        {"placement": 0.04},
    ],
)
def test_parameters_of_a_world_mean_what_they_mean_of_macro_actions(name: str, option: dict[str, Any]) -> None:
    make = make_arrows if name == "arrows" else make_pick_place
    env = make(observation="state,objects", **option, **(FREE if name == "arrows" else {}))
    start = (1, 2, 3, 0) if name == "arrows" else (0, 0, 0, 0)
    first, info = env.reset(seed=0, options={"macrostate": start})
    assert bool(info["instruction"]) == bool(option.get("told"))
    expert = Expert(env, env.another_world())
    event = next(each for _ in range(9) for each in carry_out(env, expert, 0))
    after = tuple(event["macrostate"])
    assert not event["fault"]
    if option.get("goal_change") and name == "arrows":
        assert after[-1] != start[-1]
    hidden = "gesture" in option or option.get("told")
    assert (env.world.observed(after)[-1] == -1) == bool(hidden and not (name == "pick_place" and after[-1] == 4))
    seen = env.step(np.zeros(7, dtype=np.float32))[0]
    assert np.array_equal(seen["state"], first["state"]) == ("lag" in option)


@pytest.mark.parametrize("cubes", range(1, 7))
def test_any_number_of_cubes_is_turned_by_hand(cubes: int) -> None:
    env = make_arrows(observation="proprio", cubes=cubes, goal="0" * cubes, forbid="none")
    env.reset(seed=0, options={"macrostate": (*(1, 2, 3, 1, 2, 3)[:cubes], 0)})
    expert = Expert(env, env.another_world())
    for action in (1, 2 * cubes - 2):
        assert [each["macro_action"] for each in carry_out(env, expert, action)] == [action]


@pytest.mark.parametrize("family", ["arrows", "pick_place"])
def test_the_dense_reward_sums_to_the_sparse_one_less_the_potential_of_the_start(family: str) -> None:
    """Shaping by a potential telescopes, whatever the motion; and a good motion is paid before its event."""
    dense, expert = environment(family, reward="dense")
    sparse, _ = environment(family)
    start = (1, 2, 0, 1) if family == "arrows" else (0, 0, 0, 1)
    for env in (dense, sparse):
        env.reset(seed=2, options={"macrostate": start})
    begun = dense.episode.potential
    assert begun < 0
    paid = [0.0, 0.0]
    over = False
    early = 0.0
    while not over:
        expert.begin(dense.task.rules.optimal_action(dense.episode.macrostate))
        while not expert.is_done and not over:
            action = expert.act()
            for index, env in enumerate((dense, sparse)):
                _, reward, over, _, info = env.step(action)
                paid[index] += reward
            if not info["event"] and dense.episode.events == 0:
                early = max(early, paid[0])
    assert paid[0] == pytest.approx(paid[1] - begun, abs=1e-9)
    assert early > 0.6


@pytest.mark.parametrize("family", ["arrows", "pick_place"])
def test_a_grip_that_slips_leaves_the_object_where_it_is(family: str) -> None:
    """Of 14 grips each slips or not, as drawn; a slip is no event and no fault, a firm grip is its macro-action."""
    env, expert = environment(family, slip=0.5, **(FREE if family == "arrows" else {}))
    slipped = 0
    for seed in range(14):
        state = (1, 2, 3, 0) if family == "arrows" else (0, 0, 0, seed % 3)
        action = seed % 6 if family == "arrows" else seed % 3
        env.reset(seed=seed, options={"macrostate": state})
        expert.begin(action)
        slips = False
        while not expert.is_done:
            *_, info = env.step(expert.act())
            slips |= env.episode.slipping
        assert not info["fault"]
        expected = state if slips else env.task.rules.outcomes(state, action)[0].macrostate
        assert tuple(info["macrostate"])[:-1] == expected[:-1]
        slipped += slips
    assert 2 <= slipped <= 12  # 99.8 % of binomial draws


@pytest.mark.parametrize(("family", "cubes"), [("arrows", 1), ("arrows", 3), ("arrows", 6), ("pick_place", None)])
def test_a_placement_moves_objects_apart_from_each_other_and_reads_as_before(family: str, cubes: int | None) -> None:
    """In 100 starts some object is more than 3 cm off its slot, none more than 4.3 cm, and two are 8 cm apart."""
    options = {} if cubes is None else {"cubes": cubes}
    placed, _ = environment(family, placement=0.04, **options)
    plain, _ = environment(family, **options)
    plain.reset(seed=0)
    slots_m = plain.world.object_poses()[:, :2]
    later, earlier = np.tril_indices(len(slots_m), -1)
    off_m = []
    apart_m = [1.0]
    for seed in range(100):
        _, info = placed.reset(seed=seed)
        assert placed.world.read() == Reading(macrostate=tuple(info["macrostate"]), problem=None)
        places_m = placed.world.object_poses()[:, :2]
        off_m.append(np.abs(places_m - slots_m).max())
        apart_m.extend(np.abs(places_m[later] - places_m[earlier]).max(axis=1))
    assert min(apart_m) >= 0.08  # a cube's edge is 55 mm
    assert 0.03 < max(off_m) < 0.045
    places = placed.world.places
    placed.reset(seed=0)
    assert placed.world.places != places
    placed.reset(seed=99)
    assert placed.world.places == places


def test_a_turned_cube_belongs_to_the_place_of_its_start() -> None:
    """And not to its slot; also in an environment that was set to this state, and whatever its own starts were."""
    env, _ = environment("arrows", placement=0.04, **FREE)
    again = make_arrows(observation="proprio", placement=0.04, **FREE)
    again.reset(seed=1)
    expert = Expert(again, again.another_world())
    off_m = []
    for seed in range(3):
        env.reset(seed=seed, options={"macrostate": (1, 2, 3, 0)})
        before_m = env.world.object_poses()[:, :2]
        off_m.append(math.hypot(*env.world.places[0][:2]))
        again.set_state(env.get_state())
        events = [carry_out(again, expert, action)[0] for action in (0, 5)]
        assert [each["macro_action"] for each in events] == [0, 5]
        assert np.abs(again.world.object_poses()[:, :2] - before_m).max() < 0.005
    assert max(off_m) > MAX_OFF_SLOT_M


def test_macro_actions_and_certificates_refuse_a_placement() -> None:
    with pytest.raises(InvalidValueError, match="macro-actions begin and end with objects on their slots"):
        gymnasium.make("imagine_bench/Arrows-v0", placement=0.03)
    with pytest.raises(InvalidValueError, match="a certificate is of objects on their slots"):
        measure(make_arrows(observation="proprio", placement=0.03), tries=1, turns=1)


def test_a_turn_about_the_hand_leaves_its_place() -> None:
    """By hand twist, half a turn a second: a gripped object is not dragged aside."""
    env, _ = environment("arrows")
    env.reset(seed=0)
    before_m = env.data.site_xpos[env.world.model.site("tcp").id].copy()
    for step in range(60):
        twist = [0, 0, 0, 0, 0, (1 if step < 30 else -1) * math.pi / 6, 0]
        env.step(np.array(twist, dtype=np.float32))
        off_m = env.data.site_xpos[env.world.model.site("tcp").id] - before_m
        assert np.linalg.norm(off_m) < 0.002


@pytest.mark.parametrize(
    ("seed", "start", "action"),
    [(290_004, (0, 3, 1, 2), 5), (450_004, (1, 0, 3, 2), 3), (1_070_007, (2, 3, 1, 1), 5)],
)
def test_the_hand_keeps_to_its_plan_beside_other_cubes(seed: int, start: tuple[int, ...], action: int) -> None:
    """Placements of ``strong`` in which a hand that lags behind its plan touches the next cube."""
    env, expert = environment("arrows", appearance="strong")
    env.reset(seed=seed, options={"macrostate": start})
    (event,) = carry_out(env, expert, action)
    assert event["macro_action"] == action
    assert not event["fault"]


def test_the_least_time_of_a_macro_action_follows_from_heights_and_the_largest_twist() -> None:
    env, _ = environment("arrows", **FREE)
    down_m = 0.1952 - 0.04 - (-0.1 + 0.055) - 0.022 - 0.01
    turn_s = math.radians(70) / 6.0
    for ways, state in ((2, (1, 2, 3, 0)), (1, (1, 0, 0, 0))):
        assert least_seconds(env, state, 1) == pytest.approx(math.ceil((ways * down_m + turn_s) / 0.04) * 0.04)
    env, _ = environment("pick_place")
    assert least_seconds(env, (1, 0, 0, 2), 0) < least_seconds(env, (0, 0, 0, 0), 0)


@pytest.mark.parametrize("axis", [2, 5])
def test_the_hand_keeps_to_the_largest_twist(axis: int) -> None:
    """At full speed, down or about the vertical, from rest at the observation pose: the least time assumes this."""
    env, _ = environment("arrows")
    env.reset(seed=0)
    site = env.world.model.site("tcp").id
    height_m = env.data.site_xpos[site, 2]
    before = env.data.site_xmat[site].reshape(3, 3).copy()
    for period in range(1, 6):
        env.step(-np.eye(7, dtype=np.float32)[axis])
        turned = before.T @ env.data.site_xmat[site].reshape(3, 3)
        assert height_m - env.data.site_xpos[site, 2] <= 1.0 * period * env.period_s + 1e-3
        assert math.acos(min(1.0, (np.trace(turned) - 1.0) / 2.0)) <= 6.0 * period * env.period_s + 1e-3
