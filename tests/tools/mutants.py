"""Plants small bugs, one at a time, and counts those that a test notices: ``make mutants``.

cosmic-ray lists the possible changes in the files of ``mutant_rooms.py``. Of all the places a sample is drawn, as many
a room, and at each place one of its changes. Each is made in a copy of the checkout, where the tests of its file run
until one fails. Tried mutants are kept as they come in ``build/mutants.jsonl``: the same command goes on there, and
tries again those that no test noticed. In the end ``build/mutants.json`` holds the counts and ``build/mutants.csv`` all
that was tried, with the reason why a survivor may live, as far as ``mutants_that_may_live.json`` gives one.
"""

from __future__ import annotations

import argparse
import ast
import csv
import hashlib
import importlib
import itertools
import json
import math
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names
from mutant_rooms import ROOMS

ROOT = Path(__file__).resolve().parents[2]
REASONS = Path(__file__).with_name("mutants_that_may_live.json")
_GUARDS = {"frozen", "slots", "kw_only", "strict", "validate_args"}
"""Arguments that change nothing in a correct program: of dataclasses, ``zip`` and distributions."""
_SLOWEST = 5.0
"""A change that makes its tests take so many times as long as without it is noticed."""


def bare(code: str) -> str | None:
    """A program without the parts that the type checker watches and not the tests: annotations and guards; None if it
    is none.
    """
    try:
        tree = ast.parse(code)
    except SyntaxError:
        return None
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.Call):
            node.keywords = [each for each in node.keywords if each.arg not in _GUARDS]
        elif isinstance(node, ast.arguments):  # that one is given by name
            node.args = [*node.posonlyargs, *node.args, *node.kwonlyargs]
            node.defaults += [each for each in node.kw_defaults if each is not None]
            node.posonlyargs, node.kwonlyargs, node.kw_defaults = [], [], []
    return ast.dump(tree)


def places(file: str) -> dict[tuple[Any, Any], list[tuple[str, int]]]:
    """Where a file can be changed, and the changes for each place: operators and their occurrences."""
    found: dict[tuple[Any, Any], list[tuple[str, int]]] = {}
    nodes = list(ast_nodes(get_ast((ROOT / file).read_text())))
    for name in operator_names():
        kind = get_operator(name)
        if not kind.arguments():
            positions = (where for node in nodes for where in kind().mutation_positions(node))
            for occurrence, (start, end) in enumerate(positions):
                found.setdefault((start, end), []).append((name, occurrence))
    return found


def drawn(file: str, seed: int) -> list[tuple[str, int, str, int]]:
    """One change of each place of a file, in an order of chance: order, line, operator and its occurrence.

    A draw depends on the text of the line alone, so that another line's change leaves the sample as it is.
    """
    lines, seen, found = (ROOT / file).read_text().splitlines(), Counter[str](), []
    for ((line, start), (_, end)), ways in sorted(places(file).items()):
        key = f"{seed} {file} {start} {end} {lines[line - 1]}"
        order = hashlib.sha256(f"{key} {seen[key]}".encode()).hexdigest()
        seen[key] += 1
        found.append((order, line, *ways[int(order, 16) % len(ways)]))
    return found


def sample(count: int, seed: int) -> Iterator[dict[str, Any]]:
    """So many changes, rooms by turns."""
    rooms = []
    for room, files in ROOMS.items():
        rooms.append(sorted((*each, file, room) for file in files for each in drawn(file, seed)))
    turns = itertools.chain.from_iterable(itertools.zip_longest(*rooms))
    for _, line, name, occurrence, file, room in filter(None, turns):
        if not count:
            return
        before = (ROOT / file).read_text()
        after = mutate_code(before, get_operator(name)(), occurrence)
        if after is not None and bare(after) not in (None, bare(before)):
            count -= 1
            yield {"room": room, "file": file, "line": line, "operator": name.split("/")[1], "code": after}


def copy_checkout(where: Path) -> None:
    """The tracked and new files of the checkout, its packages where Python finds them before the installed ones."""
    shutil.rmtree(where, ignore_errors=True)
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    for name in subprocess.run(command, cwd=ROOT, capture_output=True, check=True, text=True).stdout.split("\0"):
        if name and (ROOT / name).is_file():
            (where / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, where / name)
    for name in ("agents", "tasks", "assets"):
        (where / "imagine_bench" / name).symlink_to(f"../{name}")


def fails(where: Path, tests: Sequence[str], log: Path, limit_s: float) -> tuple[str, float]:
    """``passed``, ``failed`` or ``timeout`` of some tests in a process of its own, and the seconds they took."""
    start_s = time.monotonic()
    child = multiprocessing.get_context("fork").Process(target=_test, args=(where, tests, log, limit_s < math.inf))
    child.start()
    child.join(None if limit_s == math.inf else limit_s)
    took_s = time.monotonic() - start_s
    if child.is_alive():
        os.killpg(child.pid, signal.SIGKILL)
        return "timeout", took_s
    return "passed" if child.exitcode == 0 else "failed", took_s


