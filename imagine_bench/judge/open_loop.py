"""How right an agent's imagination is, measured against the rules; nothing here is ever shown to the agent.

Open loop: macro-actions that keep the episode alive are imagined from real starts and compared by depth. Examples:
rollouts that the greedy controller chooses stand beside the frames of the environment for the same macro-actions.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from imagine_bench.arrays import Floats, Frame, Ints, State, read_only
from imagine_bench.interfaces import ObservationModel, TaskSpec
from imagine_bench.interfaces.capabilities import ImaginedRollout, Imaginer, begin_episode
from imagine_bench.interfaces.model import UNCERTAINTIES
from imagine_bench.judge.questions import EvalSet, some_starts
from imagine_bench.judge.truth import added_up, expected_reward, shares
from imagine_bench.rules import Outcomes, advance, is_random
from imagine_bench.seeding import Purpose, SeedTree
from imagine_bench.statistics import auroc
from imagine_bench.store.results import ComparedRollout, OpenLoop

OPEN_LOOP_DEPTH = 10  # steps of the open-loop comparison, the thesis' I_D
EXAMPLES = 5  # greedy imagined rollouts kept with each run, with their real counterparts
SAMPLED_ROLLOUTS = 4  # rollouts sampled from one start and kept with each run
SAMPLED_DEPTH = 5  # macro-actions of each of them
Real = tuple[Frame, State, float, bool]
"""The result of a macro-action: the frame, its content, the reward, and whether the episode has ended."""
T = TypeVar("T")


def imagined_from(
    agent: Imaginer, frames: Sequence[Frame] | Frame, seeds: SeedTree, *, depth: int, actions: Ints | None = None
) -> list[ImaginedRollout]:
    """A rollout from each of N frames, of which the agent sees each as the next of its episode.

    The controller chooses where no macro-actions (N, D) are given. ``seeds`` has a generator for each rollout.
    """
    found = []
    for row, frame in enumerate(frames):
        given = None if actions is None else read_only(actions[row])
        rng = seeds.child(row).generator()
        found.append(agent.imagine(read_only(frame), actions=given, depth=depth, rng=rng).in_range())
    return found


# Open loop ---------------------------------------------------------------------------------------------------------


def surviving_actions(
    spec: TaskSpec, *, starts: int, depth: int, appearance: str, purpose: Purpose = "evaluation"
) -> EvalSet | None:
    """The questions of the open-loop comparison: the same for every agent and seed; tuning has its own.

    From each of N = ``starts`` starts, D macro-actions are drawn uniformly among those that end no episode, now or by
    force later. D is ``depth``, or less where the rules cannot be kept alive as long. Frames are kinematic. The truth
    is the content of the agent's frames, as :meth:`TaskSpec.as_observed` has it; without ``sight`` that is the
    macrostate. None where no episode can be kept alive, or no start is wanted.
    """
    rng = SeedTree(0).child(purpose, "open_loop", spec.id).generator()

    @functools.cache
    def safe(support: frozenset[State], steps: int) -> list[int]:
        """The actions after which the episode surely goes on, and can surely go on for ``steps - 1`` more."""
        found = []
        for action in range(spec.n_actions):
            outcomes = [outcome for state in support for outcome in spec.rules.outcomes(state, action)]
            ended = any(outcome.terminated for outcome in outcomes)
            reached = frozenset(outcome.macrostate for outcome in outcomes)
            if not ended and (steps == 1 or safe(reached, steps - 1)):
                found.append(action)
        return found

    observed = {state: _clearest(spec.sight, state) for state in spec.rules.start_states}
    alike = {first: [state for state in observed if observed[state] == first] for first in observed.values()}
    candidates: list[State] = []
    while depth and not candidates:
        candidates = [state for state in observed if safe(frozenset(alike[observed[state]]), depth)]
        depth -= not candidates
    if not candidates or not starts:
        return None
    chosen = [candidates[index] for index in rng.integers(len(candidates), size=starts)]
    frames = spec.render_macrostates(np.array([observed[state] for state in chosen], dtype=np.int64), appearance, rng)
    actions = np.zeros((starts, depth), dtype=np.int64)
    truth = []
    for row, state in enumerate(chosen):
        same = alike[observed[state]]
        reached: list[Outcomes] = [{(each, False): (1.0 / len(same), 0.0) for each in same}]
        for step in range(depth):
            actions[row, step] = rng.choice(safe(frozenset(shares(reached[-1])), depth - step))
            reached.append(advance(spec.rules, reached[-1], int(actions[row, step])))
        truth.append(tuple(_observed(spec, reached, observed[state], step) for step in range(1, depth + 1)))
    return EvalSet(states=tuple(chosen), frames=frames[:, None], actions=actions, truth=tuple(truth))


def _clearest(sight: ObservationModel | None, state: State) -> State:
    """The content of an episode's first frame where it hides as little as it can; -1 for the hidden."""
    if sight is None:
        return state
    return min((what for _, what in sight.seen(state, 0)), key=lambda what: sum(value < 0 for value in what))


