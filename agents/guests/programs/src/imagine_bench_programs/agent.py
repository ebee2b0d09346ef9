"""The agents ``program:FILE.py``, which plans in a program that is given, and ``laws:given``, which writes its own."""

from __future__ import annotations

import numpy as np
from imagine_bench.agents import snapshot
from imagine_bench.agents.meters import Meters
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentContext, AgentState, Arrays, Frame, Observation, State, Transition
from imagine_bench.interfaces.capabilities import ExpectedOutcomes

from .program import Program
from .settings import HYPERPARAMETERS
from .symbols import Symbols
from .writing.delay import CodedRow
from .writing.writer import Writer

_TYPES = {
    "now": np.int64,
    "action": np.int64,
    "then": np.int64,
    "reward": np.float64,
    "ended": np.bool_,
    "step": np.int64,
}


class ProgramAgent:
    """Reads symbols in frames, and acts by value iteration in the program. It learns nothing."""

    def __init__(self, symbols: Symbols, program: Program) -> None:
        self.symbols = symbols
        self.program = program
        self._before: tuple[State, int] | None = None
        """State and macro-action before, in this episode."""

    def begin_episode(self) -> None:
        """Forget the episode so far."""
        self._before = None

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The optimal macro-action in the program."""
        del explore
        (seen,) = self.symbols.read(observation.frame[None])
        state = self.program.start(seen) if self._before is None else self.program.follow(*self._before, seen)
        action = self.program.optimal_action(state)
        self._before = (state, action)
        return action

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Learn nothing."""

    def diagnostics(self) -> dict[str, float]:
        """Nothing is measured."""
        return {}

    def state(self) -> AgentState:
        """The program's digest is in the agent's name; there is nothing else to keep."""
        return AgentState(arrays={}, values={})

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot, which holds nothing; ArtefactError if it holds anything."""
        snapshot.require_fit(state, self.state(), equal=())


class LawsAgent:
    """Reads codes in frames, and writes laws from its own transitions; see :mod:`.writer`."""

    def __init__(self, symbols: Symbols, context: AgentContext) -> None:
        self.symbols = symbols
        self.meters = Meters()
        self._rng = context.seeds.child("exploration").generator()
        self.writer = Writer(symbols.sizes, context.n_actions, self._rng)
        self._step = 0
        """Macro-actions of this episode that it learned from."""

    def begin_episode(self) -> None:
        """Forget the macro-actions of the episode so far, whose effects late frames may not show yet."""
        self._step = 0
        self.writer.begin_episode()

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The first macro-action of the best plan, or, exploring, of the best plan that may be."""
        (seen,) = self.symbols.read(observation.frame[None])
        return self.writer.choose(seen, explore=explore)

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Learn from the transition."""
        with self.meters.cpu_time("time/model_s"):
            now, then = self.symbols.read(np.stack([transition.observation.frame, transition.next_observation.frame]))
            self.writer.learn(
                CodedRow(now, transition.action, then, transition.reward, transition.terminated, self._step)
            )
            self._step += 1
        self.meters.count("time/model_s")

    def read_frames(self, frames: Frame) -> NDArray[np.int64]:
        """The reading of a probe; see :class:`imagine_bench.interfaces.capabilities.FrameReader`."""
        return self.symbols.macrostates(self.symbols.read(frames))

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        """The outcomes by its laws; see :class:`imagine_bench.interfaces.capabilities.OutcomePredictor`."""
        del rng
        n_actions = self.writer.n_actions
        here = self.symbols.read(frames)
        pairs = [self.writer.laws.outcomes(state, action) for state in here for action in range(n_actions)]
        goes_on = [[each for each in outcomes if not each.terminated] for outcomes in pairs]
        most = max([1, *map(len, goes_on)])
        following = np.repeat(np.repeat(here, n_actions, axis=0)[:, None], most, axis=1)  # filled up with no change
        p_continues = np.zeros(following.shape[:2])
        for row, outcomes in enumerate(goes_on):
            for column, each in enumerate(outcomes):
                following[row, column] = each.macrostate
                p_continues[row, column] = each.probability
        different, which = np.unique(following.reshape(-1, len(self.symbols.sizes)), axis=0, return_inverse=True)
        read = self.symbols.macrostates([tuple(row) for row in different.tolist()])[which.ravel()]
        rewards = [sum(each.probability * each.reward for each in outcomes) for outcomes in pairs]
        shape = (len(here), n_actions)
        return ExpectedOutcomes(
            macrostates=read.reshape(*shape, most, -1),
            p_continues=p_continues.reshape(*shape, most),
            reward=np.array(rewards).reshape(shape),
        )

    def diagnostics(self) -> dict[str, float]:
        """CPU seconds a real step since the last call, and the counters now: real transitions, and laws."""
        counts = {"real_transitions": len(self.writer.rows), "gradient_updates": 0, "laws": self.writer.laws.count}
        return {**self.meters.read(), **{name: float(count) for name, count in counts.items()}}

    def state(self) -> AgentState:
        """A snapshot: the transitions and the generator."""
        factors = len(self.symbols.sizes)
        arrays: Arrays = {
            name: np.array([getattr(row, name) for row in self.writer.rows], dtype=kind)
            for name, kind in _TYPES.items()
        }
        arrays |= {name: arrays[name].reshape(-1, factors) for name in ("now", "then")}
        values = {
            "exploration": self._rng.bit_generator.state,
            "meters": self.meters.state(),
            "code_sizes": list(self.symbols.sizes),
        }
        return AgentState(arrays=snapshot.prefixed("replay", arrays), values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot by learning from its transitions again; ArtefactError if it does not fit this agent."""
        snapshot.require_fit(state, self.state(), equal=("code_sizes",))
        arrays = snapshot.below("replay", state.arrays)
        self.writer = Writer(self.symbols.sizes, self.writer.n_actions, self._rng)
        columns = (arrays[name].tolist() for name in _TYPES)
        for now, action, then, reward, ended, step in zip(*columns, strict=True):
            self.writer.learn(CodedRow(tuple(now), action, tuple(then), reward, ended, step))
        self.meters.restore(state.values["meters"])
        self._rng.bit_generator.state = state.values["exploration"]


def make_program(context: AgentContext) -> ProgramAgent:
    """The agent ``program:FILE.py``; InvalidValueError as of :class:`.program.Program`."""
    symbols = Symbols(context, HYPERPARAMETERS.of(context).symbols)
    return ProgramAgent(symbols, Program(context.argument, symbols.sizes, context.n_actions))


def make_laws(context: AgentContext) -> LawsAgent:
    """The agent ``laws:given``, on the codes of the context's encoder."""
    return LawsAgent(Symbols(context, "codes"), context)
