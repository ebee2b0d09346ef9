"""The measurements of a bench, as plain data: written by the runner, read by statistics, report and recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Bools, Floats, Frame, Ints, Macrostate, Pixels
from imagine_bench.errors import ArtefactError
from imagine_bench.exact.certificate import Certificate
from imagine_bench.interfaces.capabilities import ExpectedOutcomes, ImaginedRollout
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import ProtocolData
from imagine_bench.store.files import first_difference
from imagine_bench.values import Json, Setting

P = TypeVar("P", bound=ProtocolData)
R = TypeVar("R", bound="OneRun")


@dataclass(frozen=True, kw_only=True)
class OpenLoop:
    """How right the imagination is by depth, against the rules, over rollouts that the rules keep alive.

    All arrays have shape (D,), index d for imagined step d + 1.
    """

    count: Ints  #: Imagined transitions compared
    #: Share whose whole macrostate, read by the evaluation-only probe, follows from the rules.
    correct: Floats
    #: The same among those the uncertainty filter keeps (NaN where it keeps none).
    correct_accepted: Floats
    accepted: Floats  #: Share the filter keeps
    reward_mae: Floats  #: Mean absolute error of the predicted reward; NaN where a teacher's feedback was in it
    termination_error: Floats  #: Share with the wrong side of 0.5 for P(terminal)
    epistemic: Floats  #: Mean epistemic uncertainty
    aleatoric: Floats  #: Mean aleatoric uncertainty
    modal: Floats  #: Mean modal uncertainty
    #: Imagined transitions that began in the right macrostate, so that they can be wrong by themselves.
    judged: Floats
    #: How well epistemic uncertainty finds the wrong ones among those: the probability that a wrong one has the higher
    #: uncertainty of two; 0.5 is chance, NaN where none or all are wrong.
    auroc_epistemic: Floats
    auroc_aleatoric: Floats  #: The same for aleatoric uncertainty
    auroc_modal: Floats  #: The same for modal uncertainty


@dataclass(frozen=True, kw_only=True)
class ComparedRollout:
    """An imagined rollout beside the real environment's frames for the same start and actions."""

    start_frame: Frame  #: The real frame it starts from
    start_macrostate: Macrostate  #: Where it is seen
    rollout: ImaginedRollout  #: The agent's imagination
    real_frames: Pixels  #: The real frames (kinematic mode) after each action. Shape (D, 64, 64, 3), uint8.
    #: Their content: the macrostate by the rules, or where the task's frames are late or hide a coordinate, that of the
    #: frame, with one more than its last value for a hidden one. Shape (D, M).
    real_macrostates: Ints
    real_rewards: Floats  #: Rewards by the rules. Shape (D,).
    real_terminated: Bools  #: Shape (D,)


@dataclass(frozen=True, kw_only=True)
class RecordedEpisode:
    """A greedy episode of a run's recording, of L macro-actions."""

    frames: Pixels  #: The frame at its start and after each macro-action. Shape (L + 1, H, W, 3), uint8.
    actions: Ints  #: Its macro-actions. Shape (L,).
    rewards: Floats  #: Their rewards. Shape (L,).
    success: Bools  #: Whether it ended in success. Shape ().
    end: NDArray[np.str_]  #: Its end in words, such as "solved". Shape ().


@dataclass(frozen=True, kw_only=True)
class PolicyTable:
    """An agent's actions, and its model's expectations, in every macrostate of its task, S of them, in a frame of each.

    They are in the order of :func:`imagine_bench.rules.states_of`.
    """

    action: NDArray[np.int16]  #: Macro-action without exploring; 0 in terminal macrostates. Shape (S,).
    model: ExpectedOutcomes | None  #: None for an agent without a model that can be asked


