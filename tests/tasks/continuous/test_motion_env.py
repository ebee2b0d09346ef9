"""Continuous control: the effects of motions on macrostates, and effects that no motion can have."""

from __future__ import annotations

import itertools
import math
from typing import Any
from unittest import mock

import gymnasium
import numpy as np
import pytest
from by_hand import FAMILIES, FREE, STARTS, carry_out, environment
from imagine_bench.tasks.continuous.controls import CONTROL_NAMES, WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from imagine_bench.tasks.continuous.dense import Potential
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench.tasks.continuous.instructions import instruction
from imagine_bench.tasks.continuous.referee import FAULT_REWARD
from imagine_bench.tasks.continuous.segments import least_seconds, measure, move_aside
from imagine_bench.tasks.continuous.spec import make_pick_place
from imagine_bench.tasks.motion.orientation import about_vertical
from imagine_bench.tasks.scenes.arm import JOINT_SPEED_LIMITS_RAD_S

from imagine_bench.arrays import Floats
from imagine_bench.rules import shortest_plans, tabulate


@pytest.mark.parametrize("control", CONTROL_NAMES)
@pytest.mark.parametrize("family", FAMILIES)
def test_the_best_macro_actions_by_hand_are_one_event_each_as_ruled(family: str, control: str) -> None:
    env, expert = environment(family, control=control, **FREE[family])
    env.reset(seed=1, options={"macrostate": STARTS[family]})
    rules = env.task.rules
    while not rules.is_terminal(env.episode.macrostate):
        before = env.episode.macrostate
        action = rules.optimal_action(before)
        (event,) = carry_out(env, expert, action)
        assert (event["macro_action"], event["fault"]) == (action, False)
        found = (tuple(event["macrostate"]), event["reward"], event["success"])
        assert found in [(each.macrostate, each.reward, each.success) for each in rules.outcomes(before, action)]
    assert event["success"]


