"""A dataset's folder: the episodes in one of three formats, a card, and files apart that no learner is given."""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.appearance import appearance_typed
from imagine_bench.arrays import Array, Arrays, Ints, content_hash
from imagine_bench.errors import ArtefactError, InvalidValueError, require_known, writing
from imagine_bench.interfaces import TaskSpec
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.store.files import (
    make_folder,
    read_arrays,
    read_sealed,
    sealed,
    write_arrays,
    write_bytes,
    write_json,
)
from imagine_bench.values import Json

FORMATS = {name: f"imagine_bench.data.{name}" for name in ("npz", "lerobot", "minari")}
"""Modules of ``write`` and ``read``, none of which is imported before it is needed."""
_MARKS = {
    "episodes.npz": "npz",
    "meta/info.json": "lerobot",
    "data/metadata.json": "minari",
    "*/data/metadata.json": "minari",
}
"""Files by which formats are known; their modules read from there."""
CARD = "card.json"
"""The facts of a dataset for programs, in its folder."""
_README = "README.md"
_SHOWN = ("task", "policy", "episodes", "transitions", "successes", "mean_return", "execution", "appearance", "seed")
"""Facts of the card that the page for readers shows, too."""
Apart = Mapping[str, Mapping[str, Array]]
"""Named arrays that no learner is given, by the file they are in."""


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """A dataset as it was read."""

    folder: Path  #: Where it lies
    format: str  #: One of :data:`FORMATS`
    episodes: Episodes  #: The episodes in it
    card: Mapping[str, Any] | None  #: Its description, as :func:`.collect.collect` says; None for one of others

    @property
    def identity(self) -> str:
        """Its identity in a protocol: policy, episodes, and 12 digits of its content's hash; no format."""
        policy = "foreign" if self.card is None else self.card["policy"]
        return f"{policy}-{len(self.episodes)}@{self.episodes.hash[:12]}"


def write_dataset(folder: Path, episodes: Episodes, apart: Apart, card: Mapping[str, Json], format: str) -> Dataset:
    """Write a dataset into a new folder, whole or not at all.

    A killed writer leaves a hidden folder ``.<name>.<8 hex digits>.partial``, which no later one reads or removes.

    Raises:
        UnknownNameError: An unknown format.
        SetupError: The library that the format needs is not installed, or the folder cannot be written.
        InvalidValueError: The folder exists.
    """
    with new_folder(folder, format) as partial:
        registry.load(FORMATS[format]).write(partial, episodes, card)
        whole = write_card(partial, {**card, "format": format, "content": episodes.hash}, apart)
    return Dataset(folder=folder, format=format, episodes=episodes, card=whole)


@contextmanager
def new_folder(folder: Path, format: str) -> Iterator[Path]:
    """A hidden folder, which gets the name of ``folder`` if the block ends well and vanishes if not.

    Raises as :func:`write_dataset`.
    """
    require_format(format)
    require_new(folder)
    make_folder(folder.parent)
    partial = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.partial")
    try:
        with writing(folder):
            partial.mkdir()  # a new folder, so that nothing a killed writer or anybody else left is in the dataset
            yield partial
            partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_card(folder: Path, card: Mapping[str, Json], apart: Apart) -> dict[str, Json]:
    """Write the files apart, the card with their digests, and the page for readers. Returns the card."""
    whole = {**card, "apart": {name: content_hash(arrays) for name, arrays in apart.items()}}
    for name, arrays in apart.items():
        write_arrays(folder / f"{name}.npz", arrays)
    write_json(folder / CARD, sealed(whole))
    write_bytes(folder / _README, _readme(whole).encode())
    return whole


