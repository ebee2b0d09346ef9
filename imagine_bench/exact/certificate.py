"""The certificate of a world: exact facts, computed from its rules, with which any agent's result is compared."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imagine_bench.exact.beliefs import BeliefRules
from imagine_bench.exact.bound import SHARE, lower_bound
from imagine_bench.exact.factors import FactorGraph, Machine, Scope, factor_graph, machine
from imagine_bench.exact.learner import LearnerRun, learn
from imagine_bench.exact.memoryless import best_without_memory
from imagine_bench.interfaces import Floats, ObservationModel, Rules, TaskSpec
from imagine_bench.rules import evaluate, horizon_optimum, shortest_plans, tabulate

_LARGE = 5_000
_A_SECOND = 1_500
"""Macrostates above which the facts take so long that it is said, and how many a second takes."""
_PROVED = 1e-6  # of a success probability
_LEARNERS = 10
_FEWEST = 2
_PAIRS = 20_000
"""Learners behind a cost: the most, the fewest, and (macrostate, action) pairs that they share."""


@dataclass(frozen=True, kw_only=True)
class LearningCost:
    """Means over cautious learners that know the factor graph and nothing else (:mod:`.learner`)."""

    transitions: float
    standard_error: float  #: of ``transitions``
    episodes: float
    learners: int  #: learner k has the generator of seed k


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """Exact facts of a world within its horizon. Every field can be written as JSON."""

    macrostates: int  #: those that can come up, ends included
    starts: int
    horizon: int  #: macro-actions
    random: bool  #: whether some macro-action has several outcomes
    chance_level: float  #: success probability of uniformly random macro-actions
    seen_optimum: float  #: largest success probability if every frame showed everything at once
    optimal_return: float  #: expected return of that policy
    optimum: float  #: largest success probability with memory; the same where nothing is hidden or late
    beliefs: int | None  #: how many were enumerated for it; None: too many, and ``optimum`` is only a bound
    memoryless: float | None  #: best found of a deterministic policy without memory; None where nothing is hidden
    memoryless_bound: float | None  #: a success probability that none of them exceeds
    plan_lengths: tuple[tuple[int, int], ...]  #: (fewest macro-actions to a success, starts); -1 where there is none
    #: (action, coordinates that it decides, coordinates that they depend on)
    dynamics: tuple[tuple[str, str, str], ...]
    outcomes: tuple[tuple[str, str], ...]  #: (reward and end, coordinates of the conditions that force it), in order
    width: int  #: the most coordinates that decide one factor or condition
    facts: int  #: local entries and conditions that there are to know
    #: of a cautious learner; None where no start can be solved, or a learner is not done after learner.MOST
    learning_cost: LearningCost | None
    lower_bound: int | None = None  #: transitions that any learner needs (:mod:`.bound`); None in older certificates


def certificate(spec: TaskSpec) -> Certificate:
    """Compute the certificate of a task: its rules, its horizon, and the content of its frames."""
    tables = tabulate(spec.rules)
    if len(tables.index) > _LARGE:
        long_s = len(tables.index) / _A_SECOND
        print(f"The exact facts of {spec.id} are computed, about {long_s:.0f} s.", file=sys.stderr, flush=True)
    full = machine(spec.rules)
    starts = tables.starts
    best = horizon_optimum(tables, spec.horizon)
    chance = evaluate(tables, np.full(tables.reward.shape, 1.0 / spec.n_actions), spec.horizon)
    lengths = shortest_plans(tables)[starts]
    graph = factor_graph(full)
    seen_optimum = float(best.success[starts].mean())
    optimum = seen_optimum
    beliefs: int | None = 0
    memoryless = bound = None
    if spec.sight is not None:
        optimum, beliefs = _with_memory(spec.rules, spec.sight, spec.horizon, seen_optimum)
        found = best_without_memory(spec.rules, spec.sight, spec.horizon, bound=optimum)
        memoryless = found.value
        bound = found.bound
    return Certificate(
        macrostates=len(full.coordinates),
        starts=len(starts),
        horizon=spec.horizon,
        random=len(full.pair) > full.n_play * full.n_actions,
        chance_level=float(chance.success[starts].mean()),
        seen_optimum=seen_optimum,
        optimal_return=float(best.returns[starts].mean()),
        optimum=optimum,
        beliefs=beliefs,
        memoryless=memoryless,
        memoryless_bound=bound,
        plan_lengths=tuple(sorted(Counter(lengths.tolist()).items())),
        dynamics=tuple(
            (spec.action_names[each.action], _names(spec, each.children), _names(spec, each.parents))
            for each in graph.factors
        ),
        outcomes=_outcomes(spec, full, graph),
        width=graph.width,
        facts=graph.facts,
        learning_cost=_learning_cost(full, graph, spec.horizon) if seen_optimum > 0.0 else None,
        lower_bound=lower_bound(full, graph, spec.horizon) if seen_optimum > 0.0 else None,
    )


def from_json(values: Mapping[str, Any]) -> Certificate:
    """Undo ``dataclasses.asdict`` and JSON; older files say ``floor`` for ``learning_cost``.

    Raises TypeError or KeyError: fields are missing or unknown.
    """
    today = {"learning_cost" if name == "floor" else name: value for name, value in values.items()}
    lists = {name: tuple(map(tuple, today[name])) for name in ("plan_lengths", "dynamics", "outcomes")}
    cost = today["learning_cost"]
    return Certificate(**{**today, **lists, "learning_cost": cost and LearningCost(**cost)})


def optimum(spec: TaskSpec) -> float:
    """The largest success probability with memory; where there are too many beliefs, a bound on it."""
    tables = tabulate(spec.rules)
    seen_optimum = float(horizon_optimum(tables, spec.horizon).success[tables.starts].mean())
    if spec.sight is None:
        return seen_optimum
    return _with_memory(spec.rules, spec.sight, spec.horizon, seen_optimum)[0]


def certificate_rows(found: Certificate) -> dict[str, str]:
    """A certificate in words, by heading."""
    plans = ", ".join(f"{length} ({count} starts)" for length, count in found.plan_lengths if length > 0)
    unsolvable = dict(found.plan_lengths).get(-1, 0)
    rows = {
        "shortest plans": (plans or "none") + (f"; none from {unsolvable} starts" if unsolvable else ""),
        "best policy": f"{_percent(found.seen_optimum)} within the horizon where everything is seen",
    }
    if found.memoryless is not None and found.memoryless_bound is not None:
        how = "at most, for there are too many beliefs" if found.beliefs is None else f"over {found.beliefs:,} beliefs"
        rows["with memory"] = f"{_percent(found.optimum)}, {how}"
        rows["without memory"] = _without_memory(found.memoryless, found.memoryless_bound)
    moves: dict[tuple[str, str], int] = Counter((children, parents) for _, children, parents in found.dynamics)
    rows["factor graph"] = "; ".join(f"{c} from {p} ({n} actions)" for (c, p), n in moves.items())
    rows["reward and end"] = "; ".join(f"{what} by [{scopes}]" for what, scopes in found.outcomes)
    rows["facts"] = f"{found.facts} local entries and conditions, of at most {found.width} coordinates each"
    if found.lower_bound not in (None, 0):
        rows["lower bound"] = (
            f"{found.lower_bound} transitions, before which no learner solves {100 * SHARE:.0f} % of the tests "
            "that the best policy solves, on average over the worlds that differ by the names of their actions"
        )
    if found.learning_cost is not None:
        cost = found.learning_cost
        part = " (of the certain part alone)" if found.random else ""
        rows["cautious"] = (
            f"{cost.transitions:.0f} ± {cost.standard_error:.0f} transitions, {cost.episodes:.0f} episodes, until a "
            f"learner with ideal codes and this graph knows an optimal policy{part}"
        )
    return rows


def _without_memory(value: float, bound: float) -> str:
    """The best policy without memory, in words; a value of 0 may be of a world in which none was looked for."""
    if bound - value < _PROVED:
        return f"{_percent(value)}, proved"
    found = f"{_percent(value)} found" if value else "none found"
    return f"{found}; only proved to be at most {_percent(bound)}"


def _percent(share: float) -> str:
    """Rounds down, so that 99.99 % is never shown as 100 %."""
    return f"{np.floor(share * 1e4 + 1e-3) / 100:.2f} %"


def _with_memory(rules: Rules, sight: ObservationModel, horizon: int, seen_optimum: float) -> tuple[float, int | None]:
    """The optimum with memory and the number of beliefs, or the bound that everything seen at once gives."""
    beliefs = BeliefRules(rules, sight, horizon)
    known = beliefs.tables()
    if known is None:
        return seen_optimum, None
    success: Floats = horizon_optimum(known, horizon).success[known.starts]
    shares = np.array([share for share, _ in beliefs.starts.values()])
    return min(float((success * shares).sum()), seen_optimum), len(known.index)


def _names(spec: TaskSpec, scope: Scope) -> str:
    return ", ".join(spec.macrostate_names[i] for i in scope) or "nothing"


def _outcomes(spec: TaskSpec, full: Machine, graph: FactorGraph) -> tuple[tuple[str, str], ...]:
    now = list(spec.macrostate_names)
    then = [f"{name} then" for name in spec.macrostate_names]
    names = {"next": then, "choice": [*now, "action"], "both": [*now, "action", *then]}[graph.read]
    rows = []
    for claim in graph.claims:
        scopes = "; ".join(", ".join(names[i] for i in scope) or "always" for scope in claim.scopes)
        rows.append((_class(full, claim.class_), scopes))
    return (*rows, (_class(full, graph.usual), "otherwise"))


def _class(full: Machine, index: int) -> str:
    reward, ended, success = full.classes[index]
    return f"{reward:+g}{', success' if success else ', end' if ended else ''}"


def _learning_cost(full: Machine, graph: FactorGraph, horizon: int) -> LearningCost | None:
    learners = min(_LEARNERS, max(_FEWEST, _PAIRS // (full.n_play * full.n_actions)))
    runs = list[LearnerRun]()
    for seed in range(learners):
        runs.append(learn(full, graph, horizon, np.random.default_rng(seed)))
        if not runs[-1].done:
            return None
    needed = np.array([run.transitions for run in runs], dtype=np.float64)
    return LearningCost(
        transitions=float(needed.mean()),
        standard_error=float(needed.std(ddof=1) / np.sqrt(learners)),
        episodes=float(np.mean([run.episodes for run in runs])),
        learners=learners,
    )
