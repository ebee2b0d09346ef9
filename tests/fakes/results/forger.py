"""Forges the results of a finished bench at random, and mends every digest that can be mended."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from imagine_bench.arrays import Arrays
from imagine_bench.protocols.data import digest
from imagine_bench.store.codec import read_arrays, table_rows, table_text, write_arrays
from imagine_bench.store.files import sealed, sha256

Forge = Callable[[Path, np.random.Generator], None]


def mend(run: Path) -> None:
    """Bring the digests of a run up to date."""
    done = json.loads((run / "DONE").read_text())
    done.pop("seal")
    done["sha256"] = {name: sha256(run / name) for name in done["sha256"]}
    (run / "DONE").write_text(json.dumps(sealed(done)))


def one_run(bench: Path, rng: np.random.Generator) -> Path:
    return rng.choice(sorted(path.parent for path in bench.glob("*/seed_*/DONE")))  # type: ignore[arg-type]


def in_episodes(name: str, change: Callable[[Arrays, np.random.Generator], None]) -> Forge:
    """Change an array of the kept episodes, and metrics that say the same."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        run = one_run(bench, rng)
        arrays = read_arrays(run / "episodes.npz")
        before = arrays[name].copy()
        while np.array_equal(before, arrays[name]):
            change(arrays, rng)
        write_arrays(run / "episodes.npz", arrays)
        if name in ("success", "returns", "faults"):
            rows = table_rows((run / "metrics.csv").read_text(), texts=("solved",))
            for index, row in enumerate(rows):
                solved = arrays["success"][:, index]
                row |= {"successes": int(solved.sum()), "solved": "".join("01"[int(each)] for each in solved)}
                row |= {"mean_return": float(arrays["returns"][:, index].mean())}
                row |= {"faults": int(arrays["faults"][:, index].sum())}
            (run / "metrics.csv").write_text(table_text(rows))
        mend(run)

    return forge


def another(name: str, values: int) -> Forge:
    """Another integer below ``values`` somewhere in an array."""

    def change(arrays: Arrays, rng: np.random.Generator) -> None:
        arrays[name].flat[rng.integers(arrays[name].size)] = rng.integers(values)

    return in_episodes(name, change)


def exchange(name: str) -> Forge:
    """Two episodes exchange what they have in an array."""

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


def metric(name: str) -> Forge:
    """One more of a figure of a test."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        run = one_run(bench, rng)
        rows = table_rows((run / "metrics.csv").read_text(), texts=("solved",))
        rows[rng.integers(len(rows))][name] += 1
        (run / "metrics.csv").write_text(table_text(rows))
        mend(run)

    return forge


def surplus(lengthen: bool) -> Forge:
    """An action behind those of the last episode of the last test; it says so itself, or belongs to none."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        run = one_run(bench, rng)
        arrays = read_arrays(run / "episodes.npz")
        arrays["actions"] = np.append(arrays["actions"], arrays["actions"][-1:])
        if lengthen:
            arrays["lengths"][-1, -1] += 1
            rows = table_rows((run / "metrics.csv").read_text(), texts=("solved",))
            rows[-1]["mean_length"] = float(arrays["lengths"][:, -1].sum() / len(arrays["lengths"]))
            (run / "metrics.csv").write_text(table_text(rows))
        write_arrays(run / "episodes.npz", arrays)
        mend(run)

    return forge


def training_start(bench: Path, rng: np.random.Generator) -> None:
    run = one_run(bench, rng)
    arrays = read_arrays(run / "training.npz")
    if len(arrays["starts"]):
        arrays["starts"][rng.integers(len(arrays["starts"])), 0] += 1
        write_arrays(run / "training.npz", arrays)
        mend(run)
    else:
        metric("successes")(bench, rng)


def seed(bench: Path, rng: np.random.Generator) -> None:
    """A run is of another seed, here alone or in everything that names it, the protocol and its hash included."""
    other, run = int(rng.integers(1, 99)), one_run(bench, rng)
    runs = [run] if rng.random() < 0.5 else sorted(path.parent for path in bench.glob("*/seed_*/DONE"))
    whole = len(runs) > 1 or len(list(bench.glob("*/seed_*"))) == 1
    protocol = json.loads((bench / "protocol.json").read_text())
    if whole:
        protocol["seeds"] = [other]
        (bench / "protocol.json").write_text(json.dumps(protocol))
    for each in runs:
        config = json.loads((each / "config.json").read_text())
        config.pop("seal")
        config |= {"seed": other, "protocol": protocol, "protocol_hash": digest(protocol)}
        (each / "config.json").write_text(json.dumps(sealed(config)))
        mend(each)
        if whole:
            each.rename(each.with_name(f"seed_{other}"))
    if whole:
        bench.rename(bench.with_name(f"smoke-{digest(protocol)}"))


def table(bench: Path, rng: np.random.Generator) -> None:
    """Another digit in a table of the report; pictures, whose ticks are texts, are not vouched for."""
    name = str(rng.choice(["report.md", "index.html", "summary.csv", "results.csv"]))
    path = bench / "report" / name
    text = path.read_text()
    cells = {"report.md": r"(?<=\| )[0-9]+\.[0-9]", "index.html": r"(?<=>)[0-9]+\.[0-9](?=<(?!/text))"}
    found = list(re.finditer(cells.get(name, r"(?<=,)[0-9]+"), text))
    spot = found[rng.integers(len(found))].start()
    path.write_text(f"{text[:spot]}{(int(text[spot]) + rng.integers(1, 10)) % 10}{text[spot + 1 :]}")


def damage(bench: Path, rng: np.random.Generator) -> None:
    """Any byte of any file with a digest, which is left as it was."""
    run = one_run(bench, rng)
    path = run / str(rng.choice(list(json.loads((run / "DONE").read_text())["sha256"])))
    content = bytearray(path.read_bytes())
    content[rng.integers(len(content))] ^= int(rng.integers(1, 256))
    path.write_bytes(content)


FORGERIES: dict[str, Forge] = {
    "action": another("actions", 6), "start": another("starts", 4), "return": another("returns", 50),
    "success": another("success", 2), "faults": another("faults", 9), "fingerprint": another("fingerprints", 2**31),
    "exchanged starts": exchange("starts"), "exchanged outcomes": exchange("returns"),
    "length": in_episodes("lengths", shift_length), "training start": training_start, "seed": seed, "table": table,
    "damage": damage, "surplus": surplus(lengthen=False),
    "after the end": surplus(lengthen=True), "budget": metric("episodes"), "successes": metric("successes"),
    "mean return": metric("mean_return"), "mean length": metric("mean_length"), "sum of faults": metric("faults"),
}  # fmt: skip
