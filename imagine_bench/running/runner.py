"""One run: one agent, one seed, through all budgets of a protocol. The only loop that steps an environment to learn.

Whatever is needed to go on is in the newest checkpoint, so a run that was killed at any moment and started again ends
in the same bits as one that was not; only CPU times differ.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TypedDict

from imagine_bench import registry
from imagine_bench.arrays import Info
from imagine_bench.errors import DivergedError, InvalidValueError
from imagine_bench.interfaces import Observation
from imagine_bench.interfaces.capabilities import (
    ExternalTrainer,
    ModelOnlyTrainer,
    TransferLearner,
    begin_episode,
)
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import OnProgress, RunSpec
from imagine_bench.running.evaluation import (
    EvaluationCounts,
    LabelOracle,
    QueryBudget,
    as_seen,
    play,
    play_test_episode,
    training_starts,
)
from imagine_bench.running.run_state import CountVisits, Run, environments, make_env, reuse_outcomes
from imagine_bench.seeding import episode_seed, evaluation_split
from imagine_bench.store import run_folder
from imagine_bench.store.results import Checkpoint, ComparedRollout, OpenLoop, PolicyTable, RecordedEpisode
from imagine_bench.values import numbers


class AtBudget(TypedDict, total=False):
    """The measurements of observers at a budget: fields of :class:`.Checkpoint`."""

    open_loop: OpenLoop
    beliefs: PolicyTable


class AtEnd(TypedDict, total=False):
    """The measurements of observers at the end: fields of :class:`.RunResult`."""

    imagined: tuple[ComparedRollout, ...]
    sampled_rollouts: tuple[ComparedRollout, ...]
    recorded: tuple[RecordedEpisode, ...]


class RunObserver:
    """Looks at a run after each test and at its end, and changes nothing in it; this one measures nothing."""

    def at_budget(self, run: Run, budget: int) -> AtBudget:
        """Measure the agent that was just tested."""
        return {}

    def at_end(self, run: Run) -> AtEnd:
        """Measure, or record, the agent after all budgets."""
        return {}


def run(spec: RunSpec[Protocol], folder: Path, on_progress: OnProgress) -> None:
    """Do a run, or the rest of it, looked at by its observers.

    Nothing is done of a finished run.

    Raises:
        BusyError: Another process is at this run.
        ArtefactError: The folder holds something damaged, foreign or begun with other settings.
        DivergedError: NaN in physics or learning; the message says where the state lies.
        SetupError: The folder cannot be written, or there is no GL.
    """
    with run_folder.unfinished(folder) as left:
        if left:
            with environments(spec.protocol) as (env, test_env):
                reuse_outcomes(env)
                reuse_outcomes(test_env)
                observers = [registry.load(name)() for name in spec.observers]
                _go_on(Run(spec, folder, on_progress, env, test_env), observers)


def _go_on(run: Run, observers: Sequence[RunObserver]) -> None:
    """Train and test at every budget that is left, and finish."""
    try:
        if isinstance(run.agent, ExternalTrainer):
            train_externally(run, run.agent, lambda budget: _at_budget(run, budget, observers))
        else:
            transfer(run)
            for budget in run.protocol.budgets[len(run.counters.rows) :]:
                if run.entry.learns:
                    train(run, budget)
                _at_budget(run, budget, observers)
    except DivergedError as error:
        raise DivergedError(f"{error} The agent's state lies in {run.save('diverged')}.") from error
    measured = AtEnd()
    for observer in observers:
        measured.update(observer.at_end(run))
    run_folder.finish(run.folder, **measured)
    run.tell("done", at_once=True)


def _at_budget(run: Run, budget: int, observers: Sequence[RunObserver]) -> None:
    """Test at ``budget``; an agent that does not learn is tested once, and its row stands at every budget."""
    counters = run.counters
    if counters.rows and not run.entry.learns:
        row = dataclasses.replace(counters.rows[0], episodes=budget)
    else:
        row = _row(run, budget, observers)
    counters.rows.append(row)
    counters.test = None
    run.save()
    run_folder.write_metrics(run.folder, counters.rows)


def _row(run: Run, budget: int, observers: Sequence[RunObserver]) -> Checkpoint:
    tested = test(run)
    start_s = time.process_time()
    measured = AtBudget()
    for observer in observers:
        measured.update(observer.at_budget(run, budget))
    return Checkpoint(
        episodes=budget,
        env_steps=run.counters.env_steps,
        **tested.figures(),
        kept=tested.kept(),
        train_cpu_s=run.counters.train_cpu_s,
        eval_cpu_s=tested.cpu_s + time.process_time() - start_s,
        diagnostics=tested.diagnostics,
        **measured,
    )


def transfer(run: Run) -> None:
    """Train on the tasks that come before; after the last episode of each, a learner takes its model to the next.

    In a run of unannounced changes it is told nothing, and its episodes are counted on.
    """
    counters = run.counters
    each = run.protocol.after_episodes
    untold = run.protocol.unannounced and run.entry.learns
    for index, task in enumerate(run.protocol.after):
        carries = isinstance(run.agent, TransferLearner)
        if counters.before >= (index + 1) * each or not (carries or untold):
            continue
        with closing(make_env(run.protocol, task)) as env:
            while counters.before < (index + 1) * each:
                with run.training_time():
                    seed = episode_seed("earlier_training", run.spec.seed, counters.before)
                    privileged = run.entry.privileged
                    for transition, _ in play(env, run.agent, seed=seed, explore=True, privileged=privileged):
                        run.agent.observe(transition, episode=counters.before if untold else counters.before % each)
                    counters.before += 1
                    if counters.before % each == 0 and isinstance(run.agent, TransferLearner) and not untold:
                        run.agent.reset_for_new_task()
                run.made_progress("training")


def train(run: Run, budget: int) -> None:
    """Train until the agent has had ``budget`` episodes: first those of a dataset or demonstrated, then its own."""
    while run.counters.episode < budget:
        with run.training_time():
            if run.dataset is not None and run.counters.episode < len(run.dataset):
                _episode_of_dataset(run, run.dataset)
            else:
                _training_episode(run, demonstrated=run.counters.episode < run.protocol.demonstrations)
        run.made_progress("training")


def _number(run: Run) -> int:
    """The number of the training episode that goes on, as learners are told it."""
    return run.counters.episode + (run.protocol.episodes_before if run.protocol.unannounced else 0)


def _episode_of_dataset(run: Run, dataset: Episodes) -> None:
    episode = run.counters.episode
    begin_episode(run.agent)
    for transition in dataset.transitions(episode):
        run.agent.observe(transition, episode=_number(run))
    run.counters.add_episode(bool(dataset.success[episode]), int(dataset.lengths[episode]))


def _training_episode(run: Run, *, demonstrated: bool) -> None:
    counters = run.counters
    if demonstrated:
        begin_episode(run.agent)  # an agent that acts is told by play()
    queries = QueryBudget(run.agent, LabelOracle(run.task.rules), 0 if demonstrated else run.protocol.queries)
    teacher = None if demonstrated else run.teacher
    if teacher is not None:
        teacher.begin(episode_seed("feedback", run.spec.seed, counters.episode))

    def before_acting(observation: Observation, info: Info) -> None:
        queries(observation, info)
        if teacher is not None:
            teacher(observation, info)

    episode = play(
        CountVisits(run.env, counters),
        run.demonstrator if demonstrated else run.agent,
        seed=episode_seed("training", run.spec.seed, counters.episode),
        explore=True,
        privileged=demonstrated or run.entry.privileged,
        before_acting=before_acting,
    )
    length = 0
    success = False
    number = _number(run)
    for lived, info in episode:
        transition = lived if teacher is None else teacher.told(lived)
        run.agent.observe(transition if run.entry.privileged else as_seen(transition), episode=number)
        length = length + 1
        success = bool(info["is_success"])
    counters.add_episode(success, length, queries=queries.asked)


def train_externally(run: Run, agent: ExternalTrainer, test_at: Callable[[int], None]) -> None:
    """Let the agent train in its own loop through all budgets, and test it, in an environment apart, at each.

    Raises InvalidValueError: its loop ends before.
    """
    budgets = run.protocol.budgets
    start_s = time.process_time()

    def on_episode(success: bool, length: int) -> bool:
        nonlocal start_s
        run.counters.add_episode(success, length)
        run.counters.train_cpu_s += time.process_time() - start_s
        run.tell("training")
        if run.counters.episode in budgets:
            test_at(run.counters.episode)
        start_s = time.process_time()
        return run.counters.episode < budgets[-1]

    with closing(make_env(run.protocol, run.task.id)) as own:
        starts = training_starts(CountVisits(own, run.counters), run.spec.seed)
        agent.train(starts, episodes=budgets[-1], horizon=run.task.horizon, on_episode=on_episode)
    if run.counters.episode < budgets[-1]:
        raise InvalidValueError(
            f"The training loop of agent {run.spec.agent!r} ended after {run.counters.episode:,} of {budgets[-1]:,} "
            "episodes; it must go on until on_episode() answers False."
        )


def test(run: Run) -> EvaluationCounts:
    """Play the greedy test episodes of the budget that was reached, or those that a resumed run has left.

    Before them, an agent that trains in its model alone does so; its time counts as training.
    """
    counters = run.counters
    if counters.test is None:
        goes_on = True
        while goes_on and isinstance(run.agent, ModelOnlyTrainer):
            with run.training_time():
                goes_on = run.agent.train_in_model()
            run.made_progress("training in the model")
        counters.test = EvaluationCounts(diagnostics=numbers(run.agent.diagnostics()))
    purpose = evaluation_split(run.spec.seed)
    while counters.test.episodes < run.protocol.evaluation_episodes:
        start_s = time.process_time()
        seed = episode_seed(purpose, 0, counters.test.episodes)
        played = play_test_episode(run.test_env, run.agent, seed=seed, privileged=run.entry.privileged)
        counters.test.add(played)
        counters.test.cpu_s += time.process_time() - start_s
        run.made_progress("testing")
    return counters.test
