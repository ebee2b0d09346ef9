"""A reader that reads nothing: frames that the judge rendered itself are known to the pixel anyway."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import TaskSpec

NO_ERRORS = dict.fromkeys(("misread", "refused", "black_read", "gray_read", "noise_read", "blends_read"), 0.0)
"""The errors that a reader's card names, as if there were none."""


class BlindReader:
    def __init__(self, coordinates: int) -> None:
        self.coordinates, self.asked = coordinates, 0

    def read(self, pictures: NDArray[Any]) -> NDArray[np.int64]:
        self.asked += len(pictures)
        return np.full((len(pictures), self.coordinates), -1)


def read_nothing(spec: TaskSpec, appearance: str, folder: Path) -> BlindReader:
    """In place of a trained reader of a judgement's folder: one that costs nothing."""
    del appearance
    (folder / "reader.json").write_text(json.dumps(NO_ERRORS))
    return BlindReader(len(spec.macrostate_names))
