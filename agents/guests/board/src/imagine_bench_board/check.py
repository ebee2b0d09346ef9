"""The check of a leaderboard: every row is read, its episodes are played again, and its numbers are computed anew."""

from __future__ import annotations

import functools
import hashlib
from contextlib import ExitStack, closing
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, require
from imagine_bench.judge.verify import Replays, has_own_failures, verify_tests
from imagine_bench.running.bench import counted
from imagine_bench.running.retraining import Verdict, judged, part_digest
from imagine_bench.running.run_state import environments
from imagine_bench.seeding import Purpose, evaluation_split

from . import motion_rows, motions, rounds
from .motion_rows import MotionRow
from .rows import CARD, ROWS, Row, read_card, read_row, require_whole

NOT_VOUCHED = ("the player", "which seeds and how many tests", "the price", "the data seen beforehand")
"""Claims of every row that no replay shows."""
NEVER_SHOWN = (
    "A replay shows that these macro-actions, from these starts, in this world, have these outcomes. It cannot show "
    "who chose them: episodes of an oracle or of another agent play again as well. It cannot show the training: "
    "neither its real episodes and macro-actions nor its CPU seconds. It cannot show which images and tasks were seen "
    "before, nor which runs were left out because they failed. The agents of a round were filed before its starts "
    "were known, so none was trained for them; but only someone who trains them again can see that they played: "
    "imagine-bench verify --train 1, with the commit and the command of the card."
)


class OtherMujoco(Verdict):
    """That on a row that does not play again here, and whose card names another version of MuJoCo."""


@dataclass(frozen=True, kw_only=True)
class Checked:
    """A row and its verdict."""

    verdict: Verdict
    row: Row | MotionRow | None = None  #: None where it was refused, or is not vouched for with this MuJoCo

    @property
    def is_refused(self) -> bool:
        """Whether it is wrong whatever version of MuJoCo made it, or by the version that its card names."""
        return self.row is None and not isinstance(self.verdict, OtherMujoco)

    def __str__(self) -> str:
        if self.row is None:
            kind = "refused" if self.is_refused else "not vouched"
            return f"{self.verdict.what}: {kind}: {self.verdict.complaint}"
        claims = ", ".join(self.verdict.unshown)
        played = f"{self.verdict.episodes:,} episodes played again"
        if isinstance(self.row, MotionRow) and self.row.vouched.not_reproducible:
            played += f", {self.row.vouched.not_reproducible:,} not reproducible and counted as failed"
        return f"{self.row.name}: holds in {self.row.world}; {self.row.starts}; {played}; not vouched: {claims}"


def installed_mujoco() -> str:
    """The version of MuJoCo that plays here."""
    return metadata.version("mujoco")


def row_folders(board: Path) -> list[Path]:
    """The folders of a board's rows, or of the one row that the path is. Raises ArtefactError: there is none."""
    if (board / CARD).exists():
        return [board]
    found = sorted((board / ROWS).iterdir()) if (board / ROWS).is_dir() else []
    if not found:
        raise ArtefactError(f"{board} holds no rows; 'imagine-bench submit RUN --out {board / ROWS}' writes one.")
    return found


def check(board: Path) -> list[Checked]:
    """Check every row of a board, or one row. Raises ArtefactError: there is none."""
    folders = row_folders(board)
    with ExitStack() as scope:
        court = _Court(scope)
        return [court.checked(folder) for folder in counted(folders, "rows", total=len(folders))]


