"""The training of an encoder as far as it has come, so that one that was killed goes on with the same bits."""

from __future__ import annotations

import io
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from imagine_bench.errors import ArtefactError

Kept = dict[str, Any]
"""Numbers, tensors and states of optimisers, as torch saves them."""
_SAVE_EVERY_S = 60.0


class Unfinished:
    """Keeps a training in a file, three times as large as its weights; ``what`` names the training uniquely."""

    def __init__(self, path: Path, what: str) -> None:
        self._path = path
        self._what = what
        self._saved_s = time.monotonic()

    def load(self) -> Kept | None:
        """Return the kept state, or None. Raises ArtefactError if the file is damaged or of another training."""
        if not self._path.exists():
            return None
        try:
            what, kept = torch.load(self._path, weights_only=True)
        except Exception as error:  # a damaged file can be wrong in any way
            raise ArtefactError(f"{self._path} is damaged; remove it to begin anew.") from error
        if what != self._what:
            raise ArtefactError(f"{self._path} is of another training; remove it or choose another folder.")
        return dict(kept)

    def save(self, kept: Callable[[], Kept]) -> None:
        """Write the state atomically; within a minute of the last time this does nothing and ``kept`` is not called."""
        if time.monotonic() - self._saved_s < _SAVE_EVERY_S:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        partial = self._path.with_name(f"{self._path.name}.partial")
        content = io.BytesIO()
        torch.save((self._what, kept()), content)  # to a full disk torch itself would end in an error of its own
        with partial.open("wb") as stream:
            stream.write(content.getbuffer())
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, self._path)
        self._saved_s = time.monotonic()
