"""Why an agent failed a test episode: truth is swapped in, one stage at a time, until the episode is solved.

An episode that no optimal policy would have solved with the same draws of chance was bad luck. Of all else, the agent's
memory is made right first: where a frame hid something, it acts as it does on a frame that shows all. Then its
perception is made right, then its plan, then its model of transitions that it never experienced, then all of its
model, then the execution of its macro-actions. Each stage keeps the truth of those before it, and the first that solves
the episode names its cause; the last is the optimal policy, which does. So every failure has exactly one cause. A
policy cannot be learned anew in a model that was made right; so the plan comes before the model: where perfect planning
in the agent's own model solves the episode, that model was right enough. If every frame of a macrostate is misread, the
agent cannot be queried there. The optimal action and the true model are used instead.

An agent without a model has its experience in place of one: true where it was, and nothing elsewhere.

An episode is lived again by the rules. Where a stage takes the agent's own action in a step, the same happens, motor
failures included. Else a uniform number decides among the outcomes, as in an environment: in every step the one that
decided then, as far as the episode tells where it lay. So whoever slips in a step slips there whatever they do.

Shapes: ``S`` macrostates, ``A`` macro-actions, ``B`` branches, ``H`` the horizon.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from bisect import bisect
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imagine_bench.arrays import Bools, Frame, Ints, State, read_only
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.exact.values import NEVER, Model, action_values, rows_of, true_model
from imagine_bench.interfaces import Agent, Observation, Outcome, Rules, TaskSpec
from imagine_bench.interfaces.capabilities import ExpectedOutcomes, FrameReader, OutcomePredictor, begin_episode
from imagine_bench.interfaces.environments import Env
from imagine_bench.judge.truth import added_up, total_variation
from imagine_bench.protocols.control import Protocol
from imagine_bench.rules import optimal_policy, states_of, tabulate
from imagine_bench.running.run_state import make_env
from imagine_bench.running.trained import Trained
from imagine_bench.seeding import Purpose, SeedTree, episode_seed, evaluation_split
from imagine_bench.store import run_folder
from imagine_bench.store.results import Checkpoint, PolicyTable, RunResult

CAUSES = {
    "forgotten": "it did not remember a part of the first frame that later ones hide",
    "misread": "a frame was misread",
    "unexperienced": "a transition that it needed was never experienced",
    "model": "its model was wrong, though it was experienced",
    "planning": "its model was right; its plan was cut off, or its policy not greedy in it",
    "values": "its values were wrong, though it had experienced all that it needed (no model)",
    "execution": "motor failure: the arm's motion had a result that the rules exclude for that macro-action",
    "unlucky": "an optimal policy would have failed too",
}
"""Causes in the order in which tables and figures have them."""
CAUSES_OF_PLAYERS = {
    "decision": "its macro-actions were not the best ones, and nobody can ask a person, or a program elsewhere, why"
}
"""Further causes where a player's episodes are kept that is no agent."""
FORMER_CAUSES = {"fault": "execution"}
"""Today's name of each cause that kept files call otherwise."""
MOST_STATES = 2_000
"""A task of more macrostates is too large to ask an agent about every one."""
_TRIES = 8  # frames of a macrostate, until the agent reads one right
_TIE = 1e-6


@dataclass(frozen=True, kw_only=True)
class FailedEpisode:
    """The steps of a failed test episode of L macro-actions."""

    states: Sequence[State]  # length L + 1
    actions: Sequence[int]  # length L
    terminated: bool  # whether it ended in a terminal macrostate
    faults: Sequence[bool]  # motor failures: whether the result is no outcome of that macro-action. Length L.
    misread: Sequence[bool]  # whether the agent misread the frame before each macro-action. Length L.
    hidden: Sequence[bool] = ()  # whether that frame hid a part of the macrostate; length L, or empty: none did
    seed: int  # of the uniform numbers