@pytest.mark.parametrize("rate_hz", [25.0, 12.5])
@pytest.mark.parametrize("control", CONTROL_NAMES)
def test_commands_keep_the_limits_of_speed_and_range(control: str, rate_hz: float) -> None:
    """Actions beyond the space are those at its border; joints go their way in the period, and fingers at 0.5 m/s."""
    env, _ = environment("arrows", control=control, rate_hz=rate_hz, **FREE["arrows"])
    rng = np.random.default_rng(0)
    low, high = env.action_space.low, env.action_space.high
    most_rad = np.array(JOINT_SPEED_LIMITS_RAD_S) / rate_hz
    over, periods, gentle, outside = True, 0, 0, False
    for _ in range(40):
        if over:
            env.reset(seed=0)
            periods = 0
        before = env.servo_targets()
        action = np.where(rng.random(len(low)) < 0.5, low, high) * rng.choice([0.1, 1.0, 10.0])
        _, _, over, _, info = env.step(action)
        periods += 1
        held = action.clip(low, high)
        np.testing.assert_array_equal(env.checked(action), held)
        joints_rad, opening_m = np.split(env.servo_targets(), [7])
        assert (np.abs(joints_rad - before[:7]) <= most_rad + 1e-12).all()
        assert (joints_rad == joints_rad.clip(*env.model.jnt_range[:7].T)).all()
        if control.startswith("joint"):
            asked_rad = before[:7] + held[:7] * most_rad if control == "joint_delta" else held[:7]
            within_rad = asked_rad.clip(before[:7] - most_rad, before[:7] + most_rad)
            assert joints_rad == pytest.approx(within_rad.clip(*env.model.jnt_range[:7].T), abs=1e-9)
        hand_m = env.hand_target_m()
        outside |= np.abs(hand_m - hand_m.clip(WORKSPACE_LOW_M, WORKSPACE_HIGH_M)).max() > 0.005
        if control == "twist" and np.abs(held).max() < 0.2 and not info["limited"]:
            (from_m, turn), (to_m, turned) = (env.controls.hand_pose(each) for each in (before[:7], joints_rad))
            about = turned @ turn.T
            turned_rad = [about[2, 1] - about[1, 2], about[0, 2] - about[2, 0], about[1, 0] - about[0, 1]]
            moved = np.array([*(to_m - from_m), *turned_rad]) / [1.0, 1.0, 1.0, 12.0, 12.0, 12.0]
            assert moved * rate_hz == pytest.approx(held[:6], abs=0.03)
            gentle += 1
        wanted_m = 0.0225 * (held[-1] + 1.0)
        assert opening_m == pytest.approx(wanted_m.clip(before[7] - 0.5 / rate_hz, before[7] + 0.5 / rate_hz))
        assert env.data.ctrl[env.columns.ctrl[7:]] == pytest.approx([*opening_m] * 2)
        assert (info["sim_time_s"], info["elapsed_s"]) == pytest.approx((1.0 / rate_hz, env.data.time))
        assert env.data.time == pytest.approx(periods / rate_hz)
    assert gentle > 3 or control != "twist"
    assert outside or not control.startswith("joint"), "joints are not held in the workspace"


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    "option",
    [
        {"goal_change": 1.0},
        {"gesture": "first"},
        {"gesture": 0.0},
        {"distractors": 2},
        {"appearance": "strong"},
        {"slip": 0.5},
        {"told": True},
        {"placement": 0.04},
    ],
)
def test_parameters_of_a_world_mean_what_they_mean_of_macro_actions(family: str, option: dict[str, Any]) -> None:
    """What varies looks the same until an event, and otherwise after it."""
    env = FAMILIES[family](observation="state,objects", **option, **FREE[family])
    start = STARTS[family]
    first, info = env.reset(seed=0, options={"macrostate": start})
    assert bool(info["instruction"]) == bool(option.get("told"))
    expert = Expert(env)
    looks = [env.model.mat_rgba[:, :3].copy()]
    env.step(np.zeros(7))
    looks.append(env.model.mat_rgba[:, :3].copy())
    event = next(each for _ in range(9) for each in carry_out(env, expert, 0))
    looks.append(env.model.mat_rgba[:, :3].copy())
    varies = bool(option.keys() & {"appearance", "distractors"})
    assert [np.array_equal(*pair) for pair in itertools.pairwise(looks)] == [True, not varies]
    after = tuple(event["macrostate"])
    assert not event["fault"]
    assert env.world.read().macrostate == after
    assert event["instruction"] == (instruction(env.task, after) if option.get("told") else "")
    if option.get("goal_change") and family == "arrows":
        assert after[-1] != start[-1]
    hidden = "gesture" in option or option.get("told")
    assert (env.world.observed(after)[-1] == -1) == bool(hidden and not (family == "pick_place" and after[-1] == 4))
    seen = env.step(np.zeros(7, dtype=np.float32))[0]
    assert not np.array_equal(seen["state"], first["state"])


def test_a_camera_in_the_room_stands_where_this_moment_has_it() -> None:
    """In an environment that was used before as in a new one, and after an event, while the other cubes sleep."""
    options = {"appearance": "strong", "observation": "hand,front", "size": 32, **FREE["arrows"]}
    used, expert = environment("arrows", **options)
    used.reset(seed=1)
    places = []
    for _ in range(2):
        places.append(used.model.camera("front").pos.copy())
        np.testing.assert_array_equal(used.data.camera("front").xpos, places[-1])
        carry_out(used, expert, 0)
    assert not np.array_equal(*places)
    again = used.reset(seed=2)[0]
    for name, image in FAMILIES["arrows"](**options).reset(seed=2)[0].items():
        np.testing.assert_array_equal(again[name], image, err_msg=name)


