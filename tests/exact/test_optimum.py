"""Optima with and without memory against brute force over histories and policies, and against simulated episodes."""

from __future__ import annotations

import dataclasses
import itertools
from collections import defaultdict
from dataclasses import dataclass

import pytest
from machines import Glimpse, Wheels, spec_of

from imagine_bench import registry
from imagine_bench.exact.certificate import certificate, certificate_rows
from imagine_bench.exact.memoryless import best_without_memory
from imagine_bench.interfaces import Outcome
from imagine_bench.rules import states_of


class _NowAndThen(Glimpse):
    """The finger is shown in the frames of steps 0 and 2 alone."""

    def seen(self, macrostate, step):
        return ((1.0, macrostate if step in (0, 2) else (*macrostate[:-1], -1)),)


WORLDS = {
    "seen": (Wheels(n=2, slip=0.2), Glimpse(), 4),
    "first": (Wheels(n=2, goal_change=0.3), Glimpse(finger="first"), 3),
    "half": (Wheels(n=2, slip=0.1), Glimpse(finger=0.5), 2),
    "now and then": (Wheels(n=2, goal_change=0.3), _NowAndThen(), 4),
    "lag 2": (Wheels(n=2, slip=0.3), Glimpse(lag=2), 5),  # four actions are too few to use a frame so late
    "lag 1, half": (Wheels(n=2, goal_change=0.2), Glimpse(finger=0.5, lag=1), 3),
}
ALL = pytest.mark.parametrize(("rules", "sight", "horizon"), WORLDS.values(), ids=list(WORLDS))


def _best_over_histories(rules, sight, horizon):
    """Expectimax over observations: whole trajectories of macrostates are kept, nothing is merged."""

    def best(trajectories, step):
        if step == horizon:
            return 0.0
        values = []
        for action in range(rules.n_actions):
            won, groups = 0.0, defaultdict(list)
            for states, weight in trajectories:
                for o in rules.outcomes(states[-1], action):
                    if o.terminated:
                        won += weight * o.probability * o.success
                        continue
                    longer = (*states, o.macrostate)
                    frame = max(0, step + 1 - sight.lag)
                    # the frame of the start was seen before; after that each frame is one draw
                    shown = ((1.0, None),) if step + 1 - sight.lag < 1 else sight.seen(longer[frame], frame)
                    for share, what in shown:
                        groups[what].append((longer, weight * o.probability * share))
            values.append(won + sum(best(group, step + 1) for group in groups.values()))
        return max(values)

    groups = defaultdict(list)
    for start in rules.start_states:
        for share, what in sight.seen(start, 0):
            groups[what].append(((start,), share / len(rules.start_states)))
    return sum(best(group, 0) for group in groups.values())


@ALL
def test_the_optimum_with_memory_is_that_of_all_histories(rules, sight, horizon):
    found = certificate(spec_of(rules, horizon, sight))
    assert found.optimum == pytest.approx(_best_over_histories(rules, sight, horizon), abs=1e-9)
    assert found.chance_level <= found.memoryless <= found.memoryless_bound <= found.optimum + 1e-9
    assert found.optimum <= found.seen_optimum + 1e-9


OUT, TRAP = -1, -2


@dataclass(frozen=True)
class _Rooms:
    """Rooms with two doors each, each to another room, out or into a trap; one starts in any of ``starts``."""

    doors: tuple[tuple[int, int], ...]
    starts: tuple[int, ...]
    slip: float = 0.0  #: one goes through the other door
    parts: int = 1  #: so many outcomes, alike and equally probable, of each

    n_actions, states = 2, None

    @property
    def start_states(self):
        return tuple((room,) for room in self.starts)

    def outcomes(self, state, action):
        found = []
        for share, door in ((1 - self.slip, action), (self.slip, 1 - action)):
            to = self.doors[state[0]][door]
            done = to == OUT
            room = to if to >= 0 else state[0]
            outcome = Outcome(share / self.parts, (room,), float(done), terminated=to < 0, success=done)
            found += [outcome] * (self.parts if share else 0)
        return tuple(found)

    def is_terminal(self, state):
        return False


CORRIDOR = _Rooms(((OUT, 1), (0, 2), (1, 3), (2, 4), (3, TRAP)), (1, 2, 3))
EARLY = _Rooms(((2, 2), (OUT, 2), (3, 0), (2, 1)), (0, 1, 2))
LATE = _Rooms(((OUT, 3), (2, 1), (1, 0), (0, 0)), (0, 1, 2))


