"""The macrostate machine of a task, and exact facts about it by dynamic programming over its outcomes.

Shapes: ``S`` macrostates, ``A`` macro-actions.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Bools, Floats, Info, Ints, State
from imagine_bench.errors import InvalidValueError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_SWEEPS = 10_000
_VALUE_TOLERANCE = 1e-12
_TIE_TOLERANCE = 1e-9
Outcomes = dict[tuple[State, bool], tuple[float, float]]
"""By macrostate and whether the episode is over: probability, and the reward expected of the action that led there."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One possible result of a macro-action according to the rules."""

    probability: float  #: in (0, 1]; those of one (macrostate, action) sum to 1
    macrostate: State  #: the next macrostate, a tuple of M integers
    reward: float  #: the reward of this transition
    terminated: bool  #: whether the episode ends here
    success: bool  #: whether it ends as a success


class Rules(Protocol):
    """The macrostate machine of a task: no physics, no pixels, exact."""

    @property
    def n_actions(self) -> int:
        """Number of macro-actions A."""

    @property
    def states(self) -> tuple[State, ...] | None:
        """Every macrostate the machine knows, terminal ones included; None: those that are reached from the starts."""

    @property
    def start_states(self) -> tuple[State, ...]:
        """The macrostates an episode may start in, equally likely."""

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        """Every possible result of ``action``, also out of a terminal macrostate: there its dynamics hold too."""

    def judge(self, macrostate: State, action: int, reached: State) -> Outcome:
        """The outcome by the rules for ``reached`` as it was read back, also where a fault led somewhere unexpected."""

    def is_legal(self, macrostate: State) -> bool:
        """Whether ``macrostate`` breaks no rule."""

    def is_terminal(self, macrostate: State) -> bool:
        """Whether no episode goes on from ``macrostate``."""

    def optimal_action(self, macrostate: State) -> int:
        """An action of an optimal policy (the lowest index among equals)."""


Dynamics = Callable[[State, int], Sequence[Outcome]]
"""The possible outcomes of a macro-action in a macrostate, as :meth:`Rules.outcomes` says it."""


@dataclass(frozen=True, kw_only=True)
class RuleFacts:
    """The facts of a task's rules, computed by enumeration."""

    chance_level: float  #: success probability of a uniformly random agent within the horizon
    optimum: float  #: largest success probability of any policy within the horizon
    optimal_return: float  #: mean undiscounted return of an optimal agent over the start states
    mean_plan_length: float  #: mean number of actions of an optimal agent over the start states


@dataclass(frozen=True)
class OutcomeTable:
    """N outcomes, all that every macro-action has in some macrostates: by macrostate, by macro-action, as they come."""

    index: dict[State, int]  #: macrostate to row, in the order in which they come up
    asked: Ints  #: rows of the macrostates whose outcomes these are, in their order
    before: Ints  #: row of the macrostate before. Shape (N,).
    action: Ints  #: shape (N,)
    after: Ints  #: row of the macrostate after. Shape (N,).
    probability: Floats  #: shape (N,)
    reward: Floats  #: shape (N,)
    terminated: Bools  #: whether the episode ends. Shape (N,).
    success: Bools  #: whether it ends as a success. Shape (N,).


@dataclass(frozen=True, kw_only=True)
class RuleTables:
    """A macrostate machine as arrays; a terminated outcome leaves the machine, so rows may sum to less than 1."""

    index: dict[State, int]  #: macrostate to row
    starts: Ints  #: rows an episode may start in, equally likely
    alive: csr_array  #: probability of going on in each next macrostate, sparse. Shape (A S, S).
    reward: Floats  #: expected reward. Shape (A, S).
    success: Floats  #: probability of ending here as a success. Shape (A, S).


def require_macrostates(rules: Rules, macrostates: Ints) -> Ints:
    """Rows of macrostates (N, M), checked, as an array.

    Raises:
        InvalidValueError: Another shape or type, or a row that is no macrostate of the machine.
    """
    macrostates = np.asarray(macrostates)
    states = states_of(rules)
    known = set(states)
    width = len(states[0])
    if macrostates.ndim != 2 or macrostates.shape[1] != width or not np.issubdtype(macrostates.dtype, np.integer):
        given = f"{macrostates.dtype} of shape {macrostates.shape}"
        raise InvalidValueError(f"Macrostates must be integers of shape (N, {width}), not {given}.")
    for row in macrostates.tolist():
        if tuple(row) not in known:
            raise InvalidValueError(f"No macrostate {tuple(row)}; give one of {len(known)}, such as {states[0]}.")
    return macrostates


