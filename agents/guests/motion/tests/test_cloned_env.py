"""Macro-actions that a clone carries out: the rules judge them, and any agent of macro-actions can act."""

from __future__ import annotations

import functools
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from imagine_bench.tasks.scenes.arm import FINGER_JOINTS
from imagine_bench_motion.cloned_env import BUNDLED, CloneExecutedEnv, ControlPeriod, carry_out
from imagine_bench_motion.cloning import Clone
from imagine_bench_motion.instruction import GO_BACK
from imagine_bench_motion.levels import make_agent
from imagine_bench_motion.skills import HOME_COMMAND
from imagine_bench_motion.trials import MOST_PERIODS
from scripted_clone import ScriptedClone

from imagine_bench.errors import InvalidValueError
from imagine_bench.judge.causes import Attribution, lived_again
from imagine_bench.registry import task, task_entry
from imagine_bench.rules import states_of
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.store.results import PolicyTable

START = (1, 2, 3, 0)


@functools.cache
def environment() -> CloneExecutedEnv:
    return CloneExecutedEnv()


def test_the_bundled_clone_sees_no_macrostate_and_is_small() -> None:
    clone = Clone.load(BUNDLED)
    assert set(clone.observation.split(",")) <= {"hand", "front", "proprio"}
    assert clone.parameters <= 2_000_000


def test_a_clone_sees_images_of_its_own_size() -> None:
    clone = Clone.load(BUNDLED)
    clone.about["size_px"] = 96
    assert CloneExecutedEnv(clone=clone).motion.observation_space["front"].shape == (96, 96, 3)


def test_a_clone_that_does_not_feel_its_arm_is_refused() -> None:
    clone = Clone.load(BUNDLED)
    for seen in ("proprio", "front,state"):
        clone.about["observation"] = seen
        with pytest.raises(InvalidValueError, match=f"The clone sees {seen}; give one that sees proprio, and more"):
            CloneExecutedEnv(clone=clone)


def test_the_clone_turns_the_cube_of_its_instruction() -> None:
    """And its arm ends where it began, with open fingers."""
    env = environment()
    rules = task("arrow_puzzle").rules
    done = 0
    for action in range(6):
        env.reset(seed=action, options={"macrostate": START})
        joints_rad = env.motion.data.qpos[:7].copy()
        _, reward, terminated, truncated, info = env.step(action)
        assert not truncated
        np.testing.assert_allclose(env.motion.data.qpos[:7], joints_rad, atol=5e-3)
        assert min(env.motion.data.joint(name).qpos[0] for name in FINGER_JOINTS) > 0.04
        if info["done"]:
            (expected,) = rules.outcomes(START, action)
            done += 1
            assert tuple(info["macrostate"]) == expected.macrostate
            assert (reward, terminated, info["is_success"]) == (expected.reward, expected.terminated, expected.success)
            assert 1.0 < info["sim_time_s"] < 4.5
    assert done >= 4


@pytest.mark.parametrize(
    ("event", "home", "over", "lasts"),
    [
        (0, 0, 0, {"turn": MOST_PERIODS, GO_BACK: 12, "home": 25}),
        (40, 55, 0, {"turn": 40, GO_BACK: 12, "home": 3}),
        (40, 30, 0, {"turn": 40, GO_BACK: 12, "home": 25}),
        (0, 0, 10, {"turn": 10}),
        (40, 0, 45, {"turn": 40, GO_BACK: 5}),
        (40, 0, 54, {"turn": 40, GO_BACK: 12, "home": 2}),
    ],
)
def test_a_skill_lasts_to_its_event_then_lifts_the_hand_and_goes_home(
    event: int, home: int, over: int, lasts: dict[str, int]
) -> None:
    """The periods of each part, where an event, an arm at home or the end comes after so many in all; 0: never."""
    told: list[str] = []
    clone: Any = SimpleNamespace(begin=lambda words: setattr(clone, "act", lambda seen: words))

    def period(command: Any) -> ControlPeriod:
        told.append(command if isinstance(command, str) else "home")
        joints_rad = HOME_COMMAND[:-1] + 0.01 * (len(told) != home)
        return ControlPeriod({"proprio": joints_rad}, len(told) == event, len(told) == over)

    last = carry_out(clone, "turn", {}, period)
    assert Counter(told) == lasts and last.over == (over > 0)


