"""Forges the results of a finished bench at random, and mends every digest that can be mended."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench.arrays import Arrays
from imagine_bench.protocols.data import digest
from imagine_bench.store.files import sealed, sha256
from imagine_bench.store.results import Checkpoint, KeptEpisodes
from imagine_bench.store.run_folder import load_newest, load_run, save_snapshot, write_metrics
from imagine_bench.values import pack

Forge = Callable[[Path, np.random.Generator], None]


def mend(run: Path) -> None:
    """Bring the digests of a run up to date."""
    done = json.loads((run / "DONE").read_text())
    done.pop("seal")
    names = [name for name in done["sha256"] if "/" not in name]
    names += [path.relative_to(run).as_posix() for path in run.glob("checkpoints/*/state.json")]
    done["sha256"] = {name: sha256(run / name) for name in names}
    (run / "DONE").write_text(json.dumps(sealed(done)))


def forged(honest: Path, root: Path, forge: Callable[[Path], object]) -> Path:
    """A copy of a bench that somebody has forged."""
    folder = root / honest.name
    shutil.copytree(honest, folder)
    forge(folder)
    return folder


def share_weights(folder: Path) -> None:
    one, other = (load_newest(folder / "table" / seed / "checkpoints") for seed in ("seed_0", "seed_1"))
    assert one is not None and other is not None
    save_snapshot(folder / "table" / "seed_1" / "checkpoints", dataclasses.replace(other, agent=one.agent))
    mend(folder / "table" / "seed_1")


def all_runs(bench: Path, agent: str = "*") -> list[Path]:
    return sorted(path.parent for path in bench.glob(f"{agent}/seed_*/DONE"))


def one_run(bench: Path, rng: np.random.Generator, agent: str = "*") -> Path:
    return rng.choice(all_runs(bench, agent))  # type: ignore[arg-type]


def rewrite(run: Path, rows: Sequence[Checkpoint], **values: Any) -> None:
    """Other rows, or other values, in a run's checkpoint, and metrics that say the same."""
    snapshot = load_newest(run / "checkpoints")
    assert snapshot is not None
    plain, arrays = pack(rows, "rows")
    kept = {name: array for name, array in snapshot.arrays.items() if not name.startswith("rows/")}
    told = {**snapshot.values, "rows": plain, **values}
    save_snapshot(run / "checkpoints", dataclasses.replace(snapshot, arrays=kept | arrays, values=told))
    write_metrics(run, rows)
    mend(run)


def with_episodes(row: Checkpoint, arrays: Arrays) -> Checkpoint:
    """A row with other test episodes, and figures that follow from them."""
    return dataclasses.replace(
        row,
        kept=KeptEpisodes(**arrays),
        successes=int(arrays["success"].sum()),
        solved="".join("01"[int(each)] for each in arrays["success"]),
        mean_return=float(arrays["returns"].mean()),
        mean_length=float(arrays["lengths"].mean()),
        faults=int(arrays["faults"].sum()),
    )


def in_episodes(name: str, change: Callable[[Arrays, np.random.Generator], None]) -> Forge:
    """Change an array of the kept episodes, and metrics that say the same."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        changed = False
        while not changed:
            run = one_run(bench, rng)
            rows = list(load_run(run).checkpoints)
            index = int(rng.integers(len(rows)))
            before = vars(rows[index].kept)
            arrays = {each: array.copy() for each, array in before.items()}
            change(arrays, rng)
            changed = not np.array_equal(before[name], arrays[name])
        rows[index] = with_episodes(rows[index], arrays)
        rewrite(run, rows)

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


def metric(name: str, everywhere: bool = True) -> Forge:
    """One more of a figure of a test, in the table alone or in the checkpoint too."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        run = one_run(bench, rng)
        rows = list(load_run(run).checkpoints)
        index = int(rng.integers(len(rows)))
        rows[index] = dataclasses.replace(rows[index], **{name: getattr(rows[index], name) + 1})
        if everywhere:
            rewrite(run, rows)
        else:
            write_metrics(run, rows)
            mend(run)

    return forge


def surplus(lengthen: bool) -> Forge:
    """An action behind those of the last episode of the last test; it says so itself, or belongs to none."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        run = one_run(bench, rng)
        *rows, last = load_run(run).checkpoints
        arrays = {name: array.copy() for name, array in vars(last.kept).items()}
        arrays["actions"] = np.append(arrays["actions"], arrays["actions"][-1:])
        arrays["lengths"][-1] += int(lengthen)
        rewrite(run, [*rows, with_episodes(last, arrays)])

    return forge


def change_checkpoint(run: Path, change: Callable[[dict[str, Any], Arrays], None]) -> None:
    """Change the values and arrays of a run's checkpoint, and bring all digests up to date."""
    snapshot = load_newest(run / "checkpoints")
    assert snapshot is not None
    values = json.loads(json.dumps(snapshot.values))
    arrays = {name: array.copy() for name, array in snapshot.arrays.items()}
    change(values, arrays)
    save_snapshot(run / "checkpoints", dataclasses.replace(snapshot, arrays=arrays, values=values))
    mend(run)