def test_a_late_observation_is_that_of_so_many_events_ago() -> None:
    """All its parts, and it stays until the next event."""
    world = {"cubes": 1, "goal": "3", "forbid": "none"}
    (prompt, expert), (late, _) = environment("arrows", **world), environment("arrows", lag=2, **world)
    seen = [env.reset(seed=0, options={"macrostate": (0, 0)})[0] for env in (late, prompt)][:1]
    for action in (0, 1, 0, 0):
        expert.begin(action)
        while not expert.is_done:
            command = expert.act()
            now, *_, info = prompt.step(command)
            seen += [now] * bool(info["event"])
            for name, part in late.step(command)[0].items():
                np.testing.assert_array_equal(part, seen[max(0, len(seen) - 3)][name])
    assert len(seen) == 5


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("option", [{}, {"gesture": "first"}, {"gesture": 0.99}, {"lag": 1}], ids=str)
def test_a_goal_that_is_told_is_in_no_image(family: str, option: dict[str, Any]) -> None:
    """Whatever the world's frames show. Without words the first frame shows the pointing hand."""
    (*objects, first), second = STARTS[family], 1
    for told in (True, False):
        env = FAMILIES[family](observation="hand,front", size=32, told=told, **option)
        starts = [{"macrostate": (*objects, gesture)} for gesture in (first, second)]
        (seen, info), (other, other_info) = (env.reset(seed=0, options=start) for start in starts)
        assert all(np.array_equal(seen[camera], other[camera]) for camera in seen) == told
        assert (info["instruction"] != other_info["instruction"]) == told


@pytest.mark.parametrize("signs", [(1, 1, 1, 1), (-1, 1, -1, -1)])
def test_a_segment_begins_with_the_hand_moved_and_turned(signs: tuple[int, ...]) -> None:
    env, _ = environment("arrows")
    env.reset(seed=0)
    place_m, turned = env.controls.hand_pose(env.servo_targets()[:7])
    move_aside(env, mock.Mock(uniform=mock.Mock(side_effect=[np.array(signs[:3]), signs[3]])))
    then_m, then_turned = env.controls.hand_pose(env.servo_targets()[:7])
    assert np.allclose(then_m - place_m, 0.04 * np.array(signs[:3]), atol=0.004)
    turn = (then_turned @ turned.T)[:2, :2]
    assert np.isclose(np.linalg.det(turn), 1.0, atol=0.002), "it does not tilt"
    assert math.degrees(math.atan2(turn[1, 0], turn[0, 0])) == pytest.approx(15.0 * signs[3], abs=1.0)


@pytest.mark.parametrize(("cubes", "rate_hz"), [(1, 12.5), (2, 62.5), (3, 15.625), (4, 25), (5, 125), (6, 25)])
def test_any_number_of_cubes_is_turned_by_hand(cubes: int, rate_hz: float) -> None:
    """With any number of commands a second, of each kind."""
    world = {"cubes": cubes, "goal": "0" * cubes, "forbid": "none"}
    env, expert = environment("arrows", rate_hz=rate_hz, control=[*CONTROL_NAMES][(cubes + 1) % 4], **world)
    env.reset(seed=0, options={"macrostate": (*(1, 2, 3, 1, 2, 3)[:cubes], 0)})
    for action in (1, 2 * cubes - 2):
        assert [each["macro_action"] for each in carry_out(env, expert, action)] == [action]


@pytest.mark.parametrize("family", FAMILIES)
def test_dense_rewards_sum_to_sparse_ones_less_the_potential(family: str) -> None:
    """Shaping by a potential telescopes, whatever the motion; and a good motion is paid before its event."""
    dense, expert = environment(family, reward="dense")
    sparse, _ = environment(family)
    for env in (dense, sparse):
        env.reset(seed=2, options={"macrostate": {"arrows": (1, 2, 0, 1), "pick_place": (0, 0, 0, 1)}[family]})
    begun = dense.episode.potential
    standing = Potential(dense.world, dense.task.rules)
    assert begun < 0
    paid = np.zeros(2)
    over = False
    early = 0.0
    while not over:
        expert.begin(dense.task.rules.optimal_action(dense.episode.macrostate))
        while not expert.is_done and not over:
            action = expert.act()
            (_, shaped, *_), (_, reward, over, *_) = dense.step(action), sparse.step(action)
            paid += shaped, reward
            dense.world.update()
            assert over or dense.episode.potential == pytest.approx(standing(dense.episode.macrostate), abs=1e-9)
            if dense.episode.events == 0:
                early = max(early, paid[0])
    assert paid[0] == pytest.approx(paid[1] - begun, abs=1e-9)
    assert early > 0.6


