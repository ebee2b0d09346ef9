"""The command line: words to calls, errors to one line and an exit code. No logic, nothing heavy until it is needed."""

from __future__ import annotations

import io
import os
import re
import shlex
import sys
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Annotated, TextIO, get_args

import tyro
from tyro.conf import subcommand

from imagine_bench import registry
from imagine_bench.cli.benches import Bench, Plan, Report, Sweep
from imagine_bench.cli.board import Board, Daily, Submit
from imagine_bench.cli.judging import Judge, Verify
from imagine_bench.cli.options import require_values
from imagine_bench.cli.tools import (
    CheckCommand,
    DatasetCommand,
    Describe,
    Doctor,
    EncoderCommand,
    New,
    Play,
    Serve,
    ViewCommand,
)
from imagine_bench.errors import (
    EXTRAS,
    ImagineBenchError,
    InvalidValueError,
    SetupError,
    brief,
    lacking,
    plain,
    reason,
    require_known,
)
from imagine_bench.seeding import seed_range
from imagine_bench.store.files import expanded
from imagine_bench.version import __version__

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
CUT_OFF = 141
"""Exit code where nobody reads the output any more, as shells have it: no verdict was given, so 0 would be false."""

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
    | Serve
    | Describe
    | Annotated[CheckCommand, subcommand("check")]
    | New
    | Submit
    | Board
    | Daily
    | Doctor
)
COMMANDS = tuple(
    getattr(kind, "__origin__", kind).__name__.removesuffix("Command").lower() for kind in get_args(Command)
)
"""The names of the commands."""

_PROGRAM = "imagine-bench"
_CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
_LONGEST_WORD = 1000
_RANGE = re.compile(r"\d+-")
_SETS_UP_TORCH = "imagine_bench.agents.encoders.perception"
FORMER = {
    "film": ("play", "--film"),
    "margins": ("check", "--physics"),
    "study": ("sweep",),
    "suite": ("sweep",),
    "why": ("verify", "--causes"),
}
"""Commands of former versions, and the words that replace each."""
ALSO = {"list": "describe"}
"""Second names of commands."""
ELSEWHERE = {
    "coverage": "python tests/measure/interval_coverage.py",
    "speed": "make speed",
}
"""Former commands that are measurements of a checkout now, and the line to type there."""
_OF_VALUES = re.compile(r"Error parsing (--[a-z-]+)(.*)", re.DOTALL)
"""The parser's complaint about a value, behind which it speaks of types."""
_TASK_FIRST = {"bench", "judge", "sweep", "dataset", "encoder", "play", "serve", "check", "describe"}
"""Commands whose first word is a task; of others it may be a path."""


def parsed(words: Sequence[str]) -> Command:
    """The command of a command line, also of a former one; calling it carries it out.

    Raises:
        SystemExit: The words are no command, or ask for help, which is then printed.
        UnknownNameError: As :func:`understood`.
        InvalidValueError: As :func:`understood`, or an option was given a value that is no number, or the command
            takes no such word.
        SetupError: A shell's completion is asked for that needs a package which is not installed.
    """
    given = understood(words)
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            command, others = _parsed(given)
            if any(word.startswith("-") for word in others):  # the parser names the nearest options
                tyro.cli(Command, prog=_PROGRAM, args=given, config=_CONFIG)
    except ImportError as error:  # the completion of some shells needs another package
        raise SetupError(f"{plain(error)}.") from error
    except SystemExit:
        wrong = _OF_VALUES.search(said.getvalue())
        if wrong is not None:
            kind = "numbers" if "float" in wrong[2] else "whole numbers"
            raise InvalidValueError(f"{wrong[1]} was given {_values(given, wrong[1])!r}; it takes {kind}.") from None
        print(said.getvalue(), end="", file=sys.stderr)
        raise
    if others:
        added = " '--merge FOLDER' adds another bench." if isinstance(command, Report) else ""
        raise InvalidValueError(
            f"'{given[0]}' was also given {' '.join(map(repr, others))}, which it does not take; leave it out. "
            f"'imagine-bench {given[0]} --help' names all that it takes.{added}"
        )
    require_values(command)
    return command


def _parsed(words: Sequence[str]) -> tuple[Command, list[str]]:
    """The command, and the words that it does not take."""
    return tyro.cli(
        Command,
        prog=_PROGRAM,
        description="Robotics benchmarks that measure how many real episodes imagination saves a robot. "
        "'imagine-bench list' names all tasks, agents, presets and models; --version says which version this is.",
        args=words,
        config=_CONFIG,
        return_unknown_args=True,
    )


def _values(words: Sequence[str], option: str) -> str:
    """The words behind an option, as they were given."""
    text = " ".join(words).replace(f"{option}=", f"{option} ")
    return text.partition(f"{option} ")[2].partition(" --")[0].strip()


def understood(words: Sequence[str]) -> list[str]:
    """The words that are parsed. A former command is replaced, after one line on standard error.

    Raises:
        UnknownNameError: No such command.
        InvalidValueError: A word that no terminal could show, a task given twice, or a former command that is no
            command any more.
    """
    given = [*_with_seeds_listed(map(_readable, words))]
    command = given[0] if given else ""
    given[:1] = [ALSO.get(command, command)] if given else []
    if command in ELSEWHERE:
        raise InvalidValueError(
            f"'{command}' is no command any more. In a checkout type: {ELSEWHERE[command]}. "
            "'imagine-bench check TASK --physics' measures the physics of any task."
        )
    if command in FORMER:
        given = [*FORMER[command], *given[1:]]
        print(f"imagine-bench: '{command}' is now: imagine-bench {shlex.join(given)}", file=sys.stderr)
    if given and not given[0].startswith("-"):
        require_known("command", given[0], [*COMMANDS, *ALSO])
    return _with_task_first(given) if given and given[0] in _TASK_FIRST else given