def _observed(spec: TaskSpec, reached: Sequence[Outcomes], first: State, step: int) -> Outcomes:
    """The truth of a frame after ``step`` actions, and of the reward of the latest.

    ``reached`` are the outcomes after each number of actions, and ``first`` is the content of the first frame.
    """
    if spec.sight is None:
        return reached[step]
    taken = step - spec.sight.lag
    observed = {spec.as_observed(first): 1.0}
    if taken > 0:
        observed = added_up(
            (spec.as_observed(shown), share * probability)
            for state, share in shares(reached[taken]).items()
            for probability, shown in spec.sight.seen(state, taken)
        )
    reward = expected_reward(reached[step])
    return {(read, False): (share, reward) for read, share in observed.items()}


def open_loop(agent: Imaginer, questions: EvalSet, seeds: SeedTree) -> OpenLoop:
    """Imagine the macro-actions of every start in closed loop of the model and compare by depth.

    An imagined macrostate is correct if the agent's frame may show it after these actions; the reward is compared with
    its expectation. The rules keep every rollout alive: any predicted termination is wrong. The agent, which draws
    from the generators of ``seeds``, is not changed.
    """
    begin_episode(agent)
    shape = questions.asked.shape
    rollouts = imagined_from(agent, questions.frames[:, -1], seeds, depth=shape[1], actions=questions.asked)

    def stacked(name: str) -> Floats:  # [starts, D]
        return np.array([getattr(rollout, name) for rollout in rollouts], dtype=np.float64)

    correct = np.zeros(shape, dtype=bool)
    rewards = np.zeros(shape)
    for row, step in np.ndindex(*shape):
        outcomes = questions.truth[row][step]
        correct[row, step] = tuple(rollouts[row].macrostates[step].tolist()) in shares(outcomes)
        rewards[row, step] = expected_reward(outcomes)
    accepted = stacked("accepted")
    kept = accepted.sum(axis=0)
    began = np.pad(correct[:, :-1], ((0, 0), (1, 0)), constant_values=True)
    uncertain = {}
    for cause in UNCERTAINTIES:
        values = stacked(cause)
        columns = zip(values.T, correct.T, began.T, strict=True)
        uncertain[cause] = values.mean(axis=0)
        uncertain[f"auroc_{cause}"] = np.array([auroc(value[b], ~right[b]) for value, right, b in columns])
    return OpenLoop(
        count=np.full(shape[1], len(rollouts), dtype=np.int64),
        correct=correct.mean(axis=0),
        correct_accepted=np.where(kept > 0, (correct * accepted).sum(axis=0) / np.maximum(kept, 1), np.nan),
        accepted=accepted.mean(axis=0),
        reward_mae=np.abs(stacked("rewards") - rewards).mean(axis=0),
        termination_error=(stacked("p_terminated") > 0.5).mean(axis=0),
        judged=began.sum(axis=0).astype(np.float64),
        **uncertain,
    )


# Beside reality ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Moment:
    """A moment of a real episode, from which an agent imagines."""

    spec: TaskSpec
    appearance: str
    frame: Frame  #: The agent's frame. Shape (64, 64, 3).
    macrostate: State  #: Where it sees it
    before: Sequence[State] = ()  #: Macrostates of the same episode before

    def beside(self, rollout: ImaginedRollout, rng: np.random.Generator) -> ComparedRollout:
        """Put the truth beside a rollout that was imagined from here.

        The rules give states and rewards, the kinematic mode gives frames: those that the agent would really see, old
        or hiding something where the task's are. Where the rules leave several outcomes to chance, one that looks as
        was imagined is taken if there is any, else ``rng`` draws. Once the rules end the episode its last macrostate is
        held, with reward 0 and ``terminated`` True.
        """
        rules = self.spec.rules
        over = rules.is_terminal(self.macrostate)
        states = [*self.before, self.macrostate]
        ruled = []
        for step, action in enumerate(rollout.actions.tolist()):
            reward = 0.0
            if over:
                states.append(states[-1])
            else:
                possible = [(outcome.probability, outcome) for outcome in rules.outcomes(states[-1], action)]
                alike = [each for each in possible if self._as_imagined(each[1].macrostate, rollout, step)]
                outcome = alike[0][1] if len(alike) == 1 else _drawn(alike or possible, rng)
                states.append(outcome.macrostate)
                reward = outcome.reward
                over = outcome.terminated
            ruled.append((reward, over))
        shown = _in_frames(self.spec.sight, states, rng)[len(self.before) + 1 :]
        frames = self.spec.render_macrostates(np.array(shown), self.appearance, rng) if shown else ()
        read = [self.spec.as_observed(state) for state in shown]
        pairs = zip(frames, read, ruled, strict=True)
        real = [(frame, state, reward, over) for frame, state, (reward, over) in pairs]
        return beside_reality(rollout, self.frame, self.macrostate, real)

    def _as_imagined(self, state: State, rollout: ImaginedRollout, step: int) -> bool:
        """Whether a macrostate reached by action number ``step`` looks as imagined; a late coordinate was imagined
        late.
        """
        sight = self.spec.sight
        observed = {state}
        if sight is not None:
            taken = len(self.before) + step + 1
            observed = {self.spec.as_observed(what) for _, what in sight.seen(state, taken)}
            step += sight.lag
        return step < len(rollout.macrostates) and tuple(rollout.macrostates[step].tolist()) in observed

    def sampled(self, agent: Imaginer, seeds: SeedTree) -> tuple[ComparedRollout, ...]:
        """Imagine this moment several times. The agent has seen the episode so far, and is not changed."""
        rollouts = imagined_from(agent, [self.frame] * SAMPLED_ROLLOUTS, seeds, depth=SAMPLED_DEPTH)
        rng = seeds.child("reality").generator()
        return tuple(self.beside(rollout, rng) for rollout in rollouts)


