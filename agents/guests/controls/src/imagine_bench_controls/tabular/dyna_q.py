"""Q-learning and Dyna-Q in a table (Watkins & Dayan 1992; Sutton 1990; thesis 2.2.3, 2.2.4, figure 2.7).

Each real transition updates the action values and is kept in a model; ``planning_steps`` times the model then recalls
one of the pairs of state and action that were tried, each equally likely, and its outcome, and the values are
updated by that in the same way (Sutton & Barto 2018, 8.2). Without planning steps this is Q-learning. Where chance
decides what follows, one of all that followed the pair is drawn; Sutton & Barto keep the last.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from imagine_bench.agents.settings import Hyperparameters

from imagine_bench.interfaces import AgentContext, AgentState, Floats, Observation, Transition
from imagine_bench.seeding import SeedTree

from .agent import ReadState, TabularAgent, load_codes, read_codes, read_macrostate
from .settings import DYNA_Q, Q_LEARNING, DynaQSettings


class DynaQAgent(TabularAgent):
    """Action values in a table, 0 at first, updated by real transitions and by recalled ones after each."""

    def __init__(self, read: ReadState, n_actions: int, settings: DynaQSettings, seeds: SeedTree) -> None:
        super().__init__(read, n_actions, settings, seeds)
        self.updates = settings.table
        self.planning = seeds.child("planning").generator()
        self.q: dict[int, Floats] = {}

    def values(self, observation: Observation, *, explore: bool) -> Floats:
        """Values of every action (A,), whether or not it explores."""
        return self.q.get(self.read(observation), np.zeros(self.n_actions))

    def update(self, state: int, action: int, following: int, reward: float, terminated: bool) -> float:
        """Equation 2.16 of the thesis; returns the temporal-difference error, in units of reward."""
        zeros = np.zeros(self.n_actions)
        values = self.q.setdefault(state, zeros)
        then = self.q.get(following, zeros)
        after = 0.0 if terminated else self.settings.controller.discount * then.max()
        error = reward + after - values[action]
        values[action] += self.updates.step_size * error
        return float(error)

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Learn from the transition, count it in the model, and plan."""
        state = self.read(transition.observation)
        following = self.read(transition.next_observation)
        row = (state, transition.action, following, transition.reward, transition.terminated)
        with self.meters.cpu_time("time/controller_s"):
            self.meters.add("loss/bellman", self.update(*row) ** 2)
            self.table.add(*row)
            self.plan()
        self.meters.count("time/controller_s")
        self.steps += 1

    def plan(self) -> None:
        """Update by as many transitions of the model as settings say."""
        for row in self.table.recall(self.updates.planning_steps, self.planning):
            self.update(*row)

    def state(self) -> AgentState:
        """A snapshot, with values (S, A) and the generator of planning."""
        common = super().state()
        known = {"table/known": np.array(list(self.q), dtype=np.int64)}
        known["table/values"] = np.array(list(self.q.values())).reshape(-1, self.n_actions)
        own = {"planning": self.planning.bit_generator.state}
        return AgentState(arrays={**common.arrays, **known}, values={**common.values, **own})

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; errors as above."""
        super().restore(state)
        self.q = dict(zip(state.arrays["table/known"].tolist(), state.arrays["table/values"].copy(), strict=True))
        self.planning.bit_generator.state = state.values["planning"]


def build(
    context: AgentContext, *, hyperparameters: Hyperparameters[DynaQSettings], privileged: bool = False
) -> DynaQAgent:
    """An agent that reads codes, or, ``privileged``, the macrostate; InvalidValueError if the encoder has no codes."""
    settings = hyperparameters.of(context)
    read = read_macrostate if privileged else read_codes(load_codes(context))
    return DynaQAgent(read, context.n_actions, settings, context.seeds)


make_q_learning, make_dyna_q = (partial(build, hyperparameters=own) for own in (Q_LEARNING, DYNA_Q))
make_q_learning_macrostate, make_dyna_q_macrostate = (
    partial(build, hyperparameters=own, privileged=True) for own in (Q_LEARNING, DYNA_Q)
)
