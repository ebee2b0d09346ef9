"""Commands: ``python -m imagine_bench_programs experience | score | write``, each with ``--help``."""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench.appearance import appearance_name
from imagine_bench.errors import ImagineBenchError, InvalidValueError, require_integer
from imagine_bench.exact.certificate import certificate
from imagine_bench.interfaces import TaskSpec
from imagine_bench.registry import task
from imagine_bench.registry.machine import describe_environment
from imagine_bench.store.files import read_json, reading, require_writable, write_json

from .experience import See, itself, macro_actions_of, play, write_experience
from .program import Program
from .scores import Codes, ReadRules, Scores, efficiency, score
from .seeing import SeeingWriter, SeenCodes
from .writing.writer import Writer

_TIMES = 2.0
"""Macro-actions of a writer, in units of the cautious learner's."""


def main() -> None:
    """Run the command that was given; an error that is written for users is one sentence, with its own exit code."""
    parser = argparse.ArgumentParser(prog="python -m imagine_bench_programs", description=__doc__)
    commands = parser.add_subparsers(required=True)
    _add_experience(commands.add_parser("experience", help="write the folder from which a program is to be written"))
    _add_score(commands.add_parser("score", help="score a program against a task's rules, by enumeration"))
    _add_write(commands.add_parser("write", help="let the writer without a language model explore tasks, and score it"))
    given = parser.parse_args()
    try:
        given.run(given)
    except ImagineBenchError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)


