"""Agents that know their world exactly but for one flaw each, so that every failure of theirs has one known cause."""

from __future__ import annotations

from typing import Any

import numpy as np
from fake_agents import FakeAgent
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.interfaces import AgentContext, AgentState, Frame, Observation, Rules, State, Transition
from imagine_bench.interfaces.capabilities import ExpectedOutcomes
from imagine_bench.registry import AGENTS, AgentEntry
from imagine_bench.rules import optimal_actions, states_of, tabulate


def model_of(rules: Rules, wrong: NDArray[np.bool_] | None = None) -> ExpectedOutcomes:
    """The rules as a model, but for pairs (S, A) about which it is wrong: nothing good follows there."""
    states = states_of(rules)
    shape = (len(states), rules.n_actions)
    wrong = np.zeros(shape, dtype=np.bool_) if wrong is None else wrong
    branches = max(len(rules.outcomes(state, action)) for state in states for action in range(rules.n_actions))
    macrostates = np.zeros((*shape, branches, len(states[0])), dtype=np.int64)
    p_continues, reward = np.zeros((*shape, branches)), np.full(shape, -1000.0)
    for row, action in np.argwhere(~wrong).tolist():
        outcomes = rules.outcomes(states[row], action)
        reward[row, action] = sum(each.probability * each.reward for each in outcomes)
        for branch, each in enumerate(outcomes):
            macrostates[row, action, branch] = each.macrostate
            p_continues[row, action, branch] = each.probability * (not each.terminated)
    return ExpectedOutcomes(macrostates=macrostates, p_continues=p_continues, reward=reward)


class Sound(FakeAgent):
    """Plays perfectly, and tries everything in training. It is shown macrostates, and the rules."""

    settings = None
    task = "arrow_puzzle"  # set by the test

    def __init__(self, context: AgentContext) -> None:
        self.rules: Rules = registry.task(self.task).rules
        self.rows = {state: row for row, state in enumerate(states_of(self.rules))}
        tables = tabulate(self.rules)
        best = optimal_actions(tables)[:, [tables.index[state] for state in self.rows]].T  # [S, A]
        legal = [[self.rules.is_legal(o.macrostate) for o in self._first(state)] for state in self.rows]
        self.best, self.share = best.argmax(axis=1), np.where(best, 1, 4)  # the best is tried most, so that it gets far
        self.bad = (2 * ~best + np.array(legal)).argmax(axis=1)  # never optimal where anything is not; legal if it can
        self.tried = np.zeros(best.shape, dtype=np.int64)

    def _first(self, state: State) -> list[Any]:
        return [self.rules.outcomes(state, action)[0] for action in range(self.rules.n_actions)]

    def act(self, observation: Observation, *, explore: bool) -> int:
        assert observation.macrostate is not None
        row = self.rows[tuple(observation.macrostate.tolist())]
        return int(self.explores(row) if explore else self.plays(row))

    def explores(self, row: int) -> int:
        return int((self.tried[row] * self.share[row]).argmin())

    def plays(self, row: int) -> int:
        return int(self.best[row])

    def observe(self, transition: Transition, *, episode: int) -> None:
        assert transition.observation.macrostate is not None
        self.tried[self.rows[tuple(transition.observation.macrostate.tolist())], transition.action] += 1

    def state(self) -> AgentState:
        return AgentState(arrays={"tried": self.tried.copy()}, values={})

    def restore(self, state: AgentState) -> None:
        self.tried = state.arrays["tried"].copy()


class Bad(Sound):
    """Without a model, and never optimal, though it experienced all it needs."""

    def plays(self, row: int) -> int:
        return int(self.bad[row])


class NotGreedy(Bad):
    """Has a right model, and does not use it."""

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        return model_of(self.rules)


class WrongModel(Bad):
    """Experienced everything, and expects nothing good of anything."""

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        return model_of(self.rules, np.ones(self.tried.shape, dtype=np.bool_))


class Timid(Bad):
    """Never tries anything good, and has no model."""

    def explores(self, row: int) -> int:
        return int(self.bad[row])


class TimidModeller(Timid):
    """Never tries anything good; its model is right about the rest."""

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        return model_of(self.rules, self.tried == 0)


class Blind(Sound):
    """Plays perfectly for another cube than the one that is pointed at, in clean frames: it misreads every gesture."""

    def __init__(self, context: AgentContext) -> None:
        super().__init__(context)
        spec, states = registry.task(self.task), np.array(list(self.rows))
        frames = spec.render_macrostates(states, "clean", np.random.default_rng(0))
        states[:, -1] = (states[:, -1] + 1) % (states[:, -1].max() + 1)
        self.states, self.frames = states, frames.astype(np.float32).reshape(len(frames), -1)

    def act(self, observation: Observation, *, explore: bool) -> int:
        row = self.rows[tuple(self.read_frames(observation.frame[None])[0].tolist())]
        return int(self.explores(row) if explore else self.plays(row))

    def read_frames(self, frames: Frame) -> NDArray[np.int64]:
        return np.array([self.states[np.abs(self.frames - frame.ravel()).sum(axis=1).argmin()] for frame in frames])

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        return model_of(self.rules)


class HalfBlind(Blind):
    """Misreads the gesture where the first arrow points one of two ways."""

    def read_frames(self, frames: Frame) -> NDArray[np.int64]:
        read, n_gestures = super().read_frames(frames), self.states[:, -1].max() + 1
        read[:, -1] = np.where(read[:, 0] % 2, read[:, -1], (read[:, -1] - 1) % n_gestures)
        return read


class Dazzled(Blind):
    """Misreads gestures in noise alone."""

    def read_frames(self, frames: Frame) -> NDArray[np.int64]:
        read, n_gestures = super().read_frames(frames), self.states[:, -1].max() + 1
        clean = np.array([np.abs(self.frames - frame.ravel()).mean(axis=1).min() < 12.0 for frame in frames])
        read[:, -1] = np.where(clean, (read[:, -1] - 1) % n_gestures, read[:, -1])
        return read


class Forgetful(Bad):
    """Plays perfectly on the first frame of an episode, and never again."""

    begun = True

    def begin_episode(self) -> None:
        self.begun = True

    def plays(self, row: int) -> int:
        first, self.begun = self.begun, False
        return int((self.best if first else self.bad)[row])


FLAWED = {
    "sound": Sound, "bad": Bad, "not_greedy": NotGreedy, "wrong_model": WrongModel, "timid": Timid,
    "timid_modeller": TimidModeller, "blind": Blind, "half_blind": HalfBlind,
    "dazzled": Dazzled,
    "forgetful": Forgetful,
}  # fmt: skip
for name, kind in FLAWED.items():
    AGENTS[name] = AgentEntry(make=f"flawed_agents:{kind.__name__}", needs_encoder=False, privileged=True)