class _Court:
    """Plays the rows of a board again; rows of one world share its environment, and each episode is played once."""

    def __init__(self, scope: ExitStack) -> None:
        self._scope = scope
        self._worlds: dict[str, Replays] = {}
        self._motion_envs: dict[tuple[str, str, float], gymnasium.Env[Any, Any]] = {}
        self._owners: dict[str, tuple[str, int]] = {}

    def checked(self, folder: Path) -> Checked:
        """The verdict on one row."""
        read: list[Row | MotionRow] = []
        verdict = judged(folder.name, functools.partial(self._check, folder, read))
        return Checked(verdict=verdict, row=None if verdict.complaint else read[0])

    def _check(self, folder: Path, read: list[Row | MotionRow]) -> Verdict:
        if read_card(folder).get("format") == motion_rows.FORMAT:
            moved = motion_rows.read_motions(folder)
            read.append(moved)
            start_seed = self._starts(folder, moved, moved.protocol.tests)
            of_round = start_seed is None or moved.protocol.seed == start_seed
            require(of_round, f"its seed is not that of the round {moved.round}.")
            here = installed_mujoco()
            is_other = moved.mujoco != here
            try:
                read[0] = motions.check_motions(moved, self._motion_env(moved), other_mujoco=is_other)
            except motions.ReplayError:
                if not is_other:
                    raise
                made = f"made with MuJoCo {moved.mujoco}, checked with {here}"
                remedy = f"check it with {moved.mujoco} (pip install mujoco=={moved.mujoco})."
                return OtherMujoco(what=moved.name, complaint=f"{made}, where it does not play again; {remedy}")
            episodes = moved.protocol.tests
            return Verdict(what=moved.name, episodes=episodes, unshown=(*NOT_VOUCHED, *self._moved_alike(moved)))
        row = read_row(folder)
        read.append(row)
        require_whole(row, registry.task(row.protocol.task))
        starts = self._starts(folder, row, row.protocol.evaluation_episodes)
        last_alone = starts is None or len(row.protocol.budgets) == 1
        require(last_alone, "a row of a round has the tests of one budget, the last.")
        episodes = 0
        for place, figures in enumerate(row.vouched):
            purpose: Purpose = evaluation_split(figures.seed) if starts is None else "board"
            tested = row.checkpoint(place)
            both = {"env_steps": tested.env_steps, "starts": starts or 0}
            try:
                episodes += verify_tests(tested, row.protocol, purpose, self._replays(row), **both)
            except ArtefactError as error:
                raise ArtefactError(f"seed {figures.seed}, {error}") from error
        return Verdict(what=row.name, episodes=episodes, unshown=(*NOT_VOUCHED, *self._alike(row)))

    def _motion_env(self, row: MotionRow) -> gymnasium.Env[Any, Any]:
        """The environment of a row of continuous control, made once for each world."""
        of = row.protocol
        world = (of.task, of.appearance, of.placement)
        if world not in self._motion_envs:
            self._motion_envs[world] = self._scope.enter_context(closing(of.make(observation="state")))
        return self._motion_envs[world]

    def _replays(self, row: Row) -> Replays:
        """The environments of a row's world, made once."""
        if row.world not in self._worlds:
            unseen = {"observation": "state"} if registry.is_own(row.protocol.task) else {}
            self._worlds[row.world] = Replays(*self._scope.enter_context(environments(row.protocol, **unseen)))
        return self._worlds[row.world]

    def _starts(self, folder: Path, row: Row | MotionRow, n_tests: int) -> int | None:
        """The seed of the row's round, None without one. Raises ArtefactError: the row is not of that round."""
        if not row.round:
            return None
        round_folder = folder.absolute().parents[1] / rounds.ROUNDS / row.round
        seed, filed = rounds.revealed_seed(round_folder, row.name)
        require(row.agents == filed, f"its agents are not those that were filed in the round {row.round}.")
        tests = rounds.read_round(round_folder).tests
        require(n_tests == tests, f"it has {n_tests} tests, and the round {row.round} has {tests}.")
        return seed

    def _moved_alike(self, row: MotionRow) -> tuple[str, ...]:
        """Other rows that have all commands of one of this row's tests, from the same start."""
        alike = dict[str, None]()
        for test, motion in enumerate(row.motions):
            commands = hashlib.sha256(motion.commands.tobytes()).hexdigest()
            key = f"{row.world} {row.protocol.start(test)} {commands}"
            name, _ = self._owners.setdefault(key, (row.name, test))
            if name != row.name:
                alike[f"whether it is another player than that of {name}"] = None
        return tuple(alike)

    def _alike(self, row: Row) -> tuple[str, ...]:
        """Runs of other rows that failed in the same tests in the same ways as this row's run of the same seed.

        Learners of one seed that have not yet diverged do so honestly. Raises ArtefactError: two seeds did.
        """
        alike = dict[str, None]()
        for place, figures in enumerate(row.vouched):
            kept = row.kept(place)
            if not has_own_failures(kept, row.protocol):
                continue
            name, seed = self._owners.setdefault(part_digest(kept), (row.name, figures.seed))
            shared = f"its tests of seed {figures.seed} are those of seed {seed} of {name}, failures included"
            require(seed == figures.seed, f"{shared}, and no two seeds share them.")
            if name != row.name:
                alike[f"whether its seed {seed} is another player than that of {name}"] = None
        return tuple(alike)