def frames_to_ask_with(agent: Agent, spec: TaskSpec, *, appearance: str, purpose: Purpose) -> Frame:
    """A frame of every macrostate that the agent reads right, if one of :data:`_TRIES` is. Shape (S, 64, 64, 3).

    Without a model an agent is not asked about terminal macrostates; theirs are black.
    """
    states = np.array(states_of(spec.rules), dtype=np.int64)
    rng = SeedTree(0).child(purpose, "causes", spec.id).generator()
    frames = np.zeros((len(states), 64, 64, 3), dtype=np.uint8)
    modelled = isinstance(agent, OutcomePredictor)
    left = np.array([modelled or not spec.rules.is_terminal(tuple(state)) for state in states.tolist()])
    for _ in range(_TRIES):
        if left.any():
            frames[left] = spec.render_macrostates(states[left], appearance, rng)
            left[left] = misread(agent, frames[left], states[left])
    return read_only(frames)


def misread(agent: Agent | None, frames: Frame, states: Ints) -> Bools:
    """Which frames (N, 64, 64, 3) of macrostates (N, M) an agent misreads; none of one that cannot say. Shape (N,).

    A coordinate that is hidden, -1, cannot be misread.
    """
    if not isinstance(agent, FrameReader):
        return np.zeros(len(frames), dtype=bool)
    begin_episode(agent)
    return ((agent.read_frames(frames) != states) & (states >= 0)).any(axis=1)


def beliefs(agent: Agent, rules: Rules, frames: Frame, rng: np.random.Generator, *, privileged: bool) -> PolicyTable:
    """The agent's action, and the outcomes that its model expects, in every macrostate, shown by ``frames``; see
    above.
    """
    states = states_of(rules)
    action = np.zeros(len(frames), dtype=np.int16)
    for row, state in enumerate(states):
        if not rules.is_terminal(state):
            seen = Observation(frame=frames[row], macrostate=np.array(state) if privileged else None)
            begin_episode(agent)
            action[row] = agent.act(seen, explore=False)
    begin_episode(agent)
    model = agent.predict_outcomes(frames, rng) if isinstance(agent, OutcomePredictor) else None
    if model is not None:
        small = {"macrostates": np.int16, "p_continues": np.float32, "reward": np.float32}
        model = ExpectedOutcomes(**{name: getattr(model, name).astype(kind) for name, kind in small.items()})
    return PolicyTable(action=action, model=model)


