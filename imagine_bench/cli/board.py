"""The commands of the leaderboard: submit, board and daily. The plug-in imagine-bench-board carries them out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from imagine_bench import registry
from imagine_bench.cli.benches import Bench, Budget, Learner, Tests, WorldOptions
from imagine_bench.cli.options import EncoderWord, File, Launch, Word, Words, one_of, require_with
from imagine_bench.errors import require_known

_ACTIONS = ("check", "page", "open", "file", "reveal")


@dataclass(frozen=True, kw_only=True)
class Submit:
    """Write rows for the leaderboard: a run's, or a bench's, test episodes, and a card with its claims."""

    run: Annotated[Path, tyro.conf.Positional]
    """A run's folder, whose agent is submitted with all its seeds, or a bench's, of which each agent is."""
    out: Path = Path("rows")
    """Folder in which a folder for each row is made; never overwritten."""
    author: str = ""
    """Your name, as the table shows it."""
    round: File = None
    """Folder of a round whose seed is published: the agents that were filed play its tests now."""
    encoder: EncoderWord = None
    """With --round: the encoder the runs saw through, where it is not bundled."""

    def __call__(self) -> None:
        """Write."""
        if self.round is None:
            require_with("--round", self, "encoder")
        registry.load(registry.command("submit"))(**vars(self))


@dataclass(frozen=True, kw_only=True)
class Board:
    """The leaderboard: check its rows, write its page, and its rounds: open, file, reveal.

    check FOLDER plays every episode of a board, or of one row, again. page FOLDER does so too, and writes a page.
    open ROUND makes the folder of a round and draws its secret starts. file RUN --round ROUND files the trained agents
    of a run or a bench; file POLICY_FILE --round ROUND files a policy of continuous control. reveal ROUND publishes the
    starts, from the closing day on.
    """

    action: Annotated[str, tyro.conf.Positional, one_of(*_ACTIONS)]
    """The part of the board's work."""
    path: Annotated[Path, tyro.conf.Positional]
    """check, page: the folder of a board, such as docs/board, or of a row. open, reveal: of a round. file: the folder
    of a run or a bench, or the file of a policy."""
    out: Path = Path("build/board")
    """With page: the folder of the page."""
    closes: Word = None
    """With open: the day from which nothing more is filed, such as 2026-12-24."""
    tests: int = 100
    """With open: test episodes of each run or policy."""
    secret: Path = Path("secret.json")
    """With open and reveal: the file that holds seed and salt until they are published."""
    round: File = None
    """With file: the folder of the round, which is open."""

    def __call__(self) -> None:
        """Do it."""
        require_known("action", self.action, _ACTIONS)
        registry.load(registry.command("board"))(**vars(self))


@dataclass(frozen=True, kw_only=True)
class Daily:
    """Name the world of a day, with its exact facts, and run agents on it: hardly anybody has trained on it."""

    date: Word = None
    """The day, such as 2026-12-24; by default today, in UTC."""
    secret: str = ""
    """A word that makes the world unknown before the day; publish the printed hash before, and the word on the day."""
    agents: Words = None
    """Agents that are trained and tested on it; without any, the world is only named."""
    seeds: tuple[int, ...] = (0,)
    """With --agents: seeds of their runs."""
    budgets: tuple[int, ...] = (50,)
    """With --agents: real training episodes at which they are tested."""
    launch: Launch

    def __call__(self) -> None:
        """Draw, describe, run."""
        if self.agents is None:
            require_with("--agents", self, "seeds", "budgets")
            require_with("--agents", self.launch, "workers", "launcher", "out")
        task = registry.load(registry.command("daily"))(date=self.date, secret=self.secret)
        if self.agents is None:
            return
        Bench(
            task=task,
            world=WorldOptions(execution="kinematic"),
            learner=Learner(agents=self.agents),
            budget=Budget(seeds=self.seeds, budgets=self.budgets),
            tests=Tests(),
            launch=self.launch,
        )()
