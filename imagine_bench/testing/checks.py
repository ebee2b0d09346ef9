"""The contract of a task, an agent and a world model, a sentence each, in a task's kinematic execution."""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env

from imagine_bench import registry
from imagine_bench.arrays import Frame, Info, Ints, State, content_hash
from imagine_bench.errors import ImagineBenchError, InvalidValueError
from imagine_bench.exact.beliefs import optimal_policy_of
from imagine_bench.interfaces import Agent, AgentContext, AgentState, ExactWorld, Observation, TaskSpec
from imagine_bench.interfaces.capabilities import begin_episode
from imagine_bench.interfaces.environments import Env
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined, WorldModel
from imagine_bench.judge.models import source_of
from imagine_bench.judge.predictions import call, imagined_by
from imagine_bench.judge.reading import RenderedFrameIndex
from imagine_bench.registry.entries import parse_configuration
from imagine_bench.rules import facts, states_of
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.running.evaluation import play
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders
from imagine_bench.store.run_folder import Snapshot, load_snapshot, save_snapshot
from imagine_bench.values import numbers

_MOST = 200  # starts and macro-actions tried
_KEYS = {"macrostate", "is_success", "legal", "fault"}
_EPISODES = 8
_SEED = 1_000
_HISTORY = 2  # frames shown, macro-actions and futures imagined, of the longer questions
_DEPTH = 3
_SAMPLES = 4
_METHODS = ("fit", "imagine", "parameters")


class NotOffered(ImagineBenchError):
    """The checked ability is one that a guest may do without."""


def require(holds: bool, otherwise: str) -> None:
    """Raise InvalidValueError with these words unless it holds."""
    if not holds:
        raise InvalidValueError(otherwise)


def make_env(spec: TaskSpec) -> Env:
    """A task's environment as it is checked: kinematic where it can be, clean."""
    return gymnasium.make(spec.env_id, execution=spec.executions[-1], appearance="clean", disable_env_checker=True)


# Tasks -------------------------------------------------------------------------------------------------------------


def _rules(spec: TaskSpec) -> None:
    found = facts(spec.rules, spec.horizon)
    require(found.optimum > 0.0, "an optimal agent never succeeds within the horizon")


def _frames(spec: TaskSpec) -> None:
    states = np.array(states_of(spec.rules)[:_MOST])
    one, other = (spec.render_macrostates(states, "clean", np.random.default_rng(0)) for _ in range(2))
    given = f"{one.dtype} of shape {one.shape}"
    require(one.dtype == np.uint8 and one.shape == (len(states), 64, 64, 3), f"{len(states)} frames are {given}")
    require(np.array_equal(one, other), "two calls with equal generators differ")


def _gymnasium(spec: TaskSpec) -> None:
    with closing(make_env(spec)) as env:
        check_env(env.unwrapped, skip_render_check=True)
        asked = gymnasium.spaces.Discrete(spec.n_actions)
        require(env.action_space == asked, f"its action_space is {env.action_space}, the rules say {asked}")