@pytest.mark.parametrize("before", range(4))
@pytest.mark.parametrize("sense", [-1, 1])
def test_a_dense_reward_pays_the_way_to_either_next_direction(before: int, sense: int) -> None:
    """A sixth of a quarter turn toward the goal is a sixth of the 0.6 of its potential; one away from it is none."""
    env, _ = environment("arrows", reward="dense", cubes=1, goal=str((before + sense) % 4), forbid="none")
    env.reset(seed=0, options={"macrostate": (before, 0)})
    paid = []
    for turned_deg in (0, -15, 0, 15):
        yaw_rad = math.radians(-90 * before - turned_deg * sense)
        env.data.qpos[env.world.object_qpos[0, 3:]] = about_vertical(yaw_rad)
        paid.append(env.step(np.zeros(7, dtype=np.float32))[1])
    assert paid[1:] == pytest.approx([0.0, 0.0, 0.1], abs=1e-3)


def test_a_dense_reward_pays_the_hands_way_to_the_object_that_is_due() -> None:
    """The cup: 0.3 there, and 1/e of it at 10 cm."""
    env, _ = environment("pick_place", reward="dense")
    env.reset(seed=0, options={"macrostate": (0, 0, 0, 2)})

    def near() -> float:
        return 0.3 * math.exp(-float(np.linalg.norm(hand(env)[0] - env.world.object_poses()[2, :3])) / 0.1)

    paid = []
    for axis in (2, 2, 2, 2, 0, 1):
        before = near()
        paid.append(env.step(-np.eye(7, dtype=np.float32)[axis])[1] - near() + before)
    assert np.abs(paid).max() < 1e-3 and near() > 0.05


@pytest.mark.parametrize("family", FAMILIES)
def test_a_dense_reward_keeps_no_potential_after_a_fault(family: str) -> None:
    """The episode ends in a macrostate from which the rules would go on; the fault costs what it costs, and no more."""
    env, _ = environment(family, reward="dense", **FREE[family])
    env.reset(seed=3, options={"macrostate": STARTS[family]})
    begun = env.episode.potential
    still = np.zeros(7, dtype=np.float32)
    paid = env.step(still)[1]
    assert begun < 0 and not env.task.rules.is_terminal(env.episode.macrostate)
    env.data.qpos[env.world.object_qpos[1, 2]] -= 0.2
    _, reward, terminated, _, info = env.step(still)
    assert terminated and "fell off the table" in info["fault_reason"]
    assert not env.task.rules.is_terminal(env.episode.macrostate)
    assert paid + reward == pytest.approx(FAULT_REWARD - begun, abs=1e-9)


def test_an_object_held_at_the_start_does_not_slip() -> None:
    env, _ = environment("pick_place", slip=0.99)
    closed = np.array([0.0] * 6 + [-1.0])
    for seed in range(3):
        env.reset(seed=seed, options={"macrostate": (1, 0, 0, 1)})
        *_, info = env.step(closed)
        assert env.episode.gripped_m is not None and not env.episode.slipping and not info["fault"]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_grip_that_slips_leaves_the_object_where_it_is(family: str) -> None:
    """Each grip slips or not, as drawn; a slip is no event and no fault, a firm grip is its macro-action."""
    env, expert = environment(family, slip=0.5, **FREE[family])
    slipped = []
    for seed in range(7):
        state = (*STARTS[family][:3], seed % 3)
        action = seed % 6 if family == "arrows" else seed % 3
        env.reset(seed=seed, options={"macrostate": state})
        while env.episode.events == 0:
            expert.begin(action)
            slips = False
            while not expert.is_done:
                *_, info = env.step(expert.act())
                slips |= env.episode.slipping
            expected = state if slips else env.task.rules.outcomes(state, action)[0].macrostate
            assert (tuple(info["macrostate"])[:-1], info["fault"]) == (expected[:-1], False)
            slipped.append(slips)
    assert 9 <= len(slipped) <= 25  # 97 % of seven waits for a firm grip