def in_training(name: str) -> Forge:
    """One more somewhere in an array of the training episodes, or another number in a list of them."""

    def change(values: dict[str, Any], arrays: Arrays, rng: np.random.Generator) -> None:
        if name in values:
            index = int(rng.integers(len(values[name])))
            values[name][index] = 1 - values[name][index]
        else:
            array = arrays[name]
            index = int(rng.integers(array.size))
            array.flat[index] = not array.flat[index] if array.dtype == bool else (array.flat[index] + 1) % 6

    return in_checkpoint(change)


def in_checkpoint(change: Callable[[dict[str, Any], Arrays, np.random.Generator], None]) -> Forge:
    """Change the checkpoint of a learner."""

    def forge(bench: Path, rng: np.random.Generator) -> None:
        run = one_run(bench, rng, "table")
        change_checkpoint(run, lambda values, arrays: change(values, arrays, rng))

    return forge


def no_digests(bench: Path, rng: np.random.Generator) -> None:
    (one_run(bench, rng) / "DONE").write_text(json.dumps(sealed({"format": "imagine_bench run 3", "sha256": {}})))


def tried(values: dict[str, Any], arrays: Arrays, rng: np.random.Generator) -> None:
    """A macro-action was tried an episode later than it was."""
    del arrays
    values["tried"][str(rng.choice(list(values["tried"])))] += 1


def exchanged_lengths(values: dict[str, Any], arrays: Arrays, rng: np.random.Generator) -> None:
    """Two training episodes before the first test exchange their lengths, so that every sum of them stays."""
    del arrays, rng
    length = values["length"]
    early = range(values["rows"][0]["episodes"])
    other = next(each for each in early if length[each] != length[0])
    length[0], length[other] = length[other], length[0]


def without(beginning: str) -> Forge:
    """The arrays of a learner's checkpoint whose names begin so are deleted, though its format says they are kept."""

    def change(values: dict[str, Any], arrays: Arrays, rng: np.random.Generator) -> None:
        del values, rng
        for name in [name for name in arrays if name.startswith(beginning)]:
            del arrays[name]

    return in_checkpoint(change)


def protocol_of(bench: Path) -> dict[str, Any]:
    return dict(json.loads((bench / "protocol.json").read_text()))


def rewrite_config(run: Path, **values: Any) -> None:
    """Other values in what a run says of itself."""
    config = json.loads((run / "config.json").read_text()) | values
    config.pop("seal")
    (run / "config.json").write_text(json.dumps(sealed(config)))
    mend(run)


def rewrite_protocol(bench: Path, **values: Any) -> Path:
    """Other values in every copy of a bench's protocol, and in its hash; returns where the bench lies then."""
    protocol = protocol_of(bench) | values
    (bench / "protocol.json").write_text(json.dumps(protocol))
    for run in all_runs(bench):
        rewrite_config(run, protocol=protocol, protocol_hash=digest(protocol))
    return bench.rename(bench.with_name(f"{protocol['preset']}-{digest(protocol)}"))


def seed(bench: Path, rng: np.random.Generator) -> None:
    """A run is of another seed, here alone or in everything that names it, the protocol and its hash included."""
    other, run = int(rng.integers(1, 99)), one_run(bench, rng)
    runs = [run] if rng.random() < 0.5 else all_runs(bench)
    for each in runs:
        rewrite_config(each, seed=other)
    if len(runs) == len(all_runs(bench)):
        for each in runs:
            each.rename(each.with_name(f"seed_{other}"))
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
    run = one_run(bench, rng)
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
    "table of a run": metric("mean_length", everywhere=False), "no digests": no_digests,
}  # fmt: skip
IN_TRAINING: dict[str, Forge] = {
    "training steps": metric("env_steps"), "training start": in_training("training/starts"),
    "training action": in_training("training/actions"),
    "training success": in_training("success"), "training kept success": in_training("training/success"),
    "training length": in_training("length"), "training faults": in_training("training/faults"),
    "training return": in_training("training/returns"), "simulated time": in_training("training/sim_times_s"),
    "exchanged lengths": in_checkpoint(exchanged_lengths),
    "nothing": without("training/"), "no simulated time": without("training/sim_times_s"),
    "no simulated time of tests": without("rows/0/kept/sim_times_s"), "tried": in_checkpoint(tried),
}  # fmt: skip
