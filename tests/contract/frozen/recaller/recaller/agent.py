"""The agent: Q-learning in a table, by real transitions and by rollouts that are recalled."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from imagine_bench.agents.encoders.encoder import Encoder
from numpy.typing import NDArray

from imagine_bench.capabilities import ExpectedOutcomes, ImaginedRollout, planned_actions
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import AgentContext, AgentState, Frame, Observation, Transition
from recaller.memory import Memory
from recaller.settings import resolve


class Recaller:
    """Sees the codes of frames; all that it knows goes through ``state`` and ``restore``."""

    def __init__(self, context: AgentContext) -> None:
        assert context.encoder is not None
        self.encoder = Encoder.load(context.encoder)
        self.settings = resolve(context.hyperparameters, context.overrides, context.config_group)
        self.n_actions = context.n_actions
        self.rng = context.seeds.child("act").generator()
        self.dreams = context.seeds.child("imagine").generator()
        self.memory = Memory()
        self.values: dict[str, list[float]] = {}
        self.recalled = 0
        self.pending = 0
        self.keys: dict[bytes, str] = {}

    def act(self, observation: Observation, *, explore: bool) -> int:
        if explore and self.rng.random() < self.settings.learning.epsilon:
            return int(self.rng.integers(self.n_actions))
        return int(np.argmax(self.q_values(observation)))

    def observe(self, transition: Transition, *, episode: int) -> None:
        state = self._key(transition.observation.frame)
        after = self._key(transition.next_observation.frame)
        followed = (after, transition.reward, transition.terminated)
        self.memory.add(state, transition.action, followed)
        self._learn(state, transition.action, transition.reward, transition.terminated, after)
        self._recall(self.settings.recalling.rollouts)
        self.pending = 1

    def diagnostics(self) -> dict[str, float]:
        return {"known_states": float(len(self.values)), "imagination/transitions": float(self.recalled)}

    def state(self) -> AgentState:
        rows = np.array(list(self.values.values()), dtype=np.float64).reshape(-1, self.n_actions)
        values: dict[str, Any] = {
            "keys": list(self.values),
            "memory": self.memory.rows(),
            "recalled": self.recalled,
            "pending": self.pending,
            "generators": [each.bit_generator.state for each in (self.rng, self.dreams)],
        }
        return AgentState(arrays={"values": rows}, values=values)

    def restore(self, state: AgentState) -> None:
        if state.arrays["values"].shape[1:] != (self.n_actions,):
            raise ArtefactError(f"The snapshot is not one of {self.n_actions} actions.")
        self.values = dict(zip(state.values["keys"], state.arrays["values"].tolist(), strict=True))
        self.memory = Memory.of(state.values["memory"])
        self.recalled = state.values["recalled"]
        self.pending = state.values["pending"]
        for each, kept in zip((self.rng, self.dreams), state.values["generators"], strict=True):
            each.bit_generator.state = kept

    # What it offers beyond the agent's interface: imagined rollouts, values, a model that is asked and trained in.

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        planned = planned_actions(actions, depth, self.n_actions)
        state = self._key(frame)
        states: list[str] = []
        done: list[int] = []
        rewards: list[float] = []
        ends: list[bool] = []
        values: list[list[float]] = []
        unknown: list[float] = []
        while len(done) < (depth if planned is None else len(planned)):
            row = self._row(state)
            action = int(np.argmax(row)) if planned is None else planned[len(done)]
            values.append(row)
            unknown.append(float(self.memory.count(state, action) == 0))
            state, reward, terminated = self.memory.draw(state, action, rng)
            states.append(state)
            done.append(action)
            rewards.append(reward)
            ends.append(terminated)
            if terminated and planned is None:
                break
        epistemic = np.array(unknown, dtype=np.float32)
        return ImaginedRollout(
            actions=np.array(done, dtype=np.int64),
            frames=self.encoder.decode(self._latents(states)),
            start_frame=self.encoder.decode(self.encoder.encode(frame[None])[0])[0],
            rewards=np.array(rewards, dtype=np.float32),
            p_terminated=np.array(ends, dtype=np.float32),
            q_values=np.array(values, dtype=np.float32),
            epistemic=epistemic,
            aleatoric=np.zeros(len(done), dtype=np.float32),
            modal=np.zeros(len(done), dtype=np.float32),
            accepted=np.cumsum(epistemic) == 0,
            macrostates=self.encoder.read_macrostate(self._latents(states)),
        )

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        return np.array(self._row(self._key(observation.frame)), dtype=np.float32)

    def read_frames(self, frames: Frame) -> NDArray[np.int64]:
        return self.encoder.read_macrostate(self.encoder.encode(frames)[0])

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        """Every outcome is drawn four times; a branch each."""
        shape = (len(frames), self.n_actions, 4)
        states: list[str] = []
        p_continues = np.zeros(shape)
        reward = np.zeros(shape)
        for row, action, branch in np.ndindex(shape):
            after, gained, terminated = self.memory.draw(self._key(frames[row]), action, rng)
            states.append(after)
            reward[row, action, branch] = gained
            p_continues[row, action, branch] = 0.0 if terminated else 0.25
        macrostates = self.encoder.read_macrostate(self._latents(states)).reshape(*shape, -1)
        return ExpectedOutcomes(macrostates=macrostates, p_continues=p_continues, reward=reward.mean(axis=2))

    def train_in_model(self) -> bool:
        if not self.pending:
            return False
        self.pending = 0
        self._recall(10)
        return True

    def reset_for_new_task(self) -> None:
        self.values = {}

    def _recall(self, rollouts: int) -> None:
        """Learn from rollouts of random macro-actions out of states that were seen."""
        known = self.memory.states()
        for _ in range(rollouts if known else 0):
            state = known[int(self.dreams.integers(len(known)))]
            for _ in range(self.settings.recalling.depth):
                action = int(self.dreams.integers(self.n_actions))
                if not self.memory.count(state, action):
                    break
                after, reward, terminated = self.memory.draw(state, action, self.dreams)
                self._learn(state, action, reward, terminated, after)
                self.recalled += 1
                state = after
                if terminated:
                    break

    def _learn(self, state: str, action: int, reward: float, terminated: bool, after: str) -> None:
        learning = self.settings.learning
        ahead = 0.0 if terminated else learning.discount * max(self._row(after))
        row = self.values.setdefault(state, [0.0] * self.n_actions)
        row[action] += learning.step_size * (reward + ahead - row[action])

    def _row(self, state: str) -> list[float]:
        return self.values.get(state, [0.0] * self.n_actions)

    def _key(self, frame: Frame) -> str:
        content = frame.tobytes()
        if content not in self.keys:
            codes = self.encoder.encode(frame[None])[0][0].round().int().tolist()
            self.keys[content] = "".join(str(code) for code in codes)
        return self.keys[content]

    def _latents(self, states: list[str]) -> torch.Tensor:
        return torch.tensor([[float(code) for code in state] for state in states])
