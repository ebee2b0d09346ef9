"""Episodes of a player that is no agent of this suite, a person or a program elsewhere, kept as a run of a bench.

The folder is like any bench's, so ``report`` and ``verify`` take it. The number of episodes is fixed beforehand:
first those of training, if there are any, then the tests, which begin where everybody's tests begin. Nobody can leave
an episode out or begin it twice: each macro-action is kept at once, in ``moves.txt``, and whoever comes back goes on
in the episode that was left.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import SupportsFloat

from imagine_bench import registry
from imagine_bench.arrays import Action, Info, Observed
from imagine_bench.errors import InvalidValueError, brief, require_integer, writing
from imagine_bench.interfaces import AgentState
from imagine_bench.interfaces.environments import Env, Wrapper
from imagine_bench.protocols.control import TASK_CODE, Protocol, protocol
from imagine_bench.protocols.data import RunSpec, digest
from imagine_bench.registry.machine import describe_environment
from imagine_bench.running.bench import certificate_of
from imagine_bench.running.evaluation import EvaluationCounts, Options, RecordedEnv
from imagine_bench.running.run_state import Counters, CountVisits, make_env
from imagine_bench.seeding import episode_seed, evaluation_split
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import BenchStore, as_begun, bench_folder, read_control
from imagine_bench.store.files import write_bytes
from imagine_bench.store.results import Checkpoint

_MOVES = "moves.txt"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")
TESTS = 20
"""Tests of a player where nobody says how many."""
_Step = tuple[Observed, SupportsFloat, bool, bool, Info]


def protocol_of_player(
    task: str | None,
    kind: str,
    name: str,
    *,
    training: int | None = None,
    tests: int | None = None,
    seed: int | None = None,
    like: Path | None = None,
    execution: str | None = None,
    appearance: str | None = None,
) -> Protocol:
    """The protocol of a player's run.

    Args:
        task: The task; None is that of ``like``.
        kind: ``"person"``, or the prefix of other players that a package offers.
        name: The player's name.
        training: Training episodes before the tests; None is 0.
        tests: Test episodes; None is :data:`TESTS`.
        seed: Number of the player's run; None is the first seed of ``like``, or else 0. Runs of other numbers meet the
            same tests.
        like: Folder of a bench whose world and preset are taken, so that both can be merged into one table.
        execution: How macro-actions happen; None is the task's or the bench's way.
        appearance: How frames vary; None likewise.

    Raises:
        ImagineBenchError: There is no such task or bench, they do not fit, or a value is out of range.
    """
    if not _NAME.fullmatch(name):
        raise InvalidValueError(
            f"A player cannot be called {brief(name)}; give 1 to 40 of the letters A to Z and a to z, digits, dots, "
            "dashes and underscores, a letter or digit first."
        )
    if training is not None:
        require_integer("training", training, 1)
    if like is not None:
        found = read_control(like)
        if task is not None and registry.task_name(task) != found.task:
            raise InvalidValueError(f"{like} is a bench of {found.task}, not of {task}; leave one of them out.")
    elif task is None:
        raise InvalidValueError("There is nothing to play; give a task.")
    else:
        found = protocol(task, "quick", agents=(registry.DEMONSTRATOR,))
    first = 0 if like is None else found.seeds[0]
    player = f"{'' if training is None else 'trained_'}{kind}:{name}"
    wanted = dataclasses.replace(
        found,
        execution=registry.task(found.task).execution(execution or found.execution),
        appearance=appearance or found.appearance,
        test_appearance=None if appearance else found.test_appearance,
        agents=(player,),
        seeds=(first if seed is None else seed,),
        few_seeds=(),
        budgets=found.budgets if training is None else (training,),
        evaluation_episodes=TESTS if tests is None else tests,
        encoder=None,
        codes=None,
        code=tuple(pair for pair in found.code if pair[0].startswith(TASK_CODE)),
        settings_digest=digest({} if training is None else {player: {}}),
    )
    differs = found.helps or found.split or wanted.appearance_in_tests != wanted.appearance
    if not found.shows_frames_alone or (training is not None and differs):
        where = like or f"The appearance {wanted.appearance_in_words}"
        raise InvalidValueError(
            f"{where} shows more than frames, or trains otherwise than it tests; a player cannot be compared there."
        )
    return wanted


class FinishedError(InvalidValueError):
    """All episodes of a player are played."""


class PlayedRun(Wrapper):
    """The episodes of a run, one after another; :meth:`reset` and :meth:`step` are all that a player does.

    Args:
        env: The protocol's environment.
        spec: The run.
        folder: Its folder, held by this process.
    """

    def __init__(self, env: Env, spec: RunSpec[Protocol], folder: Path) -> None:
        super().__init__(env)
        self._spec = spec
        self.player = spec.agent
        self.folder = folder
        run_folder.check_config(folder, spec, None)
        snapshot = run_folder.load_newest(folder / run_folder.CHECKPOINTS)
        self._counters = Counters() if snapshot is None else Counters.of(snapshot)
        self._tests = self._counters.test or EvaluationCounts()
        self._training = spec.protocol.budgets[-1] if registry.agent_entry(spec.agent).learns else 0
        self._now: RecordedEnv | None = None
        self._moves_before = 0  # of the episode that was kept last, 0 where an earlier session kept it
        self._seen: tuple[Observed, Info]
        if self._counters.rows and not self.is_done:  # killed between the last episode and the mark
            self._finish()

    @property
    def is_done(self) -> bool:
        """Whether all episodes are played."""
        return run_folder.is_done(self.folder)

    @property
    def number(self) -> int:
        """Episodes that are over."""
        return self._counters.episode + self._tests.episodes

    @property
    def moves(self) -> int:
        """Macro-actions of the episode that goes on, or of the latest."""
        return self._moves_before if self._now is None else len(self._now.episode.actions)

    @property
    def words(self) -> str:
        """Which episode goes on or is next, or that none is left."""
        tests = self._spec.protocol.evaluation_episodes
        if self.is_done:
            return f"all {self._training + tests} episodes are played"
        if self._counters.episode < self._training:
            return f"training episode {self._counters.episode + 1} of {self._training}"
        return f"test {self._tests.episodes + 1} of {tests}"

    def reset(self, *, seed: int | None = None, options: Options = None) -> tuple[Observed, Info]:
        """Begin the next episode, or see the one again that goes on; ``seed`` and ``options`` are the run's own.

        Raises FinishedError: all episodes are played.
        """
        self.keep()
        if self._now is not None:
            return self._seen
        if self.is_done:
            raise FinishedError(f"{self.player}: {self.words}; give another name to play more.")
        moves = self._left_moves()
        is_training = self._counters.episode < self._training
        purpose = "training" if is_training else evaluation_split(self._spec.seed)
        place = self._counters.episode if is_training else self._tests.episodes
        self._now = CountVisits(self.env, self._counters) if is_training else RecordedEnv(self.env)
        self._seen = self._now.reset(seed=episode_seed(purpose, self._spec.seed if is_training else 0, place))
        for action in moves:
            self._seen = self._now.step(action)[::4]
        return self.reset() if self._now.episode.over else self._seen

    def step(self, action: Action) -> _Step:
        """Carry out a macro-action and keep it. Raises InvalidValueError: no episode goes on, or no such action."""
        if self._now is None or self._now.episode.over:
            raise InvalidValueError("No episode goes on; reset begins the next one.")
        after = self._now.step(action)
        self._seen = after[::4]
        with writing(self.folder / _MOVES), (self.folder / _MOVES).open("a") as stream:
            stream.write(f"{self.number} {int(action)}\n")
        if self._now.episode.over and self.number + 1 == self._training + self._spec.protocol.evaluation_episodes:
            self.keep()
        return after

    def _left_moves(self) -> list[int]:
        """The macro-actions of the episode that an earlier session left; a line that was cut off is none."""
        path = self.folder / _MOVES
        text = path.read_text(errors="replace") if path.exists() else ""
        found = [line.split() for line in text.splitlines(keepends=True) if re.fullmatch(r"\d+ \d+\n", line)]
        moves = [int(action) for number, action in found if int(number) == self.number]
        write_bytes(path, "".join(f"{self.number} {action}\n" for action in moves).encode())
        return moves

    def keep(self) -> None:
        """Keep the latest episode for good if it is over; after the last one, the results."""
        if self._now is None or not self._now.episode.over:
            return
        counters = self._counters
        played = self._now.episode
        self._now = None
        self._moves_before = len(played.actions)
        if counters.episode < self._training:
            counters.add_episode(played.success, len(played.actions))
        else:
            self._tests.add(played)
        counters.test = self._tests
        protocol = self._spec.protocol
        if self._tests.episodes == protocol.evaluation_episodes:
            counters.test = None
            budgets = (self._training,) if self._training else protocol.budgets
            counters.rows = [self._row(budget) for budget in budgets]
        nothing = AgentState(arrays={}, values={})
        run_folder.save_snapshot(self.folder / run_folder.CHECKPOINTS, counters.snapshot(nothing))
        if counters.rows:
            self._finish()

    def _finish(self) -> None:
        run_folder.write_metrics(self.folder, self._counters.rows)
        run_folder.finish(self.folder)
        with writing(self.folder / _MOVES):
            (self.folder / _MOVES).unlink(missing_ok=True)

    def _row(self, budget: int) -> Checkpoint:
        steps = self._counters.env_steps
        figures = self._tests.figures()
        kept = self._tests.kept()
        return Checkpoint(episodes=budget, env_steps=steps, **figures, kept=kept, train_cpu_s=0.0, eval_cpu_s=0.0)


@contextmanager
def played_run(wanted: Protocol, root: Path, **options: str) -> Iterator[PlayedRun]:
    """The only run of a player's protocol, below the folder of all benches; held by this process in the block.

    ``options`` are of its environment, and change no episode.

    Raises:
        BusyError: Another process plays it.
        ArtefactError: A file is damaged or foreign.
        SetupError: The folder cannot be written, or there is no GL.
    """
    (player,) = wanted.agents
    (seed,) = wanted.seeds
    wanted = as_begun(root, wanted)
    store = BenchStore(bench_folder(root, wanted), wanted)
    folder = store.run_folder(player, seed)
    env = make_env(wanted, wanted.task, testing=not registry.agent_entry(player).learns, **options)
    with closing(env), store.held(), run_folder.unfinished(folder) as is_left:
        if is_left:
            store.begin_session(describe_environment(), certificate_of)
        run = PlayedRun(env, RunSpec(protocol=wanted, agent=player, seed=seed), folder)
        try:
            yield run
        finally:
            run.keep()
            if is_left:
                store.save_time()