class Attribution:
    """Finds the cause of failures of one agent at one budget.

    Args:
        spec: The task.
        held: The agent's actions and expectations.
        tried: Macrostate and macro-action of everything that it had experienced. Shape (pairs, M + 1).
        readable: Macrostates of which it reads some frame right; those that end episodes do not matter. Shape (S,).
    """

    def __init__(self, spec: TaskSpec, held: PolicyTable, tried: Ints, readable: Bools) -> None:
        self._rules = spec.rules
        self._horizon = spec.horizon
        self._action = held.action
        states = states_of(spec.rules)
        self._rows = {state: row for row, state in enumerate(states)}
        truth = true_model(spec.rules, states)
        known = np.zeros((len(states) + 1, spec.n_actions), dtype=bool)
        known[rows_of(tried[:, :-1], states), tried[:, -1]] = True
        known = known[:-1]  # physics can leave a scene that is no macrostate
        model = held.model
        if model is None:
            own = Model(truth.following, truth.p_continues * known[..., None], np.where(known, truth.reward, NEVER))
        else:
            following = _remembered(model.macrostates, spec, states)
            expected = Model(rows_of(following, states), model.p_continues, model.reward)
            own = _mixed(readable[:, None], expected, truth)
        self._best = self._plan(truth)
        self._any = np.ones_like(self._best)
        self._stages = (
            ("misread", self._best | readable[:, None]),
            ("planning" if model else "values", self._plan(own)),
            ("unexperienced", self._plan(_mixed(known, own, truth))),
            ("model", self._best),
        )  # and "execution": the best plan, without motor failures

    def cause(self, episode: FailedEpisode) -> str:
        """One of :data:`CAUSES`."""
        drawn = self._drawn(episode)
        if not self._solves(episode, drawn, self._best, faults=False):
            return "unlucky"
        if any(episode.hidden) and self._solves(episode, drawn, self._any, faults=True, remembers=True):
            return "forgotten"
        for name, plan in self._stages[0 if any(episode.misread) else 1 :]:
            if self._solves(episode, drawn, plan, faults=True):
                return name
        return "execution"

    def _drawn(self, episode: FailedEpisode) -> list[float]:
        """The uniform number of each step until the horizon."""
        rng = np.random.default_rng(episode.seed)
        drawn: list[float] = rng.random(self._horizon).tolist()
        for step, (state, action) in enumerate(zip(episode.states, episode.actions, strict=False)):
            if state in self._rows and not episode.faults[step]:
                before, probability = place(self._rules.outcomes(state, action), episode.states[step + 1])
                drawn[step] = before + probability * drawn[step]
        return drawn

    def _plan(self, model: Model) -> Bools:
        """Which macro-actions have the largest return in those left, 1 to H of them. Shape (H, S, A)."""
        values = action_values(model, self._horizon)
        best = values.max(axis=2, keepdims=True)
        return values >= best - _TIE * np.maximum(1.0, np.abs(best))

    def _solves(
        self, episode: FailedEpisode, drawn: Sequence[float], plan: Bools, *, faults: bool, remembers: bool = False
    ) -> bool:
        """Whether the episode succeeds where frames are read right and a plan is followed.

        If the agent's action is among equally good ones of the plan, it is the plan's. If it only ``remembers``, a
        misread frame stays misread.
        """
        replaced = episode.misread
        if remembers:
            pairs = zip(episode.hidden, episode.misread, strict=True)
            replaced = [hidden and not wrong for hidden, wrong in pairs]
        state = episode.states[0]
        for step in range(self._horizon):
            row = self._rows.get(state)
            if row is None:
                return False
            lived = step < len(episode.actions) and state == episode.states[step]
            action = int(episode.actions[step] if lived and not replaced[step] else self._action[row])
            if not plan[self._horizon - step - 1, row, action]:
                action = int(plan[self._horizon - step - 1, row].argmax())
            if lived and action == episode.actions[step] and (faults or not episode.faults[step]):
                if episode.terminated and step + 1 == len(episode.actions):
                    return False
                state = episode.states[step + 1]
                continue
            outcome = drawn_by(drawn[step], self._rules.outcomes(state, action))
            if outcome.terminated:
                return outcome.success
            state = outcome.macrostate
        return False


def _remembered(macrostates: Ints, spec: TaskSpec, states: Sequence[State]) -> Ints:
    """Macrostates (S, A, B, M) that a model expects; a coordinate that it expects to be hidden is as before."""
    values = np.array([len(each) for each in spec.macrostate_values])
    before = np.array(states)[:, None, None]
    hidden = (macrostates < 0) | (macrostates >= values)
    return np.where(hidden, before, macrostates) if spec.sight is not None else macrostates


def memory_suffices(spec: TaskSpec) -> bool:
    """Whether all is known to an agent that remembers an episode's first frame.

    Then no frame is late, the first one shows everything, and coordinates that later ones hide do not change.
    """
    sight = spec.sight
    if sight is None:
        return True
    if sight.lag or any(sight.seen(state, 0) != ((1.0, state),) for state in spec.rules.start_states):
        return False
    for state, action in itertools.product(states_of(spec.rules), range(spec.n_actions)):
        after = [each.macrostate for each in spec.rules.outcomes(state, action) if not each.terminated]
        for _, seen in sight.seen(state, 1):
            kept = [(old, place) for place, (old, new) in enumerate(zip(state, seen, strict=True)) if new < 0]
            if any(then[place] != old for then in after for old, place in kept):
                return False
    return True


def can_be_asked(spec: TaskSpec) -> bool:
    """Whether an agent is asked about every macrostate, so that its failures have causes."""
    return len(states_of(spec.rules)) <= MOST_STATES and memory_suffices(spec)


