"""The lower bound against every adaptive strategy in every world of tiny classes."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from itertools import product

import pytest

from imagine_bench.exact.bound import lower_bound
from imagine_bench.exact.factors import factor_graph, machine
from imagine_bench.interfaces import Outcome, State

HORIZON = 3
World = dict[int, bool]
"""At each place of play, whether the names of both actions are exchanged."""


class Places:
    """Places in a row or a ring; the actions go down and up, and the ends of the episode are told by place."""

    n_actions = 2

    def __init__(self, starts: Iterable[int], goals: set[int], pits: set[int], around: int) -> None:
        self.start_states = [(start,) for start in starts]
        self.goals = goals
        self.pits = pits
        self.around = around

    def step(self, place: int, action: int) -> int:
        return (place + (1 if action else -1)) % self.around

    def outcomes(self, state: State, action: int) -> list[Outcome]:
        after = self.step(state[0], action)
        success = after in self.goals
        ended = success or after in self.pits
        return [Outcome(probability=1.0, macrostate=(after,), reward=float(success), terminated=ended, success=success)]


ROW = Places(starts=(1, 2, 3), goals={4}, pits={0}, around=9)
RING = Places(starts=(1, 2, 3), goals={0}, pits=set(), around=4)
SHORT = Places(starts=(1, 2), goals={3}, pits={0}, around=9)
TINY = {"row": ROW, "ring": RING, "short row": SHORT}


def bound(world: Places, share: float = 0.95) -> int:
    full = machine(world)  # type: ignore[arg-type]
    return lower_bound(full, factor_graph(full), HORIZON, share)


def go(places: Places, world: World, place: int, name: int) -> int:
    """The next place in a world where some places have exchanged names."""
    return places.step(place, name ^ world[place])


def solves(places: Places, world: World, policy: dict[int, int], place: int) -> bool:
    for _ in range(HORIZON):
        place = go(places, world, place, policy[place])
        if place in places.goals | places.pits:
            return place in places.goals
    return False


def best_policy(places: Places, worlds: list[World]) -> float:
    """The mean success of the best policy without memory, added over worlds."""
    starts = [start for (start,) in places.start_states]
    policies = [dict(zip(starts, names, strict=True)) for names in product((0, 1), repeat=len(starts))]
    solved = [sum(solves(places, world, each, s) for world in worlds for s in starts) for each in policies]
    return max(solved) / len(starts)


def best_after(places: Places, transitions: int) -> float:
    """The mean success of the best learner after so many transitions: over all adaptive strategies and policies."""
    starts = [start for (start,) in places.start_states]
    worlds = [dict(zip(starts, swapped, strict=True)) for swapped in product((False, True), repeat=len(starts))]

    @cache
    def tested(possible: tuple[int, ...]) -> float:
        return best_policy(places, [worlds[i] for i in possible])

    @cache
    def after(possible: tuple[int, ...], place: int, name: int, left: int, of_episode: int) -> float:
        """The value of an action: each place that it leads to rules out the worlds in which it does not."""
        leads_to = {i: go(places, worlds[i], place, name) for i in possible}
        value = 0.0
        for following in set(leads_to.values()):
            agree = tuple(i for i in possible if leads_to[i] == following)
            ends = following in places.goals | places.pits or of_episode == 1
            value += learned(agree, None if ends else following, left - 1, of_episode - 1)
        return value

    @cache
    def learned(possible: tuple[int, ...], place: int | None, left: int, of_episode: int) -> float:
        if not left:
            return tested(possible)
        if place is None:
            return sum(learned(possible, start, left, HORIZON) for start in starts) / len(starts)
        return max(after(possible, place, name, left, of_episode) for name in (0, 1))

    return learned(tuple(range(len(worlds))), None, transitions, HORIZON) / len(worlds)


@pytest.mark.parametrize("places", TINY.values(), ids=TINY)
@pytest.mark.parametrize("share", [0.6, 0.8, 0.95])
def test_no_strategy_is_as_good_with_fewer_transitions(places: Places, share: float) -> None:
    fewest = bound(places, share)
    optimum = best_after(places, 20)
    assert optimum == 1.0
    assert all(best_after(places, count) < share for count in range(fewest))


def test_a_bound_by_hand() -> None:
    """In the row each place must be known; in the ring a wrong guess still leaves a way of three steps to the goal."""
    assert bound(ROW) == 3
    assert bound(ROW, share=0.8) == 2
    assert bound(SHORT) == 2
    assert bound(SHORT, share=0.7) == 0, "one guess in two leaves 75 %"
    assert bound(RING) == 0
    wide = Places(starts=range(1, 100), goals={100}, pits={0}, around=200)
    assert bound(wide, share=0.0) == 0, "also where there are more sets of unknown places than are tried"
