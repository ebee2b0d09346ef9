"""The control ``count_table_own``: a count table that learns to see as ``factored`` does, from its own frames.

It has the same codes and counts, and neither structure nor uncertainty: R-max on whole codes. Whenever factors are
found anew, it counts all remembered transitions once more by the codes that their frames have now.
"""

from __future__ import annotations

import numpy as np
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench_factored.perception import LearnedPerception

from imagine_bench.interfaces import AgentContext, AgentState, Arrays, Observation, Transition
from imagine_bench.seeding import SeedTree

from .count_table import CountTableAgent
from .settings import OWN, OwnCountTableSettings


class OwnCountTableAgent(CountTableAgent):
    """R-max on codes of its own; states are whole codes as numbers."""

    settings: OwnCountTableSettings

    def __init__(self, n_actions: int, settings: OwnCountTableSettings, seeds: SeedTree) -> None:
        self.perception = LearnedPerception(settings.perception, factored=False)
        super().__init__(self._see, n_actions, settings, seeds, directed=True)
        self._happened: list[tuple[float, bool]] = []
        """Reward and end of every remembered transition."""
        self._begins = True

    def _see(self, observation: Observation) -> int:
        return self.perception.code(observation.frame)[0]

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Remember the frame, find factors anew if that is due, and count."""
        perception = self.perception
        if not perception.full:
            before, after = transition.observation.frame, transition.next_observation.frame
            perception.remember(before, transition.action, after, begins=self._begins)
            if perception.renew():
                self._recount()
            self._happened.append((transition.reward, transition.terminated))
        super().observe(transition, episode=episode)
        self._begins = transition.terminated or transition.truncated

    def _recount(self) -> None:
        """Count every remembered transition by the codes that its frames have now."""
        self.table.clear()
        self._plans.clear()
        perception = self.perception
        codes = perception.codes(np.stack(perception.frames)).values
        happened = zip(perception.transitions, perception.actions, self._happened, strict=False)
        for (before, after), action, (reward, terminated) in happened:
            self.table.add(codes[before][0], action, codes[after][0], reward, terminated)

    def diagnostics(self) -> dict[str, float]:
        """Also its perception."""
        return {**super().diagnostics(), **self.perception.diagnostics()}

    def state(self) -> AgentState:
        """A snapshot: also the frames that it remembers."""
        common = super().state()
        happened: Arrays = {
            "replay/action": np.array(self.perception.actions, dtype=np.int64),
            "replay/reward": np.array([reward for reward, _ in self._happened], dtype=np.float64),
            "replay/terminated": np.array([ended for _, ended in self._happened], dtype=np.bool_),
        }
        arrays: Arrays = {**common.arrays, **self.perception.arrays(), **happened}
        return AgentState(arrays=arrays, values={**common.values, **self.perception.values()})

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        super().restore(state)
        self._begins = True
        self.perception.load(state)
        columns = (state.arrays[f"replay/{name}"].tolist() for name in ("reward", "terminated"))
        self._happened = list(zip(*columns, strict=True))


def make(context: AgentContext) -> OwnCountTableAgent:
    """The ``count_table_own`` agent, of whatever frames are 64 x 64."""
    prepare_torch(context.device)
    settings = OWN.of(context)
    return OwnCountTableAgent(context.n_actions, settings, context.seeds)