def states_of(rules: Rules) -> tuple[State, ...]:
    """Every macrostate: those that the rules list, or where they list none, those reached from the starts."""
    return getattr(rules, "states", None) or tuple(tabulate(rules).index)


def states_of_play(rules: Rules) -> list[State]:
    """Every macrostate from which an episode goes on."""
    return [state for state in states_of(rules) if not rules.is_terminal(state)]


def tabulate(rules: Rules, depth: int | None = None) -> RuleTables:
    """Write the machine out as arrays: the macrostates that it lists, or those that are reached from its starts, where
    ends have empty rows.

    Macrostates that are more than ``depth`` macro-actions away have empty rows, too.

    Raises:
        InvalidValueError: The outcome probabilities of some (macrostate, action) do not sum to 1, or an outcome is a
            macrostate that the rules do not list.
    """
    from scipy.sparse import csr_array  # noqa: PLC0415 - loads for long

    listed = getattr(rules, "states", None)
    found = every_outcome(listed or rules.start_states, rules.n_actions, rules.outcomes, follow=not listed, depth=depth)
    states = list(found.index)
    pair = found.action * len(states) + found.before
    shape = (rules.n_actions, len(states))

    def summed(values: Floats) -> Floats:  # [A, S]
        sums = np.bincount(pair, found.probability * values, minlength=shape[0] * shape[1])
        return np.asarray(sums, dtype=np.float64).reshape(shape)

    total = summed(np.ones(len(pair)))
    for row, action in np.argwhere(np.abs(total[:, found.asked].T - 1.0) > _TIE_TOLERANCE):
        which = f"action {action} in macrostate {states[found.asked[row]]}"
        raise InvalidValueError(f"Outcomes of {which} sum to {total[action, found.asked[row]]}, not 1.")
    for outcome in np.flatnonzero(found.after >= len(listed)) if listed else ():
        which = f"Action {found.action[outcome]} in macrostate {states[found.before[outcome]]}"
        raise InvalidValueError(f"{which} leads to {states[found.after[outcome]]}; list it, too.")
    on = ~found.terminated
    alive = csr_array((found.probability[on], (pair[on], found.after[on])), shape=(total.size, len(states)))
    starts = np.array([found.index[state] for state in rules.start_states], dtype=np.int64)
    reward = summed(found.reward)
    success = summed(found.success.astype(np.float64))
    return RuleTables(index=found.index, starts=starts, alive=alive, reward=reward, success=success)


def every_outcome(
    states: Iterable[State], n_actions: int, outcomes: Dynamics, *, follow: bool, depth: int | None = None
) -> OutcomeTable:
    """Write out the possible outcomes of every macro-action.

    Args:
        states: Macrostates to ask about.
        n_actions: Macro-actions.
        outcomes: The dynamics.
        follow: Whether macrostates in which the episode goes on are asked about, too, as they come up.
        depth: Most macro-actions after which they are; None for any number.
    """
    index = {state: row for row, state in enumerate(dict.fromkeys(states))}
    queue = list(index)
    steps = dict.fromkeys(queue, 0)
    rows: list[tuple[float, ...]] = []
    asked = []
    for state in queue:  # grows
        if steps[state] == depth:
            break
        asked.append(index[state])
        for action in range(n_actions):
            for each in outcomes(state, action):
                after = each.macrostate
                column = index.setdefault(after, len(index))
                place = (index[state], action, column)
                rows.append((*place, each.probability, each.reward, each.terminated, each.success))
                if follow and not each.terminated and after not in steps:
                    steps[after] = steps[state] + 1
                    queue.append(after)
    columns = np.array(rows, dtype=np.float64).reshape(-1, 7).T
    places = columns[:3].astype(np.int64)
    ends = columns[5:].astype(bool)
    return OutcomeTable(index, np.array(asked, dtype=np.int64), *places, *columns[3:5], *ends)


