"""``CodeAgent``: a structured model of codes and plans in it, for ``factored`` and ``factored:given``."""

from __future__ import annotations

import importlib
import warnings
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentState, Floats, Frame, Observation, Transition
from imagine_bench.seeding import SeedTree

from .. import snapshot
from ..meters import Meters
from ..settings import flatten
from .factors import Code, CodeReplay, CodeTransition, Memory
from .model import FactoredModel
from .planner import TIE, Planner
from .settings import FactoredSettings

_EXPECTED = 0.9
"""A transition held less probable than this is unexpected, as is any that would still be explored."""


class FactorReader(Protocol):
    """Frames to codes; ``sizes`` are the numbers of values of the P factors."""

    @property
    def sizes(self) -> tuple[int, ...]:
        """Length P."""

    def code(self, frame: Frame) -> Code:
        """The code of a frame (64, 64, 3)."""


PerceptionT = TypeVar("PerceptionT", bound=FactorReader)


class CodeAgent(Generic[PerceptionT]):
    """Learns from codes alone; every transition is replayed, and the model is a function of the replay memory."""

    def __init__(self, perception: PerceptionT, n_actions: int, settings: FactoredSettings, seeds: SeedTree) -> None:
        self.n_actions = n_actions
        self.settings = settings
        self.rng = seeds.child("exploration").generator()
        self.perception = perception
        self.replay = CodeReplay(len(self.perception.sizes))
        self.meters = Meters()
        self._reset_model()

    def _reset_model(self) -> None:
        """An empty model; the first ``learned`` of the replayed transitions are in it."""
        self.model = FactoredModel(self.perception.sizes, self.n_actions, self.settings, self._memory)
        self.planner = Planner(self.model, self.settings.planning)
        self.learned = 0
        self.tasks: list[int] = []
        """How much was replayed when each later task began."""

    @property
    def _ready(self) -> bool:
        """Whether anything is known of what this task rewards, so that there is something to plan for."""
        return self.model.outcomes.causes is not None

    @property
    def _memory(self) -> Memory | None:
        """Of which factor the last value of a code is a memory; None where it is seen as all are."""
        return None

    @property
    def _left(self) -> int | None:
        """How many macro-actions an episode has left, where that is known."""
        return None

    def _values(self, code: Code) -> Floats:
        return self.planner.values(code, left=self._left) if self._ready else np.zeros(self.n_actions)

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The action of the largest value; exploring, that which leads to the most unknown as long as there is any."""
        if not self._ready:
            return int(self.rng.integers(self.n_actions)) if explore else 0
        code = self.perception.code(observation.frame)
        if not explore:
            return int(self._values(code).argmax())
        values = self._exploring_values(code)
        return int(self.rng.choice(np.flatnonzero(values >= values.max() - TIE)))

    def _exploring_values(self, code: Code) -> Floats:
        planning = self.settings.planning
        if planning.exploration == "optimism":
            return self.planner.values(code, "optimistic", self._left)
        if planning.exploration == "random":
            return np.zeros(self.n_actions) if self.rng.random() < planning.epsilon else self._values(code)
        novelty = self.planner.values(code, "novelty", self._left)
        curious = novelty.max() >= planning.exploration_threshold
        self.meters.add("exploration/share", float(curious))
        self.meters.add("exploration/novelty", float(novelty.max()))
        return novelty if curious else self._values(code)

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Keep the transition; if it was unexpected, learn from all since the last one, and plan anew."""
        with self.meters.cpu_time("time/model_s"):
            code = self.perception.code(transition.observation.frame)
            following = self.perception.code(transition.next_observation.frame)
            row = CodeTransition(code, transition.action, following, transition.reward, transition.terminated)
            (probability,), (unknown,) = self.model.probabilities([row])
            unexpected = bool(probability < _EXPECTED or unknown > self.settings.planning.exploration_threshold)
            self.replay.add(row)
            if unexpected:
                self.learn()
        self.meters.add("model/unexpected", float(unexpected))
        self.meters.count("time/model_s")

    def learn(self, end: int | None = None) -> None:
        """Bring the model from the first ``learned`` transitions to the first ``end``, or all, and plan anew."""
        rows = self.replay.rows(self.learned, end)
        for row in rows:
            self.model.add(row)
        self.model.outcomes.fit()
        self.planner.learned({row.action for row in rows if row.has_dynamics})
        self.learned = len(self.replay) if end is None else end

    def _relearn(self, tasks: list[int], learned: int) -> None:
        """Learn from the first ``learned`` transitions once more, with tasks that began after as many as given."""
        self._reset_model()
        for began in tasks:
            self.learn(began)
            self._begin_task()
        if learned > self.learned:
            self.learn(learned)

    def reset_for_new_task(self) -> None:
        """Keep the dynamics, and earlier causes as priors; see :meth:`.outcomes.OutcomeModel.reset_for_new_task`."""
        self.learn()
        self._begin_task()
        self.meters = Meters()  # what was measured on an earlier task is no diagnosis of this one

    def _begin_task(self) -> None:
        self.tasks.append(self.learned)
        self.model.outcomes.reset_for_new_task()
        self.planner.learned(())

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        """Value of every macro-action, in units of reward; zeros before anything was seen. Shape (A,)."""
        return self._values(self.perception.code(observation.frame)).astype(np.float32)

    def novelty(self, observation: Observation, rng: np.random.Generator) -> NDArray[np.float32] | None:
        """Where it would explore; see :class:`.capabilities.NoveltyReader`. None before it learned."""
        del rng
        if not self._ready:
            return None
        code = self.perception.code(observation.frame)
        return self.planner.values(code, "novelty", self._left).astype(np.float32)

    def diagnostics(self) -> dict[str, float]:
        """Means since the last call (``time/*`` in CPU seconds a real step), and the counters now."""
        began = self.tasks[-1] if self.tasks else 0
        real = self.replay.count_real(began)
        labels = self.replay.count_labels(began)
        outcomes = len(self.model.outcomes.outcomes)
        counters = {
            "real_transitions": real, "gradient_updates": 0, "oracle/labels": labels, "model/outcomes": outcomes
        }  # fmt: skip
        return {**self.meters.read(), **{name: float(value) for name, value in counters.items()}}

    def state(self) -> AgentState:
        """A snapshot: what is replayed, how much of it is learned, the generator, measurements."""
        values = {
            "learned": self.learned, "tasks": list(self.tasks), "exploration": self.rng.bit_generator.state,
            "meters": self.meters.state(), "settings": snapshot.jsonable(flatten(self.settings)),
            "code_sizes": list(self.perception.sizes), "n_actions": self.n_actions,
        }  # fmt: skip
        return AgentState(arrays=snapshot.prefixed("replay", self.replay.arrays()), values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot by learning from all that is replayed once more.

        ArtefactError if it does not fit this agent, and then nothing was changed.
        """
        snapshot.require_fit(state, self.state(), equal=("settings", "code_sizes", "n_actions"))
        self._take_up(state)

    def _take_up(self, state: AgentState) -> None:
        self.replay.load(snapshot.below("replay", state.arrays))
        self._relearn(state.values["tasks"], state.values["learned"])
        self.meters.restore(state.values["meters"])
        self.rng.bit_generator.state = state.values["exploration"]


def __getattr__(name: str) -> object:
    """The names that moved to :mod:`.given`; they warn, and go in version 1.0."""
    moved = {"FactoredAgent": "GivenPerceptionAgent", "make": "make"}
    if name not in moved:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    new = importlib.import_module(".given", __package__)
    message = f"{__name__}:{name} is now {new.__name__}:{moved[name]}; import it from there."
    warnings.warn(message, DeprecationWarning, stacklevel=2)
    found: object = getattr(new, moved[name])
    globals()[name] = found
    return found
