"""How right an agent's imagination is, measured against the rules; nothing here is ever shown to the agent."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.capabilities import ImaginedRollout, Imaginer
from imagine_bench.interfaces import Frame, Rules, TaskSpec
from imagine_bench.judge.comparison import compare_rollout
from imagine_bench.seeding import Purpose, SeedTree
from imagine_bench.store.results import ComparedRollout, OpenLoop

EXAMPLES = 5
"""Greedy imagined rollouts kept with each run, with their real counterparts."""

COURSES, COURSE_DEPTH = 4, 5
"""Imagined sampled_rollouts of one beginning kept with each run, and macro-actions of each."""

State = tuple[int, ...]
Alive = Callable[[frozenset[State], int], bool]
Belief = dict[State, float]
"""Probabilities of macrostates; of deterministic rules always a single one."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """A real start and actions the rules keep alive, with what the rules say about each step.

    Attributes:
        frame: The real frame. Shape (64, 64, 3).
        actions: Drawn uniformly among those that end no episode, now or by force later. Shape (D,).
        beliefs: What the macrostate may be after each action. Length D.
        rewards: Expected reward of each action. Shape (D,).
    """

    frame: NDArray[np.uint8]
    actions: NDArray[np.int64]
    beliefs: tuple[Belief, ...]
    rewards: NDArray[np.float64]


def ask(
    spec: TaskSpec, *, starts: int, depth: int, appearance: str, purpose: Purpose = "evaluation"
) -> tuple[Question, ...]:
    """The questions of the open-loop comparison: the same for every agent and seed.

    Args:
        spec: The task.
        starts: How many.
        depth: Imagined steps D of each.
        appearance: Appearance level of the start frames (kinematic mode).
        purpose: What the answers are for; tuning has questions of its own.
    """
    rng = SeedTree(0).child(purpose, "open_loop", spec.id).generator()
    alive = _alive(spec)
    candidates: list[State] = []
    while depth and not candidates:  # rules that cannot be kept alive as long are asked for less
        candidates = [state for state in spec.rules.start_states if alive(frozenset({state}), depth)]
        depth -= not candidates
    if not candidates or not starts:
        return ()
    states = [candidates[index] for index in rng.integers(len(candidates), size=starts)]
    frames = spec.render_macrostates(np.array(states, dtype=np.int64), appearance, rng)
    return tuple(_question(spec, alive, start, depth, rng) for start in zip(states, frames, strict=True))


def open_loop(agent: Imaginer, questions: tuple[Question, ...], seeds: SeedTree) -> OpenLoop:
    """Imagine every question's actions in closed loop of the model and compare by depth.

    An imagined macrostate is right if it is one the rules allow after these actions, which for deterministic rules is
    exactly one; the reward is compared with its expectation. The rules keep every rollout alive: any predicted end is
    wrong.

    Args:
        agent: It is not changed.
        questions: At least one, all of the same depth D.
        seeds: Names the generators that imagination draws from.
    """
    answers = [
        agent.imagine(
            question.frame,
            actions=question.actions,
            depth=len(question.actions),
            rng=seeds.child(index).generator(),
        )
        for index, question in enumerate(questions)
    ]
    correct = np.array([_correct(q, a) for q, a in zip(questions, answers, strict=True)])  # [starts, D]
    accepted = np.array([answer.accepted for answer in answers])
    rewards = np.array([answer.rewards for answer in answers], dtype=np.float64)
    truths = np.array([question.rewards for question in questions])
    kept = accepted.sum(axis=0)  # [D]
    return OpenLoop(
        count=np.full(correct.shape[1], len(questions), dtype=np.int64),
        correct=correct.mean(axis=0),
        correct_accepted=np.where(kept > 0, (correct & accepted).sum(axis=0) / np.maximum(kept, 1), np.nan),
        accepted=accepted.mean(axis=0),
        reward_mae=np.abs(rewards - truths).mean(axis=0),
        termination_error=_mean([answer.p_terminated > 0.5 for answer in answers]),
        epistemic=_mean([answer.epistemic for answer in answers]),
        aleatoric=_mean([answer.aleatoric for answer in answers]),
        modal=_mean([answer.modal for answer in answers]),
        **_detection(correct, answers),
    )


def _detection(correct: NDArray[np.bool_], answers: list[ImaginedRollout]) -> dict[str, NDArray[np.float64]]:
    """How well each uncertainty tells wrong transitions from right ones, by depth, where they began right.

    Args:
        correct: Shape (starts, D).
        answers: Length starts.
    """
    from imagine_bench.judge.calibration import auroc  # noqa: PLC0415 - scipy loads slowly

    began = np.concatenate([np.ones((len(correct), 1), dtype=np.bool_), correct[:, :-1]], axis=1)
    found = {"judged": began.sum(axis=0).astype(np.float64)}
    for kind in ("epistemic", "aleatoric", "modal"):
        scores = np.array([getattr(answer, kind) for answer in answers], dtype=np.float64)
        columns = zip(scores.T, correct.T, began.T, strict=True)
        found[f"auroc_{kind}"] = np.array([auroc(score[b], ~right[b]) for score, right, b in columns])
    return found


def examples(
    agent: Imaginer, spec: TaskSpec, *, appearance: str, seeds: SeedTree, purpose: Purpose = "evaluation"
) -> tuple[ComparedRollout, ...]:
    """A handful of rollouts the greedy controller chooses, each beside its real counterpart.

    Args:
        agent: It is not changed.
        spec: The task; the starts are the same for every agent and seed.
        appearance: Appearance level of the real frames (kinematic mode).
        seeds: Names the generators that imagination draws from.
        purpose: What the starts are drawn for.
    """
    rng = SeedTree(0).child(purpose, "examples", spec.id).generator()
    known = len(spec.rules.start_states)
    picks = rng.choice(known, size=EXAMPLES, replace=known < EXAMPLES)
    states = np.array([spec.rules.start_states[index] for index in picks], dtype=np.int64)
    frames = spec.render_macrostates(states, appearance, rng)
    return tuple(
        compare_rollout(
            spec,
            frame=frame,
            macrostate=state,
            rollout=agent.imagine(frame, actions=None, depth=spec.horizon, rng=seeds.child(index).generator()),
            appearance=appearance,
            rng=rng,
        )
        for index, (frame, state) in enumerate(zip(frames, states, strict=True))
    )


def is_random(rules: Rules) -> bool:
    """Whether some macro-action may lead to one thing or another."""
    return any(len(rules.outcomes(state, action)) > 1 for state in rules.states for action in range(rules.n_actions))


def imagine_sampled_rollouts(
    agent: Imaginer, spec: TaskSpec, *, appearance: str, seeds: SeedTree, purpose: Purpose = "evaluation"
) -> tuple[ComparedRollout, ...]:
    """Imagine the same beginning several times, the agent's greedy controller choosing; none if nothing is random.

    Args:
        agent: It is not changed.
        spec: The task; the beginning is the same for every agent and seed.
        appearance: Appearance level of the real frame (kinematic mode).
        seeds: Names the generators that imagination draws from.
        purpose: What the beginning is drawn for.
    """
    if not is_random(spec.rules):
        return ()
    rng = SeedTree(0).child(purpose, "sampled_rollouts", spec.id).generator()
    start = np.array(spec.rules.start_states[int(rng.integers(len(spec.rules.start_states)))], dtype=np.int64)
    frame = spec.render_macrostates(start[None], appearance, rng)[0]
    return courses_from(agent, spec, frame=frame, macrostate=start, appearance=appearance, seeds=seeds)


def courses_from(
    agent: Imaginer,
    spec: TaskSpec,
    *,
    frame: Frame,
    macrostate: NDArray[np.int64],
    appearance: str,
    seeds: SeedTree,
) -> tuple[ComparedRollout, ...]:
    """Imagine one beginning several times, the agent's greedy controller choosing.

    Args:
        agent: It is not changed.
        spec: The task.
        frame: The real frame it begins with. Shape (64, 64, 3).
        macrostate: What that frame shows. Shape (M,).
        appearance: Appearance level of the real counterparts.
        seeds: Names the generators that imagination and reality draw from.
    """
    rng = seeds.child("reality").generator()
    return tuple(
        compare_rollout(
            spec,
            frame=frame,
            macrostate=macrostate,
            rollout=agent.imagine(frame, actions=None, depth=COURSE_DEPTH, rng=seeds.child(index).generator()),
            appearance=appearance,
            rng=rng,
        )
        for index in range(COURSES)
    )


def _alive(spec: TaskSpec) -> Alive:
    """Whether some actions, chosen blindly from any of these macrostates, surely keep an episode going for so long."""

    @functools.cache
    def alive(support: frozenset[State], steps: int) -> bool:
        return steps == 0 or bool(_safe_actions(spec, alive, support, steps))

    return alive


def _safe_actions(spec: TaskSpec, alive: Alive, support: Iterable[State], steps: int) -> list[int]:
    """The actions after which the episode surely goes on, and can surely go on for ``steps - 1`` more."""
    safe = []
    for action in range(spec.n_actions):
        outcomes = [outcome for state in support for outcome in spec.rules.outcomes(state, action)]
        ended = any(outcome.terminated for outcome in outcomes)
        if not ended and alive(frozenset(outcome.macrostate for outcome in outcomes), steps - 1):
            safe.append(action)
    return safe


def _question(
    spec: TaskSpec, alive: Alive, start: tuple[State, NDArray[np.uint8]], depth: int, rng: np.random.Generator
) -> Question:
    state, frame = start
    belief: Belief = {state: 1.0}
    actions, beliefs, rewards = [], [], []
    for step in range(depth):
        action = int(rng.choice(_safe_actions(spec, alive, belief, depth - step)))
        belief, reward = _advance(spec.rules, belief, action)
        actions.append(action)
        beliefs.append(belief)
        rewards.append(reward)
    return Question(
        frame=frame,
        actions=np.array(actions, dtype=np.int64),
        beliefs=tuple(beliefs),
        rewards=np.array(rewards, dtype=np.float64),
    )


def _advance(rules: Rules, belief: Belief, action: int) -> tuple[Belief, float]:
    """The belief after ``action`` and the reward expected of it."""
    after: Belief = {}
    reward = 0.0
    for state, weight in belief.items():
        for outcome in rules.outcomes(state, action):
            after[outcome.macrostate] = after.get(outcome.macrostate, 0.0) + weight * outcome.probability
            reward += weight * outcome.probability * outcome.reward
    return after, reward


def _correct(question: Question, answer: ImaginedRollout) -> NDArray[np.bool_]:
    read = [tuple(int(value) for value in row) for row in answer.macrostates]
    return np.array([state in belief for state, belief in zip(read, question.beliefs, strict=True)])


def _mean(rows: list[NDArray[np.float32]] | list[NDArray[np.bool_]]) -> NDArray[np.float64]:
    return np.asarray(rows, dtype=np.float64).mean(axis=0)