@dataclass(frozen=True, kw_only=True)
class KeptEpisodes:
    """K episodes as they were played, N macro-actions in all, so that anyone can play them again."""

    starts: Ints  #: Where each began. Shape (K, M).
    lengths: Ints  #: Its macro-actions. Shape (K,).
    actions: Ints  #: Those of all episodes, one behind the other. Shape (N,).
    returns: Floats  #: Its undiscounted return. Shape (K,).
    success: Bools  #: Whether it ended in success. Shape (K,).
    faults: Ints  #: Its macro-actions whose physics disagreed with the rules. Shape (K,).
    #: CRC-32 of the environment's generator at its start and of every macrostate and reward that followed. Shape (K,).
    fingerprints: Ints
    #: Its simulated seconds, 0 in kinematic execution. Shape (K,). None in results of before 2026-11-28.
    sim_times_s: Floats | None = None

    def actions_of(self, episode: int) -> list[int]:
        """The macro-actions of one episode."""
        end = int(self.lengths[: episode + 1].sum())
        return self.actions[end - int(self.lengths[episode]) : end].tolist()

    def first(self, episodes: int) -> KeptEpisodes:
        """The first of them alone."""
        whole = {name: array for name, array in vars(self).items() if array is not None}
        parts = {name: array[:episodes] for name, array in whole.items()}
        parts["actions"] = self.actions[: self.lengths[:episodes].sum()]
        return KeptEpisodes(**parts)


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """One evaluated budget of one run."""

    episodes: int  #: Real training episodes so far
    env_steps: int  #: Real training macro-actions so far
    test_episodes: int  #: Greedy test episodes
    successes: int  #: Test episodes that ended in success
    #: Which: ``1`` or ``0`` for each, in their order; the same places are the same starts in every run of a bench. None
    #: in results of before 2026-11-24.
    solved: str | None = None
    mean_return: float  #: Mean undiscounted return of the test episodes
    mean_length: float  #: Mean macro-actions of the test episodes
    faults: int  #: Macro-actions of the test episodes whose physics disagreed with the rules
    train_cpu_s: float  #: CPU seconds of training (environment and learning) since the run began
    eval_cpu_s: float  #: CPU seconds of this evaluation
    #: The agent's own means since the previous checkpoint.
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    open_loop: OpenLoop | None = None  #: Imagination against the rules, for agents that imagine
    #: The agent's actions and expectations everywhere, for the causes of its failures; None for agents that do not
    #: learn, for tasks of too many macrostates, and in results of before 2026-11-24.
    beliefs: PolicyTable | None = field(default=None, compare=False)
    #: The test episodes themselves. None in results of before 2026-11-24.
    kept: KeptEpisodes | None = field(default=None, compare=False)

    @property
    def success_rate(self) -> float:
        """Share of test episodes that succeeded, in [0, 1]."""
        return self.successes / self.test_episodes

    def of_first(self, tests: int) -> Checkpoint:
        """The same with its first tests alone. Raises ArtefactError: the tests are not kept one by one."""
        if self.kept is None:
            raise ArtefactError("The test episodes of a bench are not kept, so the first ones cannot be taken alone.")
        kept = self.kept.first(tests)
        return replace(
            self,
            kept=kept,
            test_episodes=tests,
            successes=int(kept.success.sum()),
            solved="".join("01"[success] for success in kept.success.astype(int)),
            mean_return=float(kept.returns.sum()) / tests,
            mean_length=len(kept.actions) / tests,
            faults=int(kept.faults.sum()),
        )


@dataclass(frozen=True, kw_only=True)
class OneRun:
    """One finished run of any learner."""

    agent: str  #: Registered agent or regressor
    seed: int  #: The run's seed
    folder: Path  #: Where the run's files lie
    settings: Mapping[str, Setting] = field(default_factory=dict)  #: The learner's as run; none if the run was kept
    recording: Path | None = None  #: Its Rerun recording, or None