def _add_experience(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task")
    parser.add_argument("folder", type=Path, help="an empty or new folder")
    parser.add_argument("--macro-actions", type=int, default=200, help="how many are taken, at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.set_defaults(run=_experience)


def _experience(given: argparse.Namespace) -> None:
    write_experience(given.task, given.folder, macro_actions=given.macro_actions, seed=given.seed)
    print(f"{given.macro_actions} macro-actions, and the tests of them: {given.folder}")


def _add_score(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task")
    parser.add_argument("file", help="the program, a file of Python")
    parser.add_argument("--experience", type=Path, help="the folder that it was written from; gives its efficiency")
    parser.set_defaults(run=_score)


def _score(given: argparse.Namespace) -> None:
    spec = task(given.task)
    program = Program(given.file, [len(values) for values in spec.macrostate_values], spec.n_actions)
    macro_actions = None if given.experience is None else macro_actions_of(given.experience, spec)
    print(_words(spec, score(program, spec), macro_actions))


def _words(spec: TaskSpec, found: Scores, macro_actions: int | None) -> str:
    lines = [
        f"total variation  {found.total_variation:.4f}",
        f"facts            {found.found} of {found.facts}",
        f"state ranking    {found.ranking:.4f}",
        f"fidelity         {found.fidelity:.4f}",
    ]
    learner = _learner(spec)
    if macro_actions is not None and learner is not None:
        share = efficiency(learner, macro_actions)
        lines.append(f"efficiency       {share:.2f}: {macro_actions} macro-actions, the cautious learner {learner:.0f}")
    return "\n".join(lines)


def _learner(spec: TaskSpec) -> float | None:
    """Mean macro-actions of the cautious learner, where it ends."""
    cost = certificate(spec).learning_cost
    return None if cost is None else cost.transitions


def _add_write(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("tasks", nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument(
        "--codes",
        metavar="APPEARANCE",
        default="",
        help="the writer reads codes of images of this appearance, such as clean; without it, it is shown macrostates",
    )
    parser.add_argument(
        "--own",
        action="store_true",
        help="with --codes: not an encoder's codes, but those of a perception that is learned from the writer's images",
    )
    parser.add_argument("--times", type=float, default=_TIMES, help="macro-actions, times the cautious learner's")
    parser.add_argument(
        "--out", type=Path, help="a JSON file of all figures; the same command goes on where it stopped"
    )
    parser.set_defaults(run=_write)


def _write(given: argparse.Namespace) -> None:
    for seed in given.seeds:
        require_integer("--seeds", seed, 0)
    rows, done = ([], set()) if given.out is None else _kept(given.out)
    if given.own and not given.codes:
        raise InvalidValueError("--own reads images; name their appearance with --codes, such as --codes clean.")
    look = appearance_name(given.codes) if given.codes else ""
    kind = f"own {look}" if given.own else look
    for spec, learner in [_budgeted(name, given.times) for name in given.tasks]:
        budget = int(given.times * learner)
        for seed in given.seeds:
            if (spec.id, kind, seed, budget) in done:
                continue
            done.add((spec.id, kind, seed, budget))
            found = written(spec, budget, seed, look, own=given.own)
            rows.append({"task": spec.id, "codes": kind, "learner": learner, **found})
            print(*(f"{value:.4g}" if isinstance(value, float) else value for value in rows[-1].values()), flush=True)
            if given.out is not None:
                write_json(given.out, {"rows": rows, "environment": describe_environment()})


def _budgeted(name: str, times: float) -> tuple[TaskSpec, float]:
    """A task, and the cautious learner's macro-actions. Raises InvalidValueError: they are no budget of a writer."""
    spec = task(name)
    learner = _learner(spec)
    if learner is None:
        raise InvalidValueError(f"The cautious learner does not end in {name}, so there is no budget; leave it out.")
    if not 1.0 <= times * learner < math.inf:
        few = f"--times is {times:g}, and the cautious learner of {name} has {learner:.0f} macro-actions"
        raise InvalidValueError(f"{few}; give more, so that the writer has at least one.")
    return spec, learner


def _kept(out: Path) -> tuple[list[dict[str, Any]], set[tuple[Any, ...]]]:
    """The rows of a file, and the task, codes, seed and macro-actions of each; none of a new file.

    Raises ArtefactError: it is damaged. SetupError: it cannot be written.
    """
    require_writable(out.parent)
    if not out.exists():
        return [], set()
    what = "a file of 'write'"
    with reading(out, what):
        rows: list[dict[str, Any]] = read_json(out, what)["rows"]
        return rows, {(row["task"], row["codes"], row["seed"], row["macro_actions"]) for row in rows}


def written(
    spec: TaskSpec, macro_actions: int, seed: int, appearance: str = "", *, own: bool = False
) -> dict[str, Any]:
    """The scores of a writer that explored a task for so many macro-actions, and the laws that it found.

    Where an appearance is given, the writer reads the codes of images of it; else it is shown the macrostates. The
    codes are those of the task's encoder, or, with ``own``, those of a perception that the writer learns.
    """
    begun_s = time.process_time()
    starts, choices, images = (np.random.default_rng([seed, each]) for each in range(3))
    if own:
        seeing = SeeingWriter(spec, appearance, images, choices)
        _explore(seeing, spec, macro_actions, starts, seeing.see)
        writer = seeing.writer
    else:
        codes = Codes(spec, appearance, images) if appearance else None
        sizes = [len(values) for values in spec.macrostate_values] if codes is None else codes.symbols.sizes
        writer = Writer(sizes, spec.n_actions, choices)
        _explore(writer, spec, macro_actions, starts, itself if codes is None else codes.of)
    cpu_s = time.process_time() - begun_s
    read: SeenCodes | Codes | None = seeing.codes() if own else codes
    found = asdict(score(writer.laws if read is None else ReadRules(writer.laws, read), spec))
    return {"seed": seed, "macro_actions": macro_actions, **found, "laws": writer.laws.count, "cpu_s": round(cpu_s, 2)}


def _explore(
    writer: Writer | SeeingWriter, spec: TaskSpec, macro_actions: int, rng: np.random.Generator, see: See
) -> None:
    """Let a writer take so many macro-actions from new starts, and write."""
    for count, (row, last) in enumerate(play(spec, writer.explore, rng, see), start=1):
        writer.learn(row)
        if last:
            writer.begin_episode()
        if count == macro_actions:
            break
    writer.write()


if __name__ == "__main__":
    main()