class _Wall:
    """Only the end rooms can be told."""

    lag = 0

    def seen(self, macrostate, step):
        return ((1.0, (macrostate[0] if macrostate[0] in (0, 4) else -1,)),)


class _Lit(Glimpse):
    """Every room is seen, but late."""

    def seen(self, macrostate, step):
        return ((1.0, macrostate),)


TINY = {
    "walls": (CORRIDOR, _Wall(), 5),
    "late": (CORRIDOR, _Lit(lag=1), 4),
    "later": (EARLY, _Lit(lag=2), 5),
    "slipping": (dataclasses.replace(CORRIDOR, slip=0.2), _Wall(), 6),
    "solved if no later": (EARLY, _Lit(lag=1), 5),
    "solved if later": (LATE, _Lit(lag=1), 5),
    "in halves": (dataclasses.replace(CORRIDOR, slip=0.2, parts=2), _Wall(), 6),
    "late, in halves": (dataclasses.replace(LATE, parts=2), _Lit(lag=1), 5),
    "wheel": (Wheels(n=1, slip=0.3), Glimpse(finger=0.5, lag=1), 3),
}


@pytest.mark.parametrize(("rules", "sight", "horizon"), TINY.values(), ids=list(TINY))
def test_without_memory_no_policy_of_all_is_better(rules, sight, horizon):
    found = best_without_memory(rules, sight, horizon, bound=1.0)
    things = sorted({what for s in states_of(rules) for step in (0, 9) for _, what in sight.seen(s, step)})
    policies = itertools.product(range(rules.n_actions), repeat=len(things))
    best = max(_value(rules, sight, horizon, dict(zip(things, policy, strict=True))) for policy in policies)
    assert found.value == pytest.approx(best, abs=1e-9)
    assert found.bound == pytest.approx(best, abs=1e-6)


def _value(rules, sight, horizon, policy):
    """Success of a policy without memory, by recursion over all that may happen."""

    def from_here(states, shown, step):
        if step == horizon:
            return 0.0
        value = 0.0
        for o in rules.outcomes(states[-1], policy[shown]):
            longer, frame = (*states, o.macrostate), step + 1 - sight.lag
            if o.terminated:
                value += o.probability * o.success
            elif frame < 1:
                value += o.probability * from_here(longer, shown, step + 1)
            else:
                frames = sight.seen(longer[frame], frame)
                value += o.probability * sum(share * from_here(longer, what, step + 1) for share, what in frames)
        return value

    starts = rules.start_states
    return sum(q * from_here((s,), what, 0) for s in starts for q, what in sight.seen(s, 0)) / len(starts)


def test_what_needs_no_memory_is_said_of_the_thesis_puzzle():
    """A walk round the legal arrangements passes a goal within ten turns, whoever was pointed at."""
    spec = registry.task("arrow_puzzle")
    found = best_without_memory(spec.rules, Glimpse(finger="first"), spec.horizon, bound=1.0)
    assert found.value == pytest.approx(1.0)
    short = best_without_memory(spec.rules, Glimpse(finger="first"), 5, bound=1.0)
    assert short.value < 0.95


def test_too_many_beliefs_leave_a_bound_and_say_so(monkeypatch):
    monkeypatch.setattr("imagine_bench.exact.beliefs.MOST", 5)
    found = certificate(spec_of(Wheels(n=2, goal_change=0.3), 3, Glimpse(finger="first")))
    assert found.beliefs is None and found.optimum == found.seen_optimum


def test_a_policy_that_was_not_searched_has_no_success(monkeypatch):
    monkeypatch.setattr("imagine_bench.exact.memoryless.MOST", 1)
    rows = certificate_rows(certificate(spec_of(Wheels(n=2, slip=0.1), 3, Glimpse(finger="first"))))
    assert rows["without memory"].startswith("none found; only proved to be at most ")


def test_remarks_of_the_solver_are_no_output(capfd):
    """HiGHS prints them whatever it is told; standard output is that of tables and of servers."""
    spec = registry.task("pick_place:goal_change=0.1,lag=1")
    best_without_memory(spec.rules, spec.sight, spec.horizon, bound=1.0)
    print("a table", flush=True)
    said = capfd.readouterr()
    assert said.out == "a table\n"
    assert "HighsMipSolverData" in said.err, "it has learned to be silent: no need to put its remarks aside"
