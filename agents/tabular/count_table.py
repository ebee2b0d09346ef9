"""The controls ``count_table`` and ``count_table_directed``: counts of codes, value iteration, nothing else.

The state is the frame's whole code, one number. Exploration is epsilon-greedy as the DQN's, or directed: R-max (Brafman
& Tennenholtz 2002) with a threshold of one visit, where an untried action is worth the best possible return,
r_max / (1 - discount). The agent is told no r_max; it takes the largest reward seen, at least 0.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentContext, AgentState, Floats, Observation, Transition
from imagine_bench.seeding import SeedTree

from .. import snapshot
from ..dqn import epsilon
from ..factored.perception import CodePerception
from ..meters import Meters
from ..settings import flatten
from .counts import CountTable
from .settings import HYPERPARAMETERS, CountTableSettings
from .states import epsilon_greedy, load_codes, read_codes

_LEAST = 1e-3
"""What ``1 - discount`` counts as at least, so that the best return is finite without discount."""


class CountTableAgent:
    """Plans in a table of what was seen; acts greedily in tests, where an untried action is worth 0.

    ``directed`` says how it explores.
    """

    def __init__(
        self, perception: CodePerception, n_actions: int, settings: CountTableSettings, seeds: SeedTree, *,
        directed: bool,
    ) -> None:  # fmt: skip
        self.n_actions, self.settings, self.directed = n_actions, settings, directed
        self.code_sizes, self.read = perception.sizes, read_codes(perception)
        self.rng = seeds.child("exploration").generator()
        self.table = CountTable(n_actions)
        self.meters = Meters()
        self.steps = 0
        self._plans: dict[bool, dict[int, Floats]] = {}

    def _values(self, observation: Observation, *, optimistic: bool) -> Floats:
        """Values of every action (A,), from a plan that is made anew where the table predicts otherwise."""
        discount = self.settings.controller.discount
        untried = self.table.largest_reward / max(1.0 - discount, _LEAST) if optimistic else 0.0
        if optimistic not in self._plans:
            with self.meters.cpu_time("time/model_s"):
                self._plans[optimistic] = self.table.action_values(discount, untried)
        unknown = np.full(self.n_actions, untried)
        return self._plans[optimistic].get(self._state(observation), unknown)

    def _state(self, observation: Observation) -> int:
        return self.read(observation)[0]

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The action of the largest value; exploring, by chance among equals, and with epsilon or optimism."""
        if not explore:
            return int(self._values(observation, optimistic=False).argmax())
        chance = 0.0 if self.directed else epsilon(self.steps, self.settings.controller)
        values = partial(self._values, observation, optimistic=self.directed)
        return epsilon_greedy(values, self.n_actions, chance, self.rng)

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Count the transition; if the table then predicts otherwise, plan anew when next asked."""
        state, following = self._state(transition.observation), self._state(transition.next_observation)
        if self.table.add(state, transition.action, following, transition.reward, transition.terminated):
            self._plans.clear()
        self.meters.count("time/model_s")
        self.steps += 1

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        """Value of every macro-action, in units of reward. Shape (A,)."""
        return self._values(observation, optimistic=False).astype(np.float32)

    def diagnostics(self) -> dict[str, float]:
        """CPU seconds a real step since the last call, and the counters now."""
        counters = {"real_transitions": self.steps, "gradient_updates": 0}
        counters |= {"table/states": self.table.states, "table/pairs": self.table.pairs}
        now = {name: float(value) for name, value in counters.items()}
        return {**self.meters.read(), "epsilon": epsilon(self.steps, self.settings.controller), **now}

    def state(self) -> AgentState:
        """A snapshot: counts, the generator, counters, measurements."""
        values = {
            "steps": self.steps, "exploration": self.rng.bit_generator.state, "meters": self.meters.state(),
            "settings": snapshot.jsonable(flatten(self.settings)), "directed": self.directed,
            "code_sizes": list(self.code_sizes), "n_actions": self.n_actions,
        }  # fmt: skip
        return AgentState(arrays=snapshot.prefixed("table", self.table.arrays()), values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        snapshot.require_fit(state, self.state(), equal=("settings", "code_sizes", "n_actions", "directed"))
        self.table.load(snapshot.below("table", state.arrays))
        self._plans.clear()
        self.meters.restore(state.values["meters"])
        self.rng.bit_generator.state, self.steps = state.values["exploration"], state.values["steps"]


def build(context: AgentContext, *, directed: bool) -> CountTableAgent:
    """A count table; InvalidValueError if the context's encoder gives no codes."""
    settings = HYPERPARAMETERS.resolve(context.hyperparameters, context.overrides, context.config_group)
    return CountTableAgent(load_codes(context), context.n_actions, settings, context.seeds, directed=directed)


make = partial(build, directed=False)
"""The ``count_table`` agent: epsilon-greedy as the DQN."""
make_directed = partial(build, directed=True)
"""The ``count_table_directed`` agent: R-max."""