def optimal_values(tables: RuleTables) -> Floats:
    """Action values of the largest undiscounted return without a horizon, by value iteration. Shape (A, S).

    Raises:
        InvalidValueError: The return of some macrostate is unbounded; the message names one.
    """
    values = np.full(tables.reward.shape[1], tables.reward.min(initial=0.0))
    change = math.inf
    while True:
        change_before = change
        for _ in range(_SWEEPS):
            action_values: Floats = tables.reward + (tables.alive @ values).reshape(tables.reward.shape)  # [A, S]
            best = action_values.max(axis=0)
            change = float(np.abs(best - values).max())
            if change < _VALUE_TOLERANCE:
                return action_values
            values, before = best, values
        if not change <= change_before / 2.0:  # or is no number; slow where chance keeps an episode going
            endless = list(tables.index)[int(np.abs(values - before).argmax())]
            raise InvalidValueError(
                f"From macrostate {endless} the rules allow an endless return: in {_SWEEPS} sweeps of value iteration "
                "it came no nearer to its end. Let every macrostate reach an end, or reward nothing on the way round."
            )


def optimal_actions(tables: RuleTables) -> Bools:
    """Which actions an optimal agent may choose in each macrostate. Shape (A, S)."""
    action_values = optimal_values(tables)
    return action_values >= action_values.max(axis=0) - _TIE_TOLERANCE


def optimal_policy(tables: RuleTables) -> Ints:
    """The action of an optimal agent in each macrostate, the lowest index among equals. Shape (S,)."""
    return optimal_actions(tables).argmax(axis=0)


@dataclass(frozen=True, kw_only=True)
class HorizonOptimum:
    """The best that can be done in the macro-actions that are left, by backward induction.

    More success comes first, then more return, then the action of the lowest index. Shapes: ``H`` the horizon.
    """

    success: Floats  #: largest success probability with H actions left. Shape (S,).
    returns: Floats  #: expected undiscounted return of that policy. Shape (S,).
    actions: NDArray[np.int16]  #: the action to take with t + 1 actions left. Shape (H, S).


def horizon_optimum(tables: RuleTables, horizon: int) -> HorizonOptimum:
    """Solve a machine for a finite horizon of at least 1 action, exactly."""
    shape = tables.reward.shape
    success = np.zeros(shape[1])
    returns = np.zeros(shape[1])
    actions = np.empty((horizon, shape[1]), dtype=np.int16)
    everywhere = np.arange(shape[1])
    for left in range(horizon):
        wins = tables.success + (tables.alive @ success).reshape(shape)
        earns = tables.reward + (tables.alive @ returns).reshape(shape)
        earns = np.where(wins >= wins.max(axis=0) - _TIE_TOLERANCE, earns, -np.inf)
        best = (earns >= earns.max(axis=0) - _TIE_TOLERANCE).argmax(axis=0)
        actions[left], success, returns = best, wins[best, everywhere], earns[best, everywhere]
    return HorizonOptimum(success=success, returns=returns, actions=actions)


def shortest_plans(tables: RuleTables) -> Ints:
    """The fewest macro-actions after which a success is possible from each macrostate, -1 where none is. Shape (S,)."""
    n_states = tables.reward.shape[1]
    links = tables.alive.tocoo()
    before = links.row % n_states
    after = links.col
    lengths = np.where((tables.success > 0.0).any(axis=0), 1, -1)
    steps = 1
    while (lengths == steps).any():
        reaches = before[lengths[after] == steps]
        steps += 1
        lengths[reaches[lengths[reaches] < 0]] = steps
    return lengths


@dataclass(frozen=True, kw_only=True)
class PolicyValues:
    """The results of a policy within a horizon, from each macrostate. Shapes (S,)."""

    success: Floats  #: success probability
    failure: Floats  #: probability of an end that is no success; the rest of them is still going on at the horizon
    returns: Floats  #: expected undiscounted return
    length: Floats  #: expected number of actions


