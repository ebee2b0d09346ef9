"""Q-learning and Dyna-Q: the update by hand, convergence to value iteration, chance, snapshots, observations."""

from __future__ import annotations

from typing import Any

import fake_codes
import numpy as np
import pytest
from agent_states import same
from imagine_bench_controls.tabular.agent import ReadState, read_codes, read_macrostate
from imagine_bench_controls.tabular.counts import CountTable
from imagine_bench_controls.tabular.dyna_q import DynaQAgent
from imagine_bench_controls.tabular.settings import DYNA_Q
from imagine_bench_factored.perception import CodePerception

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Observation, Transition
from imagine_bench.seeding import SeedTree

ALWAYS_BY_CHANCE = {"controller.epsilon_min": 1.0, "controller.epsilon_max": 1.0}
CODES = read_codes(CodePerception(fake_codes.FakeCodes(), factored=False))  # type: ignore[arg-type]


def agent(planning: int, *, read: ReadState = CODES, seed: int = 0, **settings: Any) -> DynaQAgent:
    own = {"table.planning_steps": planning, **{name.replace("__", "."): value for name, value in settings.items()}}
    return DynaQAgent(read, fake_codes.ACTIONS, DYNA_Q.resolve("fast", own, "chapter_5"), SeedTree(seed))


def live(learner: DynaQAgent, steps: int, seed: int = 1) -> None:
    """Train on the tiny world of wheels, episodes of at most 6 steps."""
    rng = np.random.default_rng(seed)
    code = fake_codes.starts()[0]
    length = 0
    for _ in range(steps):
        action = learner.act(Observation(frame=fake_codes.frame(code)), explore=True)
        learner.observe(fake_codes.transition(code, action), episode=0)
        (code, _, ended), length = fake_codes.step(code, action), length + 1
        if ended or length == 6:
            code = fake_codes.starts()[int(rng.integers(len(fake_codes.starts())))]
            length = 0


def transition(at: int, action: int, reward: float, then: int, *, terminated: bool = False) -> Transition:
    """Between macrostates (at,) and (then,); frames say nothing."""
    blank = np.zeros((64, 64, 3), dtype=np.uint8)
    seen, following = (Observation(frame=blank, macrostate=np.array([state])) for state in (at, then))
    return Transition(
        observation=seen, action=action, reward=reward, next_observation=following, terminated=terminated,
        truncated=True,
    )  # fmt: skip


def test_q_learning_updates_as_by_hand() -> None:
    """Equation 2.16 with alpha 1/2, gamma 0.8; truncation bootstraps, termination does not."""
    learner = agent(0, read=read_macrostate, table__step_size=0.5, controller__discount=0.8)
    learner.observe(transition(1, 2, 10.0, 2), episode=0)  # 0 + (10 + 0.8 * 0 - 0) / 2 = 5
    learner.observe(transition(0, 3, -1.0, 1), episode=0)  # 0 + (-1 + 0.8 * 5 - 0) / 2 = 1.5
    learner.observe(transition(0, 3, -1.0, 1, terminated=True), episode=0)  # 1.5 + (-1 - 1.5) / 2 = 0.25
    assert learner.q[1].tolist() == [0.0, 0.0, 5.0, 0.0]
    assert learner.q[0].tolist() == [0.0, 0.0, 0.0, 0.25]
    assert set(learner.q) == {0, 1}
    assert learner.diagnostics()["loss/bellman"] == pytest.approx((10.0**2 + 3.0**2 + 2.5**2) / 3)


def test_one_plan_is_one_update_of_a_pair_that_was_tried() -> None:
    learner = agent(3, read=read_macrostate, table__step_size=0.5)
    learner.observe(transition(1, 2, 8.0, 2, terminated=True), episode=0)
    assert learner.q[1].tolist() == [0.0, 0.0, 8.0 - 8.0 / 2**4, 0.0], "one real update and three planned"


def exact_values() -> dict[int, np.ndarray]:
    """Value iteration on the whole world of wheels, discount 0.95, by the code's number."""
    table = CountTable(fake_codes.ACTIONS)
    number = {code: int(np.ravel_multi_index(code, fake_codes.SIZES)) for code in np.ndindex(*fake_codes.SIZES)}
    for code in fake_codes.starts():
        for action in range(fake_codes.ACTIONS):
            following, reward, ended = fake_codes.step(code, action)
            table.add(number[code], action, number[following], reward, ended)
    found = table.action_values(0.95, untried=0.0)
    return {number[code]: found[number[code]] for code in fake_codes.starts()}


def steps_to_exact(planning: int, seed: int) -> int:
    """Real steps of a random walk until every value is within 0.1 of the exact one (a goal is worth 10)."""
    exact = exact_values()
    learner = agent(planning, seed=seed, table__step_size=0.5, **ALWAYS_BY_CHANCE)
    for step in range(10, 20_001, 10):
        live(learner, 10, seed=1000 * seed + step)
        if all(np.abs(learner.q.get(s, np.zeros(4)) - values).max() < 0.1 for s, values in exact.items()):
            return step
    return 20_000


def test_planning_needs_a_third_of_the_real_steps() -> None:
    planned, real = ([steps_to_exact(steps, seed) for seed in range(2)] for steps in (50, 0))
    assert max(real) < 20_000, "both end at value iteration's values"
    assert 3 * np.mean(planned) <= np.mean(real)


def test_what_chance_decides_is_planned_by_its_mean() -> None:
    """One of four tests paid 8: planning goes to the mean 2, not to the last test's 0 nor to 8."""
    learner = agent(400, read=read_macrostate, table__step_size=0.01)
    for reward in (8.0, 0.0, 0.0, 0.0):
        learner.observe(transition(0, 1, reward, 1, terminated=True), episode=0)
    assert learner.q[0][1] == pytest.approx(2.0, abs=0.75)


def test_exploration_draws_among_equals_and_only_those() -> None:
    seen = transition(0, 0, 0.0, 1).observation
    for epsilon, best in ((0.0, [1.0, 0.0, 1.0, 0.0]), (0.6, [0.0, 0.0, 1.0, 0.0])):
        chance = {"controller.epsilon_min": epsilon, "controller.epsilon_max": epsilon}
        learner = agent(0, read=read_macrostate, **chance)
        learner.q[0] = np.array(best)
        taken = np.bincount([learner.act(seen, explore=True) for _ in range(2000)], minlength=4) / 2000
        share = (1 - epsilon) / sum(best) * np.array(best) + epsilon / 4
        np.testing.assert_allclose(taken, share, atol=0.05)
        assert learner.act(seen, explore=False) == np.argmax(best)


def test_each_reading_sees_its_own_state_alone() -> None:
    shown = Observation(frame=fake_codes.frame((2, 1, 0)), macrostate=np.array([3, 1]))
    assert read_macrostate(shown) == 3 + 64 * 1
    assert CODES(shown) == CODES(Observation(frame=shown.frame)) == np.ravel_multi_index((2, 1, 0), (3, 3, 2))
    with pytest.raises(InvalidValueError, match=r"reads the true state, of at most 10 .* was shown none"):
        read_macrostate(Observation(frame=shown.frame))


def test_what_is_learned_after_a_restore_leaves_the_snapshot_as_it_was() -> None:
    learner, resumed, again = agent(5), agent(5, seed=7), agent(5, seed=9)
    live(learner, 40)
    saved = learner.state()
    resumed.restore(saved)
    live(resumed, 40, seed=2)
    again.restore(saved)
    assert same(again.state(), learner.state()) and not same(resumed.state(), learner.state())
