"""``CodeAgent``: a structured model of codes and plans in it; and ``factored:given``, whose codes an encoder gives.

Which imagined outcome ``factored:given`` asks an oracle about: of all that the dynamics surely lead to, through ends of
episodes too, that which is most probably decided by something untested. This is uncertainty sampling (Lewis & Gale
1994) on imagined transitions.
"""

from __future__ import annotations

import numpy as np
from imagine_bench.agents import snapshot
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.meters import Meters
from imagine_bench.agents.settings import flatten

from imagine_bench.arrays import Floats32, Ints
from imagine_bench.interfaces import AgentContext, AgentState, Floats, Frame, Observation, Transition
from imagine_bench.interfaces.capabilities import ExpectedOutcomes, ImaginedRollout, Label, planned_actions
from imagine_bench.seeding import SeedTree

from .factors import Code, CodeTransition, as_arrays, from_arrays
from .model import FactoredModel
from .perception import CodePerception, LearnedPerception, load_code_perception
from .planner import TIE, Objective, Planner
from .rewards import EXACT, RewardClasses, reward_classes
from .settings import HYPERPARAMETERS, FactoredSettings

ACCEPTED = 0.5
"""A transition of which more than this is unknown is not accepted, nor is a transition that follows from it."""
_EXPECTED = 0.9
"""A transition held less probable than this is unexpected, as is any that would still be explored."""
_TERMINAL = 0.5
"""Predicted probability above which an imagined episode ends."""
_REWARDS_GROWTH = 1.2
"""Rewards are classed anew once so many times the transitions of the last time were seen."""
_SURE = 0.5
"""Probability with which each macro-action of a query must lead where it is imagined to."""


