"""An honest leaderboard, and the tools of a forger of its rows, who brings every copy of a number up to date."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from forging import Hand, shared_bench, tests_by
from imagine_bench_board import rounds
from imagine_bench_board.rows import CARD, EPISODES
from imagine_bench_board.submit import file_agents, submit

from imagine_bench.running.evaluation import EpisodeLog

CLOSES = "2026-12-24"
BEFORE = date(2026, 12, 1)
AFTER = date(2026, 12, 24)
ROUND = "winter"
TESTS = 8
"""Of the round."""


def on(day: date) -> Any:
    """Let a day be today."""
    return mock.patch.object(rounds, "today", lambda: day)


def with_round(bench: Path, board: Path, secret: Path) -> None:
    """Open a round, file the agents of a bench, publish the seed, and submit their rows."""
    folder = board / rounds.ROUNDS / ROUND
    with on(BEFORE):
        rounds.open_round(folder, closes=CLOSES, tests=TESTS, secret=secret)
        file_agents(bench, folder)
    with on(AFTER):
        rounds.reveal(folder, secret)
    submit(bench, board / "rows", author="a founder", round_folder=folder, encoder=None)


def submitted(run: Path, rows: Path) -> list[Path]:
    """The rows of a run or a bench, with open starts."""
    return submit(run, rows, author="a founder", round_folder=None, encoder=None)


def honest_board(root: Path) -> Path:
    """A board of the rows of a bench, with open starts and with those of a round."""
    bench, _ = shared_bench()
    board = root / "board"
    submitted(bench, board / "rows")
    with_round(bench, board, root / "secret.json")
    return board


class OpenRow:
    """A row's files as values that can be changed, and sealed again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.card: dict[str, Any] = json.loads((folder / CARD).read_text())
        self.parts: list[dict[str, Any]] = json.loads((folder / EPISODES).read_text())

    @property
    def protocol(self) -> dict[str, Any]:
        return self.card["protocol"]

    def set_tests(self, place: int, log: EpisodeLog) -> None:
        """Let the tests of a place be others."""
        columns = {field.name: getattr(log, field.name) for field in dataclasses.fields(EpisodeLog)}
        flat = iter(columns["actions"])
        columns["actions"] = [[next(flat) for _ in range(length)] for length in columns.pop("lengths")]
        self.parts[place] = columns

    def drop_tests(self, place: int, tests: list[int]) -> None:
        for name, column in self.parts[place].items():
            kept = [each for test, each in enumerate(column) if test not in tests]
            self.parts[place][name] = "".join(kept) if name == "solved" else kept

    def keep_places(self, places: list[int]) -> None:
        """Forget all but some seeds and budgets."""
        self.parts = [self.parts[place] for place in places]
        self.card["vouched"] = [self.card["vouched"][place] for place in places]
        self.card["claimed"]["prices"] = [self.card["claimed"]["prices"][place] for place in places]

    def follow(self) -> None:
        """Bring every figure up to date with the episodes."""
        for figures, part in zip(self.card["vouched"], self.parts, strict=True):
            tests = len(part["solved"])
            figures["test_episodes"] = tests
            figures["successes"] = part["solved"].count("1")
            figures["mean_return"] = sum(part["returns"]) / tests
            figures["mean_length"] = sum(map(len, part["actions"])) / tests
            figures["faults"] = sum(part["faults"])

    def sealed(self) -> OpenRow:
        """Written, with all figures brought up to date."""
        self.follow()
        return self.write()

    def write(self, *, sealed: bool = True) -> OpenRow:
        content = json.dumps(self.parts).encode()
        (self.folder / EPISODES).write_bytes(content)
        if sealed:
            self.card["episodes_sha256"] = hashlib.sha256(content).hexdigest()
        (self.folder / CARD).write_text(json.dumps(self.card))
        return self


class BoardForger:
    """A copy of an honest board, open for changes."""

    def __init__(self, source: Path, root: Path, rng: np.random.Generator) -> None:
        self.board = root / "board"
        shutil.copytree(source, self.board)
        self.rng = rng

    def pick(self, *of: Any) -> Any:
        return of[int(self.rng.integers(len(of)))]

    def learner(self, *, dated: bool = False) -> OpenRow:
        """A learner's row."""
        rows = sorted((self.board / "rows").iterdir())
        rows = [each for each in rows if each.name.startswith(("dqn", "count_table"))]
        return OpenRow(self.pick(*[each for each in rows if each.name.endswith(ROUND) == dated]))

    def any_learner(self) -> OpenRow:
        """One with open starts, or one of the round."""
        return self.learner(dated=self.pick(True, False))

    def other(self, row: OpenRow) -> OpenRow:
        """The other learner's row of the same kind."""
        names = {"dqn": "count_table", "count_table": "dqn"}
        agent = row.protocol["agents"][0]
        return OpenRow(row.folder.with_name(row.folder.name.replace(agent, names[agent], 1)))

    def hand(self) -> Hand:
        """A skilled player in a learner's stead."""
        return Hand(float(self.pick(1.0, 0.9, 0.7)), self.rng)

    def played(self, tests: int) -> EpisodeLog:
        """Open tests as a skilled player plays them."""
        return tests_by(self.hand(), range(tests))


Forgery = Callable[[BoardForger], OpenRow]
