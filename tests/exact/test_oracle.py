"""The registered oracle in real environments against the optimum that the world's certificate states."""

from __future__ import annotations

from collections import defaultdict
from contextlib import closing

import gymnasium
import numpy as np
import pytest
from machines import Glimpse, Wheels

import imagine_bench  # noqa: F401  (registers the environments)
from imagine_bench import registry
from imagine_bench.exact.beliefs import BeliefRules, OptimalPolicy, optimal_policy_of
from imagine_bench.exact.certificate import optimum
from imagine_bench.interfaces import AgentContext
from imagine_bench.rules import horizon_optimum, tabulate
from imagine_bench.running.evaluation import play
from imagine_bench.seeding import SeedTree

EPISODES = 120
WORLDS = (
    "arrows:forbid=none,lag=1",
    "arrows:slip=0.4,horizon=4",
    "arrows:fickle=0.5,horizon=4",
    "pick_place:gesture=0.5",
    "pick_place:slip=0.2",
)


def _oracle(spec):
    context = AgentContext(
        n_actions=spec.n_actions, preprocessing=spec.preprocessing, encoder=None, seeds=SeedTree(0),
        optimal_policy=optimal_policy_of(spec),
    )  # fmt: skip
    return registry.make_agent("oracle", context)


def _successes(spec, agent, episodes):
    entry = registry.task_entry(spec.id)
    with closing(gymnasium.make(entry.env_id, execution="kinematic", disable_env_checker=True)) as env:
        for index in range(episodes):
            *_, (_, info) = play(env, agent, seed=1000 + index, explore=False, privileged=True)
            yield bool(info["is_success"])


@pytest.mark.parametrize("name", WORLDS)
def test_the_oracle_reaches_what_the_certificate_says(name):
    spec = registry.task(name)
    p = optimum(spec)
    share = np.mean(list(_successes(spec, _oracle(spec), EPISODES)))
    assert abs(share - p) <= 3.3 * np.sqrt(max(p * (1 - p), 1e-3) / EPISODES)


@pytest.mark.parametrize("name", ["arrows:lag=2", "pick_place:gesture=0.5,lag=1"])
def test_what_is_shown_is_possible_by_the_sight(name):
    """Every episode's frames, late or hiding, are among those that the belief machine expects."""
    spec, rng = registry.task(name), np.random.default_rng(3)
    beliefs = BeliefRules(spec.rules, spec.sight, spec.horizon)
    hidden = late = 0
    with closing(gymnasium.make(spec.env_id, execution="kinematic", disable_env_checker=True)) as env:
        for seed in range(20):
            _, info = env.reset(seed=seed)
            belief, over = beliefs.starts[tuple(info["shown"].tolist())][1], False
            while not over:
                action = int(rng.integers(spec.n_actions))
                _, _, terminated, truncated, info = env.step(action)
                over = terminated or truncated
                shown = tuple(info["shown"].tolist())
                hidden, late = hidden + (-1 in shown), late + (shown[:-1] != tuple(info["macrostate"].tolist())[:-1])
                if not terminated:
                    belief = beliefs.follow(belief, action, shown)
                    assert belief is not None
                    assert tuple(info["macrostate"].tolist()) in {windows[-1] for windows, _ in belief[1]}
    assert late and (hidden or "gesture" not in name)


@pytest.mark.parametrize("sight", [Glimpse(finger="first"), Glimpse(finger=0.5, lag=1)], ids=str)
def test_what_the_oracle_knew_of_an_episode_is_forgotten_in_the_next(sight):
    """It acts as one does that begins with this episode."""
    rules, horizon, rng = Wheels(n=2, goal_change=0.3), 3, np.random.default_rng(0)
    used, longest = OptimalPolicy(rules, sight, horizon), 0
    for _ in range(15):
        fresh = OptimalPolicy(rules, sight, horizon)
        states = [rules.start_states[rng.integers(len(rules.start_states))]]
        for step in range(horizon):
            frame = max(0, step - sight.lag)
            if step == 0 or frame > 0:
                shares, frames = zip(*sight.seen(states[frame], frame), strict=True)
                seen = frames[rng.choice(len(frames), p=shares)]
            action = used(seen, step)
            assert action == fresh(seen, step)
            outcomes = rules.outcomes(states[-1], action)
            outcome = outcomes[rng.choice(len(outcomes), p=[each.probability for each in outcomes])]
            longest = max(longest, step)
            if outcome.terminated:
                break
            states.append(outcome.macrostate)
    assert longest == horizon - 1


@pytest.mark.parametrize("lag", [1, 2])
def test_with_too_many_beliefs_it_votes(monkeypatch, lag):
    """Each macrostate that may be now for the macro-action that is best there, by its probability."""
    monkeypatch.setattr("imagine_bench.exact.beliefs.MOST", 3)
    rules, horizon = Wheels(slip=0.3), 4
    policy = OptimalPolicy(rules, Glimpse(lag=lag), horizon)
    tables = tabulate(rules)
    best = horizon_optimum(tables, horizon).actions[horizon - lag - 1]
    apart = 0
    for start in rules.start_states:
        chances = {start: 1.0}
        for step in range(lag):
            action = policy(start, step)  # of the start alone, which frames go on to show
            reached = defaultdict(float)
            for state, chance in chances.items():
                for each in rules.outcomes(state, action):
                    reached[each.macrostate] += 0.0 if each.terminated else chance * each.probability
            chances = reached
        votes = np.zeros(rules.n_actions)
        for state, chance in chances.items():
            votes[best[tables.index[state]]] += chance
        if np.sort(votes)[-2] < votes.max() - 1e-9:
            apart += votes.argmax() != best[tables.index[start]]
            assert policy(start, lag) == votes.argmax()
    assert apart > 10


@pytest.mark.parametrize("lag", [0, 2])
def test_after_a_frame_that_cannot_be_it_goes_on_from_what_is_seen(lag):
    """As if that had stood there for long. No macro-action turns all wheels."""
    rules, horizon = Wheels(), 8
    tables = tabulate(rules)
    best = horizon_optimum(tables, horizon).actions
    policy, latest = OptimalPolicy(rules, Glimpse(lag=lag), horizon), 0
    for start in rules.start_states:
        policy(start, 0)
        now = state = (*((each + 1) % 4 for each in start[:-1]), start[-1])
        for step in range(1, 2 if lag == 0 else 6):
            if rules.is_terminal(now):
                break
            action = policy(state if step > lag else start, step)
            if step > lag:
                assert action == best[7 - step, tables.index[now]]
                (outcome,) = rules.outcomes(now, action)
                now = outcome.macrostate
                latest = max(latest, step)
    assert latest == (5 if lag else 1)
