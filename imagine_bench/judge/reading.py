"""Macrostates read from images: an image equal to a rendered frame shows its macrostate, a reader reads the rest.

A reader is trained once for each world and kept in the user's cache, and a judgement's folder keeps the one it is of.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType
from typing import Protocol

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Frame, Images, Ints, Pixels, State
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import TaskSpec
from imagine_bench.rules import states_of
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders
from imagine_bench.store.files import (
    lock,
    make_folder,
    read_sealed,
    reading,
    sealed,
    sha256,
    write_bytes,
    write_json,
)

READER_FILE = "reader.safetensors"
_READER = "imagine_bench.agents.world_models.reader"
_READ = 1_000  # frames that a reader is measured on
_PATIENCE_S = 1_800.0  # seconds that a process waits while another makes the data or the reader


class ImageReader(Protocol):
    """A reader of images; see :mod:`imagine_bench.agents.world_models.reader`."""

    def read(self, pictures: Images) -> Ints:
        """Macrostates (N, M) of images (N, H, W) or (N, H, W, 3); -1 where one shows nothing of this world."""


def reader_errors(reader: ImageReader, spec: TaskSpec, appearance: str) -> dict[str, float]:
    """Error rates of a reader, on frames that it was not trained on and on images that show nothing of this world.

    Shares of real frames: ``misread``, taken for another macrostate, and ``refused``; the others are shares taken for
    an image of this world of black and gray fog, noise, and blends of two frames of different macrostates.
    """
    rng = SeedTree(1).child("encoder_probe", "judge", spec.id, appearance).generator()
    states = np.array(states_of(spec.rules), dtype=np.int64)
    macrostates, others = (states[rng.integers(len(states), size=_READ)] for _ in range(2))
    frames, blended = (spec.render_macrostates(each, appearance, rng) for each in (macrostates, others))
    differ = (macrostates != others).any(axis=1)
    of_nothing = {
        "black": np.zeros_like(frames[:1]),
        "gray": np.full_like(frames[:1], 128),
        "noise": rng.integers(0, 256, frames.shape, dtype=np.uint8),
        "blends": ((frames[differ].astype(np.uint16) + blended[differ]) // 2).astype(np.uint8),
    }
    read = reader.read(frames)
    refused = read[:, 0] < 0
    wrong = (read != macrostates).any(axis=1) & ~refused
    found = {"misread": float(wrong.mean()), "refused": float(refused.mean())}
    for name, images in of_nothing.items():
        found[f"{name}_read"] = float((reader.read(images)[:, 0] >= 0).mean())
    return found


class RenderedFrameIndex:
    """Frames that were rendered for one judgement, and the macrostate that each of them shows, to the pixel."""

    def __init__(self, spec: TaskSpec, appearance: str) -> None:
        self._spec = spec
        self._appearance = appearance
        self._shows: dict[bytes, State] = {}
        self._frames: dict[State, Frame] = {}

    def render(self, states: Sequence[State], rng: np.random.Generator, appearance: str | None = None) -> Frame:
        """A new frame of each of N macrostates, which is remembered. Shape (N, 64, 64, 3).

        ``appearance`` is another than that of the judgement.
        """
        frames = self._spec.render_macrostates(np.array(states, dtype=np.int64), appearance or self._appearance, rng)
        for frame, state in zip(frames, states, strict=True):
            self._shows[_key(frame)] = state
        return frames

    def frame(self, state: State) -> Frame:
        """One frame of a macrostate, always the same."""
        if state not in self._frames:
            rng = SeedTree(0).child("evaluation", "judge", "gallery", self._spec.id, *state).generator()
            self._frames[state] = self.render([state], rng)[0]
        return self._frames[state]

    def shows(self, image: Pixels) -> State | None:
        """The macrostate of an image that is a rendered frame to the pixel; None for any other."""
        return self._shows.get(_key(image))

    def read(self, images: Images, reader: ImageReader) -> Ints:
        """Macrostates (N, S, D, M) of images (N, S, D, ...); a reader reads those not rendered, equal ones once."""
        flat = images.reshape(-1, *images.shape[3:])
        keys = [_key(image) for image in flat]
        unknown = {key: row for row, key in enumerate(keys) if key not in self._shows}
        read = reader.read(flat[list(unknown.values())]).tolist() if unknown else []
        shown = dict(zip(unknown, map(tuple, read), strict=True))
        states = [self._shows.get(key) or shown[key] for key in keys]
        return np.array(states, dtype=np.int64).reshape(*images.shape[:3], -1)


def _key(image: Images) -> bytes:
    """A digest of an image (H, W, 3) or (H, W)."""
    return hashlib.sha256(f"{image.shape}".encode() + np.ascontiguousarray(image).tobytes()).digest()


def making(folder: Path) -> AbstractContextManager[None]:
    """Let one process at a time make the files that all cells of a folder share; the others wait and find it made."""
    return lock(folder / ".lock", f"The folder {folder}", patience_s=_PATIENCE_S)


def reader_in(spec: TaskSpec, appearance: str, folder: Path) -> ImageReader:
    """The reader of a folder; where there is none, that of the world from the user's cache."""
    path = folder / READER_FILE
    code = registry.load(_READER)
    with making(folder):
        if not path.exists():
            content, errors = _reader_of_world(spec, appearance, code)
            write_json(folder / "reader.json", errors)
            write_bytes(path, content)
    with reading(path, "the judge's reader; remove it, and the same command trains a new one"):
        return code.load_reader(spec, path)


def _reader_of_world(spec: TaskSpec, appearance: str, code: ModuleType) -> tuple[bytes, dict[str, float]]:
    """The reader of a world as a file, and its errors; trained and measured where the cache has none."""
    states = states_of(spec.rules)
    frames = spec.render_macrostates(np.array(states[:8]), appearance, np.random.default_rng(0)).tobytes()
    made_of = (spec.id, appearance, states, inspect.getsource(code))
    name = hashlib.sha256(repr(made_of).encode() + frames).hexdigest()[:12]
    path = make_folder(encoders.cache_folder() / "readers" / name) / READER_FILE
    card = path.with_name("reader.json")
    with making(path.parent):
        if not card.exists():
            print(f"The reader of images of {spec.id} is trained into {path.parent}, once: about a minute.", flush=True)
            reader = code.train_reader(spec, appearance)
            write_bytes(path, reader.content())
            errors = reader_errors(reader, spec, appearance)
            print(f"It misreads {errors['misread']:.1%} of new frames and reads nothing in {errors['refused']:.1%}.")
            write_json(card, sealed({"sha256": sha256(path), "errors": errors}))
        facts = read_sealed(card, "a reader's card")
        if sha256(path) != facts["sha256"]:
            raise ArtefactError(f"{path} is damaged; remove {path.parent}, and the same command trains it anew.")
        return path.read_bytes(), facts["errors"]
