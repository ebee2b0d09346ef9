"""Q-learning and Dyna-Q in a table (Watkins & Dayan 1992; Sutton 1990; thesis 2.2.3, 2.2.4, figure 2.7).

Each real transition updates the action values and is kept in a model; ``planning_steps`` times the model then recalls
one of the pairs of state and action that were tried, each equally likely, and what followed it, and the values are
updated by that in the same way (Sutton & Barto 2018, 8.2). Without planning steps this is Q-learning. Where chance
decides what follows, one of all that followed the pair is drawn; Sutton & Barto keep the last.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentContext, AgentState, Floats, Observation, State, Transition
from imagine_bench.seeding import SeedTree

from .. import snapshot
from ..dqn import epsilon
from ..meters import Meters
from ..settings import Hyperparameters, flatten
from .settings import DYNA_Q, Q_LEARNING, DynaQSettings
from .states import ReadState, epsilon_greedy, load_codes, read_codes, read_macrostate


class DynaQAgent:
    """Action values in a table, updated by real transitions and by ``planning_steps`` recalled ones after each."""

    def __init__(self, read: ReadState, n_actions: int, settings: DynaQSettings, seeds: SeedTree) -> None:
        self.read, self.n_actions, self.settings = read, n_actions, settings
        self.rng = seeds.child("exploration").generator()
        self.planning = seeds.child("planning").generator()
        self.values: dict[State, Floats] = {}
        self.model: dict[tuple[State, int], list[tuple[float, State, bool]]] = {}
        self.meters = Meters()
        self.steps = 0

    def _values(self, state: State) -> Floats:
        """Of every action (A,): 0 in a state that was never updated."""
        return self.values.get(state, np.zeros(self.n_actions))

    def update(self, state: State, action: int, reward: float, following: State, terminated: bool) -> float:
        """Equation 2.16 of the thesis; returns the temporal-difference error, in units of reward."""
        values = self.values.setdefault(state, np.zeros(self.n_actions))
        after = 0.0 if terminated else self.settings.controller.discount * self._values(following).max()
        error = reward + after - values[action]
        values[action] += self.settings.table.step_size * error
        return float(error)

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Learn from the transition, keep it in the model, and plan."""
        state, following = self.read(transition.observation), self.read(transition.next_observation)
        led_to = (transition.reward, following, transition.terminated)
        with self.meters.cpu_time("time/controller_s"):
            self.meters.add("loss/bellman", self.update(state, transition.action, *led_to) ** 2)
            self.model.setdefault((state, transition.action), []).append(led_to)
            self._plan()
        self.meters.count("time/controller_s")
        self.steps += 1

    def _plan(self) -> None:
        pairs = list(self.model)
        for drawn in self.planning.integers(len(pairs), size=self.settings.table.planning_steps):
            state, action = pairs[drawn]
            seen = self.model[state, action]
            self.update(state, action, *seen[self.planning.integers(len(seen))])

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The action of the largest value, the lowest among equals; exploring, epsilon-greedy as the DQN."""
        state = self.read(observation)
        if not explore:
            return int(self._values(state).argmax())
        return epsilon_greedy(lambda: self._values(state), self.n_actions, self._epsilon, self.rng)

    @property
    def _epsilon(self) -> float:
        return epsilon(self.steps, self.settings.controller)

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        """Value of every macro-action, in units of reward. Shape (A,)."""
        return self._values(self.read(observation)).astype(np.float32)

    def diagnostics(self) -> dict[str, float]:
        """Squared temporal-difference error and CPU seconds a real step since the last call, and the counters now."""
        counters = {"real_transitions": self.steps, "gradient_updates": 0}
        counters |= {"table/states": len(self.values), "table/pairs": len(self.model)}
        now = {name: float(value) for name, value in counters.items()}
        return {**self.meters.read(), "epsilon": self._epsilon, **now}

    def state(self) -> AgentState:
        """A snapshot: values (S, A), the model's N rows (N, 5), generators, counters, measurements."""
        known = list(dict.fromkeys([*self.values, *(f for seen in self.model.values() for _, f, _ in seen)]))
        row = {state: i for i, state in enumerate(known)}
        rows = [(row[s], a, r, row[f], end) for (s, a), seen in self.model.items() for r, f, end in seen]
        values = {
            "steps": self.steps, "exploration": self.rng.bit_generator.state, "n_actions": self.n_actions,
            "planning": self.planning.bit_generator.state, "meters": self.meters.state(),
            "settings": snapshot.jsonable(flatten(self.settings)), "states": [list(state) for state in known],
        }  # fmt: skip
        arrays = {
            "table/values": np.array(list(self.values.values())).reshape(-1, self.n_actions),
            "table/model": np.array(rows, dtype=np.float64).reshape(-1, 5),
        }
        return AgentState(arrays=arrays, values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        snapshot.require_fit(state, self.state(), equal=("settings", "n_actions"))
        known, saved = [tuple(each) for each in state.values["states"]], state.arrays
        self.values = dict(zip(known, saved["table/values"].copy(), strict=False))
        self.model = {}
        for s, a, reward, following, terminated in saved["table/model"].tolist():
            led_to = (reward, known[int(following)], bool(terminated))
            self.model.setdefault((known[int(s)], int(a)), []).append(led_to)
        self.meters.restore(state.values["meters"])
        self.rng.bit_generator.state = state.values["exploration"]
        self.planning.bit_generator.state, self.steps = state.values["planning"], state.values["steps"]


def build(
    context: AgentContext, *, hyperparameters: Hyperparameters[DynaQSettings], privileged: bool = False
) -> DynaQAgent:
    """An agent that reads codes, or, ``privileged``, the macrostate; InvalidValueError if the encoder has no codes."""
    settings = hyperparameters.resolve(context.hyperparameters, context.overrides, context.config_group)
    read = read_macrostate if privileged else read_codes(load_codes(context))
    return DynaQAgent(read, context.n_actions, settings, context.seeds)


make_q_learning, make_dyna_q = (partial(build, hyperparameters=own) for own in (Q_LEARNING, DYNA_Q))
make_q_learning_macrostate, make_dyna_q_macrostate = (
    partial(build, hyperparameters=own, privileged=True) for own in (Q_LEARNING, DYNA_Q)
)
