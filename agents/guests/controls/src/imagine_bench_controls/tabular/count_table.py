"""The controls ``count_table`` and ``count_table_directed``: counts of states, value iteration, nothing else.

The state is the frame's whole code, one number, or, privileged, the true macrostate. Exploration is epsilon-greedy as
the DQN's, or directed: R-max (Brafman & Tennenholtz 2002) with a threshold of one visit, where an untried action is
worth the best possible return, r_max / (1 - discount). The agent is told no r_max; it takes the largest reward seen, at
least 0.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from imagine_bench_factored.perception import CodePerception
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentContext, AgentState, Floats, Frame, Observation, Transition
from imagine_bench.interfaces.capabilities import ExpectedOutcomes
from imagine_bench.seeding import SeedTree

from .agent import ReadState, TabularAgent, load_codes, read_codes, read_macrostate
from .settings import HYPERPARAMETERS, CountTableSettings

_LEAST = 1e-3
"""The least value that ``1 - discount`` counts as, so that the best return is finite without discount."""


class CountTableAgent(TabularAgent):
    """Plans in a table of its experience; an untried action is worth 0 in tests.

    ``directed`` says how it explores.
    """

    def __init__(
        self, read: ReadState, n_actions: int, settings: CountTableSettings, seeds: SeedTree, *, directed: bool
    ) -> None:
        super().__init__(read, n_actions, settings, seeds)
        self.directed = directed
        self._plans: dict[bool, dict[int, Floats]] = {}

    def values(self, observation: Observation, *, explore: bool) -> Floats:
        """Values of every action (A,), from a plan that is made anew where the table predicts otherwise."""
        discount = self.settings.controller.discount
        optimistic = explore and self.directed
        untried = self.table.largest_reward / max(1.0 - discount, _LEAST) if optimistic else 0.0
        if optimistic not in self._plans:
            with self.meters.cpu_time("time/model_s"):
                self._plans[optimistic] = self.table.action_values(discount, untried)
        return self._plans[optimistic].get(self.read(observation), np.full(self.n_actions, untried))

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Count the transition; if the table then predicts otherwise, plan anew when next asked."""
        state = self.read(transition.observation)
        following = self.read(transition.next_observation)
        if self.table.add(state, transition.action, following, transition.reward, transition.terminated):
            self._plans.clear()
        self.meters.count("time/model_s")
        self.steps += 1

    def state(self) -> AgentState:
        """A snapshot, which says how it explores."""
        common = super().state()
        return AgentState(arrays=common.arrays, values={**common.values, "directed": self.directed})

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot, and plan anew when next asked; errors as above."""
        super().restore(state)
        self._plans.clear()


class CodeCountTableAgent(CountTableAgent):
    """One whose states are codes of frames, so that its perception and expectations can be read."""

    def __init__(
        self, perception: CodePerception, n_actions: int, settings: CountTableSettings, seeds: SeedTree, *,
        directed: bool,
    ) -> None:  # fmt: skip
        super().__init__(read_codes(perception), n_actions, settings, seeds, directed=directed)
        self.perception = perception
        self.code_sizes = perception.sizes

    def read_frames(self, frames: Frame) -> NDArray[np.int64]:
        """The reading of a probe; see :class:`imagine_bench.interfaces.capabilities.FrameReader`."""
        return self.perception.macrostates(self.perception.codes(frames))

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        """The contents of the table; see :class:`imagine_bench.interfaces.capabilities.OutcomePredictor`."""
        here = [code for (code,) in self.perception.codes(frames)]
        pairs = [self.table.expected(state, action) for state in here for action in range(self.n_actions)]
        most = max(1, *(len(branches) for branches, _ in pairs))
        following = np.repeat(np.repeat(here, self.n_actions)[:, None], most, axis=1)  # filled up with no change
        p_continues = np.zeros(following.shape)
        for row, (branches, _) in enumerate(pairs):
            for column, (state, share) in enumerate(branches):
                following[row, column], p_continues[row, column] = state, share
        read = self.perception.macrostates([(code,) for code in following.ravel().tolist()])
        shape = (len(here), -1)
        return ExpectedOutcomes(
            macrostates=read.reshape(*shape, most, read.shape[1]),
            p_continues=p_continues.reshape(*shape, most),
            reward=np.array([reward for _, reward in pairs]).reshape(shape),
        )

    def state(self) -> AgentState:
        """A snapshot, which names the codes that it reads, too."""
        common = super().state()
        return AgentState(arrays=common.arrays, values={**common.values, "code_sizes": list(self.code_sizes)})


def build(context: AgentContext, *, directed: bool) -> CodeCountTableAgent:
    """A count table; InvalidValueError if the context's encoder gives no codes."""
    settings = HYPERPARAMETERS.of(context)
    return CodeCountTableAgent(load_codes(context), context.n_actions, settings, context.seeds, directed=directed)


make = partial(build, directed=False)
"""The ``count_table`` agent: epsilon-greedy as the DQN."""
make_directed = partial(build, directed=True)
"""The ``count_table_directed`` agent: R-max."""


def make_directed_macrostate(context: AgentContext) -> CountTableAgent:
    """The ``count_table_directed_macrostate`` agent: R-max, shown the true state."""
    settings = HYPERPARAMETERS.of(context)
    return CountTableAgent(read_macrostate, context.n_actions, settings, context.seeds, directed=True)
