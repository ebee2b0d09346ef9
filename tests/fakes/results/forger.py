"""Forges the results of a finished bench at random, and mends every digest that can be mended."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from forging import OpenRun, all_runs, of_second, rewrite_protocol

from imagine_bench.arrays import Arrays
from imagine_bench.running.evaluation import EvaluationCounts
from imagine_bench.store.files import sealed
from imagine_bench.store.results import KeptEpisodes

Forge = Callable[[Path, np.random.Generator], None]


def forged(honest: Path, root: Path, forge: Callable[[Path], object] = lambda folder: None) -> Path:
    """A copy of a bench that somebody has forged, or that is to be."""
    folder = root / honest.name
    shutil.copytree(honest, folder)
    forge(folder)
    return folder


def with_weights_of_first(one: OpenRun, other: OpenRun) -> None:
    other.agent = one.agent


share_weights = of_second(with_weights_of_first)


def one_run(bench: Path, rng: np.random.Generator) -> OpenRun:
    return rng.choice(list(all_runs(bench)))  # type: ignore[arg-type]


def one_row(run: OpenRun, rng: np.random.Generator) -> int:
    return int(rng.integers(len(run.rows)))


def with_tests(run: OpenRun, row: int, arrays: Arrays) -> None:
    """A budget with other test episodes, and figures that follow from them."""
    run.set_tests(row, EvaluationCounts.of(KeptEpisodes(**arrays)))
    run.rows[row]["mean_length"] = float(arrays["lengths"].mean())  # a surplus action belongs to no episode
    run.write()


def in_episodes(name: str, change: Callable[[Arrays, np.random.Generator], None]) -> Forge:
    """Change an array of the kept episodes, and metrics that say the same."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        changed = False
        while not changed:
            run = one_run(bench, rng)
            row = one_row(run, rng)
            before = run.kept(row)
            arrays = {each: array.copy() for each, array in before.items()}
            change(arrays, rng)
            changed = not np.array_equal(before[name], arrays[name])
        with_tests(run, row, arrays)

    return forge


def another(name: str, values: int) -> Forge:
    """Another integer below ``values`` somewhere in an array."""

    def change(arrays: Arrays, rng: np.random.Generator) -> None:
        arrays[name].flat[rng.integers(arrays[name].size)] = rng.integers(values)

    return in_episodes(name, change)


def exchange(name: str) -> Forge:
    """Two episodes exchange their values in an array."""

    def change(arrays: Arrays, rng: np.random.Generator) -> None:
        one, other = rng.integers(len(arrays[name]), size=2)
        arrays[name][[one, other]] = arrays[name][[other, one]]

    return in_episodes(name, change)


def shift_length(arrays: Arrays, rng: np.random.Generator) -> None:
    """One episode gives a macro-action to another."""
    lengths = arrays["lengths"]
    one, other = rng.integers(lengths.size, size=2)
    if lengths.flat[one] > 1:
        lengths.flat[one] -= 1
        lengths.flat[other] += 1


def metric(name: str, write: Callable[[OpenRun], None] = OpenRun.write) -> Forge:
    """One more of a figure of a test, in the checkpoint and the table, or in the table alone."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        run = one_run(bench, rng)
        run.rows[one_row(run, rng)][name] += 1
        write(run)

    return forge


def surplus(lengthen: bool) -> Forge:
    """An action behind those of the last episode of the last test; it says so itself, or belongs to none."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        run = one_run(bench, rng)
        last = len(run.rows) - 1
        arrays = run.kept(last)
        arrays["actions"] = np.append(arrays["actions"], arrays["actions"][-1:])
        arrays["lengths"] = arrays["lengths"].copy()
        arrays["lengths"][-1] += int(lengthen)
        with_tests(run, last, arrays)

    return forge