def _with_seeds_listed(words: Iterable[str]) -> Iterator[str]:
    """The words, with all seeds in place of a range behind ``--seeds``, such as ``0-21``."""
    option = ""
    for word in words:
        name, equals, value = word.partition("=")
        if word.startswith("--"):
            option = name
        elif option == "--seeds":
            value = word
        if option != "--seeds" or not _RANGE.match(value):
            yield word
            continue
        if equals:
            yield option
        yield from map(str, seed_range(value))


def _readable(word: str) -> str:
    """A word with ``~`` as the home folder. Raises InvalidValueError if no terminal could show it."""
    if len(word) > _LONGEST_WORD or any(unicodedata.category(mark) in ("Cc", "Cs") for mark in word):
        raise InvalidValueError(
            f"The word {brief(word)} cannot be meant: give at most {_LONGEST_WORD:,} characters, none of them a "
            "control character or outside Unicode."
        )
    return re.sub(r"^(--[a-z-]+=)?~(?=/|$)", lambda found: f"{found[1] or ''}{expanded(Path('~'))}", word)


def _with_task_first(words: list[str]) -> list[str]:
    """The task of ``--task TASK`` or ``--task=TASK`` as the first word behind the command."""
    command, *rest = words
    tasks = []
    others = []
    while rest:
        name, equals, value = rest.pop(0).partition("=")
        if name != "--task" or not (equals or rest):
            others.append(f"{name}{equals}{value}")
        else:
            tasks.append(value if equals else rest.pop(0))
    if others and not others[0].startswith("-"):
        tasks.insert(0, others.pop(0))
    if len(tasks) > 1:
        raise InvalidValueError(f"Both {tasks[0]} and --task {tasks[1]} were given; leave one of them out.")
    return [command, *tasks, *others]


def main(words: Sequence[str] | None = None) -> None:
    """Carry out a command line, as :func:`exit_code`; without words that of this process.

    Raises:
        SystemExit: It failed. A script that does not catch this ends with the exit code.
    """
    if words is None:  # this process is ours
        os.environ["MPLBACKEND"] = "agg"  # figures go to files, and the backend that is set may be of another machine
    code = exit_code(sys.argv[1:] if words is None else words)
    if code:
        sys.exit(code)


def exit_code(words: Sequence[str]) -> int:
    """Carry out a command line and return its exit code: 0, 1 (a run or check failed), 2 (bad input), 130 (Ctrl-C).

    Raises:
        SystemExit: The words are no command, or ask for help.
        SetupError: It is called by a module that a command is importing.
    """
    registry.refuse_while_loading()
    with ExitStack() as scope:
        scope.enter_context(torch_as_it_was())
        if sys.stderr is None:
            scope.enter_context(redirect_stderr(scope.enter_context(Path(os.devnull).open("w"))))
        return _carried_out(list(words))


class _Printable(io.StringIO):
    """An output that shows control characters as escapes: names, titles and files may be of somebody else."""

    def __init__(self, output: TextIO) -> None:
        super().__init__()
        self._output = output

    def write(self, text: str) -> int:
        return self._output.write(plain(text))

    def flush(self) -> None:
        self._output.flush()

    def fileno(self) -> int:
        return self._output.fileno()

    def isatty(self) -> bool:
        return self._output.isatty()


@contextmanager
def torch_as_it_was() -> Iterator[None]:
    """After the block torch has the settings that it had before, which hold for the whole process."""
    _of_torch("keep_torch")
    try:
        yield
    finally:
        _of_torch("restore_torch")


def _of_torch(function: str) -> None:
    """Call ``keep_torch`` or ``restore_torch`` if torch's settings may have been changed."""
    if _SETS_UP_TORCH in sys.modules:
        registry.load(f"{_SETS_UP_TORCH}:{function}")()


def _carried_out(words: list[str]) -> int:
    command: Command | None = None
    code = 0
    try:
        if sys.stdout is None:
            raise SetupError("Standard output is closed; open it, or send it to a file or /dev/null.")
        if words == ["--version"]:
            print(f"imagine-bench {__version__}")
            return 0
        command = parsed(words)
        with redirect_stdout(_Printable(sys.stdout)):
            command()
        sys.stdout.flush()
    except ImagineBenchError as error:
        return _say(error, error.exit_code)
    except BrokenPipeError:  # the reader has seen enough, as `| head` does; nothing more can be said to it
        _discard_output()
        code = CUT_OFF
    except OSError as error:
        where = error.filename or "standard output"
        return _say(f"{where} cannot be read or written: {reason(error)}.")
    except (ModuleNotFoundError, MemoryError, RecursionError, UnicodeError) as error:
        return _say(_words(error))
    except KeyboardInterrupt:
        resumes = isinstance(command, Bench | Judge | Sweep)
        then = "goes on from the last checkpoints" if resumes else "begins anew"
        return _say(f"interrupted; the same command {then}.", INTERRUPTED)
    return code


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
