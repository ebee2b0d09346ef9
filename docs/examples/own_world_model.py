"""A world model of your own, held against the exact distribution of futures. Run it: python own_world_model.py.

The model remembers what followed each macro-action in each code of a frame, and samples from it; the agent plans in it
by value iteration. The report compares its futures with those that the rules allow.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
import torch
from imagine_bench.agents.encoders.encoder import Encoder

from imagine_bench.capabilities import Follow, SampledFutures
from imagine_bench.cli import main
from imagine_bench.interfaces import AgentContext, AgentState, Frame, Observation, Transition
from imagine_bench.registry import AGENTS, AgentEntry

DISCOUNT, EPSILON, SWEEPS = 0.95, 0.3, 20
Outcome = tuple[str, float, bool]  # code of the next frame, reward, whether the episode ended


class OwnModel:
    """``memory[code][action]`` holds every outcome that was seen."""

    def __init__(self, context: AgentContext) -> None:
        assert context.encoder is not None
        self.encoder, self.n_actions = Encoder.load(context.encoder), context.n_actions
        self.rng = context.seeds.child("act").generator()
        self.memory: dict[str, list[list[Outcome]]] = {}
        self.values: dict[str, float] = {}

    def act(self, observation: Observation, *, explore: bool) -> int:
        if explore and self.rng.random() < EPSILON:
            return int(self.rng.integers(self.n_actions))
        return int(np.argmax(self._worth(self._codes(observation.frame[None])[0])))

    def observe(self, transition: Transition, *, episode: int) -> None:
        code, after = self._codes(np.stack([transition.observation.frame, transition.next_observation.frame]))
        outcomes = self.memory.setdefault(code, [[] for _ in range(self.n_actions)])
        outcomes[transition.action].append((after, transition.reward, transition.terminated))
        if transition.terminated or transition.truncated:
            for _ in range(SWEEPS):
                self.values = {known: max(self._worth(known)) for known in self.memory}

    def sample_futures(
        self, frames: Frame, actions: Any, *, follow: Follow, samples: int, depth: int, rng: np.random.Generator
    ) -> SampledFutures:
        """What the judge asks for: futures in closed loop, ``follow`` choosing the later macro-actions."""
        codes = [code for code in self._codes(frames) for _ in range(samples)]
        chosen, over = np.repeat(actions, samples), np.zeros(len(codes), dtype=np.bool_)
        states = self._macrostates(codes)
        shape = (depth, len(frames), samples)
        macrostates = np.zeros((depth, *states.shape), dtype=np.int64)
        rewards, ended = np.zeros((depth, len(codes)), dtype=np.float32), np.zeros((depth, len(codes)), dtype=np.bool_)
        for step in range(depth):
            for index in np.flatnonzero(~over & (chosen >= 0)):
                seen = self.memory.get(codes[index], [[]] * self.n_actions)[chosen[index]]
                if seen:  # of what it never saw it says that nothing changes
                    codes[index], rewards[step, index], over[index] = seen[int(rng.integers(len(seen)))]
            over |= chosen < 0
            macrostates[step], ended[step] = self._macrostates(codes), over
            chosen = follow(macrostates[step])
        return SampledFutures(
            macrostates=macrostates.reshape(*shape, -1), rewards=rewards.reshape(shape), ended=ended.reshape(shape)
        )

    def diagnostics(self) -> dict[str, float]:
        return {"known_codes": float(len(self.memory))}

    def state(self) -> AgentState:
        values = {"memory": json.dumps(self.memory), "generator": self.rng.bit_generator.state, "values": self.values}
        return AgentState(arrays={}, values=values)

    def restore(self, state: AgentState) -> None:
        self.memory, self.values = json.loads(state.values["memory"]), dict(state.values["values"])
        self.rng.bit_generator.state = state.values["generator"]

    def _worth(self, code: str) -> list[float]:
        means = [
            [reward + (0.0 if ended else DISCOUNT * self.values.get(after, 0.0)) for after, reward, ended in outcomes]
            for outcomes in self.memory.get(code, [[]] * self.n_actions)
        ]
        return [sum(each) / max(len(each), 1) for each in means]

    def _codes(self, frames: Frame) -> list[str]:
        return ["".join(map(str, row)) for row in self.encoder.encode(frames)[0].round().int().tolist()]

    def _macrostates(self, codes: list[str]) -> Any:
        """What an evaluation-only probe reads from codes."""
        return self.encoder.read_macrostate(torch.tensor([list(map(float, code)) for code in codes]))


AGENTS["own_model"] = AgentEntry(make="own_world_model:OwnModel", encoder_kind="codes", title="own model")
BENCH = "bench --task pick_place --preset smoke --execution kinematic --agents dqn own_model --budgets 20 100"

if __name__ == "__main__":
    sys.exit(main([*BENCH.split(), *sys.argv[1:]]))