def test_a_macro_action_that_turns_nothing_counts_as_one_that_slipped() -> None:
    env = CloneExecutedEnv(clone=ScriptedClone())
    env.reset(seed=0, options={"macrostate": START})
    _, reward, terminated, truncated, info = env.step(2)
    assert (reward, terminated, truncated) == (-1.0, False, False)
    assert tuple(info["macrostate"]) == START and not info["done"] and not info["fault"]


def test_why_names_motor_failure_where_a_skill_turns_nothing() -> None:
    spec = replace(task("arrow_puzzle_cloned"), horizon=6)
    rules = spec.rules
    states = states_of(rules)
    everything = np.array([[*state, action] for state in states for action in range(rules.n_actions)])
    optimal = [0 if rules.is_terminal(state) else rules.optimal_action(state) for state in states]
    held = PolicyTable(action=np.array(optimal, dtype=np.int16), model=None)
    attribution = Attribution(spec, held, everything, np.ones(len(states), dtype=np.bool_))
    env = CloneExecutedEnv(clone=ScriptedClone())
    for seed in (3, 4):
        _, info = env.reset(seed=seed)
        action = optimal[states.index(tuple(info["macrostate"].tolist()))]
        happened = lived_again(env, make_agent("random", spec, 0), rules, seed, [action] * spec.horizon)
        assert all(happened.faults)
        assert attribution.cause(happened) == "execution"


def test_equal_seeds_give_equal_episodes() -> None:
    env = environment()
    found = []
    for _ in range(2):
        first, _ = env.reset(seed=9)
        second, reward, *_, info = env.step(1)
        found.append((first.tobytes(), second.tobytes(), reward, info["macrostate"].tobytes()))
    assert found[0] == found[1]


@pytest.mark.slow
def test_gymnasiums_checker_passes() -> None:
    check_env(CloneExecutedEnv(clone=ScriptedClone()), skip_render_check=True)


def test_another_execution_reward_or_macro_action_is_refused() -> None:
    """A dense reward would be that of the period of its event alone.

    With ``told`` no frame shows the goal, and an agent of macro-actions is told no words.
    """
    decided = "frames show the goal; leave out"
    for option, value, why in (
        ("execution", "dense", "in physics; execution='dense'"),
        ("reward", "dense", "as the rules say; leave out reward"),
        ("told", True, f"{decided} told"),
        ("family", "pick_place", f"{decided} family"),
        ("control", "twist", f"{decided} control"),
        ("observation", "human", f"{decided} observation"),
    ):
        with pytest.raises(InvalidValueError, match=why):
            CloneExecutedEnv(**{option: value})
    for action in (6, 1.5, None):
        with pytest.raises(InvalidValueError, match="from 0 to 5"):
            environment().step(action)
    with pytest.raises(InvalidValueError, match=r"call reset\(\) first"):
        CloneExecutedEnv(clone=environment().clone).step(0)


def test_another_horizon_than_that_of_the_task_is_refused() -> None:
    """Gymnasium would go on ending episodes after ten macro-actions."""
    env_id = task("arrow_puzzle_cloned").env_id
    env = gymnasium.make(env_id, horizon=3, disable_env_checker=True)
    with pytest.raises(InvalidValueError, match="ends after 10 macro-actions, so leave out horizon=3"):
        env.reset(seed=0)


def test_a_dataset_of_cloned_macro_actions_names_the_task_that_tells_no_motion() -> None:
    cloned = task("arrow_puzzle_cloned")
    oracle = policy_of("oracle", cloned, 0)
    with pytest.raises(InvalidValueError, match=r"^Task arrow_puzzle_cloned tells no motion of its arm; leave --"):
        collect(cloned, oracle, episodes=1, seed=0, execution="physics", appearance="clean", motion_hz=25.0)


def test_the_bench_knows_the_task_with_the_rules_of_the_arrow_puzzle() -> None:
    cloned, puzzle = task("arrow_puzzle_cloned"), task("arrow_puzzle")
    assert task_entry("arrow_puzzle_cloned").env_id == cloned.env_id
    assert cloned.rules is puzzle.rules and cloned.encoder == puzzle.encoder