def drawn_by(number: float, outcomes: Sequence[Outcome]) -> Outcome:
    """The outcome that a number in [0, 1) draws, as environments do."""
    ends = list(itertools.accumulate(outcome.probability for outcome in outcomes))
    return outcomes[min(bisect(ends, number), len(outcomes) - 1)]


def place(outcomes: Sequence[Outcome], macrostate: State) -> tuple[float, float]:
    """Where the numbers begin that draw the first outcome that leads to a macrostate, and how many of them do."""
    before = 0.0
    for outcome in outcomes:
        if outcome.macrostate == macrostate:
            return before, outcome.probability
        before += outcome.probability
    return 0.0, 1.0  # none does


def _mixed(where: Bools, one: Model, other: Model) -> Model:
    """One model where (S, A) says so, and the other elsewhere."""
    shares = [one.p_continues * where[..., None], other.p_continues * ~where[..., None]]
    return Model(
        following=np.concatenate([one.following, other.following], axis=2),
        p_continues=np.concatenate(shares, axis=2),
        reward=np.where(where, one.reward, other.reward),
    )


def expected_rightly(rules: Rules, held: PolicyTable) -> float:
    """The share of a macro-action's outcomes by the rules that a model expects too, in [0, 1]; NaN without a model.

    One less the total variation of where the episode goes on, or that it ends: the mean over every macro-action in
    every macrostate that is not terminal.
    """
    if held.model is None:
        return math.nan
    found = []
    for row, state in enumerate(states_of(rules)):
        for action in range(0 if rules.is_terminal(state) else rules.n_actions):
            exact = added_up(
                (() if outcome.terminated else outcome.macrostate, outcome.probability)
                for outcome in rules.outcomes(state, action)
            )
            shares = held.model.p_continues[row, action]
            after = zip(map(tuple, held.model.macrostates[row, action].tolist()), shares.tolist(), strict=True)
            expected = added_up([((), 1.0 - float(shares.sum())), *after])
            found.append(1.0 - total_variation(exact, expected))
    return float(np.mean(found))


@dataclass(frozen=True, kw_only=True)
class Tested:
    """The causes of one test's failures."""

    episodes: int  # real training episodes before
    tests: int
    causes: Mapping[int, str]  # by number of the test


def causes_of(trained: Trained) -> tuple[Tested, ...]:
    """The causes of every failure of an agent, which sees as at the end of training.

    Its failed test episodes are played again.

    Raises:
        ArtefactError: An unfinished run, or one that keeps no test episodes.
        InvalidValueError: Its experience is not known, or its task has too many macrostates or hides something.
    """
    protocol = trained.spec.protocol
    spec = trained.task
    _require_seen(spec)
    if protocol.dataset or protocol.after:
        raise InvalidValueError(
            "The experience of agents in a dataset or an earlier task is not kept; give another bench."
        )
    if not protocol.shows_frames_alone:
        raise InvalidValueError("These agents saw more than frames; give a bench of --observation frame.")
    if not run_folder.is_done(trained.folder):
        raise ArtefactError(f"{trained.folder} is not finished; give the bench command again to finish it.")
    run = run_folder.load_run(trained.folder)
    purpose = evaluation_split(trained.spec.seed)
    frames = frames_to_ask_with(trained.agent, spec, appearance=protocol.appearance_in_tests, purpose=purpose)
    readable = ~misread(trained.agent, frames, np.array(states_of(spec.rules), dtype=np.int64))

    def attribution_at(row: Checkpoint) -> Attribution:
        if run.tried is None:
            raise ArtefactError(f"{trained.folder} keeps no test episodes; run its bench anew, elsewhere.")
        if row.beliefs is None and not can_be_asked(spec):
            raise InvalidValueError(f"{spec.id} has too many macrostates to ask an agent about each.")
        if row.beliefs is None:
            raise ArtefactError(f"{trained.folder} keeps no answers about macrostates; run its bench anew, elsewhere.")
        tried = run.tried[run.tried[:, -1] < row.episodes, :-1].astype(np.int64)
        return Attribution(spec, row.beliefs, tried, readable)

    return _tested(run, protocol, spec.rules, trained.agent, attribution_at)


