"""The control ``elimination``: R-max on the true state with a structured model that is learned by elimination.

A table holds, for each action, coordinate and value of the coordinate, how often each next value came; the most
frequent one is expected. One outcome (reward and end) is the usual one: the most frequent that does not end the
episode. Any other outcome has a cause: a set of at most two values of the next macrostate that was never seen with the
usual outcome. If the data rule out every such set for some macrostate, sets of one value more are allowed, wherever no
smaller set is left. Whatever is unknown is worth the largest reward seen (R-max, Brafman & Tennenholtz 2002;
elimination of conjunctions as in DOORmax, Diuk, Cohen & Littman 2008).

It is told the true macrostate, so it needs no perception. It knows beforehand that a coordinate's next value depends on
this coordinate and the action alone, and that outcomes depend on the next macrostate.
"""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import numpy as np
from imagine_bench.agents import snapshot
from imagine_bench.agents.meters import Meters
from imagine_bench.agents.settings import flatten

from imagine_bench.arrays import Floats32, Ints
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, AgentState, Floats, Observation, State, Transition
from imagine_bench.seeding import SeedTree

from .tabular.settings import HYPERPARAMETERS, CountTableSettings

Outcome = tuple[float, bool]
"""Reward, and whether the episode ended."""
Values = tuple[tuple[int, int], ...]
"""Values of some coordinates: pairs (coordinate, value), ascending."""
_FEWEST = 2
"""Values in a cause, at most, unless data rule that out."""
_TIE = 1e-9
_SWEEPS = 1_000
_LEAST_CHANGE = 1e-6


def value_sets(state: State, most: int) -> list[Values]:
    """All sets of 1 to ``most`` values of a macrostate."""
    values = list(enumerate(state))
    return [chosen for size in range(1, most + 1) for chosen in combinations(values, size)]


class EliminationModel:
    """The effects and outcomes of macro-actions, as far as the transitions so far decide them."""

    def __init__(self) -> None:
        self._moves: dict[tuple[int, int, int], Counter[int]] = {}
        self._outcomes: dict[State, Counter[Outcome]] = {}
        self._causes: dict[Values, Outcome] = {}
        self._cleared: set[Values] = set()
        self.most = _FEWEST
        """Values in a cause, at most."""
        self.usual: Outcome | None = None
        """The outcome without a cause; None before the first transition."""

    def add(self, state: State, action: int, following: State, outcome: Outcome) -> None:
        """Learn one transition."""
        for coordinate, (value, after) in enumerate(zip(state, following, strict=True)):
            self._moves.setdefault((action, coordinate, value), Counter())[after] += 1
        self._outcomes.setdefault(following, Counter())[outcome] += 1
        self._eliminate()

    def next_state(self, state: State, action: int) -> State | None:
        """The macrostate that is expected next; None if some coordinate's next value was never seen."""
        found = [self._moves.get((action, *each)) for each in enumerate(state)]
        return tuple(counts.most_common(1)[0][0] for counts in found if counts) if all(found) else None

    def outcome(self, following: State) -> Outcome | None:
        """The outcome of reaching a macrostate; None if it is unknown."""
        if following in self._outcomes:
            return self._outcomes[following].most_common(1)[0][0]
        suspects = self._suspects(following)
        known = [self._causes[each] for each in suspects if each in self._causes]
        if known:
            return known[0]
        return None if suspects else self.usual

    def _suspects(self, following: State) -> list[Values]:
        """The sets of values that were never seen with the usual outcome; larger ones only where no smaller is left."""
        for most in range(min(_FEWEST, len(following)), self.most + 1):
            found = [each for each in value_sets(following, most) if each not in self._cleared]
            if found:
                return found
        return []

    def _eliminate(self) -> None:
        """Allow as few values a cause as the data permit, and find the causes that are alone under suspicion."""
        seen = {state: counts.most_common(1)[0][0] for state, counts in self._outcomes.items()}
        frequency = Counter(seen.values())
        self.usual = max(frequency, key=lambda outcome: (not outcome[1], frequency[outcome]))
        usual = [state for state, outcome in seen.items() if outcome == self.usual]
        others = [state for state, outcome in seen.items() if outcome != self.usual]
        every = len(next(iter(seen)))
        for self.most in range(min(_FEWEST, every), every + 1):
            self._cleared = {each for state in usual for each in value_sets(state, self.most)}
            suspects = [self._suspects(state) for state in others]
            if all(suspects):
                break
        alone = zip(others, suspects, strict=True)
        self._causes = {sets[0]: seen[state] for state, sets in alone if len(sets) == 1}


