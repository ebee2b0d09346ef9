"""The command line: words to calls, errors to one line and an exit code. No logic, nothing heavy until it is needed."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

import tyro

from imagine_bench import __version__
from imagine_bench.cli.analysis import Generalise, Plan, Policy
from imagine_bench.cli.benches import Bench, List, Report, Study, parse_settings
from imagine_bench.cli.tools import Doctor, Encoder, Film, Margins, Speed, View
from imagine_bench.errors import ImagineBenchError

__all__ = ["INTERRUPTED", "main", "parse_settings"]

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

Command = Bench | Report | Plan | Generalise | Policy | Study | View | Encoder | Film | Speed | Margins | Doctor | List


def main(words: Sequence[str] | None = None) -> int:
    """Carry out a command line and return its exit code: 0, 1 (a run or check failed), 2 (bad input), 130 (Ctrl-C)."""
    given = sys.argv[1:] if words is None else list(words)
    command: Any = None
    try:
        if given == ["--version"]:
            print(f"imagine-bench {__version__}")
            return 0
        command = tyro.cli(
            Command,
            prog="imagine-bench",
            description="Robotics benchmarks that measure how far imagination cuts the real interaction a robot needs. "
            "--version says which this is.",
            args=given,
            config=(tyro.conf.OmitArgPrefixes,),
        )
        command()
        sys.stdout.flush()
    except ImagineBenchError as error:
        print(f"imagine-bench: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # the reader has seen enough, as `| head` does; nothing more can be said to it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        resumes = isinstance(command, Bench | Study)
        then = "goes on from the last checkpoints" if resumes else "begins anew"
        print(f"imagine-bench: interrupted; the same command {then}.", file=sys.stderr)
        return INTERRUPTED
    return 0