def _starts(spec: TaskSpec) -> None:
    with closing(make_env(spec)) as env:
        states = states_of(spec.rules)
        for start in (*spec.rules.start_states[:_MOST], *states[:: 1 + len(states) // _MOST]):
            _, info = env.reset(seed=0, options={"macrostate": start})
            require(info.keys() >= _KEYS, f"info lacks {sorted(_KEYS - info.keys())}")
            require(_told(info) == start, f"begun in {start}, it tells {_told(info)}")


def _told(info: Info) -> State:
    return tuple(np.asarray(info["macrostate"]).tolist())


class _Step(NamedTuple):
    """A random macro-action and its result."""

    frame: bytes
    action: int
    found: tuple[State, float, bool, bool]  # the macrostate reached, the reward, whether it ended, and in success
    fault: bool


def _walk(env: Env, spec: TaskSpec, rng: np.random.Generator) -> Iterator[_Step]:
    """Random macro-actions to the end of the episode."""
    over = False
    while not over:
        action = int(rng.integers(spec.n_actions))
        frame, reward, terminated, truncated, info = env.step(action)
        found = (_told(info), float(reward), terminated, bool(info["is_success"]))
        yield _Step(np.asarray(frame).tobytes(), action, found, bool(info["fault"]))
        over = terminated or truncated


def _steps(spec: TaskSpec) -> None:
    rng = np.random.default_rng(0)
    tried = 0
    with closing(make_env(spec)) as env:
        while tried < _MOST:
            state = _told(env.reset(seed=int(rng.integers(1 << 30)))[1])
            for step in _walk(env, spec, rng):
                outcomes = spec.rules.outcomes(state, step.action)
                allowed = [(o.macrostate, o.reward, o.terminated, o.success) for o in outcomes]
                words = f"action {step.action} in {state} gave {step.found}, the rules allow {allowed}"
                require(step.found in allowed or step.fault, words)
                state = step.found[0]
                tried += 1


def _same_episodes(spec: TaskSpec) -> None:
    def episode(env: Env, seed: int) -> list[object]:
        frame, _ = env.reset(seed=seed)
        return [np.asarray(frame).tobytes(), *_walk(env, spec, np.random.default_rng(seed))]

    with closing(make_env(spec)) as one, closing(make_env(spec)) as other:
        episode(other, 1)
        for seed in range(3):
            require(episode(one, seed) == episode(other, seed), f"two episodes of seed {seed} differ")


def _kept(spec: TaskSpec) -> None:
    with closing(make_env(spec)) as one, closing(make_env(spec)) as other:
        env = one.unwrapped
        twin = other.unwrapped
        if not (hasattr(env, "get_state") and hasattr(env, "set_state")):
            raise NotOffered("the environment has no get_state and set_state")
        env.reset(seed=1)
        twin.reset(seed=2)
        env.step(0)
        state = env.get_state()
        walked = _walked(env, spec)
        for again, where in ((env, "in the same environment"), (twin, "in another")):
            again.set_state(state)
            require(_walked(again, spec) == walked, f"put back {where}, it goes on otherwise")


def _walked(env: Env, spec: TaskSpec) -> list[_Step]:
    """As far as an episode can go, also where nobody cuts it off."""
    return list(itertools.islice(_walk(env, spec, np.random.default_rng(0)), spec.horizon))


TASK_CHECKS: Mapping[str, Callable[[TaskSpec], None]] = {
    "its rules are distributions, reach an end and can be won": _rules,
    "its frames are 64 x 64 RGB bytes and the same for the same generator": _frames,
    "Gymnasium's checker is content": _gymnasium,
    "every macrostate is begun in, and told": _starts,
    "macro-actions end as the rules say": _steps,
    "the same seed gives the same episode": _same_episodes,
    "in the middle of an episode its state is kept and put back, to the bit": _kept,
}
"""The contract of a task."""


# Agents ------------------------------------------------------------------------------------------------------------


class CheckedAgent(NamedTuple):
    """An agent that is checked, and where."""

    name: str
    entry: registry.AgentEntry
    spec: TaskSpec
    context: AgentContext

    def make(self) -> Agent:
        """A new one."""
        return registry.make_agent(self.name, self.context)

    def trainee(self) -> Agent:
        """A new one that is trained here."""
        if self.entry.external_training_loop:
            raise NotOffered("it trains in a loop of its own, and its run cannot pause")
        return self.make()

    def train(self, agent: Agent, episodes: range) -> list[int]:
        """Train for some episodes; returns the actions."""
        actions = []
        with closing(make_env(self.spec)) as env:
            for episode in episodes:
                for transition, _ in play(env, agent, seed=episode, explore=True, privileged=self.entry.privileged):
                    count = self.spec.n_actions
                    require(0 <= transition.action < count, f"it acts {transition.action} of {count}")
                    agent.observe(transition, episode=episode)
                    actions.append(transition.action)
        return actions


def checked_agent(name: str, task: str) -> CheckedAgent:
    """An agent as it is checked, in a task's kinematic execution. Raises as :func:`.registry.agent_entry`."""
    spec = registry.task(task)
    entry = registry.agent_entry(name)
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=encoders.own(spec, "clean", entry.encoder_kind) if entry.needs_encoder else None,
        seeds=SeedTree(0).child("agent"),
        config_group=spec.config_group,
        hyperparameters="minimal",
        overrides=registry.own_settings(name, {}),
        argument=parse_configuration(name).argument,
        optimal_policy=optimal_policy_of(spec) if entry.privileged else None,
        exact_world=ExactWorld.of(spec, "clean") if entry.privileged else None,
    )
    return CheckedAgent(name, entry, spec, context)


def _agent_is_made(one: CheckedAgent) -> None:
    require(one.make() is not None, "nothing is made")


def _acts(one: CheckedAgent) -> None:
    agent = one.trainee()
    one.train(agent, range(3))
    states = np.array(one.spec.rules.start_states[:20])
    frames = one.spec.render_macrostates(states, "clean", np.random.default_rng(0))
    given = []
    for frame, state in zip(frames, states, strict=True):
        given.append(Observation(frame=frame, macrostate=state if one.entry.privileged else None))
    before = copy.deepcopy(agent.state())
    once, again = (greedy(agent, given) for _ in range(2))
    if one.entry.learns:
        require(once == again, "asked twice with explore=False, it acts otherwise")
        require(same_state(before, agent.state()), "acting with explore=False changes its state")
    numbers(agent.diagnostics())  # raises, if one is none


def greedy(agent: Agent, given: Sequence[Observation]) -> list[int]:
    """The greedy action in each observation, as the first of an episode."""
    actions = []
    for each in given:
        begin_episode(agent)
        actions.append(agent.act(each, explore=False))
    return actions


def _goes_on(one: CheckedAgent) -> None:
    agent = one.trainee()
    one.train(agent, range(3))
    snapshot = agent.state()
    kept = copy.deepcopy(snapshot)
    with TemporaryDirectory() as folder:  # as a run is interrupted: JSON has lists for tuples, and texts for all keys
        whole = Snapshot(episode=3, agent=snapshot, arrays={}, values={})
        read = load_snapshot(save_snapshot(Path(folder), whole)).agent
    here = one.train(agent, range(3, 6))
    require(same_state(kept, snapshot), "later learning alters a state that it gave before")
    twin = one.make()
    twin.restore(read)
    require(one.train(twin, range(3, 6)) == here, "it acts otherwise")
    require(same_state(agent.state(), twin.state()), "its later state differs")


def same_state(one: AgentState, other: AgentState) -> bool:
    """Whether two states are equal, to the bit, CPU times of an agent's meters aside."""

    def untimed(state: AgentState) -> str:
        values = dict(state.values)
        if isinstance(values.get("meters"), dict):
            values["meters"] = {name: value for name, value in values["meters"].items() if not name.startswith("time/")}
        kept = json.loads(json.dumps(values, default=_plain))
        return json.dumps(kept, sort_keys=True)  # in which a NaN equals itself

    return untimed(one) == untimed(other) and same_arrays(one, other)


def _plain(value: object) -> object:
    """A number or an array of numpy as JSON can hold it."""
    return np.asarray(value).tolist()


def same_arrays(one: AgentState, other: AgentState) -> bool:
    """Whether two states have equal arrays, to the bit."""
    if one.arrays.keys() != other.arrays.keys():
        return False
    return all(value.tobytes() == other.arrays[name].tobytes() for name, value in one.arrays.items())


AGENT_CHECKS: Mapping[str, Callable[[CheckedAgent], None]] = {
    "it is made": _agent_is_made,
    "it acts and learns, greedily without a change": _acts,
    "taken up from its state it goes on to the same bits": _goes_on,
}
"""The contract of an agent."""


# World models ------------------------------------------------------------------------------------------------------


class CheckedModel(NamedTuple):
    """A world model that is checked, and where: on a few real episodes."""

    name: str
    task: str

    def make(self) -> WorldModel:
        """A new one."""
        spec = registry.task(self.task)
        seeds = SeedTree(_SEED).child("judge", self.task)
        return source_of(self.name, spec, RenderedFrameIndex(spec, "clean"), "clean", seeds).model()

    def fitted(self) -> WorldModel:
        """A new one that has seen the episodes."""
        model = self.make()
        call(self.name, "fit", model.fit, _episodes(self.task), np.random.default_rng(0))
        return model

    def imagine(self, model: WorldModel, frames: Frame, actions: Ints, samples: int) -> Imagined:
        """A model's imagination with a generator that is always the same, checked."""
        return imagined_by(model, self.name, frames, actions, samples, np.random.default_rng(1))

    def answer(self, model: WorldModel) -> dict[str, bytes]:
        """Its imagination for the longest questions."""
        imagined = self.imagine(model, *_questions(self.task, _HISTORY, _DEPTH), _SAMPLES)
        given = {field.name: getattr(imagined, field.name) for field in dataclasses.fields(imagined)}
        return {name: array.tobytes() for name, array in given.items() if array is not None}


@functools.lru_cache(maxsize=1)
def _episodes(task: str) -> Episodes:
    spec = registry.task(task)
    policy = policy_of("random", spec, _SEED)
    return collect(spec, policy, episodes=_EPISODES, seed=_SEED, execution="kinematic", appearance="clean")[0]


def _questions(task: str, history: int, depth: int) -> tuple[Frame, Ints]:
    """The first frames of some episodes, with the macro-actions between them, and random ones after them."""
    episodes = _episodes(task)
    places = [episodes.steps(index) for index in range(len(episodes)) if episodes.lengths[index] >= history - 1]
    frames = np.stack([episodes.frames[rows.start : rows.start + history] for _, rows in places])
    between = np.stack([episodes.actions[steps.start : steps.start + history - 1] for steps, _ in places])
    rng = np.random.default_rng(2)
    return frames, np.hstack([between, rng.integers(episodes.n_actions, size=(len(frames), depth))])


def _model_is_made(one: CheckedModel) -> None:
    model = one.make()
    lacks = [name for name in _METHODS if not callable(getattr(model, name, None))]
    require(not lacks, f"{type(model).__name__} lacks {', '.join(lacks)}")


def _learns(one: CheckedModel) -> None:
    episodes = _episodes(one.task)
    before = content_hash(episodes.arrays())
    count = call(one.name, "parameters", one.fitted().parameters)
    require(content_hash(episodes.arrays()) == before, "fit() alters the episodes that it is given")
    sound = isinstance(count, int | np.integer) and not isinstance(count, bool)
    require(sound and int(count) >= 0, f"parameters() gave {count!r}; give how many numbers were fitted")


def _imagines(one: CheckedModel) -> None:
    model = one.fitted()
    for history, depth, samples in ((1, 1, 1), (1, _DEPTH, _SAMPLES), (_HISTORY, _DEPTH, 1), (_HISTORY, 1, _SAMPLES)):
        frames, actions = _questions(one.task, history, depth)
        seen = (frames.copy(), actions.copy())
        one.imagine(model, frames, actions, samples)
        one.imagine(model, frames[:1], actions[:1], samples)
        alike = np.array_equal(frames, seen[0]) and np.array_equal(actions, seen[1])
        require(alike, "imagine() alters the frames or actions that it is given")


def _asked_again(one: CheckedModel) -> None:
    model = one.fitted()
    require(one.answer(model) == one.answer(model), "asked twice with equal generators, it imagines otherwise")


def _fitted_again(one: CheckedModel) -> None:
    same = one.answer(one.fitted()) == one.answer(one.fitted())
    require(same, "two models with equal episodes and generators differ")


MODEL_CHECKS: Mapping[str, Callable[[CheckedModel], None]] = {
    "it is made, with fit, imagine and parameters": _model_is_made,
    "it learns from episodes, and leaves them as they are": _learns,
    "it imagines pictures at every depth, and probabilities that sum to 1": _imagines,
    "asked again with the same generator it imagines the same": _asked_again,
    "the same episodes and generators give the same model": _fitted_again,
}
"""The contract of a world model."""
