"""World parameters: environments agree with the frequencies of their rules."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from imagine_bench import registry


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
        legal = outcome.success or not outcome.terminated
        assert (reward, terminated, info["legal"]) == (outcome.reward, outcome.terminated, legal) and not info["fault"]
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
