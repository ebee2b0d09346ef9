"""How right an agent's imagination is, measured against the rules; nothing here is ever shown to the agent.

Open loop: macro-actions that keep the episode alive are imagined from real starts and compared by depth. Examples:
rollouts that the greedy controller chooses stand beside what the environment shows for the same macro-actions.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats, Frame, Macrostate, Outcome, Sight, State, TaskSpec
from imagine_bench.interfaces.capabilities import ImaginedRollout, Imaginer, begin_episode
from imagine_bench.judge.calibration import auroc
from imagine_bench.judge.models.truth import Outcomes, advance, expected_reward, shares
from imagine_bench.rules import is_random
from imagine_bench.seeding import Purpose, SeedTree
from imagine_bench.store.results import ComparedRollout, OpenLoop

OPEN_LOOP_DEPTH = 10  # steps of the open-loop comparison, the thesis' I_D
EXAMPLES = 5  # greedy imagined rollouts kept with each run, with their real counterparts
SAMPLED_ROLLOUTS, SAMPLED_DEPTH = 4, 5
"""Rollouts sampled from one start and kept with each run, and macro-actions of each."""

Alive = Callable[[frozenset[State], int], bool]


@dataclass(frozen=True, kw_only=True)
class OpenLoopStart:
    """A real start and macro-actions that the rules keep alive, with what the rules say about each of them."""

    frame: Frame  # the real frame
    actions: NDArray[np.int64]  # drawn uniformly among those that end no episode, now or by force later. Shape (D,).
    #: Probabilities of what the agent's frame shows after each action, as :meth:`TaskSpec.as_observed` has it. In a
    #: task without ``sight`` that is the macrostate. Length D.
    beliefs: tuple[dict[State, float], ...]
    rewards: Floats  # expected reward of each action. Shape (D,).


def open_loop_starts(
    spec: TaskSpec, *, starts: int, depth: int, appearance: str, purpose: Purpose = "evaluation"
) -> tuple[OpenLoopStart, ...]:
    """The ``starts`` starts of the open-loop comparison: the same for every agent and seed; tuning has its own.

    Each is imagined for ``depth`` steps D, fewer where the rules cannot be kept alive as long. Frames are kinematic.
    """
    rng = SeedTree(0).child(purpose, "open_loop", spec.id).generator()
    alive = _alive(spec)
    looks = {state: _clearest_look(spec.sight, state) for state in spec.rules.start_states}
    alike = {look: [state for state in looks if looks[state] == look] for look in looks.values()}
    candidates: list[State] = []
    while depth and not candidates:
        candidates = [state for state in looks if alive(frozenset(alike[looks[state]]), depth)]
        depth -= not candidates
    if not candidates or not starts:
        return ()
    shown = [looks[candidates[index]] for index in rng.integers(len(candidates), size=starts)]
    frames = spec.render_macrostates(np.array(shown, dtype=np.int64), appearance, rng)
    return tuple(
        _start(spec, alive, alike[look], look, frame, depth, rng) for look, frame in zip(shown, frames, strict=True)
    )


def _clearest_look(sight: Sight | None, state: State) -> State:
    """What the first frame of an episode shows of its start where it hides as little as it can; -1 for the hidden."""
    if sight is None:
        return state
    return min((what for _, what in sight.seen(state, 0)), key=lambda what: sum(value < 0 for value in what))


def open_loop(agent: Imaginer, starts: tuple[OpenLoopStart, ...], seeds: SeedTree) -> OpenLoop:
    """Imagine the macro-actions of every start in closed loop of the model and compare by depth.

    An imagined macrostate is correct if the agent's frame may show it after these actions; the reward is compared with
    its expectation. The rules keep every rollout alive: any predicted termination is wrong. There is at least one
    start, all have the same depth D; the agent, which draws from the generators of ``seeds``, learns nothing. Each
    start is the first frame of an episode to it.
    """
    begin_episode(agent)
    rollouts = [
        agent.imagine(start.frame, actions=start.actions, depth=len(start.actions), rng=seeds.child(index).generator())
        for index, start in enumerate(starts)
    ]

    def stacked(name: str) -> Floats:  # [starts, D]
        return np.array([getattr(rollout, name) for rollout in rollouts], dtype=np.float64)

    correct = np.array([
        [tuple(row) in belief for row, belief in zip(rollout.macrostates.tolist(), start.beliefs, strict=True)]
        for start, rollout in zip(starts, rollouts, strict=True)
    ])  # fmt: skip  # [starts, D]
    accepted, kept = stacked("accepted"), stacked("accepted").sum(axis=0)
    rewards = np.array([start.rewards for start in starts])
    causes = {cause: stacked(cause) for cause in ("epistemic", "aleatoric", "modal")}
    return OpenLoop(
        count=np.full(correct.shape[1], len(starts), dtype=np.int64),
        correct=correct.mean(axis=0),
        correct_accepted=np.where(kept > 0, (correct * accepted).sum(axis=0) / np.maximum(kept, 1), np.nan),
        accepted=accepted.mean(axis=0),
        reward_mae=np.abs(stacked("rewards") - rewards).mean(axis=0),
        termination_error=(stacked("p_terminated") > 0.5).mean(axis=0),
        **{cause: values.mean(axis=0) for cause, values in causes.items()},
        **_detection(correct, causes),
    )


def _detection(correct: NDArray[np.bool_], causes: dict[str, Floats]) -> dict[str, Floats]:
    """How well each uncertainty (starts, D) tells wrong transitions from correct ones that began correct, by depth."""
    began = np.concatenate([np.ones((len(correct), 1), dtype=np.bool_), correct[:, :-1]], axis=1)
    found = {"judged": began.sum(axis=0).astype(np.float64)}
    for cause, values in causes.items():
        columns = zip(values.T, correct.T, began.T, strict=True)
        found[f"auroc_{cause}"] = np.array([auroc(value[b], ~right[b]) for value, right, b in columns])
    return found


def examples(
    agent: Imaginer, spec: TaskSpec, *, appearance: str, seeds: SeedTree, purpose: Purpose = "evaluation"
) -> tuple[ComparedRollout, ...]:
    """A handful of rollouts that the greedy controller chooses, each from a start of its own, beside reality.

    The starts are the same for every agent and seed, the real frames kinematic. The agent, which draws from the
    generators of ``seeds``, learns nothing; each start is the first frame of an episode to it.
    """
    starts = spec.rules.start_states
    rng = SeedTree(0).child(purpose, "examples", spec.id).generator()
    picks = rng.choice(len(starts), size=EXAMPLES, replace=len(starts) < EXAMPLES)
    states = np.array([starts[index] for index in picks], dtype=np.int64)
    shown = np.array([_clearest_look(spec.sight, starts[index]) for index in picks], dtype=np.int64)
    frames = spec.render_macrostates(shown, appearance, rng)
    begin_episode(agent)
    return _greedy_rollouts(agent, spec, frames, states, appearance, seeds, rng, depth=spec.horizon)


def imagine_sampled_rollouts(
    agent: Imaginer, spec: TaskSpec, *, appearance: str, seeds: SeedTree, purpose: Purpose = "evaluation"
) -> tuple[ComparedRollout, ...]:
    """Like :func:`examples`, with the same start several times; none where the rules leave nothing to chance."""
    if not is_random(spec.rules):
        return ()
    rng = SeedTree(0).child(purpose, "sampled_rollouts", spec.id).generator()
    start = spec.rules.start_states[int(rng.integers(len(spec.rules.start_states)))]
    shown = np.array([_clearest_look(spec.sight, start)], dtype=np.int64)
    frame = spec.render_macrostates(shown, appearance, rng)[0]
    begin_episode(agent)
    macrostate = np.array(start, dtype=np.int64)
    return sampled_rollouts_from(agent, spec, frame=frame, macrostate=macrostate, appearance=appearance, seeds=seeds)


def sampled_rollouts_from(
    agent: Imaginer, spec: TaskSpec, *, frame: Frame, macrostate: Macrostate, appearance: str, seeds: SeedTree,
    before: Sequence[State] = (),
) -> tuple[ComparedRollout, ...]:  # fmt: skip
    """Imagine one start several times: the real ``frame``, seen in ``macrostate`` after those ``before``."""
    frames, states = [frame] * SAMPLED_ROLLOUTS, [macrostate] * SAMPLED_ROLLOUTS
    rng = seeds.child("reality").generator()
    return _greedy_rollouts(agent, spec, frames, states, appearance, seeds, rng, depth=SAMPLED_DEPTH, before=before)


def _greedy_rollouts(
    agent: Imaginer, spec: TaskSpec, frames: Iterable[Frame], states: Iterable[Macrostate], appearance: str,
    seeds: SeedTree, rng: np.random.Generator, *, depth: int, before: Sequence[State] = (),
) -> tuple[ComparedRollout, ...]:  # fmt: skip
    found = []
    for index, (frame, state) in enumerate(zip(frames, states, strict=True)):
        rollout = agent.imagine(frame, actions=None, depth=depth, rng=seeds.child(index).generator())
        start: dict[str, Any] = {"frame": frame, "macrostate": state, "rollout": rollout}
        found.append(compare_rollout(spec, **start, appearance=appearance, rng=rng, before=before))
    return tuple(found)


def compare_rollout(
    spec: TaskSpec, *, frame: Frame, macrostate: Macrostate, rollout: ImaginedRollout, appearance: str,
    rng: np.random.Generator, before: Sequence[State] = (),
) -> ComparedRollout:  # fmt: skip
    """Put the truth beside a rollout imagined from ``frame``, which is seen in ``macrostate`` (M,).

    The rules give states and rewards, the kinematic mode gives frames: those that the agent would really see after the
    macrostates ``before`` of the same episode, old or hiding something where the task's are. Where the rules leave
    several outcomes to chance, one that looks as was imagined is taken if there is any, else ``rng`` draws.
    Once the rules end the episode its last macrostate is held, with reward 0 and ``terminated`` True.
    """
    start = state = tuple(int(value) for value in macrostate)
    over = spec.rules.is_terminal(state)
    real: list[tuple[State, float, bool]] = []
    for step, action in enumerate(rollout.actions.tolist()):
        reward = 0.0
        if not over:
            possible = spec.rules.outcomes(state, action)
            alike = _as_imagined(spec, possible, rollout, step, len(before))
            outcome = alike[0] if len(alike) == 1 else _draw(alike or possible, rng)
            state, reward, over = outcome.macrostate, outcome.reward, outcome.terminated
        real.append((state, reward, over))
    seen = _in_frames(spec.sight, (*before, start, *(state for state, _, _ in real)), rng)[len(before) + 1 :]
    frames = spec.render_macrostates(np.array(seen), appearance, rng) if real else ()
    read = [(spec.as_observed(shown), reward, over) for shown, (_, reward, over) in zip(seen, real, strict=True)]
    return beside_reality(rollout, frame, macrostate, frames, read)


def _in_frames(sight: Sight | None, states: Sequence[State], rng: np.random.Generator) -> Sequence[State]:
    """What the frame shows that the agent sees in each macrostate of an episode; -1 for what it hides."""
    if sight is None:
        return states
    shown = []
    for step, state in enumerate(states):
        chances, whats = zip(*sight.seen(state, step), strict=True)
        shown.append(whats[0 if len(whats) == 1 else int(rng.choice(len(whats), p=chances))])
    return [shown[max(0, step - sight.lag)] for step in range(len(states))]


def beside_reality(
    rollout: ImaginedRollout, frame: Frame, macrostate: Sequence[int] | Macrostate, frames: Sequence[Frame] | Frame,
    real: Sequence[tuple[State, float, bool]],
) -> ComparedRollout:  # fmt: skip
    """An imagined rollout from a ``frame`` that is seen in ``macrostate``, and what really came of it.

    ``frames`` and ``real`` (what they show, reward, whether the episode has ended) have an entry for each macro-action
    that was carried out.
    """
    done = len(real)
    return ComparedRollout(
        start_frame=frame.copy(),
        start_macrostate=np.array(macrostate, dtype=np.int64),
        rollout=rollout,
        real_frames=np.array(frames, dtype=np.uint8).reshape(done, *frame.shape),
        real_macrostates=np.array([state for state, _, _ in real], dtype=np.int64).reshape(done, len(macrostate)),
        real_rewards=np.array([reward for _, reward, _ in real], dtype=np.float64),
        real_terminated=np.array([over for _, _, over in real], dtype=np.bool_),
    )


def _as_imagined(
    spec: TaskSpec, possible: Sequence[Outcome], rollout: ImaginedRollout, step: int, before: int
) -> tuple[Outcome, ...]:
    """Those outcomes of the rollout's action number ``step`` that look as they were imagined.

    ``before`` macro-actions of the episode came before the rollout. Where frames are late, so is what was imagined.
    """
    lag = 0 if spec.sight is None else spec.sight.lag
    if step + lag >= len(rollout.macrostates):
        return ()
    imagined = tuple(rollout.macrostates[step + lag].tolist())

    def looks(outcome: Outcome) -> set[State]:
        if spec.sight is None:
            return {outcome.macrostate}
        return {spec.as_observed(what) for _, what in spec.sight.seen(outcome.macrostate, before + step + 1)}

    return tuple(outcome for outcome in possible if imagined in looks(outcome))


def _draw(outcomes: Sequence[Outcome], rng: np.random.Generator) -> Outcome:
    """One of the outcomes, in proportion to their probabilities."""
    probabilities = np.array([outcome.probability for outcome in outcomes])
    return outcomes[int(rng.choice(len(outcomes), p=probabilities / probabilities.sum()))]


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


def _start(
    spec: TaskSpec, alive: Alive, alike: Sequence[State], look: State, frame: Frame, depth: int,
    rng: np.random.Generator,
) -> OpenLoopStart:  # fmt: skip
    """A start of which ``frame`` shows ``look``, as it does of each of the equally likely macrostates ``alike``."""
    outcomes: Outcomes = {(state, False): (1.0 / len(alike), 0.0) for state in alike}
    actions, rewards = [], []
    in_turn = [shares(outcomes)]
    for step in range(depth):
        actions.append(int(rng.choice(_safe_actions(spec, alive, in_turn[-1], depth - step))))
        outcomes = advance(spec.rules, outcomes, actions[-1])
        in_turn.append(shares(outcomes))
        rewards.append(expected_reward(outcomes))
    return OpenLoopStart(
        frame=frame,
        actions=np.array(actions, dtype=np.int64),
        beliefs=tuple(_read_after(spec, in_turn, look, step) for step in range(1, depth + 1)),
        rewards=np.array(rewards, dtype=np.float64),
    )


def _read_after(spec: TaskSpec, in_turn: Sequence[dict[State, float]], look: State, step: int) -> dict[State, float]:
    """Probabilities of what the agent's frame shows after ``step`` actions, given those of macrostates in turn."""
    if spec.sight is None:
        return in_turn[step]
    taken = step - spec.sight.lag
    if taken <= 0:
        return {spec.as_observed(look): 1.0}
    found: dict[State, float] = {}
    for state, share in in_turn[taken].items():
        for probability, what in spec.sight.seen(state, taken):
            read = spec.as_observed(what)
            found[read] = found.get(read, 0.0) + share * probability
    return found