def _first_moments(spec: TaskSpec, starts: Sequence[State], appearance: str, rng: np.random.Generator) -> list[Moment]:
    """How episodes begin in some macrostates."""
    observed = [_clearest(spec.sight, start) for start in starts]
    frames = spec.render_macrostates(np.array(observed, dtype=np.int64), appearance, rng)
    pairs = zip(frames, starts, strict=True)
    return [Moment(spec=spec, appearance=appearance, frame=frame, macrostate=start) for frame, start in pairs]


def examples(
    agent: Imaginer, spec: TaskSpec, *, appearance: str, seeds: SeedTree, purpose: Purpose = "evaluation"
) -> tuple[ComparedRollout, ...]:
    """A handful of rollouts that the greedy controller chooses, each from a start of its own, beside reality.

    The starts are the same for every agent and seed, the real frames kinematic. The agent, which draws from the
    generators of ``seeds``, is not changed.
    """
    rng = SeedTree(0).child(purpose, "examples", spec.id).generator()
    moments = _first_moments(spec, some_starts(spec.rules, EXAMPLES, rng), appearance, rng)
    begin_episode(agent)
    rollouts = imagined_from(agent, [moment.frame for moment in moments], seeds, depth=spec.horizon)
    return tuple(moment.beside(rollout, rng) for moment, rollout in zip(moments, rollouts, strict=True))


def imagine_sampled_rollouts(
    agent: Imaginer, spec: TaskSpec, *, appearance: str, seeds: SeedTree, purpose: Purpose = "evaluation"
) -> tuple[ComparedRollout, ...]:
    """Several rollouts from one start; none where the rules leave nothing to chance."""
    if not is_random(spec.rules):
        return ()
    rng = SeedTree(0).child(purpose, "sampled_rollouts", spec.id).generator()
    start = spec.rules.start_states[int(rng.integers(len(spec.rules.start_states)))]
    begin_episode(agent)
    return _first_moments(spec, [start], appearance, rng)[0].sampled(agent, seeds)


def _in_frames(sight: ObservationModel | None, states: Sequence[State], rng: np.random.Generator) -> Sequence[State]:
    """The content of the agent's frame in each macrostate of an episode; -1 for a hidden coordinate."""
    if sight is None:
        return states
    possible = [sight.seen(state, step) for step, state in enumerate(states)]
    shown = [each[0][1] if len(each) == 1 else _drawn(each, rng) for each in possible]
    return [shown[max(0, step - sight.lag)] for step in range(len(states))]


def _drawn(choices: Sequence[tuple[float, T]], rng: np.random.Generator) -> T:
    """One of the choices, in proportion to their probabilities."""
    probabilities = np.array([probability for probability, _ in choices])
    return choices[int(rng.choice(len(choices), p=probabilities / probabilities.sum()))][1]


def beside_reality(rollout: ImaginedRollout, frame: Frame, macrostate: State, real: Sequence[Real]) -> ComparedRollout:
    """An imagined rollout from a ``frame`` that is seen in ``macrostate``, and the real course of the same
    macro-actions.

    ``real`` has an entry for each macro-action that was carried out.
    """
    done = len(real)
    frames, states, rewards, over = zip(*real, strict=True) if real else ([], [], [], [])
    return ComparedRollout(
        start_frame=frame.copy(),
        start_macrostate=np.array(macrostate, dtype=np.int64),
        rollout=rollout,
        real_frames=np.array(frames, dtype=np.uint8).reshape(done, *frame.shape),
        real_macrostates=np.array(states, dtype=np.int64).reshape(done, len(macrostate)),
        real_rewards=np.array(rewards, dtype=np.float64),
        real_terminated=np.array(over, dtype=bool),
    )