def causes_of_player(folder: Path) -> tuple[Tested, ...]:
    """The causes of every failure of a player that cannot be asked: bad luck, motor failure, or a decision.

    The best macro-actions stand for those that it would have chosen elsewhere. Raises as :func:`causes_of`.
    """
    run = run_folder.load_run(folder)
    protocol = Protocol.from_dict(run_folder.read_config(folder)["protocol"])
    spec = protocol.spec(testing=True)
    _require_seen(spec)
    states = states_of(spec.rules)
    action = optimal_policy(tabulate(spec.rules)).astype(np.int16)
    every = [(*state, each) for state in states for each in range(spec.n_actions)]
    best = PolicyTable(action=action, model=None)
    attribution = Attribution(spec, best, np.array(every, dtype=np.int64), np.ones(len(states), dtype=bool))
    found = _tested(run, protocol, spec.rules, None, lambda row: attribution)
    return tuple(
        dataclasses.replace(
            each, causes={test: "decision" if cause == "values" else cause for test, cause in each.causes.items()}
        )
        for each in found
    )


def _require_seen(spec: TaskSpec) -> None:
    """Raise InvalidValueError for a task whose frames do not show all, unless a memory of the first one suffices."""
    if not memory_suffices(spec):
        raise InvalidValueError(
            f"Frames of {spec.id} are old, or hide something that changes. The right action there depends on all "
            "that it saw before, so its failures have no one cause; ask about a world without lag whose gesture is "
            "always shown, or gesture=first without goal_change."
        )


def _tested(
    run: RunResult,
    protocol: Protocol,
    rules: Rules,
    agent: Agent | None,
    attribution_at: Callable[[Checkpoint], Attribution],
) -> tuple[Tested, ...]:
    """The causes of the failures of a run, whose failed tests are played again."""
    purpose = evaluation_split(run.seed)
    found = []
    with closing(make_env(protocol, protocol.task, testing=True)) as env:
        lived = functools.cache(functools.partial(lived_again, env, agent, rules))
        for row in run.checkpoints:
            if row.kept is None:
                raise ArtefactError(f"{run.folder} keeps no test episodes; run its bench anew, elsewhere.")
            attribution = attribution_at(row)
            causes = {}
            for test in np.flatnonzero(~row.kept.success).tolist():
                actions = tuple(row.kept.actions_of(test))
                causes[test] = attribution.cause(lived(episode_seed(purpose, 0, test), actions))
            found.append(Tested(episodes=row.episodes, tests=row.test_episodes, causes=causes))
    return tuple(found)


def is_outcome(rules: Rules, before: State, action: int, after: State) -> bool:
    """Whether the rules say that a macro-action can lead from one macrostate to another.

    A skill that does nothing, or another macro-action than it was asked for, leads elsewhere; no fault says so.
    """
    return any(outcome.macrostate == after for outcome in rules.outcomes(before, action))


def lived_again(env: Env, agent: Agent | None, rules: Rules, seed: int, actions: Sequence[int]) -> FailedEpisode:
    """A failed test episode, played again to find the frames that the agent misread, and motor failures."""
    frame, info = env.reset(seed=seed)
    frames = []
    infos = [info]
    terminated = False
    for action in actions:
        frames.append(frame)
        frame, _, terminated, _, info = env.step(action)
        infos.append(info)
    states = np.array([info["macrostate"] for info in infos], dtype=np.int64)
    shown = np.array([info.get("shown", info["macrostate"]) for info in infos], dtype=np.int64)
    visited = [tuple(state) for state in states.tolist()]
    known = set(states_of(rules))
    faults = []
    for before, action, after, info in zip(visited, actions, visited[1:], infos[1:], strict=False):
        faults.append(bool(info["fault"]) or (before in known and not is_outcome(rules, before, action, after)))
    return FailedEpisode(
        states=visited,
        actions=actions,
        terminated=bool(terminated),
        faults=faults,
        misread=misread(agent, np.array(frames), shown[:-1]).tolist(),
        hidden=[bool(row.min() < 0) for row in shown[:-1]],
        seed=seed,
    )
