"""The commands of the leaderboard, whose options the command line of imagine_bench declares."""

from __future__ import annotations

import time
from pathlib import Path

from imagine_bench.errors import CheckFailedError, InvalidValueError
from imagine_bench.judge.verify import cost
from imagine_bench.store.files import require_writable

from . import rounds
from . import submit as submitting
from .check import NEVER_SHOWN, check
from .daily import world_of_day
from .page import write_board
from .rows import named

_NEEDED = "'board {}' needs {}; give it too."


def submit(*, run: Path, out: Path, author: str, round: Path | None, encoder: str | None) -> None:
    """Write rows for a board, and print their folders."""
    of_round = None if round is None else named(round)
    print(*submitting.submit(run, out, author=author, round_folder=of_round, encoder=encoder), sep="\n")


def board(
    *, action: str, path: Path, out: Path, closes: str | None, tests: int, secret: Path, round: Path | None
) -> None:
    """Carry out an action on a board, a row or a round, and print its result.

    Raises:
        CheckFailedError: A row is refused, or was made with another MuJoCo and does not play again with this one.
        InvalidValueError: The action needs an option that was not given.
    """
    match action:
        case "open":
            if closes is None:
                raise InvalidValueError(_NEEDED.format("open", "--closes, a day such as 2026-12-24"))
            print(rounds.open_round(named(path), closes=closes, tests=tests, secret=secret))
        case "file":
            if round is None:
                raise InvalidValueError(_NEEDED.format("file", "--round, the folder of a round"))
            print(*submitting.file_agents(path, named(round)), sep="\n")
        case "reveal":
            print(rounds.reveal(named(path), secret))
        case _:
            _check(path, out if action == "page" else None)


def _check(path: Path, page: Path | None) -> None:
    """Print the verdict on every row, and write the page of the board if a folder for it is given."""
    if page is not None:
        require_writable(page)
    begun_s = time.process_time()
    found = check(named(path))
    verdicts = [each.verdict for each in found]
    print(*found, NEVER_SHOWN, cost(verdicts, time.process_time() - begun_s), sep="\n")
    if page is not None:
        print(f"Page: {write_board(found, page)}")
    refused = sum(each.is_refused for each in found)
    elsewhere = sum(each.row is None for each in found) - refused
    if refused or elsewhere:
        more = f", and {elsewhere} cannot be vouched for with this MuJoCo" if elsewhere else ""
        raise CheckFailedError(f"{refused} of {len(verdicts)} rows are refused{more}; see above.")


def daily(date: str | None, secret: str) -> str:
    """Print the world of a day and its exact facts; returns the world."""
    world = world_of_day(date, secret)
    print(world)
    return world.task
