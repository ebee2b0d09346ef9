"""The training of an encoder as far as it has come, so that one that was killed goes on with the same bits."""

from __future__ import annotations

import os
import time
from pathlib import Path

import torch
from torch import Tensor

from imagine_bench.errors import ArtefactError

from .vae import Vae

_SAVE_EVERY_S = 60.0


class Unfinished:
    """What a file holds of a training: step, weights, optimiser, order of the images, generator and CPU seconds.

    Args:
        path: The file, of a few MB. Written once a minute; whoever finishes the training removes it.
        what: Words that only the same training has, such as its command and recipe.
        vae: Networks, optimiser and generator that are trained with; :meth:`restore` writes into them.
    """

    def __init__(
        self, path: Path, what: str, vae: Vae, optimiser: torch.optim.Optimizer, generator: torch.Generator
    ) -> None:
        self._path, self._what, self._vae, self._optimiser, self._generator = path, what, vae, optimiser, generator
        self._saved_s, self._begun_s = time.monotonic(), time.process_time()
        self.earlier_cpu_s = 0.0  #: spent before this process

    def restore(self) -> tuple[int, Tensor]:
        """The next gradient step and the images that wait for their turn, 0 and none where nothing was begun.

        Raises:
            ArtefactError: The file is damaged or of another training; it is left untouched.
        """
        if not self._path.exists():
            return 0, torch.empty(0, dtype=torch.int64)
        try:
            kept = torch.load(self._path, weights_only=True)
            if kept["what"] != self._what:
                raise ValueError("it is of another training")
            self._vae.load_state_dict(kept["vae"])
            self._optimiser.load_state_dict(kept["optimiser"])
            self._generator.set_state(kept["generator"])
            self.earlier_cpu_s = float(kept["cpu_s"])
            return int(kept["step"]), kept["order"]
        except Exception as error:  # a damaged file can be wrong in any way
            raise ArtefactError(f"{self._path} cannot be gone on with ({error}); remove it to begin anew.") from error

    def save(self, step: int, order: Tensor) -> None:
        """Keep what :meth:`restore` gives, whole or not at all; nothing within a minute of the last time."""
        if time.monotonic() - self._saved_s < _SAVE_EVERY_S:
            return
        kept = {
            "what": self._what, "step": step, "order": order, "vae": self._vae.state_dict(),
            "optimiser": self._optimiser.state_dict(), "generator": self._generator.get_state(),
            "cpu_s": self.earlier_cpu_s + time.process_time() - self._begun_s,
        }  # fmt: skip
        partial = self._path.with_name(f"{self._path.name}.partial")
        self._path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(kept, partial)
        os.replace(partial, self._path)
        self._saved_s = time.monotonic()