class CodeAgent:
    """Learns from codes alone; every transition is replayed, and the model is a function of the replay memory."""

    perception: CodePerception | LearnedPerception
    _observed = 0
    """Transitions of this episode that it was shown, its own or another's."""
    _chosen: tuple[Code, int] | None = None
    """The last code of this episode and the macro-action that was chosen in it, where it is not shown the result."""

    def __init__(
        self,
        perception: CodePerception | LearnedPerception,
        n_actions: int,
        settings: FactoredSettings,
        seeds: SeedTree,
    ) -> None:
        self.n_actions = n_actions
        self.settings = settings
        self.rng = seeds.child("exploration").generator()
        self.perception = perception
        self.replay: list[CodeTransition] = []
        """Every transition that happened or was asked about, in that order; none is dropped."""
        self.rewards: RewardClasses = EXACT
        self.class_rewards: list[float] = []
        """The reward of the class of each replayed transition: the model learns from these."""
        self.classed = 0
        """In how many of the first replayed transitions classes of rewards were looked for."""
        self.meters = Meters()
        self._reset_model()

    def _reset_model(self) -> None:
        """An empty model; the first ``learned`` of the replayed transitions are in it."""
        self.model = FactoredModel(self.perception.sizes, self.n_actions, self.settings, self.perception.memory)
        self.planner = Planner(self.model, self.settings.planning)
        self.learned = 0
        self.tasks: list[int] = []
        """How much was replayed when each later task began."""

    def begin_episode(self) -> None:
        """The next frame is the first of an episode; see :class:`.capabilities.EpisodeRememberer`."""
        self._observed = 0
        self._chosen = None
        if self.model.outcomes.forget_going_on():
            self.planner.learned()

    @property
    def _ready(self) -> bool:
        """Whether anything is known of this task's rewards, so that there is something to plan for."""
        return self.model.outcomes.causes is not None

    @property
    def _left(self) -> int | None:
        """How many macro-actions an episode has left, where that is known."""
        return None

    def _values(self, code: Code, objective: Objective = "value") -> Floats:
        return self.planner.values(code, objective, self._left) if self._ready else np.zeros(self.n_actions)

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The action of the largest value; exploring, see :meth:`exploring_values`."""
        if not self._ready:
            return int(self.rng.integers(self.n_actions)) if explore else 0
        code = self.perception.code(observation.frame)
        if not explore:
            return self._act_greedily(code, is_clear=self.perception.is_clear(observation.frame))
        self._chosen = None
        values = self.exploring_values(code)
        return int(self.rng.choice(np.flatnonzero(values >= values.max() - TIE)))

    def _act_greedily(self, code: Code, *, is_clear: bool) -> int:
        """The action of the largest value.

        Nothing is learned in a test. But an unseen transition after which this episode went on ends no episode: without
        this, an agent that expects a reward there in vain would try the same again and again.
        """
        if is_clear and self._chosen is not None and self.model.outcomes.goes_on(*self._chosen, code):
            self.planner.learned()
        action = int(self._values(code).argmax())
        self._chosen = (code, action) if is_clear else None
        return action

    def exploring_values(self, code: Code) -> Floats:
        """Values (A,) that it acts by in training.

        By R-max, as long as something unknown may earn more than all that is known, or the best reward seen is known to
        be within reach. Elsewhere it goes where most is unknown, until nothing is left; then it acts greedily.
        """
        planning = self.settings.planning
        if planning.exploration == "optimism":
            return self._values(code, "optimistic")
        if planning.exploration == "random":
            return np.zeros(self.n_actions) if self.rng.random() < planning.epsilon else self._values(code)
        if planning.exploration == "r_max":
            hoped = self._values(code, "r_max")
            if hoped.max() > self._values(code).max() + TIE or self._is_solved(code):
                return hoped
        novelty = self._values(code, "novelty")
        curious = novelty.max() >= planning.exploration_threshold
        self.meters.add("exploration/share", float(curious))
        self.meters.add("exploration/novelty", float(novelty.max()))
        return novelty if curious else self._values(code)

    def _is_solved(self, code: Code) -> bool:
        """Whether the value is no less than that of the largest reward seen at the greatest depth of a plan."""
        planning = self.settings.planning
        best = float(self.model.outcomes.rewards.max())
        return best > 0.0 and bool(self._values(code).max() >= planning.discount**planning.depth * best)

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Keep the transition; if it was clear and unexpected, learn from all since the last one, and plan anew."""
        before = transition.observation.frame
        after = transition.next_observation.frame
        with self.meters.cpu_time("time/model_s"):
            row = CodeTransition(
                code=self.perception.code(before),
                action=transition.action,
                following=self.perception.code(after),
                reward=transition.reward,
                terminated=transition.terminated,
                is_first=self._observed == 0,
                code_is_clear=self.perception.is_clear(before),
                following_is_clear=self.perception.is_clear(after),
            )
            self._observed += 1
            class_reward = self.rewards.reward(row)
            unexpected = row.is_clear and self._is_unexpected(row._replace(reward=class_reward))
            self.replay.append(row)
            self.class_rewards.append(class_reward)
            due = len(self.replay) - self._task_start >= _REWARDS_GROWTH * (self.classed - self._task_start)
            if due and self._class_rewards():
                self._relearn(self.tasks, len(self.replay))
            elif unexpected:
                self.learn()
        self.meters.add("model/unexpected", float(unexpected))
        self.meters.count("time/model_s")
        if transition.terminated or transition.truncated:
            self.begin_episode()

    def _is_unexpected(self, row: CodeTransition) -> bool:
        (probability,), (unknown,) = self.model.probabilities([row])
        return bool(probability < _EXPECTED or unknown > self.settings.planning.exploration_threshold)

    @property
    def _task_start(self) -> int:
        """How much was replayed when this task began."""
        return self.tasks[-1] if self.tasks else 0

    def _class_rewards(self) -> bool:
        """Class the rewards of this task anew; whether any may have changed."""
        start = self._task_start
        before = self.rewards
        self.rewards = reward_classes(self.replay[start:])
        self.classed = len(self.replay)
        if self.rewards is EXACT and before is EXACT:
            return False
        self.class_rewards[start:] = [row.reward for row in self.rewards.of(self.replay[start:])]
        return True

    def learn(self, end: int | None = None) -> None:
        """Bring the model from the first ``learned`` transitions to the first ``end``, or all, and plan anew."""
        new = slice(self.learned, end)
        for row, reward in zip(self.replay[new], self.class_rewards[new], strict=True):
            self.model.add(row._replace(reward=reward))
        self.model.outcomes.fit()
        self.planner.learned()
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
        self.rewards = EXACT
        self.classed = self._task_start
        self.meters = Meters()  # a measurement on an earlier task is no diagnosis of this one

    def _begin_task(self) -> None:
        self.tasks.append(self.learned)
        self.model.outcomes.reset_for_new_task()
        self.planner.learned()

    def q_values(self, observation: Observation) -> Floats32:
        """Value of every macro-action, in units of reward; zeros before anything was seen. Shape (A,)."""
        return self._values(self.perception.code(observation.frame)).astype(np.float32)

    def novelty(self, observation: Observation, rng: np.random.Generator) -> Floats32 | None:
        """Where it would explore; see :class:`.capabilities.NoveltyReader`. None before it learned."""
        del rng
        if not self._ready:
            return None
        return self._values(self.perception.code(observation.frame), "novelty").astype(np.float32)

    def diagnostics(self) -> dict[str, float]:
        """Means since the last call (``time/*`` in CPU seconds a real step), and the counters now."""
        of_task = self.replay[self.tasks[-1] if self.tasks else 0 :]
        counters = {
            "real_transitions": sum(row.has_dynamics for row in of_task),
            "gradient_updates": 0,
            "oracle/labels": sum(row.has_reward and not row.has_dynamics for row in of_task),
            "model/outcomes": len(self.model.outcomes.outcomes),
        }
        return {**self.meters.read(), **{name: float(value) for name, value in counters.items()}}

    def state(self) -> AgentState:
        """A snapshot: the replayed transitions, how much of them is learned, the generator, measurements."""
        sizes = self.perception.sizes
        values = {
            "learned": self.learned,
            "classed": self.classed,
            "tasks": list(self.tasks),
            "exploration": self.rng.bit_generator.state,
            "meters": self.meters.state(),
            "settings": snapshot.jsonable(flatten(self.settings)),
            "code_sizes": list(sizes),
            "n_actions": self.n_actions,
        }
        arrays = {**as_arrays(self.replay, len(sizes)), "class_reward": np.array(self.class_rewards, dtype=np.float64)}
        return AgentState(arrays=snapshot.prefixed("replay", arrays), values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot by learning from all that is replayed once more.

        ArtefactError if it does not fit this agent, and then nothing was changed.
        """
        complete = completed(state)
        snapshot.require_fit(complete, self.state(), equal=("settings", "code_sizes", "n_actions"))
        self._take_up(complete)

    def _take_up(self, state: AgentState) -> None:
        self.replay = from_arrays(snapshot.below("replay", state.arrays))
        self.class_rewards = state.arrays["replay/class_reward"].tolist()
        self.classed = state.values["classed"]
        first = state.values["tasks"][-1] if state.values["tasks"] else 0
        self.rewards = reward_classes(self.replay[first : self.classed])
        self._relearn(state.values["tasks"], state.values["learned"])
        self.meters.restore(state.values["meters"])
        self.rng.bit_generator.state = state.values["exploration"]


def completed(state: AgentState) -> AgentState:
    """A snapshot with all that those of earlier versions lack.

    Until 2026-11-28 there were no classes of rewards, so every reward was its own class; until 2026-11-29 nothing told
    which transitions began an episode, so starts were no evidence; until 2026-11-30 all codes counted as clear, and for
    some hours of that day one column told of both codes of a transition.
    """
    if "replay/reward" not in state.arrays:
        return state
    rewards = state.arrays["replay/reward"]
    given = dict(state.arrays)
    clear = given.pop("replay/is_clear", np.ones(len(rewards), dtype=np.bool_))
    arrays = {
        "replay/class_reward": rewards.astype(np.float64),
        "replay/is_first": np.zeros(len(rewards), dtype=np.bool_),
        "replay/code_is_clear": clear,
        "replay/following_is_clear": clear,
        **given,
    }
    return AgentState(arrays=arrays, values={"classed": len(rewards), **state.values})


class FactoredAgent(CodeAgent):
    """Sees with an encoder, and so can show its imagination, be read by a probe, and ask an oracle."""

    perception: CodePerception

    def query(self, observation: Observation) -> Ints | None:
        """The macro-actions (D,) whose last one has the most uncertain outcome; the fewest among equals.

        None where nothing is uncertain enough; a question that got no label is not asked again.
        """
        if not self._ready:
            return None
        settings = self.settings.planning
        without = {(row.code, row.action) for row in self.replay if not row.has_dynamics and not row.has_reward}
        with self.meters.cpu_time("time/model_s"):
            best = settings.exploration_threshold
            chosen = None
            start = self.perception.code(observation.frame)
            front = [start]
            ways: dict[Code, tuple[int, ...]] = {start: ()}  # the actions that lead to each code
            for _ in range(settings.depth):
                if not front or len(ways) > settings.states:
                    break
                following, sure = self.model.likeliest(np.array(front))
                untested = self.model.untested(np.array(front), following)
                further = []
                for row, action in np.argwhere(sure >= _SURE).tolist():
                    way = (*ways[front[row]], action)
                    if untested[row, action] > best and (front[row], action) not in without:
                        best = untested[row, action]
                        chosen = np.array(way)
                    after = tuple(following[row, action].tolist())
                    if after not in ways:
                        ways[after] = way
                        further.append(after)
                front = further
        return chosen

    def learn_label(self, observation: Observation, actions: Ints, label: Label | None) -> None:
        """Learn the outcome of an imagined transition, and nothing of the dynamics, or that it has no label."""
        codes = [self.perception.code(observation.frame)]
        for action in actions.tolist():
            following, _ = self.model.likeliest(np.array(codes[-1:]))
            codes.append(tuple(following[0, action].tolist()))
        told = label or Label(0.0, False)
        asked = CodeTransition(codes[-2], int(actions[-1]), codes[-1], told.reward, told.terminated, has_dynamics=False)
        self.replay.append(asked._replace(has_reward=label is not None))
        self.class_rewards.append(self.rewards.reward(asked))
        with self.meters.cpu_time("time/model_s"):
            self.learn()

    def imagine(self, frame: Frame, *, actions: Ints | None, depth: int, rng: np.random.Generator) -> ImaginedRollout:
        """Imagine up to ``depth`` transitions from ``frame``; see :class:`.capabilities.Imaginer`.

        ``epistemic`` is the probability that something untested decides the transition, ``modal`` that it does not
        lead where it most probably leads; a categorical model knows no Gaussian noise, so ``aleatoric`` is 0.
        InvalidValueError if there is no depth to imagine, or actions are none.
        """
        planned = planned_actions(actions, depth, self.n_actions)
        codes = [self.perception.code(frame)]
        chosen: list[int] = []
        values: list[Floats] = []
        outcomes: list[tuple[float, float, float, float]] = []  # reward, P(it ends), unknown, P(it leads elsewhere)
        for index in range(depth if planned is None else len(planned)):
            values.append(self._values(codes[-1]))
            chosen.append(int(values[-1].argmax()) if planned is None else planned[index])
            following, outcome = self._imagined(codes[-1], chosen[-1], rng)
            codes.append(following)
            outcomes.append(outcome)
            if planned is None and outcome[1] > _TERMINAL:
                break
        images = self.perception.images(codes)
        reward, p_terminated, unknown, p_other = np.array(outcomes, dtype=np.float32).T.copy()
        return ImaginedRollout(
            actions=np.array(chosen),
            frames=images[1:],
            start_frame=images[0],
            rewards=reward,
            p_terminated=p_terminated,
            q_values=np.array(values, dtype=np.float32),
            epistemic=unknown,
            aleatoric=np.zeros_like(unknown),
            modal=p_other,
            accepted=np.logical_and.accumulate(unknown <= ACCEPTED),
            macrostates=self.perception.macrostates(codes[1:]),
        )

    def _imagined(
        self, code: Code, action: int, rng: np.random.Generator
    ) -> tuple[Code, tuple[float, float, float, float]]:
        """A drawn next code; reward, P(the episode ends), P(something untested decides), P(it leads elsewhere)."""
        if not self._ready:
            return code, (0.0, 0.0, 1.0, 0.0)
        following, p_likeliest = self.model.sample(code, action, rng)
        reward, p_terminated, unknown = (float(each[action]) for each in self.planner.outcome(code))
        return following, (reward, p_terminated, unknown, 1.0 - p_likeliest)

    def read_frames(self, frames: Frame) -> Ints:
        """The reading of a probe; see :class:`.capabilities.FrameReader`."""
        return self.perception.macrostates(self.perception.codes(frames))

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        """The predictions of its planner; see :class:`.capabilities.OutcomePredictor`."""
        codes = self.perception.codes(frames)
        if not self._ready:
            nothing = np.zeros((len(codes), self.n_actions))
            where = np.repeat(self.perception.macrostates(codes)[:, None, None], self.n_actions, axis=1)
            return ExpectedOutcomes(macrostates=where, p_continues=nothing[..., None], reward=nothing)
        where = np.array(codes)
        moves = self.model.moves(where)
        found = self.model.results(where, moves)
        read = self.perception.macrostates(moves.following.reshape(-1, where.shape[1]))
        return ExpectedOutcomes(
            macrostates=read.reshape(*found.p_continues.shape, -1), p_continues=found.p_continues, reward=found.reward
        )


def make(context: AgentContext) -> FactoredAgent:
    """The agent ``factored:given``; InvalidValueError if the context's encoder gives no codes."""
    settings = HYPERPARAMETERS.of(context)
    prepare_torch(context.device)
    perception = load_code_perception(context, factored=settings.dynamics.factored)
    return FactoredAgent(perception, context.n_actions, settings, context.seeds)
