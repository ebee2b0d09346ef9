"""World parameters: the rules worked out by hand, and that environments agree with their frequencies."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from imagine_bench import registry


def chances(outcomes):
    return {each.macrostate: each.probability for each in outcomes}


def test_parameters_of_pick_and_place_by_hand():
    rules = registry.task("pick_place:slip=0.2,fickle=0.4").rules
    table, held, wrong = (0, 0, 0, 1), (0, 1, 0, 3), (1, 0, 0, 4)
    assert chances(rules.outcomes(table, 0)) == pytest.approx(
        {wrong: 0.8, table: 0.12, (0, 0, 0, 0): 0.04, (0, 0, 0, 2): 0.04}
    )
    assert chances(rules.outcomes(table, 1)) == pytest.approx({
        (0, 1, 0, 0): 0.8 / 3, (0, 1, 0, 2): 0.8 / 3, (0, 1, 0, 3): 0.8 / 3,  # each wish as likely as the others
        table: 0.12, (0, 0, 0, 0): 0.04, (0, 0, 0, 2): 0.04,
    })  # fmt: skip
    given = rules.outcomes(held, 3)
    assert chances(given)[0, 2, 0, 3] == pytest.approx(0.8) and sum(each.success for each in given) == 1
    assert {each.reward for each in given} == {5.0, 0.0}
    for state in rules.states:
        for action in range(4):
            found = rules.outcomes(state, action)
            assert sum(each.probability for each in found) == pytest.approx(1.0) and len(chances(found)) == len(found)
            assert all(each.macrostate in rules.states for each in found)
            assert all(rules.judge(state, action, each.macrostate) == each for each in found)


def walk(name, execution, steps):
    """Probability that the rules gave to the outcomes, and to slips and to a human elsewhere, and how often these
    came.
    """
    spec = registry.task(name)
    env = gymnasium.make(spec.env_id, execution=execution, observation="state", disable_env_checker=True)
    rng, found = np.random.default_rng(0), []
    _, info = env.reset(seed=5)
    for _ in range(steps):
        before, action = tuple(info["macrostate"].tolist()), int(rng.integers(spec.n_actions))
        _, reward, terminated, truncated, info = env.step(action)
        after, outcomes = tuple(info["macrostate"].tolist()), spec.rules.outcomes(before, action)
        (outcome,) = [each for each in outcomes if each.macrostate == after]
        assert not info["fault"] and (reward, terminated) == (outcome.reward, outcome.terminated)
        stays = sum(each.probability for each in outcomes if each.macrostate[:-1] == before[:-1])
        answers = sum(each.probability for each in outcomes if each.macrostate[-1] != before[-1])
        found.append((stays, after[:-1] == before[:-1], answers, after[-1] != before[-1]))
        if terminated or truncated:
            _, info = env.reset()
    env.close()
    return np.array(found, dtype=float)


@pytest.mark.parametrize(
    ("name", "execution", "steps"),
    [
        ("arrows:slip=0.2,goal_change=0.3", "kinematic", 600),
        ("pick_place:slip=0.2,goal_change=0.3", "kinematic", 600),
        ("arrows:cubes=2,coupling=neighbour,forbid=none,shuffle=1,slip=0.4,fickle=0.3", "physics", 30),
        ("pick_place:slip=0.4,fickle=0.3", "physics", 30),
    ],
)
def test_what_happens_is_as_often_as_the_rules_say(name, execution, steps):
    """Within 3.5 standard deviations; in physics whatever slips stays, and nothing is a fault."""
    for said, came in walk(name, execution, steps).reshape(steps, 2, 2).transpose(1, 2, 0):
        assert abs(came.sum() - said.sum()) <= 3.5 * np.sqrt((said * (1 - said)).sum())
        assert 0 < came.sum() < steps