def in_learner(change: Callable[[OpenRun, np.random.Generator], None]) -> Forge:
    """Change the checkpoint of a learner."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        run = OpenRun.read(rng.choice(sorted(bench.glob("table/seed_*"))))  # type: ignore[arg-type]
        change(run, rng)
        run.write()

    return forge


def in_training(name: str) -> Forge:
    """One more somewhere in an array of the training episodes, or another number in a list of them."""

    def change(run: OpenRun, rng: np.random.Generator) -> None:
        if name in run.values:
            index = int(rng.integers(len(run.values[name])))
            run.values[name][index] = 1 - run.values[name][index]
        else:
            array = run.arrays[name].copy()
            index = int(rng.integers(array.size))
            array.flat[index] = not array.flat[index] if array.dtype == bool else (array.flat[index] + 1) % 6
            run.arrays[name] = array

    return in_learner(change)


def last_tests_dropped(bench: Path, rng: np.random.Generator) -> None:
    """The tests of a budget behind its last success are dropped, or the last one, with every figure that follows."""
    run = one_run(bench, rng)
    row = one_row(run, rng)
    kept = KeptEpisodes(**run.kept(row))
    successes = np.flatnonzero(kept.success[:-1])
    run.set_tests(row, EvaluationCounts.of(kept.first(int(successes[-1]) + 1 if len(successes) else 1)))
    run.write()


def last_training_episode_dropped(run: OpenRun, rng: np.random.Generator) -> None:
    """The last training episode was never played, nor its macro-actions tried; the steps agree."""
    del rng
    prefix = "training/"
    kept = {name: array for name, array in run.arrays.items() if name.startswith(prefix)}
    last = len(kept["training/lengths"]) - 1
    first = KeptEpisodes(**{name.removeprefix(prefix): array for name, array in kept.items()}).first(last)
    run.arrays |= {name: getattr(first, name.removeprefix(prefix)) for name in kept}
    for name in ("success", "length", "queries"):
        run.values[name].pop()
    run.values["tried"] = {pair: episode for pair, episode in run.values["tried"].items() if episode < last}
    run.values["env_steps"] = run.rows[-1]["env_steps"] = sum(run.values["length"])


def last_budget_dropped(bench: Path, rng: np.random.Generator) -> None:
    """The tests of the last budget are left out."""
    run = one_run(bench, rng)
    last = len(run.rows) - 1
    run.drop(f"rows/{last}/")
    del run.rows[last]
    run.write()


def no_digests(bench: Path, rng: np.random.Generator) -> None:
    (one_run(bench, rng).folder / "DONE").write_text(
        json.dumps(sealed({"format": "imagine_bench run 3", "sha256": {}}))
    )


def tried(run: OpenRun, rng: np.random.Generator) -> None:
    """A macro-action was tried an episode later than it was."""
    run.values["tried"][str(rng.choice(list(run.values["tried"])))] += 1


def exchanged_lengths(run: OpenRun, rng: np.random.Generator) -> None:
    """Two training episodes before the first test exchange their lengths, so that every sum of them stays."""
    del rng
    length = run.values["length"]
    early = range(run.rows[0]["episodes"])
    other = next(each for each in early if length[each] != length[0])
    length[0], length[other] = length[other], length[0]


def without(beginning: str) -> Forge:
    """The arrays of a learner's checkpoint whose names begin so are deleted, though its format says they are kept."""
    return in_learner(lambda run, rng: run.drop(beginning))


def seed(bench: Path, rng: np.random.Generator) -> None:
    """A run is of another seed, here alone or in everything that names it, the protocol and its hash included."""
    other, run = int(rng.integers(1, 99)), one_run(bench, rng)
    everywhere = rng.random() >= 0.5
    for each in all_runs(bench) if everywhere else [run]:
        each.config["seed"] = other
        each.write()
        if everywhere:
            each.folder.rename(each.folder.with_name(f"seed_{other}"))
    if everywhere:
        rewrite_protocol(bench, seeds=[other])


def table(bench: Path, rng: np.random.Generator) -> None:
    """Another digit in a table of the report; pictures, whose ticks are texts, are not vouched for."""
    name = str(rng.choice(["index.html", "summary.csv", "results.csv"]))
    path = bench / "report" / name
    text = path.read_text()
    cells = {"index.html": r"(?<=>)[0-9]+\.[0-9](?=<(?!/text))"}
    found = list(re.finditer(cells.get(name, r"(?<=,)[0-9]+"), text))
    spot = found[rng.integers(len(found))].start()
    path.write_text(f"{text[:spot]}{(int(text[spot]) + rng.integers(1, 10)) % 10}{text[spot + 1 :]}")


def damage(bench: Path, rng: np.random.Generator) -> None:
    """Any byte of any file with a digest, which is left as it was."""
    run = one_run(bench, rng).folder
    names = list(json.loads((run / "DONE").read_text())["sha256"])
    names += [path.relative_to(run).as_posix() for path in run.glob("checkpoints/*/runner.safetensors")]
    path = run / str(rng.choice(names))
    content = bytearray(path.read_bytes())
    content[rng.integers(len(content))] ^= int(rng.integers(1, 256))
    path.write_bytes(content)


FORGERIES: dict[str, Forge] = {
    "action": another("actions", 6), "start": another("starts", 4), "return": another("returns", 50),
    "success": another("success", 2), "faults": another("faults", 9), "fingerprint": another("fingerprints", 2**31),
    "exchanged starts": exchange("starts"), "exchanged outcomes": exchange("returns"),
    "length": in_episodes("lengths", shift_length), "seed": seed, "table": table,
    "damage": damage, "surplus": surplus(lengthen=False),
    "after the end": surplus(lengthen=True), "budget": metric("episodes"), "successes": metric("successes"),
    "mean return": metric("mean_return"), "mean length": metric("mean_length"), "sum of faults": metric("faults"),
    "table of a run": metric("mean_length", OpenRun.write_table), "no digests": no_digests,
    "last tests dropped": last_tests_dropped, "last budget dropped": last_budget_dropped,
}  # fmt: skip
IN_TRAINING: dict[str, Forge] = {
    "training steps": metric("env_steps"), "training start": in_training("training/starts"),
    "training action": in_training("training/actions"),
    "training success": in_training("success"), "training kept success": in_training("training/success"),
    "training length": in_training("length"), "training faults": in_training("training/faults"),
    "training return": in_training("training/returns"), "simulated time": in_training("training/sim_times_s"),
    "exchanged lengths": in_learner(exchanged_lengths),
    "nothing": without("training/"), "no simulated time": without("training/sim_times_s"),
    "no simulated time of tests": without("rows/0/kept/sim_times_s"), "tried": in_learner(tried),
    "last episode dropped": in_learner(last_training_episode_dropped),
}  # fmt: skip
