"""How right an agent's imagination is, measured against the rules; nothing here is ever shown to the agent.

Open loop: macro-actions that keep the episode alive are imagined from real starts and compared by depth. Examples:
rollouts that the greedy controller chooses stand beside what the environment shows for the same macro-actions.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats, Frame, Macrostate, Outcome, Sight, State, TaskSpec
from imagine_bench.interfaces.capabilities import ImaginedRollout, Imaginer
from imagine_bench.judge.models import AgentModel
from imagine_bench.judge.questions import EvalSet
from imagine_bench.judge.truth import added_up, expected_reward, shares
from imagine_bench.rules import Outcomes, advance, is_random
from imagine_bench.seeding import Purpose, SeedTree
from imagine_bench.statistics import auroc
from imagine_bench.store.results import ComparedRollout, OpenLoop

OPEN_LOOP_DEPTH = 10  # steps of the open-loop comparison, the thesis' I_D
EXAMPLES = 5  # greedy imagined rollouts kept with each run, with their real counterparts
SAMPLED_ROLLOUTS = 4  # rollouts sampled from one start and kept with each run
SAMPLED_DEPTH = 5  # macro-actions of each of them

Alive = Callable[[frozenset[State], int], bool]


def surviving_actions(
    spec: TaskSpec, *, starts: int, depth: int, appearance: str, purpose: Purpose = "evaluation"
) -> EvalSet | None:
    """The questions of the open-loop comparison: the same for every agent and seed; tuning has its own.

    From each of N = ``starts`` starts, D macro-actions are drawn uniformly among those that end no episode, now or by
    force later. D is ``depth``, or less where the rules cannot be kept alive as long. Frames are kinematic. The truth
    is what the agent's frames show, as :meth:`TaskSpec.as_observed` has it; without ``sight`` that is the macrostate.
    None where no episode can be kept alive, or no start is wanted.
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
        return None
    chosen = [candidates[index] for index in rng.integers(len(candidates), size=starts)]
    frames = spec.render_macrostates(np.array([looks[state] for state in chosen], dtype=np.int64), appearance, rng)
    actions = []
    truth = []
    for state in chosen:
        same_look = alike[looks[state]]
        reached: list[Outcomes] = [{(each, False): (1.0 / len(same_look), 0.0) for each in same_look}]
        row: list[int] = []
        for step in range(depth):
            safe = _safe_actions(spec, alive, shares(reached[-1]), depth - step)
            row.append(int(rng.choice(safe)))
            reached.append(advance(spec.rules, reached[-1], row[-1]))
        actions.append(row)
        truth.append(tuple(_observed(spec, reached, looks[state], step) for step in range(1, depth + 1)))
    return EvalSet(
        states=tuple(chosen), frames=frames[:, None], actions=np.array(actions, dtype=np.int64), truth=tuple(truth)
    )


def _clearest_look(sight: Sight | None, state: State) -> State:
    """What the first frame of an episode shows of its start where it hides as little as it can; -1 for the hidden."""
    if sight is None:
        return state
    return min((what for _, what in sight.seen(state, 0)), key=lambda what: sum(value < 0 for value in what))


def _observed(spec: TaskSpec, reached: Sequence[Outcomes], look: State, step: int) -> Outcomes:
    """The truth of a frame after ``step`` actions, and of the reward of the latest.

    ``reached`` are the outcomes after each number of actions, and ``look`` is what the first frame shows.
    """
    if spec.sight is None:
        return reached[step]
    reward = expected_reward(reached[step])
    taken = step - spec.sight.lag
    if taken <= 0:
        return {(spec.as_observed(look), False): (1.0, reward)}
    looks = (
        (spec.as_observed(shown), share * probability)
        for state, share in shares(reached[taken]).items()
        for probability, shown in spec.sight.seen(state, taken)
    )
    return {(read, False): (share, reward) for read, share in added_up(looks).items()}


