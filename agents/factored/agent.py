"""The agent ``factored``: sees codes, learns a structured model of them, plans in it, and goes where it is in doubt."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from imagine_bench.capabilities import Answer, ImaginedRollout, planned_actions
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, AgentState, Frame, Observation, Transition
from imagine_bench.seeding import SeedTree

from .. import snapshot
from ..encoders.encoder import Encoder
from ..encoders.perception import load_perception, prepare_torch
from ..meters import Meters
from ..presets import flatten
from .experience import CodeMemory, CodeTransition
from .images import Imagined, one_hot, picture
from .model import StructuredModel, as_codes
from .planner import Planner
from .queries import last_step, question
from .settings import ImagineSettings, resolve

_SURE = 0.9
"""A transition held less probable than this is a surprise, as is any that would still attract curiosity."""
_TERMINAL = 0.5
"""Predicted probability above which an imagined episode ends."""
_TIE = 1e-9


class ImagineAgent:
    """Learns from codes alone; every transition is replayed, and the model is a function of what is replayed.

    Args:
        encoder: Frames to codes of parts.
        n_actions: A.
        settings: All hyperparameters.
        seeds: This agent's node of the seed tree.
    """

    def __init__(self, encoder: Encoder, n_actions: int, settings: ImagineSettings, seeds: SeedTree) -> None:
        self.encoder, self.n_actions, self.settings = encoder, n_actions, settings
        self.rng = seeds.child("exploration").generator()
        sizes = encoder.card.code_sizes
        self.sizes = sizes if settings.dynamics.factored else (int(np.prod(sizes)),)
        self.memory = CodeMemory(len(self.sizes))
        self.meters = Meters()
        self._seen: tuple[bytes, tuple[int, ...]] | None = None
        self._start_anew()

    def _start_anew(self) -> None:
        """An empty model; the first ``learned`` of the replayed transitions are in it."""
        self.model = StructuredModel(self.sizes, self.n_actions, self.settings)
        self.planner = Planner(self.model, self.settings.planning)
        self.learned = 0
        self.tasks: list[int] = []
        """How much was replayed when each later task began."""

    @property
    def _ready(self) -> bool:
        """Whether anything is known of what this task rewards, so that there is something to plan for."""
        return self.model.outcomes.causes is not None

    def code(self, frame: Frame) -> tuple[int, ...]:
        """The code of a frame, one value a part; remembers the last one, which often is asked for twice."""
        key = frame.tobytes()
        if self._seen is None or self._seen[0] != key:
            self._seen = (key, self.encoder.codes(frame))
        return self._seen[1]

    def _modelled(self, code: tuple[int, ...]) -> tuple[int, ...]:
        """The code as the model takes it."""
        if self.settings.dynamics.factored:
            return code
        return (int(np.ravel_multi_index(code, self.encoder.card.code_sizes)),)

    def _observed(self, code: tuple[int, ...]) -> tuple[int, ...]:
        """The inverse of :meth:`_modelled`."""
        if self.settings.dynamics.factored:
            return code
        return tuple(int(value) for value in np.unravel_index(code[0], self.encoder.card.code_sizes))

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The action of the largest worth; exploring, that which leads to the most unknown as long as there is any."""
        if not self._ready:
            return int(self.rng.integers(self.n_actions)) if explore else 0
        code = self._modelled(self.code(observation.frame))
        if not explore:
            return int(self.planner.worth(code).argmax())
        values = self._exploring(code)
        return int(self.rng.choice(np.flatnonzero(values >= values.max() - _TIE)))

    def _exploring(self, code: tuple[int, ...]) -> NDArray[np.float64]:
        planning = self.settings.planning
        if planning.exploration == "optimism":
            return self.planner.optimistic(code)
        if planning.exploration == "random":
            random = self.rng.random() < planning.epsilon
            return np.zeros(self.n_actions) if random else self.planner.worth(code)
        novelty = self.planner.novelty(code)
        curious = novelty.max() >= planning.boredom
        self.meters.add("curiosity/share", float(curious))
        self.meters.add("curiosity/novelty", float(novelty.max()))
        return novelty if curious else self.planner.worth(code)

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Remember the transition; if it was a surprise, learn from all since the last one, and forget all plans."""
        with self.meters.cpu_time("time/model_s"):
            row = CodeTransition(
                code=self._modelled(self.code(transition.observation.frame)),
                action=transition.action,
                following=self._modelled(self.code(transition.next_observation.frame)),
                reward=transition.reward,
                terminated=transition.terminated,
            )
            chance, unknown = self.model.expected(row)
            surprise = chance < _SURE or unknown > self.settings.planning.boredom
            self.memory.add(row)
            if surprise:
                self._learn(len(self.memory))
        self.meters.add("model/surprise", float(surprise))
        self.meters.count("time/model_s")

    def _learn(self, upto: int) -> None:
        """Bring the model from the first ``learned`` transitions to the first ``upto``, and plan anew."""
        for row in itertools.islice(self.memory.since(self.learned), upto - self.learned):
            self.model.add(row)
        self.model.outcomes.fit()
        self.planner.forget()
        self.learned = upto

    def reset_for_new_task(self) -> None:
        """Keep the dynamics, and of what was rewarded no more than hints; see :meth:`.outcomes.Outcomes.reset_for_new_task`."""
        self._learn(len(self.memory))
        self._begin_task()
        self.meters = Meters()  # what was measured on an earlier task is no diagnosis of this one

    def _begin_task(self) -> None:
        self.tasks.append(self.learned)
        self.model.reset_for_new_task()
        self.planner.forget()

    def question(self, observation: Observation) -> NDArray[np.int64] | None:
        """What to ask; see :class:`imagine_bench.capabilities.QueryingAgent` and :mod:`.questions`."""
        planning = self.settings.planning
        with self.meters.cpu_time("time/model_s"):
            return question(
                self.model,
                self._modelled(self.code(observation.frame)),
                depth=planning.depth,
                codes=planning.states,
                least=planning.boredom,
                without=self.memory.in_vain,
            )

    def learn_label(self, observation: Observation, actions: NDArray[np.int64], answer: Answer | None) -> None:
        """Learn the outcome of an imagined transition, and nothing of the dynamics, or that it has no answer."""
        code, action, following = last_step(self.model, self._modelled(self.code(observation.frame)), actions)
        reward, terminated = (0.0, False) if answer is None else (answer.reward, answer.terminated)
        self.memory.add(
            CodeTransition(code, action, following, reward, terminated, moves=False, pays=answer is not None)
        )
        with self.meters.cpu_time("time/model_s"):
            self._learn(len(self.memory))

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        """Worth of every macro-action, in units of reward; zeros before anything was seen. Shape (A,)."""
        if not self._ready:
            return np.zeros(self.n_actions, dtype=np.float32)
        return self.planner.worth(self._modelled(self.code(observation.frame))).astype(np.float32)

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        """Imagine up to ``depth`` transitions from ``frame``; see :class:`imagine_bench.capabilities.Imaginer`.

        ``epistemic`` is the probability that something untested decides the transition, ``modal`` that it does not
        lead where it most probably leads; a categorical model knows no Gaussian noise, so ``aleatoric`` is 0.

        Raises:
            InvalidValueError: No depth to imagine, or actions that are none.
        """
        planned = planned_actions(actions, depth, self.n_actions)
        start = self.encoder.codes(frame)
        steps: list[Imagined] = []
        code = self._modelled(start)
        for index in range(depth if planned is None else len(planned)):
            steps.append(self._imagined(code, None if planned is None else planned[index], rng))
            if planned is None and steps[-1].p_terminated > _TERMINAL:
                break
            code = self._modelled(steps[-1].code)
        return picture(self.encoder, start, steps)

    def replayed(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """What it did, answers of a teacher not counted; see :class:`imagine_bench.capabilities.ReplayReader`."""
        rows = [row for row in self.memory.since(0) if row.moves]
        codes = np.array([self._observed(row.code) for row in rows], dtype=np.int64)
        sizes = self.encoder.card.code_sizes
        macrostates = self.encoder.read_macrostate(one_hot(codes.reshape(-1, len(sizes)), sizes))
        return macrostates, np.array([row.action for row in rows], dtype=np.int64)

    def _imagined(self, code: tuple[int, ...], action: int | None, rng: np.random.Generator) -> Imagined:
        """One imagined step of ``action``, or of the greedy one."""
        worth = self.planner.worth(code) if self._ready else np.zeros(self.n_actions)
        chosen = int(worth.argmax()) if action is None else action
        if not self._ready:
            return Imagined(
                action=chosen,
                code=self._observed(code),
                reward=0.0,
                p_terminated=0.0,
                values=worth,
                unknown=1.0,
                otherwise=0.0,
            )
        following, sure = self.model.sample(as_codes(code), chosen, rng)
        return Imagined(
            action=chosen,
            code=self._observed(tuple(following.tolist())),
            reward=float(self.planner.reward(code)[chosen]),
            p_terminated=float(self.planner.terminates(code)[chosen]),
            values=worth,
            unknown=float(self.planner.unknown(code)[chosen]),
            otherwise=1.0 - sure,
        )

    def diagnostics(self) -> dict[str, float]:
        """Means since the last call (``time/*`` in CPU seconds a real step), and the counters now."""
        began = self.tasks[-1] if self.tasks else 0
        counters = {
            "real_transitions": self.memory.real(since=began),
            "teacher/answers": self.memory.told(since=began),
            "model/outcomes": len(self.model.outcomes.kinds),
        }
        return {**self.meters.read(), **{name: float(value) for name, value in counters.items()}}

    def state(self) -> AgentState:
        """A snapshot: what is replayed, how much of it is learned, the generator, measurements."""
        values = {
            "learned": self.learned,
            "tasks": list(self.tasks),
            "exploration": self.rng.bit_generator.state,
            "meters": self.meters.state(),
            "settings": snapshot.jsonable(flatten(self.settings)),
            "code_sizes": list(self.sizes),
            "n_actions": self.n_actions,
        }
        return AgentState(arrays=snapshot.prefixed("memory", self.memory.arrays()), values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot by living through what is replayed once more.

        Raises:
            ArtefactError: It does not fit this agent; nothing was changed.
        """
        snapshot.require_fit(state, self.state(), equal=("settings", "code_sizes", "n_actions"))
        self.memory.load(snapshot.below("memory", state.arrays))
        self._start_anew()
        for began in state.values["tasks"]:
            self._learn(began)
            self._begin_task()
        if state.values["learned"] > self.learned:
            self._learn(state.values["learned"])
        self.meters.restore(state.values["meters"])
        self.rng.bit_generator.state = state.values["exploration"]


def make(context: AgentContext) -> ImagineAgent:
    """The ``factored`` agent.

    Raises:
        InvalidValueError: The context's encoder gives no codes.
    """
    settings = resolve(context.preset, context.overrides, context.settings)
    prepare_torch(context.device)
    encoder = load_perception(context).encoder
    if not encoder.card.code_sizes:
        raise InvalidValueError(
            f"Agent 'factored' reads codes of parts, and encoder {encoder.card.recipe.name!r} gives continuous latents; "
            "give one made with `imagine-bench encoder --recipe codes`."
        )
    return ImagineAgent(encoder, context.n_actions, settings, context.seeds)