@pytest.mark.parametrize(
    ("physics", "holds"),
    [({}, True), ({"pad_friction": 0.01}, False), ({"finger_force_n": 0.3}, False), ({"object_mass": 50.0}, False)],
    ids=str,
)
def test_a_grip_is_as_firm_as_its_physics_also_after_a_slip(physics: dict[str, float], *, holds: bool) -> None:
    """Six tries to lift the ball: each is an event unless this grip slips, or no grip holds."""
    env = make_pick_place(observation="proprio", physics=physics, slip=0.5)
    expert = Expert(env)
    env.reset(seed=0, options={"macrostate": STARTS["pick_place"]})
    slipped = []
    events = [0]
    for _ in range(6):
        expert.begin(0)
        slips = False
        while not expert.is_done:
            env.step(expert.act())
            slips |= env.episode.slipping
        slipped.append(slips)
        events.append(env.episode.events)
    assert True in slipped[:-1]
    assert np.diff(events).tolist() == [int(holds and not slips) for slips in slipped]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_measured_slip_is_as_ruled_and_a_weak_grip_is_not(family: str) -> None:
    """Of fingers without force, which move nothing as ruled, those segments alone are right whose grip slips."""

    def right(slip: float, **physics: float) -> tuple[int, int]:
        env = FAMILIES[family](observation="proprio", slip=slip, physics=physics)
        found = measure(env, tries=12, turns=0)
        tries, as_ruled = np.array([each[2:4] for each in found.segments]).T.sum(axis=1)
        assert sum(found.faults.values()) == tries - as_ruled or len(found.faults) == 10, "the ten most frequent"
        assert max(longest_s for *_, longest_s, _ in found.segments) < {"arrows": 2.7, "pick_place": 1.9}[family]
        return int(as_ruled), int(tries)

    all_right, tries = right(0.5)
    assert all_right == tries >= 12
    assert right(0.0, finger_force_n=0.3) == (0, tries)
    slipped, _ = right(0.5, finger_force_n=0.3)
    assert 0 < slipped < tries


@pytest.mark.parametrize("pad_friction", [0.01, 0.5, 2.0])
def test_a_grip_that_slips_never_has_more_friction_than_one_that_holds(pad_friction: float) -> None:
    world = make_pick_place(observation="proprio", physics={"pad_friction": pad_friction}).world
    tips = [index for index in range(world.model.ngeom) if "_tip_" in world.model.geom(index).name]
    firm = world.model.geom_friction[tips, 0].copy()
    world.set_slipping(True)
    assert (world.model.geom_friction[tips, 0] == np.minimum(firm, 0.02)).all()
    world.set_slipping(False)
    assert (world.model.geom_friction[tips, 0] == firm).all()


def test_a_measured_segment_lasts_as_long_as_its_macro_action() -> None:
    """The first try begins where the arm rests, and each later one with the hand moved aside.

    Whole episodes have the seeds 0, 1, 2 and so on, and together at least as many macro-actions as were asked for.
    """
    env, expert = environment("arrows", cubes=1)
    found = measure(env, tries=18, turns=9)
    tables = tabulate(env.task.rules)
    starts = [tables.index[tuple(env.reset(seed=seed)[1]["macrostate"].tolist())] for seed in range(9)]
    done = np.cumsum(shortest_plans(tables)[starts])
    assert found.solved == found.episodes == 1 + np.searchsorted(done, 9) != 1 + np.ceil(9 / done[0])
    sampled = measure(env, tries=4, turns=0)
    assert [(each.pairs, [tries for _, _, tries, *_ in each.segments]) for each in (found, sampled)] == [
        (6, [3] * 6),
        (6, [1] * 4),
    ]
    for number, (objects, action, *_, mean_s, longest_s, ends) in enumerate(found.segments):
        rng = np.random.default_rng([0, number])
        lasted_s = []
        for attempt in range(3):
            env.reset(seed=10_000 * number + attempt, options={"macrostate": (*objects, 0)})
            if attempt:
                move_aside(env, rng)
            began_s = env.data.time
            carry_out(env, expert, action)
            lasted_s.append(env.data.time - began_s)
        assert (mean_s, longest_s) == pytest.approx((np.mean(lasted_s), max(lasted_s)), abs=1e-3)
        assert ends == env.task.rules.outcomes((*objects, 0), action)[0].terminated


