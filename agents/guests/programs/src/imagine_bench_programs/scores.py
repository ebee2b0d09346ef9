"""Scores of rules between symbols against a task's rules, all by enumeration; the symbols are macrostates."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from imagine_bench.exact.factors import FactorGraph, Machine, factor_graph, keys, machine, numbered
from imagine_bench.interfaces import AgentContext, Outcome, State, TaskSpec
from imagine_bench.judge.truth import added_up, total_variation
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders

from .symbol_rules import SymbolRules
from .symbols import Symbols

if TYPE_CHECKING:
    from .seeing import SeenCodes

DISTRACTORS = 5
"""Macrostates among which a real next one is ranked."""
_SAME = 0.005
"""Total variation below which a distribution is right."""
Distribution = Mapping[State, float]


@dataclass(frozen=True, kw_only=True)
class Scores:
    """How near rules are to a task's, over every macro-action in every macrostate of play."""

    total_variation: float  #: mean half sum of absolute differences of probabilities of the next macrostate
    facts: int  #: facts of the task, as ``imagine-bench describe`` counts them
    found: int  #: those that the rules have right
    #: OneLife's state ranking: probability that a real next macrostate is more probable in the rules than each of
    #: :data:`DISTRACTORS` macrostates that are drawn from all that cannot follow
    ranking: float
    #: OneLife's fidelity: mean share of coordinates in which the macrostate that the rules hold likeliest next is right
    fidelity: float


class Codes:
    """Codes of a task's own images.

    Args:
        spec: The task.
        appearance: How images vary, such as ``clean``.
        rng: Draws how each image looks.
    """

    def __init__(self, spec: TaskSpec, appearance: str, rng: np.random.Generator) -> None:
        self._spec = spec
        self._appearance = appearance
        self._rng = rng
        context = AgentContext(
            n_actions=spec.n_actions,
            preprocessing=spec.preprocessing,
            encoder=encoders.own(spec, appearance, "codes"),
            seeds=SeedTree(0),
        )
        self.symbols = Symbols(context, "codes")

    def of(self, macrostate: State) -> State:
        """The code of a new image of a macrostate, whose hidden coordinates are -1."""
        shown = np.array([macrostate], dtype=np.int64)
        return self.symbols.read(self._spec.render_macrostates(shown, self._appearance, self._rng))[0]

    def macrostates(self, codes: Sequence[State]) -> NDArray[np.int64]:
        """The macrostates that the encoder's probe reads in N codes. Shape (N, M)."""
        return self.symbols.macrostates(codes)


class ReadRules(SymbolRules):
    """Rules between codes as rules between macrostates, by the codes of macrostates and the macrostates of codes."""

    def __init__(self, rules: SymbolRules, codes: Codes | SeenCodes) -> None:
        super().__init__(rules.n_actions)
        self._rules = rules
        self._codes = codes
        self._shown: dict[State, State] = {}
        self._known: dict[tuple[State, int], tuple[Outcome, ...]] = {}

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        """The outcomes that the rules expect where an image of the macrostate is seen, one image for all actions."""
        if macrostate not in self._shown:
            self._shown[macrostate] = self._codes.of(macrostate)
        key = (macrostate, action)
        if key not in self._known:
            expected = self._rules.outcomes(self._shown[macrostate], action)
            read = self._codes.macrostates([each.macrostate for each in expected])
            states = map(tuple, read.tolist())
            self._known[key] = tuple(
                replace(each, macrostate=state) for each, state in zip(expected, states, strict=True)
            )
        return self._known[key]


def score(rules: SymbolRules, spec: TaskSpec) -> Scores:
    """Compare rules with those of a task."""
    truth = machine(spec.rules)
    states = [tuple(row) for row in truth.coordinates.tolist()]
    known = {*states}
    width = len(states[0])
    first = np.searchsorted(truth.pair, np.arange(truth.n_actions * truth.n_play + 1))
    distances, ranks, shares = [], [], []
    expected: list[Distribution] = []
    for pair in range(truth.n_actions * truth.n_play):
        action, row = divmod(pair, truth.n_play)
        imagined = _distribution(rules, states[row], action)
        expected.append(imagined)
        outcomes = range(first[pair], first[pair + 1])
        real = added_up((states[truth.after[each]], float(truth.probability[each])) for each in outcomes)
        distances.append(total_variation(real, imagined))
        likeliest = max(imagined, key=lambda state: imagined[state])
        for state, share in real.items():
            shares.append(share * sum(a == b for a, b in zip(state, likeliest, strict=True)) / width)
            ranks.append(share * _ranked_first(state, real, imagined, known))
    graph = factor_graph(truth)
    found = sum(_entries_found(truth, graph, expected)) + sum(_conditions_found(truth, graph, rules))
    return Scores(
        total_variation=float(np.mean(distances)),
        facts=graph.facts,
        found=found,
        ranking=math.fsum(ranks) / len(distances),
        fidelity=math.fsum(shares) / len(distances),
    )


