"""The best deterministic policy without memory: one action for each thing that a frame can show.

A mixed-integer programme over occupancies: ``x[t, w, a]`` is the probability of doing ``a`` in ``w`` after ``t``
macro-actions, where ``w`` is the macrostates whose frames are still to come and the one that is shown now; ``p[o, a]``
in {0, 1} is the policy, and ``x[t, w, a] <= u[t, w] p[o(w), a]`` with ``u`` a bound on how probable ``w`` can be made.
HiGHS solves it by branch and bound; its solution is then improved one action at a time.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from imagine_bench.arrays import Floats, Ints
from imagine_bench.interfaces import ObservationModel, Rules, State

_Seen = tuple[tuple[State, ...], State]
"""The macrostates whose frames are still to come, the newest last, and the one that is shown now."""
MOST = 30_000
SOLVED = 8_000
"""Occupancies up to which a policy is looked for, and up to which the programme is solved."""
NODES = 20
_GAIN = 1e-7
_STDOUT, _STDERR = 1, 2


@dataclass(frozen=True, kw_only=True)
class Memoryless:
    """The success probability of the best policy found, and a bound that no other can exceed."""

    value: float
    bound: float


@dataclass(frozen=True, kw_only=True)
class _Layer:
    """The possible situations after t macro-actions."""

    most: dict[_Seen, float]  # the largest probability that it can be given; at the start the only one
    links: dict[tuple[_Seen, int], list[tuple[float, _Seen]]]  # by (situation, action): where the episode goes on
    wins: dict[tuple[_Seen, int], float]


@dataclass(frozen=True, kw_only=True)
class _Table:
    """A layer as arrays: N situations, A actions, at most W continuations of each."""

    first: Floats  # the largest probabilities. Shape (N,)
    shown: Ints  # the number of the observation in each situation. Shape (N,)
    then: Ints  # where the episode goes on. Shape (N, A, W)
    share: Floats  # with these probabilities, 0 for places that are not used. Shape (N, A, W)
    wins: Floats  # Shape (N, A)
    following: int  # situations of the next layer


def _layers(rules: Rules, sight: ObservationModel, horizon: int) -> Iterator[_Layer]:
    most: dict[_Seen, float] = defaultdict(float)
    for start in rules.start_states:
        for share, shown in sight.seen(start, 0):
            most[(start,), shown] += share / len(rules.start_states)
    for step in range(horizon):
        links: dict[tuple[_Seen, int], list[tuple[float, _Seen]]] = {}
        wins: dict[tuple[_Seen, int], float] = {}
        after: dict[_Seen, float] = defaultdict(float)
        for now, weight in most.items():
            reached: dict[_Seen, float] = defaultdict(float)
            for action in range(rules.n_actions):
                links[now, action] = list(_next(rules, sight, now, action, step))
                outcomes = rules.outcomes(now[0][-1], action)
                wins[now, action] = sum(o.probability for o in outcomes if o.terminated and o.success)
                total: dict[_Seen, float] = defaultdict(float)  # several outcomes may lead to one place
                for share, then in links[now, action]:
                    total[then] += share
                for then, share in total.items():
                    reached[then] = max(reached[then], share)
            for then, share in reached.items():
                after[then] += weight * share
        yield _Layer(most=most, links=links, wins=wins)
        most = {then: min(weight, 1.0) for then, weight in after.items()}


def _next(rules: Rules, sight: ObservationModel, now: _Seen, action: int, step: int) -> Iterator[tuple[float, _Seen]]:
    window, shown = now
    frame = step + 1 - sight.lag
    for outcome in rules.outcomes(window[-1], action):
        if outcome.terminated:
            continue
        longer = (*window, outcome.macrostate) if sight.lag and step else (outcome.macrostate,)
        if frame < 1:
            yield outcome.probability, (longer, shown)
        else:
            for share, what in sight.seen(longer[0], frame):
                yield outcome.probability * share, (longer[1:] if sight.lag else longer, what)


def best_without_memory(rules: Rules, sight: ObservationModel, horizon: int, *, bound: float) -> Memoryless:
    """Solve the programme, or say after :data:`NODES` of the search the best policy found and the bound proved.

    ``bound`` is the optimum with memory: a policy without it that reaches it is the best, and where the programme is
    too large, no other bound is proved. A value of 0 says that none was looked for.
    """
    layers: list[_Layer] = []
    for layer in _layers(rules, sight, horizon):
        layers.append(layer)
        if sum(len(each.links) for each in layers) > MOST:
            return Memoryless(value=0.0, bound=bound)
    choices = _choices(layers)
    value = _climb(layers, choices, {})
    if value < bound - _GAIN and sum(len(each.links) for each in layers) <= SOLVED:
        policy, proved = _solve(layers, choices)
        value = max(value, _climb(layers, choices, policy))
        bound = min(bound, proved)
    return Memoryless(value=value, bound=float(max(bound, value)))


def _climb(layers: list[_Layer], choices: dict[tuple[State, int], int], policy: dict[State, int]) -> float:
    """Change a policy, one action at a time, while that helps; its value then."""
    numbers = {shown: number for number, shown in enumerate(dict.fromkeys(shown for shown, _ in choices))}
    usual = {shown: action for shown, action in reversed(choices)}
    chosen = np.array([policy.get(shown, usual[shown]) for shown in numbers])
    tables = _tables(layers, numbers)
    value = _value(tables, chosen)
    better = True
    while better:
        better = False
        for shown, action in choices:
            before = chosen[numbers[shown]]
            if action == before:
                continue
            chosen[numbers[shown]] = action
            found = _value(tables, chosen)
            if found > value + _GAIN:
                value = found
                better = True
            else:
                chosen[numbers[shown]] = before
    return value


def _choices(layers: list[_Layer]) -> dict[tuple[State, int], int]:
    """A column for each (observation, action), but for actions that can only end an episode without a success."""
    useful: dict[State, set[int]] = defaultdict(set)
    everything: dict[State, None] = {}
    n_actions = 1 + max(action for _, action in layers[0].links)
    for layer in layers:
        for (now, action), links in layer.links.items():
            everything.setdefault(now[1])
            if links or layer.wins[now, action]:
                useful[now[1]].add(action)
    pairs = ((shown, action) for shown in everything for action in sorted(useful[shown]) or range(n_actions))
    return {pair: column for column, pair in enumerate(pairs)}


def _solve(layers: list[_Layer], choices: dict[tuple[State, int], int]) -> tuple[dict[State, int], float]:
    """The best policy found and the bound proved."""
    from scipy import optimize, sparse  # noqa: PLC0415 - loads for long

    used = [[pair for pair in layer.links if (pair[0][1], pair[1]) in choices] for layer in layers]
    column = [{} for _ in layers]  # type: list[dict[tuple[_Seen, int], int]]
    total = len(choices)
    for here, pairs in zip(column, used, strict=True):
        here.update((pair, total + i) for i, pair in enumerate(pairs))
        total += len(pairs)
    entries: list[tuple[float, int, int]] = []
    low: list[float] = []
    high: list[float] = []
    gain = np.zeros(total)
    most = np.ones(total)
    for shown in dict.fromkeys(shown for shown, _ in choices):  # one action each
        entries += [(1.0, len(low), at) for (what, _), at in choices.items() if what == shown]
        low.append(1.0)
        high.append(1.0)
    for step, layer in enumerate(layers):
        flow = {now: len(low) + i for i, now in enumerate(layer.most)}
        low += [weight if step == 0 else 0.0 for weight in layer.most.values()]
        high += low[-len(flow) :]
        entries += [(1.0, flow[pair[0]], at) for pair, at in column[step].items()]
        for pair, at in column[step - 1].items() if step else ():
            entries += [(-share, flow[then], at) for share, then in layers[step - 1].links[pair]]
        for pair, at in column[step].items():  # nothing is done that the policy does not say
            weight = layer.most[pair[0]]
            entries += [(1.0, len(low), at), (-weight, len(low), choices[pair[0][1], pair[1]])]
            low.append(-np.inf)
            high.append(0.0)
            gain[at], most[at] = layer.wins[pair], weight
    values, rows, columns = zip(*entries, strict=True)
    matrix = sparse.coo_array((values, (rows, columns)), shape=(len(low), total)).tocsr()
    with _remarks_aside():
        found = optimize.milp(
            -gain,
            integrality=np.arange(total) < len(choices),
            bounds=optimize.Bounds(0.0, most),
            constraints=optimize.LinearConstraint(matrix, np.array(low), np.array(high)),
            options={"node_limit": NODES, "mip_rel_gap": 0.0},
        )
    policy = {} if found.x is None else {shown: action for (shown, action), at in choices.items() if found.x[at] > 0.5}
    bound = 1.0 if found.mip_dual_bound is None else min(1.0, -found.mip_dual_bound)
    return policy, bound


@contextmanager
def _remarks_aside() -> Iterator[None]:
    """HiGHS writes remarks on its search to standard output, whatever it is told: they go to standard error."""
    try:
        kept = os.dup(_STDOUT)
        os.dup2(_STDERR, _STDOUT)
    except OSError:  # one of them is closed
        yield
        return
    try:
        yield
    finally:
        os.dup2(kept, _STDOUT)
        os.close(kept)


def _tables(layers: list[_Layer], numbers: dict[State, int]) -> list[_Table]:
    """The layers as arrays; ``numbers`` are those of observations."""
    found = []
    following = [*layers[1:], None]
    for layer, after in zip(layers, following, strict=True):
        rows = {now: row for row, now in enumerate(layer.most)}
        columns = {} if after is None else {now: column for column, now in enumerate(after.most)}
        actions = 1 + max(action for _, action in layer.links)
        width = max(map(len, layer.links.values()))
        then = np.zeros((len(rows), actions, width), dtype=np.int64)
        share = np.zeros(then.shape)
        wins = np.zeros(then.shape[:2])
        for (now, action), links in layer.links.items():
            wins[rows[now], action] = layer.wins[now, action]
            for place, (chance, reached) in enumerate(links if columns else ()):
                then[rows[now], action, place] = columns[reached]
                share[rows[now], action, place] = chance
        shown = np.array([numbers[now[1]] for now in layer.most])
        first = np.array([*layer.most.values()])
        found.append(_Table(first=first, shown=shown, then=then, share=share, wins=wins, following=len(columns)))
    return found


def _value(tables: list[_Table], policy: Ints) -> float:
    """The success probability of a policy (O,), exactly."""
    now: Floats = tables[0].first
    won = 0.0
    for table in tables:
        pair = np.arange(len(now)), policy[table.shown]
        won += float(now @ table.wins[pair])
        weights = now[:, None] * table.share[pair]
        reached = np.bincount(table.then[pair].ravel(), weights.ravel(), minlength=max(1, table.following))
        now = reached.astype(np.float64)
    return won