class EliminationAgent:
    """Plans by value iteration over everything that is known to be within reach of the macrostate it is in."""

    def __init__(self, n_actions: int, settings: CountTableSettings, seeds: SeedTree) -> None:
        self.n_actions = n_actions
        self.settings = settings
        self.rng = seeds.child("exploration").generator()
        self.model = EliminationModel()
        self.meters = Meters()
        self._seen: list[tuple[State, int, State, Outcome]] = []
        self._plans: dict[bool, dict[State, Floats]] = {}

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The action of the largest value: exploring, by chance among equals, and in tests the first."""
        values = self._values(observation, explore=explore)
        best = np.flatnonzero(values >= values.max() - _TIE)
        return int(self.rng.choice(best)) if explore else int(best[0])

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Learn the transition, and plan anew when next asked."""
        del episode
        state = true_state(transition.observation)
        following = true_state(transition.next_observation)
        row = (state, transition.action, following, (transition.reward, transition.terminated))
        with self.meters.cpu_time("time/model_s"):
            self._learn(row)
        self.meters.count("time/model_s")

    def _learn(self, row: tuple[State, int, State, Outcome]) -> None:
        self._seen.append(row)
        self.model.add(*row)
        self._plans = {}

    def _values(self, observation: Observation, *, explore: bool) -> Floats:
        """Values (A,); an unknown outcome is worth the largest reward seen, and in tests 0."""
        state = true_state(observation)
        plan = self._plans.setdefault(explore, {})
        if state not in plan:
            with self.meters.cpu_time("time/model_s"):
                plan |= self._plan(state, explore)
        return plan[state]

    def _plan(self, start: State, explore: bool) -> dict[State, Floats]:
        """Action values (A,) of every macrostate that is known to be within reach."""
        unknown = max((row[3][0] for row in self._seen), default=0.0) if explore else 0.0
        places = {start: 0}
        waiting = [start]
        reward: list[float] = []
        leads_to: list[int] = []  # the place of the next macrostate; -1 where the episode ends or nothing is known
        for state in waiting:
            for action in range(self.n_actions):
                following = self.model.next_state(state, action)
                outcome = None if following is None else self.model.outcome(following)
                reward.append(unknown if outcome is None else outcome[0])
                if following is None or outcome is None or outcome[1]:
                    leads_to.append(-1)
                    continue
                if following not in places:
                    places[following] = len(places)
                    waiting.append(following)
                leads_to.append(places[following])
        values = self._iterate(np.array(reward), np.array(leads_to))
        return dict(zip(places, values, strict=True))

    def _iterate(self, reward: Floats, leads_to: Ints) -> Floats:
        """Value iteration over S macrostates. Shape (S, A)."""
        discount = self.settings.controller.discount
        value = np.zeros(len(reward) // self.n_actions + 1)  # the last is that of the end
        for _ in range(_SWEEPS):
            table = (reward + discount * value[leads_to]).reshape(-1, self.n_actions)
            change = np.abs(table.max(axis=1) - value[:-1]).max()
            value[:-1] = table.max(axis=1)
            if change < _LEAST_CHANGE:
                break
        return table

    def q_values(self, observation: Observation) -> Floats32:
        """Value of every macro-action, in units of reward. Shape (A,)."""
        return self._values(observation, explore=False).astype(np.float32)

    def diagnostics(self) -> dict[str, float]:
        """CPU seconds a real step since the last call, and the counters now."""
        counters = {"real_transitions": len(self._seen), "gradient_updates": 0, "model/values_a_cause": self.model.most}
        return {**self.meters.read(), **{name: float(value) for name, value in counters.items()}}

    def state(self) -> AgentState:
        """A snapshot: every transition, the generator, measurements."""
        before, actions, after, outcomes = zip(*self._seen, strict=True) if self._seen else ((), (), (), ())
        arrays = {
            "replay/state": np.array(before, dtype=np.int64).ravel(),
            "replay/action": np.array(actions, dtype=np.int64),
            "replay/following": np.array(after, dtype=np.int64).ravel(),
            "replay/reward": np.array([reward for reward, _ in outcomes], dtype=np.float64),
            "replay/ended": np.array([ended for _, ended in outcomes], dtype=np.bool_),
        }
        values = {
            "exploration": self.rng.bit_generator.state,
            "meters": self.meters.state(),
            "settings": snapshot.jsonable(flatten(self.settings)),
            "n_actions": self.n_actions,
        }
        return AgentState(arrays=arrays, values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot by learning every transition once more.

        ArtefactError if it does not fit this agent, and then nothing was changed.
        """
        snapshot.require_fit(state, self.state(), equal=("settings", "n_actions"))
        columns = {name: array.tolist() for name, array in snapshot.below("replay", state.arrays).items()}
        count = len(columns["action"])
        self.model = EliminationModel()
        self._seen = []
        self._plans = {}
        for row in range(count):
            width = len(columns["state"]) // count
            own = slice(row * width, (row + 1) * width)
            outcome = (columns["reward"][row], columns["ended"][row])
            before = tuple(columns["state"][own])
            self._learn((before, columns["action"][row], tuple(columns["following"][own]), outcome))
        self.meters.restore(state.values["meters"])
        self.rng.bit_generator.state = state.values["exploration"]


def true_state(observation: Observation) -> State:
    """The true macrostate; InvalidValueError if the observation shows none."""
    if observation.macrostate is None:
        raise InvalidValueError(
            "The agent elimination reads the true macrostate, and the observation shows none; use it through a bench, "
            "which shows it to agents that are registered as privileged."
        )
    return tuple(observation.macrostate.tolist())


def make(context: AgentContext) -> EliminationAgent:
    """The ``elimination`` agent."""
    return EliminationAgent(context.n_actions, HYPERPARAMETERS.of(context), context.seeds)
