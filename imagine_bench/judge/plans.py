"""Plans: a whole sequence of macro-actions imagined from one camera frame, then carried out without looking again.

The greedy controller acts in the closed-loop model until the model says that the episode is over (thesis 5.2.3,
"Generating Plans"). The arm then carries out the plan; the frames it passes are kept for people to compare, and the
agent never sees them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass

import numpy as np

from imagine_bench.arrays import Bools, State
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.capabilities import ImaginedRollout, begin_episode
from imagine_bench.interfaces.environments import Env
from imagine_bench.judge.open_loop import Real, beside_reality
from imagine_bench.rules import fewest_actions
from imagine_bench.running import run_state
from imagine_bench.running.trained import Trained
from imagine_bench.seeding import SeedTree, episode_seed, is_tuning_seed
from imagine_bench.store.results import ComparedRollout


@dataclass(frozen=True, kw_only=True)
class PlanResult:
    """One plan and its outcome."""

    number: int  # its start, from 0; the same for every agent
    start: State  # the macrostate it starts from
    compared: ComparedRollout  # the imagined frames beside those of the camera, cut where the episode ended
    refused: str  # why it was not carried out, or an empty string
    solved: bool  # whether the task was solved when the plan was done
    shortest: int | None  # the fewest macro-actions that can solve it from there, by the rules; None where none can
    faults: int  # macro-actions whose physics disagreed with the rules

    @property
    def length(self) -> int:
        """Macro-actions planned."""
        return len(self.compared.rollout.actions)

    @property
    def done(self) -> int:
        """Macro-actions carried out."""
        return 0 if self.refused else len(self.compared.real_frames)

    @property
    def optimal(self) -> bool:
        """Whether it solved the task in the fewest macro-actions possible."""
        return self.solved and self.done == self.shortest

    @property
    def as_imagined(self) -> Bools:
        """Whether each macro-action that was carried out led where it was imagined to. Shape (done,)."""
        read = self.compared.rollout.macrostates
        real = self.compared.real_macrostates
        return (read[: self.done] == real[: self.done]).all(axis=-1)

    @property
    def outcome(self) -> str:
        """Its outcome in a few words."""
        if self.refused:
            return f"refused: {self.refused}"
        if self.solved:
            longer = 0 if self.shortest is None else self.done - self.shortest
            return f"solved, {longer} longer than needed" if longer else "solved"
        if self.compared.real_terminated[-1]:
            return f"failed at macro-action {self.done}"
        return "over before anything was solved"


def make_plans(
    trained: Trained, *, count: int, execution: str, max_epistemic: float | None = None
) -> Iterator[PlanResult]:
    """Plan from ``count`` starts and carry each plan out.

    The starts have seeds of their own, the same for every agent: no run ever trained, tested or tuned on them.
    A plan with an imagined step of more epistemic uncertainty than ``max_epistemic``, reduced as the agent's filter
    does, is refused; None leaves the verdict to that filter. The agent is not changed.

    Raises:
        InvalidValueError: The agent does not imagine.
    """
    with closing(make_env(trained, execution)) as env:
        for number in range(count):
            yield carry_out(env, trained, number, max_epistemic=max_epistemic)


def make_env(trained: Trained, execution: str) -> Env:
    """The environment that plans are carried out in: the one that the agent is tested in, but for its execution."""
    protocol = trained.spec.protocol
    return run_state.make_env(protocol, protocol.task, testing=True, execution=execution)


def carry_out(
    env: Env,
    trained: Trained,
    number: int,
    *,
    max_epistemic: float | None = None,
    on_step: Callable[[int], None] | None = None,  # told how many of the plan are done, from 0, when it is made
) -> PlanResult:
    """Imagine plan ``number`` from one frame and, unless it is refused, let the arm do it."""
    first, info = env.reset(seed=episode_seed("planning", int(is_tuning_seed(trained.spec.seed)), number))
    frame = np.asarray(first)
    start = tuple(int(value) for value in info["macrostate"])
    rng = SeedTree(trained.spec.seed).child("planning", number).generator()
    agent = trained.imaginer
    begin_episode(agent)
    rollout = agent.imagine(frame, actions=None, depth=trained.task.horizon, rng=rng).in_range()
    refused = _refusal(rollout, max_epistemic)
    tell = on_step or (lambda done: None)
    tell(0)
    real: list[Real] = []
    faults = 0
    solved = False
    for action in [] if refused else rollout.actions.tolist():
        seen, reward, terminated, truncated, info = env.step(action)
        shown = trained.task.as_observed(info.get("shown", info["macrostate"]))
        real.append((np.asarray(seen), shown, float(reward), bool(terminated)))
        faults += bool(info["fault"])
        solved = bool(info["is_success"])
        tell(len(real))
        if terminated or truncated:
            break
    shortest = None
    with suppress(InvalidValueError):  # nothing is solved from there
        shortest = fewest_actions(trained.task.rules, start)
    return PlanResult(
        number=number,
        start=start,
        compared=beside_reality(rollout, frame, start, real),
        refused=refused,
        solved=solved,
        shortest=shortest,
        faults=faults,
    )


def require_threshold(max_epistemic: float | None) -> None:
    """Raise InvalidValueError for an epistemic uncertainty that nothing could stay below, NaN included."""
    if max_epistemic is not None and not max_epistemic >= 0.0:
        raise InvalidValueError(f"Plans of more epistemic uncertainty than {max_epistemic}: give at least 0.")


def _refusal(rollout: ImaginedRollout, max_epistemic: float | None) -> str:
    """Why a plan must not be carried out, or an empty string."""
    discarded = ~rollout.accepted if max_epistemic is None else rollout.epistemic > max_epistemic
    if not discarded.any():
        return ""
    step = int(discarded.argmax())
    epistemic = f"{rollout.epistemic[step]:.2g}"
    if max_epistemic is None:
        end = f"{rollout.p_terminated[step]:.2g}"  # the filter may read it, too
        known = f"epistemic uncertainty of the state {epistemic}, probability of the end {end}"
        return f"the agent's filter discards macro-action {step + 1} ({known})"
    return f"epistemic uncertainty {epistemic} at macro-action {step + 1} is above {max_epistemic:g}"
