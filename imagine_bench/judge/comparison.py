"""What the real environment shows for the macro-actions that an agent imagined."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine_bench.capabilities import ImaginedRollout
from imagine_bench.interfaces import Frame, Outcome, TaskSpec
from imagine_bench.store.results import ComparedRollout


def compare_rollout(
    spec: TaskSpec,
    *,
    frame: Frame,
    macrostate: NDArray[np.int64],
    rollout: ImaginedRollout,
    appearance: str,
    rng: np.random.Generator,
) -> ComparedRollout:
    """Put the truth beside an imagined rollout: the rules give states and rewards, the kinematic mode gives frames.

    Where the rules leave several outcomes to chance, the one that was imagined is taken if it is among them.
    Once the rules end the episode its last macrostate is held, with reward 0 and ``terminated`` True.

    Args:
        spec: The task.
        frame: The real frame the rollout starts from. Shape (64, 64, 3).
        macrostate: What that frame shows. Shape (M,).
        rollout: What the agent imagined from it, of depth D.
        appearance: Appearance level of the real frames.
        rng: Draws among stochastic outcomes, and the appearance.
    """
    state = tuple(int(value) for value in macrostate)
    over = spec.rules.is_terminal(state)
    states, rewards, ends = [], [], []
    for action, imagined in zip(rollout.actions, rollout.macrostates, strict=True):
        reward = 0.0
        if not over:
            outcome = _choose(spec.rules.outcomes(state, int(action)), tuple(imagined.tolist()), rng)
            state, reward, over = outcome.macrostate, outcome.reward, outcome.terminated
        states.append(state)
        rewards.append(reward)
        ends.append(over)
    real_macrostates = np.array(states, dtype=np.int64).reshape(-1, len(macrostate))  # [D, M]
    real_frames = (
        spec.render_macrostates(real_macrostates, appearance, rng)
        if states
        else np.zeros((0, *frame.shape), dtype=np.uint8)
    )
    return ComparedRollout(
        start_frame=frame.copy(),
        start_macrostate=np.asarray(macrostate, dtype=np.int64),
        rollout=rollout,
        real_frames=real_frames,
        real_macrostates=real_macrostates,
        real_rewards=np.array(rewards, dtype=np.float64),
        real_terminated=np.array(ends, dtype=np.bool_),
    )


def _choose(outcomes: tuple[Outcome, ...], imagined: tuple[int, ...], rng: np.random.Generator) -> Outcome:
    """The imagined outcome if it is possible, else one of the possible ones, with its probability."""
    for outcome in outcomes:
        if outcome.macrostate == imagined:
            return outcome
    return outcomes[int(rng.choice(len(outcomes), p=[outcome.probability for outcome in outcomes]))]
