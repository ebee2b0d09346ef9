"""Agents whose every move is known, for the tests of the bench; run as a script it is the command line with them.

Worker processes import this module too, for an agent of theirs or because a spec of theirs is pickled here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.cli import main
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import AgentContext, AgentState, Frame, Observation, Transition
from imagine_bench.interfaces.capabilities import ImaginedRollout, Label
from imagine_bench.protocols.data import RunSpec
from imagine_bench.registry import AGENTS, AgentEntry
from imagine_bench.seeding import SeedTree


@dataclass(frozen=True)
class FakeSettings:
    rate: float = 0.5


class TableAgent:
    """Q-learning on how bright the frame is: weights, a generator and counters, all of which a resume must restore."""

    settings = FakeSettings()

    def __init__(self, context: AgentContext) -> None:
        self.n_actions = context.n_actions
        self.rng = context.seeds.child("exploration").generator()
        self.table = np.zeros((16, context.n_actions))
        self.errors: list[float] = []
        self.steps = 0

    def _row(self, observation: Observation) -> int:
        return int(observation.frame.sum() // 997) % len(self.table)

    def act(self, observation: Observation, *, explore: bool) -> int:
        if explore and self.rng.random() < 0.5:
            return int(self.rng.integers(self.n_actions))
        return int(self.table[self._row(observation)].argmax())

    def observe(self, transition: Transition, *, episode: int) -> None:
        row, after = self._row(transition.observation), self._row(transition.next_observation)
        target = transition.reward + 0.9 * (not transition.terminated) * self.table[after].max()
        noise = self.rng.normal(scale=0.1)
        error = target + noise - self.table[row, transition.action]
        self.table[row, transition.action] += self.settings.rate * error
        self.errors.append(float(error))
        self.steps += 1

    def diagnostics(self) -> dict[str, float]:
        errors, self.errors = self.errors, []
        return {"loss/bellman": float(np.mean(np.square(errors))) if errors else 0.0, "real_transitions": self.steps}

    def state(self) -> AgentState:
        values = {"rng": self.rng.bit_generator.state, "errors": list(self.errors), "steps": self.steps}
        return AgentState(arrays={"table": self.table.copy()}, values=values)

    def restore(self, state: AgentState) -> None:
        if state.arrays["table"].shape != self.table.shape:
            raise ArtefactError("table has another shape")
        self.table = state.arrays["table"].copy()
        self.rng.bit_generator.state = state.values["rng"]
        self.errors, self.steps = list(state.values["errors"]), state.values["steps"]


class RulesImaginer(TableAgent):
    """Imagines as it is told: ``wrong_from`` is the first depth (from 1) it gets wrong, and the filter knows."""

    wrong_from = 4

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        actions = np.zeros(depth, dtype=np.int64) if actions is None else actions
        count = len(actions)
        right = np.arange(1, count + 1) < self.wrong_from
        return ImaginedRollout(
            actions=actions,
            frames=rng.random((count, 64, 64)).astype(np.float32),
            start_frame=np.zeros((64, 64), dtype=np.float32),
            rewards=np.full(count, -0.5, dtype=np.float32),
            p_terminated=np.where(right, 0.1, 0.9).astype(np.float32),
            q_values=np.zeros((count, self.n_actions), dtype=np.float32),
            epistemic=np.full(count, 0.25, dtype=np.float32),
            aleatoric=np.full(count, 0.5, dtype=np.float32),
            modal=np.full(count, 0.75, dtype=np.float32),
            accepted=right,
            macrostates=np.zeros((count, 4), dtype=np.int64),
        )


class FailingAgent(TableAgent):
    """Breaks in its third episode, with seed 1 only."""

    def __init__(self, context: AgentContext) -> None:
        super().__init__(context)
        self.seeds: SeedTree = context.seeds

    def observe(self, transition: Transition, *, episode: int) -> None:
        if self.seeds.root == 1 and episode == 2:
            print("\x1b[31mred")
            raise RuntimeError("this agent breaks on purpose")
        super().observe(transition, episode=episode)


class Pupil(TableAgent):
    """Notes all that it is shown, asks about random plans whenever it may, and counts its transfers."""

    made: list[Pupil] = []  # noqa: RUF012 - how a test finds it

    def __init__(self, context: AgentContext) -> None:
        super().__init__(context)
        self.optimal_policy = context.optimal_policy
        self.told = context.observation
        self.asking = np.random.default_rng(0)
        self.shown: list[tuple[int, Transition]] = []
        self.seen: list[Observation] = []
        self.answers: list[tuple[NDArray[np.int64], Label | None]] = []
        self.carried: list[int] = []
        self.made.append(self)

    def act(self, observation: Observation, *, explore: bool) -> int:
        self.seen.append(observation)
        return super().act(observation, explore=explore)

    def observe(self, transition: Transition, *, episode: int) -> None:
        self.shown.append((episode, transition))
        super().observe(transition, episode=episode)

    def reset_for_new_task(self) -> None:
        self.carried.append(len({episode for episode, _ in self.shown}))
        self.shown.clear()

    def query(self, observation: Observation) -> NDArray[np.int64] | None:
        self.seen.append(observation)
        return self.asking.integers(self.n_actions, size=3)

    def learn_label(self, observation: Observation, actions: NDArray[np.int64], label: Label | None) -> None:
        self.answers.append((actions, label))

    def state(self) -> AgentState:
        state = super().state()
        return AgentState(arrays=state.arrays, values={**state.values, "asking": self.asking.bit_generator.state})

    def restore(self, state: AgentState) -> None:
        super().restore(state)
        self.asking.bit_generator.state = state.values["asking"]


@dataclass(frozen=True, kw_only=True)
class FakeRunSpec(RunSpec):
    """A spec that makes a worker import this module."""


AGENTS.update(
    table=AgentEntry(make="bench_fakes:TableAgent", needs_encoder=False),
    imaginer=AgentEntry(make="bench_fakes:RulesImaginer", needs_encoder=False),
    failing=AgentEntry(make="bench_fakes:FailingAgent", needs_encoder=False),
    pupil=AgentEntry(make="bench_fakes:Pupil", needs_encoder=False),
    pupil_privileged=AgentEntry(make="bench_fakes:Pupil", needs_encoder=False, privileged=True),
)

if __name__ == "__main__":
    main()