def open_loop(agent: Imaginer, questions: EvalSet, seeds: SeedTree) -> OpenLoop:
    """Imagine the macro-actions of every start in closed loop of the model and compare by depth.

    An imagined macrostate is correct if the agent's frame may show it after these actions; the reward is compared with
    its expectation. The rules keep every rollout alive: any predicted termination is wrong. The agent, which draws
    from the generators of ``seeds``, is not changed.
    """
    rollouts = AgentModel(agent).rollouts(
        questions.frames[:, -1],
        questions.asked,
        depth=questions.depth,
        generators=(seeds.child(index).generator() for index in range(len(questions.frames))),
    )

    def stacked(name: str) -> Floats:  # [starts, D]
        return np.array([getattr(rollout, name) for rollout in rollouts], dtype=np.float64)

    correct = np.array(
        [
            [
                tuple(read) in shares(outcomes)
                for read, outcomes in zip(rollout.macrostates.tolist(), steps, strict=True)
            ]
            for rollout, steps in zip(rollouts, questions.truth, strict=True)
        ]
    )  # [starts, D]
    accepted = stacked("accepted")
    kept = accepted.sum(axis=0)
    rewards = np.array([[expected_reward(outcomes) for outcomes in steps] for steps in questions.truth])
    causes = {cause: stacked(cause) for cause in ("epistemic", "aleatoric", "modal")}
    return OpenLoop(
        count=np.full(questions.depth, len(rollouts), dtype=np.int64),
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
    generators of ``seeds``, is not changed.
    """
    starts = spec.rules.start_states
    rng = SeedTree(0).child(purpose, "examples", spec.id).generator()
    picks = [starts[index] for index in rng.choice(len(starts), size=EXAMPLES, replace=len(starts) < EXAMPLES)]
    frames = _first_frames(spec, picks, appearance, rng)
    rollouts = AgentModel(agent).rollouts(
        frames,
        [None] * EXAMPLES,
        depth=spec.horizon,
        generators=[seeds.child(index).generator() for index in range(EXAMPLES)],
    )
    return tuple(
        compare_rollout(spec, frame=frame, macrostate=np.array(start), rollout=rollout, appearance=appearance, rng=rng)
        for frame, start, rollout in zip(frames, picks, rollouts, strict=True)
    )


def _first_frames(spec: TaskSpec, starts: Sequence[State], appearance: str, rng: np.random.Generator) -> Frame:
    """A frame of each of N starts, as an episode begins. Shape (N, 64, 64, 3)."""
    looks = [_clearest_look(spec.sight, start) for start in starts]
    return spec.render_macrostates(np.array(looks, dtype=np.int64), appearance, rng)


def imagine_sampled_rollouts(
    agent: Imaginer, spec: TaskSpec, *, appearance: str, seeds: SeedTree, purpose: Purpose = "evaluation"
) -> tuple[ComparedRollout, ...]:
    """Several rollouts from one start; none where the rules leave nothing to chance."""
    if not is_random(spec.rules):
        return ()
    rng = SeedTree(0).child(purpose, "sampled_rollouts", spec.id).generator()
    start = spec.rules.start_states[int(rng.integers(len(spec.rules.start_states)))]
    frame = _first_frames(spec, [start], appearance, rng)[0]
    return sampled_rollouts_from(
        agent, spec, frame=frame, macrostate=np.array(start), appearance=appearance, seeds=seeds, begins=True
    )


def sampled_rollouts_from(
    agent: Imaginer,
    spec: TaskSpec,
    *,
    frame: Frame,
    macrostate: Macrostate,
    appearance: str,
    seeds: SeedTree,
    before: Sequence[State] = (),
    begins: bool = False,
) -> tuple[ComparedRollout, ...]:
    """Imagine one moment several times: the real ``frame``, seen in ``macrostate`` after those ``before``.

    If it ``begins`` an episode, the agent is told so; otherwise it has seen the episode so far.
    """
    rollouts = AgentModel(agent).rollouts(
        [frame] * SAMPLED_ROLLOUTS,
        [None] * SAMPLED_ROLLOUTS,
        depth=SAMPLED_DEPTH,
        generators=[seeds.child(index).generator() for index in range(SAMPLED_ROLLOUTS)],
        begins=begins,
    )
    rng = seeds.child("reality").generator()
    compare = functools.partial(
        compare_rollout, spec, frame=frame, macrostate=macrostate, appearance=appearance, rng=rng, before=before
    )
    return tuple(compare(rollout=rollout) for rollout in rollouts)


def compare_rollout(
    spec: TaskSpec,
    *,
    frame: Frame,
    macrostate: Macrostate,
    rollout: ImaginedRollout,
    appearance: str,
    rng: np.random.Generator,
    before: Sequence[State] = (),
) -> ComparedRollout:
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
            state = outcome.macrostate
            reward = outcome.reward
            over = outcome.terminated
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
    rollout: ImaginedRollout,
    frame: Frame,
    macrostate: Sequence[int] | Macrostate,
    frames: Sequence[Frame] | Frame,
    real: Sequence[tuple[State, float, bool]],
) -> ComparedRollout:
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