def evaluate(tables: RuleTables, policy: Floats, horizon: int) -> PolicyValues:
    """Evaluate a stationary policy, action probabilities (A, S), exactly; truncated after ``horizon`` >= 1 actions."""
    if horizon < 1:
        raise InvalidValueError(f"Horizon {horizon} is too short; give at least 1 action.")
    alive = tables.alive.multiply(policy.ravel()[:, None]).tocoo()
    n_states = policy.shape[1]
    alive = type(tables.alive)((alive.data, (alive.row % n_states, alive.col)), shape=(n_states, n_states))
    reward = (policy * tables.reward).sum(axis=0)
    success = (policy * tables.success).sum(axis=0)
    failure = 1.0 - np.asarray(alive.sum(axis=1)).ravel() - success
    zeros = np.zeros(alive.shape[0])
    successes = zeros
    failures = zeros
    returns = zeros
    length = zeros
    for _ in range(horizon):
        successes = success + alive @ successes
        failures = failure + alive @ failures
        returns = reward + alive @ returns
        length = 1.0 + alive @ length
    return PolicyValues(success=successes, failure=failures, returns=returns, length=length)


def ending(info: Info, *, terminated: bool) -> str:
    """How an episode ended, in words; ``info`` and ``terminated`` are of its last step.

    A package's environment need not say why a macro-action went wrong.
    """
    if info["is_success"]:
        return "solved"
    if terminated:
        return "lost, because the rules forbid the result of the last macro-action"
    reason = info.get("fault_reason") or ("of a fault" if info.get("fault") else "no macro-actions are left")
    return f"lost, because {reason}"


def is_random(rules: Rules) -> bool:
    """Whether some macro-action may lead to one thing or another."""
    return any(
        len(rules.outcomes(state, action)) > 1 for state in states_of(rules) for action in range(rules.n_actions)
    )


def fewest_actions(rules: Rules, start: State) -> int:
    """The fewest macro-actions after which the rules can give a success; exact where the rules are deterministic.

    Raises:
        InvalidValueError: No success can be reached from ``start``.
    """
    reached = {start}
    seen = {start}
    steps = 0
    while reached:
        steps += 1
        outcomes = [o for state in reached for action in range(rules.n_actions) for o in rules.outcomes(state, action)]
        if any(outcome.success for outcome in outcomes):
            return steps
        reached = {outcome.macrostate for outcome in outcomes if not outcome.terminated} - seen
        seen |= reached
    raise InvalidValueError(f"The rules allow no success from {start}.")


def greedy(policy: Ints, n_actions: int) -> Floats:
    """A deterministic policy (S,) as action probabilities (A, S)."""
    return np.eye(n_actions)[:, policy]


def facts(rules: Rules, horizon: int) -> RuleFacts:
    """Chance level, optimum and plan length of a task, exactly.

    Figures are means over the start macrostates, truncated at ``horizon`` actions. The optimum is that of all policies,
    also of those that count actions; the optimal agent is the stationary one with the largest undiscounted return.
    """
    tables = tabulate(rules)
    best = horizon_optimum(tables, horizon)
    optimal = evaluate(tables, greedy(optimal_policy(tables), rules.n_actions), horizon)
    chance = evaluate(tables, np.full(tables.reward.shape, 1.0 / rules.n_actions), horizon)
    return RuleFacts(
        chance_level=float(chance.success[tables.starts].mean()),
        optimum=float(best.success[tables.starts].mean()),
        optimal_return=float(optimal.returns[tables.starts].mean()),
        mean_plan_length=float(optimal.length[tables.starts].mean()),
    )


def outcomes_by_depth(rules: Rules, state: State, actions: Sequence[int]) -> tuple[Outcomes, ...]:
    """The possible outcomes of macro-actions from a macrostate, after each of them."""
    start: Outcomes = {(state, False): (1.0, 0.0)}
    reached = itertools.accumulate(actions, functools.partial(advance, rules), initial=start)
    return tuple(reached)[1:]


def advance(rules: Rules, outcomes: Outcomes, action: int) -> Outcomes:
    """The possible outcomes of one more macro-action, the same whatever has come before.

    Dynamics hold after the end of an episode, too; rewards stop there.
    """
    after: dict[tuple[State, bool], list[float]] = {}
    for (before, over), (weight, _) in outcomes.items():
        for outcome in rules.outcomes(before, int(action)):
            sums = after.setdefault((outcome.macrostate, over or outcome.terminated), [0.0, 0.0])
            sums[0] += weight * outcome.probability
            sums[1] += weight * outcome.probability * (0.0 if over else outcome.reward)
    return {key: (share, earned / share if share else 0.0) for key, (share, earned) in after.items()}