def test_lanes_see_as_late_as_each_would_alone() -> None:
    """One has two events, the other none."""
    options = {"observation": "proprio,state", "lag": 1, **FREE["arrows"]}
    lanes = gymnasium.make_vec("imagine_bench/ArrowsMotion-vector-v0", num_envs=2, **options)
    alone = [FAMILIES["arrows"](**options) for _ in range(2)]
    for seed, env in enumerate((lanes, *alone)):
        env.reset(seed=max(0, seed - 1), options={"macrostate": STARTS["arrows"]})
    expert = Expert(alone[1])
    for action in (0, 2):
        expert.begin(action)
        while not expert.is_done:
            actions = np.stack([np.zeros(7, dtype=np.float32), expert.act()])
            seen, *_ = lanes.step(actions)
            own = [env.step(each)[0] for env, each in zip(alone, actions, strict=True)]
            for name, parts in seen.items():
                np.testing.assert_array_equal(parts, [each[name] for each in own])
    assert [env.episode.events for env in alone] == [0, 2]


def hand(env: MotionEnv) -> tuple[Floats, Floats]:
    """Position (3,) in m and rotation matrix (3, 3) of the point between the fingers."""
    site = env.data.site("tcp")
    return site.xpos.copy(), site.xmat.reshape(3, 3).copy()


def test_a_turn_about_the_hand_leaves_its_place() -> None:
    """By hand twist, half a turn a second: a gripped object is not dragged aside."""
    env, _ = environment("arrows")
    env.reset(seed=0)
    before_m, _ = hand(env)
    for sign in [1] * 30 + [-1] * 30:
        env.step(sign * math.pi / 6 * np.eye(7, dtype=np.float32)[5])
        assert np.linalg.norm(hand(env)[0] - before_m) < 0.002


@pytest.mark.parametrize("axis", [2, 5])
def test_the_hand_keeps_to_the_largest_twist(axis: int) -> None:
    """At full speed, down or about the vertical, from rest at the observation pose: the least time assumes this."""
    env, _ = environment("arrows")
    env.reset(seed=0)
    before_m, before = hand(env)
    for period in range(1, 6):
        env.step(-np.eye(7, dtype=np.float32)[axis])
        now_m, now = hand(env)
        assert before_m[2] - now_m[2] <= 1.0 * period * env.period_s + 1e-3
        assert math.acos(min(1.0, (np.trace(before.T @ now) - 1.0) / 2.0)) <= 6.0 * period * env.period_s + 1e-3


@pytest.mark.parametrize(
    ("seed", "start", "action"),
    [(290_004, (0, 3, 1, 2), 5), (450_004, (1, 0, 3, 2), 3), (1_070_007, (2, 3, 1, 1), 5)],
)
def test_the_hand_keeps_to_its_plan_beside_other_cubes(seed: int, start: tuple[int, ...], action: int) -> None:
    """Placements of ``strong`` in which a hand that lags behind its plan touches the next cube."""
    env, expert = environment("arrows", appearance="strong")
    env.reset(seed=seed, options={"macrostate": start})
    (event,) = carry_out(env, expert, action)
    assert (event["macro_action"], event["fault"]) == (action, False)


def test_the_least_time_follows_from_heights_and_largest_twist() -> None:
    env, _ = environment("arrows", **FREE["arrows"])
    down_m = 0.1952 - 0.04 - (-0.1 + 0.055) - 0.022 - 0.01
    turn_s = math.radians(70) / 6.0
    for ways, state in ((2, (1, 2, 3, 0)), (1, (1, 0, 0, 0))):
        assert least_seconds(env, state, 1) == pytest.approx(math.ceil((ways * down_m + turn_s) / 0.04) * 0.04)
    env, _ = environment("pick_place")
    hand_m, ball_m, palm_m = 0.1952, -0.1 + 0.028, -0.1 + 0.055 + 0.028
    for state, action, seconds in (
        ((0, 0, 0, 0), 0, 2 * (hand_m - 0.04 - (ball_m + 0.028) - 0.022 - 0.01)),
        ((1, 0, 0, 2), 0, falling_s(hand_m - ball_m - 0.04 - 0.01)),
        ((1, 0, 0, 3), 3, falling_s(hand_m - palm_m - 0.04 - 0.01)),
    ):
        assert least_seconds(env, state, action) == pytest.approx(math.ceil(seconds / 0.04) * 0.04)


def falling_s(height_m: float) -> float:
    """How long something falls that is thrown down at 1 m/s."""
    return (math.sqrt(1.0 + 2.0 * 9.81 * height_m) - 1.0) / 9.81
