"""One run: one agent, one seed, through all budgets of a protocol. The only loop that steps an environment to learn.

Whatever is needed to go on is in the newest checkpoint, so a run that was killed at any moment and started again ends
in the same bits as one that was not; only CPU times differ. (With other runs abreast, where company changes no bits:
``docs/cluster.md``.)
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium

from imagine_bench import registry
from imagine_bench.bench.cohort import cpu_time_s
from imagine_bench.bench.evaluation import EvaluationCounts, TrainingStarts, play
from imagine_bench.bench.queries import LabelOracle, QueryBudget, as_seen, demonstrator, require_able
from imagine_bench.bench.runs import Counters, Observer, Phase, Progress, RunSpec
from imagine_bench.capabilities import (
    ExternalTrainer,
    FutureSampler,
    Imaginer,
    ModelOnlyTrainer,
    QueryingAgent,
    TransferLearner,
)
from imagine_bench.errors import ArtefactError, DivergedError
from imagine_bench.judge.futures import imagined_futures
from imagine_bench.judge.imagination_quality import Question, ask, examples, imagine_sampled_rollouts, open_loop
from imagine_bench.seeding import SeedTree, episode_seed, evaluation_split
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.checkpoints import load_newest, save_snapshot
from imagine_bench.store.files import lock, make_folder
from imagine_bench.store.results import Checkpoint, ComparedRollout, Futures, RunResult

IMAGINED_DEPTH = 10
"""Steps of the open-loop comparison, the thesis' I_D."""
_RECENT = 100
"""Training episodes whose success is shown while running."""
_REPORT_EVERY_S = 0.25


def run(spec: RunSpec, folder: Path, on_progress: Observer) -> RunResult | None:
    """Do a run, or what is left of it, and read its result; a finished run is only read.

    Args:
        spec: What to run.
        folder: The run's own folder.
        on_progress: Told now and then how far it is.

    Returns:
        The result, or None if the run rests before its end.

    Raises:
        BusyError: Another process is at this run.
        ArtefactError: The folder holds something damaged, foreign or begun with other settings.
        DivergedError: NaN in physics or learning; the message says where the state lies.
        SetupError: The folder cannot be written, or there is no GL.
    """
    make_folder(folder)
    with lock(folder / ".lock", f"The run folder {folder}", patience_s=5.0):  # a killed parent's child may be dying
        if not run_folder.is_done(folder):
            with closing(_make_env(spec)) as env:
                _Run(spec, folder, on_progress, env).go_on()
    return run_folder.load_run(folder) if run_folder.is_done(folder) else None


def _make_env(spec: RunSpec, task: str | None = None) -> gymnasium.Env[Any, Any]:
    """The environment of a run's own task, or of another one as the run has it."""
    protocol = spec.protocol
    return gymnasium.make(
        registry.task_entry(task or protocol.task).env_id,
        execution=protocol.execution,
        appearance=protocol.appearance,
        disable_env_checker=True,  # the tests run it; here it would only cost time
    )