def efficiency(learner: float, own: int) -> float:
    """ARC-AGI-3's: the square of a learner's macro-actions over the program's own, at most 1."""
    return min(1.0, (learner / own) ** 2)


def _distribution(rules: SymbolRules, state: State, action: int) -> Distribution:
    """Probabilities of the next symbols."""
    outcomes = rules.outcomes(rules.start(state), action)
    return added_up((each.macrostate[: len(state)], each.probability) for each in outcomes)


def _ranked_first(state: State, real: Distribution, imagined: Distribution, states: Collection[State]) -> float:
    """Probability that a state is more probable than each of the distractors, drawn without replacement.

    Distractors are macrostates of the world. Other symbols, such as those of an unreadable image, are none.
    """
    own = imagined.get(state, 0.0)
    if not own:
        return 0.0
    better = sum(share >= own and other in states and other not in real for other, share in imagined.items())
    others = len(states) - len(real)
    drawn = min(DISTRACTORS, others)
    return math.comb(others - better, drawn) / math.comb(others, drawn)


def _entries_found(truth: Machine, graph: FactorGraph, expected: list[Distribution]) -> Iterator[int]:
    """Of each factor, how many of its local entries the rules have right wherever they hold."""
    before = truth.before
    for factor in graph.factors:
        wrong = set()
        rows = truth.action == factor.action
        children = list(factor.children)
        values = map(tuple, truth.coordinates[truth.after[rows]][:, children].tolist())
        shares: list[list[tuple[State, float]]] = [[] for _ in range(truth.n_play)]
        for row, value, share in zip(before[rows].tolist(), values, truth.probability[rows].tolist(), strict=True):
            shares[row].append((value, share))
        for row, law in enumerate(shares):
            imagined = expected[factor.action * truth.n_play + row].items()
            own = added_up((tuple(state[child] for child in children), share) for state, share in imagined)
            if total_variation(added_up(law), own) >= _SAME:
                wrong.add(int(factor.entry[row]))
        yield len({*factor.entry.tolist()} - wrong)


def _conditions_found(truth: Machine, graph: FactorGraph, rules: SymbolRules) -> Iterator[int]:
    """Of each claim, how many conditions the rules have right: reward and end of all outcomes in which one holds."""
    right = _ends_right(truth, graph, rules)
    label = np.zeros(len(graph.points), dtype=np.int64)
    label[graph.point] = truth.class_
    left = np.ones(len(label), dtype=bool)
    for claim in graph.claims:
        for scope in claim.scopes:
            key = numbered(keys(graph.points, scope))
            for each in np.unique(key[left]):
                holds = left & (key == each)
                if (label[holds] == claim.class_).all():
                    yield int(right[holds].all())
        left &= label != claim.class_


def _ends_right(truth: Machine, graph: FactorGraph, rules: SymbolRules) -> NDArray[np.bool_]:
    """Whether the rules have reward and end right in all outcomes of each point. Shape (Q,)."""
    states = [tuple(row) for row in truth.coordinates.tolist()]
    right = np.ones(len(graph.points), dtype=bool)
    rows = zip(truth.before.tolist(), truth.action.tolist(), truth.after.tolist(), strict=True)
    for outcome, (before, action, after) in enumerate(rows):
        reward, ended, _ = truth.classes[truth.class_[outcome]]
        expected = rules.outcomes(rules.start(states[before]), action)
        width = len(states[before])
        same = [each for each in expected if each.macrostate[:width] == states[after]]
        right[graph.point[outcome]] &= [(each.reward, each.terminated) for each in same] == [(reward, ended)]
    return right
