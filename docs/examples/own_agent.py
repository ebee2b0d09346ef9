"""An agent of your own: Q-learning in a table of small gray pictures. Run it: python own_agent.py."""

from __future__ import annotations

import sys

import numpy as np

from imagine_bench.cli import main
from imagine_bench.interfaces import AgentContext, AgentState, Observation, Transition
from imagine_bench.registry import AGENTS, AgentEntry

RATE, DISCOUNT, EPSILON = 0.5, 0.95, 0.2


class OwnAgent:
    """It sees frames, how many actions there are, and its generators; no task, rules or macrostate."""

    def __init__(self, context: AgentContext) -> None:
        self.n_actions = context.n_actions
        self.rng = context.seeds.child("act").generator()
        self.values: dict[str, list[float]] = {}

    def act(self, observation: Observation, *, explore: bool) -> int:
        if explore and self.rng.random() < EPSILON:
            return int(self.rng.integers(self.n_actions))
        return int(np.argmax(self._row(observation)))

    def observe(self, transition: Transition, *, episode: int) -> None:
        after = 0.0 if transition.terminated else DISCOUNT * max(self._row(transition.next_observation))
        row = self.values.setdefault(self._key(transition.observation), [0.0] * self.n_actions)
        row[transition.action] += RATE * (transition.reward + after - row[transition.action])

    def diagnostics(self) -> dict[str, float]:
        return {"known_pictures": float(len(self.values))}

    def state(self) -> AgentState:
        rows = np.array(list(self.values.values())).reshape(-1, self.n_actions)
        values = {"keys": list(self.values), "generator": self.rng.bit_generator.state}
        return AgentState(arrays={"values": rows}, values=values)

    def restore(self, state: AgentState) -> None:
        self.values = dict(zip(state.values["keys"], state.arrays["values"].tolist(), strict=True))
        self.rng.bit_generator.state = state.values["generator"]

    def _row(self, observation: Observation) -> list[float]:
        return self.values.get(self._key(observation), [0.0] * self.n_actions)

    def _key(self, observation: Observation) -> str:
        gray = observation.frame.mean(axis=2).reshape(4, 16, 4, 16).mean(axis=(1, 3))
        return (gray // 8).astype(np.uint8).tobytes().hex()


AGENTS["own_agent"] = AgentEntry(make="own_agent:OwnAgent", needs_encoder=False, title="own agent")
BENCH = "bench --task pick_place --preset smoke --execution kinematic --agents random own_agent --budgets 100 500"

if __name__ == "__main__":
    main([*BENCH.split(), *sys.argv[1:]])