@dataclass(frozen=True, kw_only=True)
class RunResult(OneRun):
    """One finished run of an agent."""

    checkpoints: tuple[Checkpoint, ...]  #: One a budget, in the protocol's order
    #: Whether each training episode succeeded. Shape (episodes,), or (0,) if the run was kept for good.
    training_success: Bools = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    #: Macro-actions of each training episode. Shape (episodes,), or (0,) likewise.
    training_length: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    #: The training episodes that were played: all but a dataset's, those of a resumed run from when this version took
    #: it up. None in results of before 2026-11-28.
    training: KeptEpisodes | None = None
    #: Macrostate, macro-action and the first episode in which it was tried there. Shape (pairs, M + 2). None likewise.
    tried: NDArray[np.int32] | None = None
    imagined: tuple[ComparedRollout, ...] = ()  #: Example rollouts at the last budget, for agents that imagine
    #: Several from one beginning at the last budget, where the rules leave something to chance.
    sampled_rollouts: tuple[ComparedRollout, ...] = ()
    #: Of its recording, the first episode that was solved and the first that was not, in the order of their play; none
    #: in results of versions that kept no episodes of recordings.
    recorded: tuple[RecordedEpisode, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AllRuns(Generic[P, R]):
    """All runs of a protocol. Every learner and seed is there, or this cannot be built.

    Raises:
        ArtefactError: A run is missing or doubled, or two runs of a learner had different settings.
    """

    protocol: P  #: The protocol
    runs: tuple[R, ...]  #: One a learner and seed
    environment: Mapping[str, Json]  #: Command, commit, versions, machine, GL renderer, threads; JSON-like
    folder: Path  #: Where the bench's files lie
    wall_s: float  #: Wall seconds of the bench, over all its sessions
    missing: tuple[str, ...] = ()  #: The missing runs of a part, a sentence each
    left_out: tuple[str, ...] = ()  #: Runs of merged benches that are not shown, for not all agents have their seeds

    def __post_init__(self) -> None:
        wanted = sorted(self.protocol.runs)
        found = sorted((run.agent, run.seed) for run in self.runs)
        if found != wanted:
            raise ArtefactError(
                f"{self.folder} should hold the runs {wanted} and holds {found}. Run the same bench command again for "
                "those that are missing."
            )
        first: dict[str, R] = {}
        for run in self.runs:
            known = first.setdefault(run.agent, run)
            both = known.settings and run.settings  # kept results have none
            difference = first_difference(known.settings, run.settings) if both else None
            if difference is not None:
                name, value, differs = difference
                raise ArtefactError(
                    f"{known.folder} ran with {name} {value!r} and {run.folder} with {differs!r}, as another kind of "
                    f"machine may choose. Runs that are compared need one value: give it with --set {name}=..., or "
                    "use one kind of machine."
                )

    @property
    def protocol_hash(self) -> str:
        """The hash of the whole protocol, which names the bench's folder."""
        return self.protocol.hash

    def of(self, agent: str) -> tuple[R, ...]:
        """The runs of one learner, in the order of the protocol's seeds."""
        by_seed = {run.seed: run for run in self.runs if run.agent == agent}
        return tuple(by_seed[seed] for seed in self.protocol.seeds_of(agent))


@dataclass(frozen=True, kw_only=True)
class BenchResult(AllRuns[Protocol, RunResult]):
    """All runs of a bench of agents.

    Raises:
        ArtefactError: As :class:`AllRuns`, or a run has other budgets.
    """

    certificate: Certificate | None = None  #: That of the world; None in results of before 2026-11-25
    whole: Protocol | None = None  #: The protocol of which this is a part; None if it is all of it
    made_with: str = ""  #: Of kept results, the hash that their protocol had then; names may have changed since

    def __post_init__(self) -> None:
        super().__post_init__()
        for run in self.runs:
            budgets = tuple(checkpoint.episodes for checkpoint in run.checkpoints)
            if budgets != self.protocol.budgets:
                raise ArtefactError(f"{run.folder} has budgets {budgets}, the protocol says {self.protocol.budgets}.")

    @property
    def protocol_hash(self) -> str:
        """The hash of the whole protocol, which names the bench's folder."""
        return self.made_with or (self.whole or self.protocol).hash

    @property
    def rows(self) -> list[tuple[RunResult, Checkpoint]]:
        """Every tested budget of every run, in the order of the protocol's agents and seeds."""
        return [(run, row) for agent in self.protocol.agents for run in self.of(agent) for row in run.checkpoints]

    def success_rates(self, agent: str) -> Floats:
        """Success rates of one agent. Shape (seeds, budgets)."""
        return np.array([[checkpoint.success_rate for checkpoint in run.checkpoints] for run in self.of(agent)])
