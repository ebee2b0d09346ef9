"""The command line: words to calls, errors to one line and an exit code. No logic, nothing heavy until it is needed."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import subcommand

from imagine_bench.cli.analysis import Judge, Plan, Verify
from imagine_bench.cli.benches import Bench, Report, Sweep
from imagine_bench.cli.data import DatasetCommand, EncoderCommand
from imagine_bench.cli.tools import CheckCommand, Describe, Doctor, New, Play, ViewCommand
from imagine_bench.cli.words import understood
from imagine_bench.errors import EXTRAS, ImagineBenchError, SetupError, lacking, plain
from imagine_bench.store.files import reason
from imagine_bench.version import __version__

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

Command = (
    Bench
    | Report
    | Judge
    | Verify
    | Plan
    | Sweep
    | Annotated[DatasetCommand, subcommand("dataset")]
    | Annotated[EncoderCommand, subcommand("encoder")]
    | Annotated[ViewCommand, subcommand("view")]
    | Play
    | Describe
    | Annotated[CheckCommand, subcommand("check")]
    | New
    | Doctor
)


def parsed(words: Sequence[str]) -> Command:
    """The command of a command line, also of a former one; calling it carries it out.

    Raises:
        SystemExit: The words are no command, or ask for help, which is then printed.
        InvalidValueError: As :func:`.words.understood`.
    """
    command: Command = tyro.cli(
        Command,
        prog="imagine-bench",
        description="Robotics benchmarks that measure how far imagination cuts the real interaction a robot needs. "
        "--version says which this is.",
        args=understood(words),
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    return command


def main(words: Sequence[str] | None = None) -> int:
    """Carry out a command line and return its exit code: 0, 1 (a run or check failed), 2 (bad input), 130 (Ctrl-C)."""
    command: Command | None = None
    os.environ["MPLBACKEND"] = "agg"  # figures go to files; a window system's backend would fail only at the end
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w")
    try:
        if sys.stdout is None:
            raise SetupError("Standard output is closed; open it, or send it to a file or /dev/null.")
        given = sys.argv[1:] if words is None else list(words)
        if given == ["--version"]:
            print(f"imagine-bench {__version__}")
            return 0
        command = parsed(given)
        command()
        sys.stdout.flush()
    except ImagineBenchError as error:
        return _say(error, error.exit_code)
    except BrokenPipeError:  # the reader has seen enough, as `| head` does; nothing more can be said to it
        _discard_output()
    except OSError as error:
        where = error.filename or "standard output"
        return _say(f"{where} cannot be read or written: {reason(error)}.")
    except (ModuleNotFoundError, MemoryError, RecursionError, UnicodeError) as error:
        return _say(_words(error))
    except KeyboardInterrupt:
        resumes = isinstance(command, Bench | Judge | Sweep)
        then = "goes on from the last checkpoints" if resumes else "begins anew"
        return _say(f"interrupted; the same command {then}.", INTERRUPTED)
    return 0


def _words(error: Exception) -> object:
    """The words for an error of Python's own; an unforeseen missing module is raised again."""
    if not isinstance(error, ModuleNotFoundError):
        return f"{type(error).__name__}: {error}"
    if error.name not in EXTRAS:
        raise error
    return lacking(error.name)


def _say(error: object, exit_code: int = 2) -> int:
    """Print an error, and let nothing that is still to be written fail after that."""
    with suppress(OSError):
        print(f"imagine-bench: {plain(error)}", file=sys.stderr)
    try:
        sys.stdout.flush()
    except (OSError, ValueError, AttributeError):
        _discard_output()
    return exit_code


def _discard_output() -> None:
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