def _test(where: Path, tests: Sequence[str], log: Path, mutated: bool) -> None:
    """Run some tests of a copy of the checkout, in a process that does nothing else."""
    os.setsid()
    os.chdir(where)
    packages = [str(where), *map(str, sorted(where.glob("agents/guests/*/src")))]
    os.environ["PYTHONPATH"] = os.pathsep.join(packages)
    sys.dont_write_bytecode = mutated
    sys.path[:0] = packages
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os._exit(int(importlib.import_module("pytest").main(["-x", "-p", "no:cacheprovider", *tests])))


def main() -> int:
    """Try the sample, or go on with it; 1 if too few fall."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=300, help="changes to try")
    parser.add_argument("--seed", type=int, default=0, help="seed of the sample")
    parser.add_argument("--least", type=float, default=0.92, help="share that must be noticed")
    args = parser.parse_args()
    for name in ("torch", "numpy", "scipy.stats", "gymnasium", "pytest"):  # once, not in every process
        importlib.import_module(name)
    build = ROOT / "build"
    where, log = build / "mutants", build / "mutants.jsonl"
    copy_checkout(where)
    limits: dict[Sequence[str], float] = {}
    known = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    tried, reasons = list[dict[str, Any]](), json.loads(REASONS.read_text())
    for mutant in sample(args.count, args.seed):
        code, path = mutant.pop("code"), where / mutant["file"]
        before = path.read_text()
        mutant["change"] = change(before, code)
        what = (mutant["file"], mutant["change"])
        earlier = [row for row in known if (row["file"], row["change"]) == what and row["result"] != "passed"]
        if not earlier:
            tests = tuple(ROOMS[mutant["room"]][mutant["file"]])
            if tests not in limits:
                result, took_s = fails(where, tests, build / "mutants.log", math.inf)
                if result != "passed":
                    sys.exit(f"{' '.join(tests)} fail without any change; see {build / 'mutants.log'}.")
                limits[tests] = 20.0 + _SLOWEST * took_s
            path.write_text(code)
            mutant["result"], took_s = fails(where, tests, build / "mutants.log", limits[tests])
            shutil.copy2(ROOT / mutant["file"], path)
            mutant["seconds"] = round(took_s, 1)
            with log.open("a") as file:
                file.write(json.dumps(mutant) + "\n")
        tried.append({**earlier[0], "line": mutant["line"]} if earlier else mutant)
        if tried[-1]["result"] == "passed":
            tried[-1]["why"] = why = reasons.get(mutant["file"], {}).get(mutant["change"], "")
            print(f"survives: {mutant['file']}:{mutant['line']} {mutant['change']}\n    {why or 'WHY?'}", flush=True)
    return reported(tried, args.seed, args.least)


def reported(tried: list[dict[str, Any]], seed: int, least: float) -> int:
    """Print the counts, keep them and all that was tried; 1 if less than a share was noticed."""
    rooms = {room: [row["result"] != "passed" for row in tried if row["room"] == room] for room in ROOMS}
    noticed, reasoned = sum(map(sum, rooms.values())), sum(bool(row.get("why")) for row in tried)
    for room, found in rooms.items():
        print(f"{room}: {sum(found)} of {len(found)} noticed")
    print(f"{noticed} of {len(tried)} small bugs are noticed, {noticed / len(tried):.1%}; wanted are {least:.0%}")
    print(f"{reasoned} of the other {len(tried) - noticed} may live, by {REASONS.name}")
    with (ROOT / "build" / "mutants.csv").open("w", newline="") as file:
        names = ("room", "file", "line", "operator", "change", "result", "seconds", "why")
        table = csv.DictWriter(file, names, lineterminator="\n")
        table.writeheader()
        table.writerows(tried)
    counts = {"seed": seed, "count": len(tried), "noticed": noticed, "reasoned": reasoned}
    by_room = {room: [sum(found), len(found)] for room, found in rooms.items()}
    # not imported earlier, or every process had it unchanged
    machine = importlib.import_module("imagine_bench.registry.machine")
    environment = {**machine.describe_environment(), "command": "make mutants"}
    summary = {**counts, "noticed_of": by_room, "environment": environment}
    (ROOT / "build" / "mutants.json").write_text(json.dumps(summary, indent=1) + "\n")
    return int(noticed < least * len(tried))


def change(before: str, after: str) -> str:
    """The first line that differs, as it was and as it is."""
    pairs = zip(before.splitlines(), after.splitlines(), strict=False)
    old, new = next((old.strip(), new.strip()) for old, new in pairs if old != new)
    return f"{old} -> {new}"


if __name__ == "__main__":
    sys.exit(main())
