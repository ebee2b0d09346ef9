"""The control ``posterior_sampling``: explores by one model drawn from its beliefs an episode (PSRL).

Strens 2000; Osband, Russo & Van Roy 2013. Before each episode a model is drawn from the posterior that the counts and a
prior give, planned in by value iteration, and followed to the end of the episode. The prior knows neither the number of
states nor the largest reward: an unseen outcome of a pair is one of other pairs, each kind of outcome equally likely
(:meth:`.counts.CountTable.sampled_values`). So it looks for no more than it has seen to pay somewhere. Tests follow the
counts alone, as those of ``count_table``.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from imagine_bench.agents import snapshot

from imagine_bench.interfaces import AgentContext, AgentState, Floats, Observation, Transition
from imagine_bench.seeding import SeedTree

from .agent import ReadState, load_codes, read_codes, read_macrostate
from .count_table import CountTableAgent
from .settings import POSTERIOR_SAMPLING, PosteriorSamplingSettings


class PosteriorSamplingAgent(CountTableAgent):
    """A count table that follows a drawn model while it explores."""

    def __init__(self, read: ReadState, n_actions: int, settings: PosteriorSamplingSettings, seeds: SeedTree) -> None:
        super().__init__(read, n_actions, settings, seeds, directed=True)
        self.prior = settings.prior
        self.drawing = seeds.child("posterior").generator()
        self.drawn: dict[int, Floats] | None = None  #: values of this episode's model; None before its first action

    def values(self, observation: Observation, *, explore: bool) -> Floats:
        """Values of every action (A,): of the drawn model, 0 of a state it does not know, or of the counts."""
        if not explore:
            return super().values(observation, explore=False)
        if self.drawn is None:
            discount = self.settings.controller.discount
            with self.meters.cpu_time("time/model_s"):
                self.drawn = self.table.sampled_values(discount, self.prior.concentration, self.drawing)
        return self.drawn.get(self.read(observation), np.zeros(self.n_actions))

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Count the transition; the next episode draws anew."""
        super().observe(transition, episode=episode)
        if transition.terminated or transition.truncated:
            self.drawn = None

    def state(self) -> AgentState:
        """A snapshot, with the model that is being followed."""
        common = super().state()
        drawn = self.drawn or {}
        arrays = {"known": np.array(list(drawn), dtype=np.int64)}
        arrays["values"] = np.array(list(drawn.values())).reshape(-1, self.n_actions)
        own = {"drawn": self.drawn is not None, "posterior": self.drawing.bit_generator.state}
        return AgentState(
            arrays={**common.arrays, **snapshot.prefixed("table/drawn", arrays)}, values={**common.values, **own}
        )

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; errors as above."""
        super().restore(state)
        known, values = (state.arrays[f"table/drawn/{name}"] for name in ("known", "values"))
        rows = dict(zip(known.tolist(), values.copy(), strict=True))
        self.drawn = rows if state.values["drawn"] else None
        self.drawing.bit_generator.state = state.values["posterior"]


def build(context: AgentContext, *, privileged: bool) -> PosteriorSamplingAgent:
    """An agent that reads codes, or, ``privileged``, the macrostate; InvalidValueError if the encoder has no codes."""
    settings = POSTERIOR_SAMPLING.of(context)
    read = read_macrostate if privileged else read_codes(load_codes(context))
    return PosteriorSamplingAgent(read, context.n_actions, settings, context.seeds)


make, make_macrostate = (partial(build, privileged=own) for own in (False, True))