def _readme(card: Mapping[str, Json]) -> str:
    """The page of a dataset for readers. Its head, in YAML, is as LeRobot and the Hugging Face hub expect it."""
    format = card["format"]
    head: dict[str, Json] = {
        "license": "apache-2.0",
        "task_categories": ["robotics", "reinforcement-learning"],
        "tags": ["imagine_bench", "LeRobot" if format == "lerobot" else format],
    }
    if format == "lerobot":
        head["configs"] = [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    yaml = "\n".join(f"{name}: {json.dumps(value)}" for name, value in head.items())
    known = {name: card[name] for name in _SHOWN if name in card}
    if "appearance" in known:
        known["appearance"] = appearance_typed(str(known["appearance"]))
    facts = "\n".join(f"| {name.replace('_', ' ')} | {value} |" for name, value in known.items())
    return f"""---
{yaml}
---

# Episodes of {card.get("task", "a task")}

{card.get("description", "")}

| fact | value |
|---|---|
{facts}

Made with imagine_bench: `{card.get("command", "")}`. `{CARD}` has all facts and the digest of the episodes.
`imagine_bench.data.folder.read_dataset(folder)` reads and checks them.
"""


def require_format(format: str) -> None:
    """Raise UnknownNameError for an unknown format, or SetupError where the library that it needs is not installed."""
    registry.load(FORMATS[require_known("format", format, FORMATS)])


def require_new(folder: Path) -> None:
    """Raise InvalidValueError for a folder that exists."""
    if folder.exists():
        raise InvalidValueError(f"{folder} exists; give another folder with --out. Nothing was written.")


def read_dataset(folder: Path) -> Dataset:
    """Read a dataset, all that is in it but the files apart, and check it against its card if it has one.

    Raises:
        ArtefactError: There is none, or several, a file is damaged, or the content differs from the card.
        SetupError: The library that its format needs is not installed.
    """
    card = read_card(folder)
    if card is not None and "control" in card:
        raise InvalidValueError(f"{folder} has hand commands, no macro-actions; give a dataset of these.")
    found = [(name, path) for mark, name in _MARKS.items() for path in sorted(folder.glob(mark))]
    if not found:
        marks = ", ".join(f"{mark} ({name})" for mark, name in _MARKS.items())
        raise ArtefactError(f"{folder} is no dataset; give a folder with {marks}.")
    if len(found) > 1:
        places = ", ".join(str(path.relative_to(folder)) for _, path in found)
        raise ArtefactError(f"{folder} holds {len(found)} datasets ({places}); give the folder of one.")
    ((format, path),) = found
    episodes = registry.load(FORMATS[format]).read(path)
    if card is not None and card.get("content") != episodes.hash:
        raise ArtefactError(f"{folder} is damaged: its episodes are not those of its card. It was left untouched.")
    return Dataset(folder=folder, format=format, episodes=episodes, card=card)


def read_card(folder: Path) -> dict[str, Any] | None:
    """The card of a folder, None where there is none. Raises ArtefactError: it is damaged."""
    return read_sealed(folder / CARD, "a dataset's card") if (folder / CARD).exists() else None


def read_apart(dataset: Dataset) -> dict[str, Arrays]:
    """Arrays that no learner is given, by file, such as ``privileged``: ``macrostates`` (N + E, M) and ``seeds`` (E,).

    Raises ArtefactError: a file is missing or damaged.
    """
    return read_files(dataset.folder, dataset.card or {})


def macrostates_of(dataset: Dataset) -> Ints:
    """The macrostate of every frame, which no learner is given. Shape (N + E, M). Raises as :func:`read_apart`."""
    return read_apart(dataset)["privileged"]["macrostates"]


def read_files(folder: Path, card: Mapping[str, Any]) -> dict[str, Arrays]:
    """The files apart that a card names. Raises as :func:`read_apart`."""
    found = {}
    for name, digest in card.get("apart", {}).items():
        path = folder / f"{name}.npz"
        found[name] = read_arrays(path, "a part of a dataset")
        if content_hash(found[name]) != digest:
            raise ArtefactError(f"{path} differs from the card. It was left untouched.")
    return found


def require_fits(dataset: Dataset, spec: TaskSpec, appearance: str) -> None:
    """Raise InvalidValueError for a dataset of another task, or of frames that an encoder does not expect.

    The card names the task. Without a card only the number of actions is checked.
    """
    task = None if dataset.card is None else dataset.card.get("task")
    if task not in (None, spec.id) or dataset.episodes.n_actions != spec.n_actions:
        given = f"{dataset.episodes.n_actions} macro-actions"
        wanted = f"{spec.id}, which has {spec.n_actions}"
        raise InvalidValueError(f"{dataset.folder} is of {task or 'a task'} with {given}; give one of {wanted}.")
    looks = appearance if dataset.card is None else dataset.card.get("appearance")
    if looks != appearance:
        has, asked = (appearance_typed(str(each)) for each in (looks, appearance))
        how = f"--appearance {has}, and --test-appearance for tests at another"
        raise InvalidValueError(f"{dataset.folder} has frames of appearance {has}, not {asked}; give {how}.")
