"""The judge's reader of images: trained once for a world, kept whole, and refused in one sentence where it is not."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from fake_reader import BlindReader
from imagine_bench.agents.world_models.reader import images_of
from judged import labelled, shown

from imagine_bench import registry
from imagine_bench.arrays import Images, Ints
from imagine_bench.errors import ArtefactError
from imagine_bench.judge.reading import reader_errors, reader_in
from imagine_bench.store.files import make_folder


def test_judges_at_once_train_one_reader_of_a_world_and_see_it_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, trained = registry.task("pick_place"), []

    class Slow(BlindReader):
        def content(self) -> bytes:
            return b"whole"

    def train(*_: object) -> Slow:
        trained.append(threading.get_ident())
        time.sleep(0.2)
        return Slow(4)

    code = ModuleType("reader")
    vars(code).update(__file__=__file__, train_reader=train, load_reader=lambda spec, path: path.read_bytes())
    monkeypatch.setattr(registry, "load", lambda name: code)
    monkeypatch.setattr("imagine_bench.judge.reading.reader_errors", lambda *_: {"misread": 0.0, "refused": 0.0})
    monkeypatch.setenv("IMAGINE_BENCH_CACHE", str(tmp_path / "cache"))
    folders = [tmp_path / name for name in ("one", "one", "other")]
    for folder in folders:
        folder.mkdir(exist_ok=True)
    with ThreadPoolExecutor(3) as pool:
        jobs = [pool.submit(reader_in, spec, "clean", folder) for folder in folders]
    assert [job.result() for job in jobs] == [b"whole"] * 3
    assert len(trained) == 1, "the reader of a world serves every folder"
    (cached,) = (tmp_path / "cache").rglob("reader.safetensors")
    cached.write_bytes(b"other")
    with pytest.raises(ArtefactError, match=r"reader\.safetensors is damaged; remove .* trains it anew"):
        reader_in(spec, "clean", make_folder(tmp_path / "third"))


def test_a_half_written_reader_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "reader.safetensors").write_bytes(b"half")
    with pytest.raises(ArtefactError, match=r"reader\.safetensors is not the judge's reader; remove it, and the same"):
        reader_in(registry.task("pick_place"), "clean", tmp_path)


class FlawedReader:
    """Reads the labels of frames. Of every ten images it refuses some, and misreads one coordinate of the next ones."""

    def __init__(self, refused: int, misread: int) -> None:
        self.spec = labelled("arrow_puzzle")
        self._refused = refused
        self._misread = misread

    def read(self, pictures: Images) -> Ints:
        place = np.arange(len(pictures)) % 10
        read = np.array([shown(picture, self.spec) for picture in pictures]).clip(min=0)
        read[(place >= self._refused) & (place < self._refused + self._misread), -1] += 1
        read[place < self._refused] = -1
        return read


@pytest.mark.parametrize(("refused", "misread"), [(0, 0), (10, 0), (0, 10), (2, 1), (1, 3)])
def test_a_refused_frame_is_not_counted_as_misread(refused: int, misread: int) -> None:
    reader = FlawedReader(refused, misread)
    errors = reader_errors(reader, reader.spec, "clean")
    assert (errors["refused"], errors["misread"]) == pytest.approx((refused / 10, misread / 10))
    assert [errors[f"{name}_read"] for name in ("noise", "blends")] == pytest.approx([1 - refused / 10] * 2, abs=0.01)
    assert [errors[f"{name}_read"] for name in ("black", "gray")] == [float(refused == 0)] * 2


@pytest.mark.parametrize("size", [64, 80, 96, 128])
def test_an_image_of_any_size_is_read_by_the_means_of_its_pixels(size: int) -> None:
    """A checkerboard is gray, so no detail of one pixel decides."""
    checkers = np.indices((size, size)).sum(axis=0) % 2
    (read,) = images_of(checkers[None].astype(np.uint8) * 255)
    assert read.shape == (3, 32, 32)
    assert abs(read[:, 2:-2, 2:-2] - 0.5).max() < 0.2
