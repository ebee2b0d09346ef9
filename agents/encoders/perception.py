"""Frames to latents for one learner: the encoder, and a cache of the last frames."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor

from imagine_bench.errors import InvalidValueError, SetupError, require_known
from imagine_bench.interfaces import DEVICES, AgentContext, Frame

from ..networks.allocator import keep_freed_memory
from .encoder import Encoder

_CACHED = 2_000
"""Frames kept, 25 MB: those of test episodes, which begin alike at each budget, and those of the latest training."""


_OURS = (1, True, True)
_replaced: list[tuple[int, bool, bool]] = []


class Perception:
    """Encodes single frames; a frame that is both the end of one transition and the start of the next costs once."""

    def __init__(self, encoder: Encoder) -> None:
        self.encoder = encoder
        self._recent: OrderedDict[bytes, tuple[Tensor, Tensor]] = OrderedDict()

    @property
    def latent_size(self) -> int:
        """Z."""
        return self.encoder.latent_size

    def posterior(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of a frame's latents, each of shape (Z,)."""
        key = frame.tobytes()
        if key not in self._recent:
            mu, sigma = self.encoder.encode(frame[None])
            self._recent[key] = (mu[0], sigma[0])
            if len(self._recent) > _CACHED:
                self._recent.popitem(last=False)
        return self._recent[key]


def prepare_torch(device: str) -> torch.device:
    """Set torch up for small networks: one thread, freed memory kept, denormals flushed, convolutions that repeat.

    Denormals make Adam's moments 10 times slower on some processors.

    Raises:
        UnknownNameError: No such device name.
        SetupError: The machine has no such device.
    """
    require_known("device", device, DEVICES)
    if device == "cuda" and not torch.cuda.is_available():
        raise SetupError("Device 'cuda' was asked for, but torch finds no NVIDIA GPU here; use device 'cpu'.")
    found = _settings()
    if found != _OURS:
        _replaced.append(found)
        _set_up(*_OURS)
    keep_freed_memory()
    return torch.device(device)


def keep_torch() -> None:
    """Keep torch's present settings: :func:`restore_torch` will not undo the changes that were made before."""
    _replaced.clear()


def restore_torch() -> None:
    """Undo all changes of torch's settings that :func:`prepare_torch` has made since :func:`keep_torch`."""
    if _replaced:
        _set_up(*_replaced[0])
    _replaced.clear()


def _settings() -> tuple[int, bool, bool]:
    """Threads, whether denormals become 0, and whether convolutions repeat: torch's for the whole process."""
    flushed = torch.tensor(1e-323, dtype=torch.float64).item() == 0.0
    return torch.get_num_threads(), flushed, torch.backends.cudnn.deterministic


def _set_up(threads: int, flush: bool, deterministic: bool) -> None:
    torch.set_num_threads(threads)
    torch.set_flush_denormal(flush)
    torch.backends.cudnn.deterministic = deterministic


def load_perception(context: AgentContext) -> Perception:
    """The perception of an agent.

    Raises:
        InvalidValueError: The context names no encoder, or one that reads frames otherwise than the task declares.
    """
    if context.encoder is None:
        raise InvalidValueError("This agent sees latents; give it the path of an encoder.")
    encoder = Encoder.load(context.encoder, context.device)
    if encoder.card.preprocessing != context.preprocessing:
        reads = f"Encoder {context.encoder.name!r} reads frames as {encoder.card.preprocessing!r}"
        declared = f"the task declares {context.preprocessing!r}"
        raise InvalidValueError(f"{reads}, {declared}; choose an encoder of this task.")
    return Perception(encoder)
