"""Worlds of the family against a second statement of their rules, which shares no code with the first."""

from __future__ import annotations

import functools
import itertools

import pytest

from imagine_bench import registry

WORLDS = [
    "arrow_puzzle",
    "arrow_puzzle_hard",
    "arrow_puzzle_clockwise",
    "arrow_puzzle_toward",
    "arrow_puzzle_easy",
    "arrows:cubes=2,fickle=0.5",
    "arrows:slip=0.2",
    "arrows:forbid=agent",
    "arrows:goal=toward_agent,forbid=neighbours",
    "arrows:goal=all,forbid=none,coupling=neighbour,shuffle=5",
    "arrows:goal=012,slip=0.1,fickle=0.3",
    "arrows:cubes=4,goal=toward_agent,fickle=1",
    "arrows:cubes=4,goal=clockwise,forbid=neighbours+agent",
    "arrows:cubes=4,goal=3210,coupling=neighbour,slip=0.4",
]


def status(world, directions, pointed):
    """``"illegal"``, ``"goal"`` or ``"going on"``."""
    n = len(directions)
    alike = {frozenset((i, j)) for i, j in itertools.combinations(range(n), 2) if directions[i] == directions[j]}
    forbidden = world.forbid.split("+")
    if ("equal" in forbidden and alike) or any(
        "neighbours" in forbidden and frozenset((i, i + 1)) in alike for i in range(n)
    ):
        return "illegal"
    human, agent = directions.count(0), directions.count(2)
    own = directions[pointed]
    reached = {
        "pointed": own == 0,
        "toward_agent": own == 2,
        "clockwise": own == 3 and human == 0,
        "all": human == n,
    }.get(world.goal, "".join(map(str, directions)) == world.goal)
    return "goal" if reached and not ("agent" in forbidden and agent) else "going on"


def after(world, directions, pointed, turns):
    """Probability of each state ``(directions, pointed)`` after turns, and whether the episode ends there."""
    turned = tuple((value + sum(1 if turn.clockwise else 3 for turn in turns if turn.cube == cube)) % 4
                   for cube, value in enumerate(directions))  # fmt: skip
    chances = {}
    for reached, chance in ((turned, 1 - world.slip), (directions, world.slip)):
        others = [cube for cube in range(len(directions)) if cube != pointed]
        changes = world.goal_change if status(world, reached, pointed) == "going on" else 0.0
        for cube in range(len(directions)):
            share = changes / len(others) if cube in others else 1 - changes
            if chance * share > 0:
                chances[reached, cube] = chances.get((reached, cube), 0.0) + chance * share
    return chances


@functools.cache
def oracle(world):
    """All states with their status, where turns lead, and from which a goal is reached, by search."""
    pairs = list(itertools.product(itertools.product(range(4), repeat=world.cubes), range(world.cubes)))
    found = {pair: status(world, *pair) for pair in pairs}
    leads = {(pair, action): after(world, *pair, turns)
             for pair in pairs for action, turns in enumerate(world.turns)}  # fmt: skip
    before = {}
    for pair in pairs:
        for turns in world.turns:
            ((reached, _),) = [each for each in after(_still(world), *pair, turns) if each[1] == pair[1]]
            if found[pair] == "going on":
                before.setdefault((reached, pair[1]), []).append(pair)
    queue = [pair for pair in pairs if found[pair] == "goal"]
    depth = dict.fromkeys(queue, 0)
    for pair in queue:  # grows
        for earlier in before.get(pair, ()):
            if earlier not in depth:
                depth[earlier] = depth[pair] + 1
                queue.append(earlier)
    return found, leads, depth


def _still(world):
    return type(world)(cubes=world.cubes, coupling=world.coupling)


@pytest.mark.parametrize("name", WORLDS)
def test_rules_say_what_the_oracle_says(name):
    spec = registry.task(name)
    found, leads, depth = oracle(spec.rules.world)
    rewards = {"illegal": -5.0, "goal": 50.0, "going on": -1.0}
    assert set(spec.rules.states) == {(*directions, pointed) for directions, pointed in found}
    for pair, what in found.items():
        state = (*pair[0], pair[1])
        assert (spec.rules.is_legal(state), spec.rules.is_terminal(state)) == (what != "illegal", what != "going on")
        for action in range(spec.n_actions):
            outcomes = {each.macrostate: each for each in spec.rules.outcomes(state, action)}
            expected = {(*reached, cube): chance for (reached, cube), chance in leads[pair, action].items()}
            assert {reached: each.probability for reached, each in outcomes.items()} == pytest.approx(expected)
            for reached, each in outcomes.items():
                then = found[reached[:-1], reached[-1]]
                assert each.reward == spec.rules.judge(state, action, reached).reward == rewards[then]
                assert (each.terminated, each.success) == (then != "going on", then == "goal")
    starts = {(*directions, pointed): length for (directions, pointed), length in depth.items() if length}
    assert set(spec.rules.start_states) == set(starts)
    known = dict(zip(spec.rules.states, spec.rules.plan_lengths.tolist(), strict=True))
    assert {state: known[state] for state in starts} == starts
    named = spec.rules.world.horizon
    assert spec.horizon == (named or max(10, 2 * max(starts.values())))