class _Run:
    def __init__(self, spec: RunSpec, folder: Path, on_progress: Observer, env: gymnasium.Env[Any, Any]) -> None:
        self.spec, self.folder, self.on_progress, self.env = spec, folder, on_progress, env
        self.task = registry.task(spec.protocol.task)
        self.entry = registry.agent_entry(spec.agent)
        self.seeds = SeedTree(spec.seed)
        self._require_its_encoder()
        self.agent = registry.make_agent(spec.agent, spec.context())
        if self.entry.learns:
            require_able(self.agent, spec.agent, spec.protocol)
        self.counters = Counters()
        run_folder.check_config(folder, self._config())
        if self.entry.external_training_loop:
            run_folder.forget(folder)  # an earlier attempt cannot be gone on with
        snapshot = load_newest(folder / "checkpoints")
        if snapshot is not None:
            self.agent.restore(snapshot.agent)
            self.counters = Counters.of(snapshot)
            if self.counters.rows:  # a kill between a test's checkpoint and its table would leave the table behind
                run_folder.write_metrics(folder, self.counters.rows)
        self.saved_s = self.reported_s = time.monotonic()

    def _require_its_encoder(self) -> None:
        """Refuse another file than the protocol's, such as an older one on another node, or one changed since."""
        wanted = self.spec.protocol.encoder_of(self.entry.encoder_kind) if self.entry.needs_encoder else None
        if wanted is not None and self.spec.encoder is not None:
            found = encoders.identity(self.spec.encoder)
            if found != wanted:
                raise ArtefactError(f"{self.spec.encoder} is encoder {found}, and this bench is of {wanted}.")

    def go_on(self) -> None:
        """Train and test at every budget that is wanted now; after the last one of all, finish."""
        try:
            if isinstance(self.agent, ExternalTrainer):
                self._watch(self.agent)
            else:
                self._train_and_test()
        except DivergedError as error:
            where = save_snapshot(self.folder / "diverged", self.counters.snapshot(self.agent.state()))
            raise DivergedError(f"{error} The agent's state lies in {where}.") from error
        if len(self.counters.rows) == len(self.spec.protocol.budgets):
            self._finish()
        self._tell("done", at_once=True)

    def _train_and_test(self) -> None:
        if isinstance(self.agent, TransferLearner):
            self._train_before(self.agent)
        for budget in self.spec.budgets[len(self.counters.rows) :]:
            if self.entry.learns:
                self._train(budget)
            self._test(budget)

    def _watch(self, agent: ExternalTrainer) -> None:
        """Let the agent train itself through all budgets, and test it, in an environment apart, at each of them."""
        budgets, start_s = self.spec.protocol.budgets, cpu_time_s()

        def on_episode(success: bool, length: int) -> bool:
            nonlocal start_s
            self.counters.add_episode(success, length)
            self.counters.train_cpu_s += cpu_time_s() - start_s
            self._tell("training")
            if self.counters.episode in budgets:
                self._test(self.counters.episode)
            start_s = cpu_time_s()
            return self.counters.episode < budgets[-1]

        with closing(_make_env(self.spec)) as own:
            starts = TrainingStarts(own, self.spec.seed)
            agent.train(starts, episodes=budgets[-1], horizon=self.task.horizon, on_episode=on_episode)

    def _finish(self) -> None:
        """Look at the imagination, record, and mark the run as done."""
        imagined, sampled_rollouts = self._examples()
        self._record()
        run_folder.finish(
            self.folder,
            checkpoints=self.counters.rows,
            training=self.counters.training(),
            imagined=imagined,
            sampled_rollouts=sampled_rollouts,
        )

    def _train(self, budget: int) -> None:
        while self.counters.episode < budget:
            start_s = cpu_time_s()
            self._training_episode()
            self.counters.train_cpu_s += cpu_time_s() - start_s
            self._tell("training")
            self._save_now_and_then()

    def _train_before(self, agent: TransferLearner) -> None:
        """Train on the tasks that come before; after the last episode of each, carry over to the next."""
        protocol, counters = self.spec.protocol, self.counters
        for index, task in enumerate(protocol.after):
            end = (index + 1) * protocol.after_episodes
            if counters.before >= end:
                continue
            with closing(_make_env(self.spec, task)) as env:
                while counters.before < end:
                    start_s = cpu_time_s()
                    self._earlier_episode(env, counters.before % protocol.after_episodes)
                    if counters.before == end:
                        agent.reset_for_new_task()
                    counters.train_cpu_s += cpu_time_s() - start_s
                    self._tell("training")
                    self._save_now_and_then()

    def _earlier_episode(self, env: gymnasium.Env[Any, Any], episode: int) -> None:
        seed = episode_seed("earlier_training", self.spec.seed, self.counters.before)
        for transition, _ in play(env, self.agent, seed=seed, explore=True, privileged=False):
            self.agent.observe(transition, episode=episode)
        self.counters.before += 1

    def _training_episode(self) -> None:
        counters, length, success = self.counters, 0, False
        seed = episode_seed("training", self.spec.seed, counters.episode)
        if counters.episode < self.spec.protocol.demonstrations:
            lesson, actor, privileged = None, demonstrator(self.spec), True
        else:
            lesson, actor, privileged = self._lesson(), self.agent, self.entry.privileged
        episode = play(self.env, actor, seed=seed, explore=True, privileged=privileged, before_acting=lesson)
        for transition, info in episode:
            seen = transition if self.entry.privileged else as_seen(transition)
            self.agent.observe(seen, episode=counters.episode)
            length, success = length + 1, bool(info["is_success"])
        counters.add_episode(success, length, questions=0 if lesson is None else lesson.asked)

    def _lesson(self) -> QueryBudget | None:
        questions = self.spec.protocol.questions
        if not questions or not isinstance(self.agent, QueryingAgent):
            return None
        return QueryBudget(self.agent, LabelOracle(self.task.rules), questions)

    def _test(self, budget: int) -> None:
        """Test at ``budget``; an agent that does not learn is tested once, and its row stands at every budget."""
        counters = self.counters
        if counters.rows and not self.entry.learns:
            self._add_row(dataclasses.replace(counters.rows[0], episodes=budget))
            return
        if counters.test is None:
            self._train_in_model()
            counters.test = EvaluationCounts(diagnostics=self.agent.diagnostics())
        while counters.test.episodes < self.spec.protocol.evaluation_episodes:
            counters.test.add_episode(
                self.env, self.agent, privileged=self.entry.privileged, purpose=evaluation_split(self.spec.seed)
            )
            self._tell("testing")
            self._save_now_and_then()
        self._add_row(self._row(budget, counters.test))

    def _train_in_model(self) -> None:
        """Let an agent that practises without the world do so; its time counts as training."""
        if not isinstance(self.agent, ModelOnlyTrainer):
            return
        more = True
        while more:
            start_s = cpu_time_s()
            more = self.agent.train_in_model()
            self.counters.train_cpu_s += cpu_time_s() - start_s
            self._tell("rehearsing")
            self._save_now_and_then()

    def _row(self, budget: int, test: EvaluationCounts) -> Checkpoint:
        start_s = cpu_time_s()
        loop = None
        if isinstance(self.agent, Imaginer) and self._questions:
            self._tell("imagining", at_once=True)
            loop = open_loop(self.agent, self._questions, self.seeds.child("open_loop", budget))
        futures = self._futures(budget)
        return Checkpoint(
            episodes=budget,
            env_steps=self.counters.env_steps,
            test_episodes=test.episodes,
            successes=test.successes,
            mean_return=test.return_sum / test.episodes,
            mean_length=test.env_steps / test.episodes,
            faults=test.faults,
            train_cpu_s=self.counters.train_cpu_s,
            eval_cpu_s=test.cpu_s + cpu_time_s() - start_s,
            diagnostics=test.diagnostics,
            open_loop=loop,
            futures=futures,
        )

    def _futures(self, budget: int) -> Futures | None:
        protocol = self.spec.protocol
        if not isinstance(self.agent, FutureSampler) or protocol.sampled_futures == 0:
            return None
        self._tell("imagining", at_once=True)
        return imagined_futures(
            self.agent,
            self.task,
            samples=protocol.sampled_futures,
            appearance=protocol.appearance,
            seeds=self.seeds.child("futures", budget),
            purpose=evaluation_split(self.spec.seed),
        )

    def _add_row(self, row: Checkpoint) -> None:
        self.counters.rows.append(row)
        self.counters.test = None
        self._save()
        run_folder.write_metrics(self.folder, self.counters.rows)

    @functools.cached_property
    def _questions(self) -> tuple[Question, ...]:
        protocol = self.spec.protocol
        return ask(
            self.task,
            starts=protocol.open_loop_starts,
            depth=IMAGINED_DEPTH,
            appearance=protocol.appearance,
            purpose=evaluation_split(self.spec.seed),
        )

    def _examples(self) -> tuple[tuple[ComparedRollout, ...], tuple[ComparedRollout, ...]]:
        """Rollouts from several beginnings, and several from one."""
        if not isinstance(self.agent, Imaginer):
            return (), ()
        self._tell("imagining", at_once=True)
        appearance, purpose = self.spec.protocol.appearance, evaluation_split(self.spec.seed)
        return (
            examples(self.agent, self.task, appearance=appearance, seeds=self.seeds.child("examples"), purpose=purpose),
            imagine_sampled_rollouts(
                self.agent,
                self.task,
                appearance=appearance,
                seeds=self.seeds.child("sampled_rollouts"),
                purpose=purpose,
            ),
        )

    def _record(self) -> None:
        """Record some test episodes beside the results; the file appears whole or not at all."""
        protocol = self.spec.protocol
        if protocol.recorded_episodes == 0:
            return
        from imagine_bench.recording import record_run  # noqa: PLC0415 - loading Rerun costs a second

        self._tell("recording", at_once=True)
        record_run(
            protocol.task,
            self.agent,
            name=self.spec.agent,
            seed=self.spec.seed,
            execution=protocol.execution,
            appearance=protocol.appearance,
            episodes=protocol.recorded_episodes,
            path=run_folder.recording_path(self.folder),
        )

    def _config(self) -> Mapping[str, Any]:
        settings = getattr(self.agent, "settings", None)
        return {
            "protocol": self.spec.protocol.as_dict(),
            "protocol_hash": self.spec.protocol.hash,
            "agent": self.spec.agent,
            "seed": self.spec.seed,
            "settings": {} if settings is None else dataclasses.asdict(settings),
        }

    def _save_now_and_then(self) -> None:
        if time.monotonic() - self.saved_s >= self.spec.checkpoint_every_s:
            self._save()

    def _save(self) -> None:
        save_snapshot(self.folder / "checkpoints", self.counters.snapshot(self.agent.state()))
        self.saved_s = time.monotonic()

    def _tell(self, phase: Phase, *, at_once: bool = False) -> None:
        now_s = time.monotonic()
        if not at_once and now_s - self.reported_s < _REPORT_EVERY_S:
            return
        self.reported_s = now_s
        counters, test = self.counters, self.counters.test
        tested = len(counters.rows) if self.entry.learns else min(1, len(counters.rows))
        done = (
            counters.before
            + counters.episode
            + tested * self.spec.protocol.evaluation_episodes
            + (test.episodes if test else 0)
        )
        recent = counters.success[-_RECENT:]
        if test is not None and test.episodes:
            success: float | None = test.successes / test.episodes
        else:
            success = sum(recent) / len(recent) if recent else None
        self.on_progress(
            Progress(
                agent=self.spec.agent,
                seed=self.spec.seed,
                phase=phase,
                done=done,
                work=self.spec.work,
                episode=counters.episode,
                success=success,
            )
        )
