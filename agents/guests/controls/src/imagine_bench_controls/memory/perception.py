"""States for a controller that has no memory of its own: the latents of a frame and the memory after it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from imagine_bench.agents.encoders.encoder import Encoder
from imagine_bench.agents.encoders.perception import Perception
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.interfaces import Frame

from .sequences import START, Recurrence


class StateEncoder(Encoder):
    """An encoder whose latents (N, Z + H) are followed by the memory after a first frame."""

    def __init__(self, encoder: Encoder, units: int, recurrence: Callable[[], Recurrence]) -> None:
        # everything is done by the encoder that is given
        self.card = encoder.card
        self.device = encoder.device
        self.latent_size = encoder.latent_size + units
        self._encoder = encoder
        self._recurrence = recurrence

    @torch.no_grad()
    def encode(self, frames: Frame) -> tuple[Tensor, Tensor]:
        """Means and standard deviations of the states that lone frames are taken for; the memory is certain."""
        return self.remembering(*self._encoder.encode(frames))

    @torch.no_grad()
    def remembering(self, mu: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
        """The same from their posteriors (N, Z)."""
        recurrence = self._recurrence()
        blank = recurrence.blank(len(mu))
        first = torch.full((len(mu), 1), START, device=mu.device)
        memory = recurrence(mu.unsqueeze(1), first, blank)[:, 0]
        return torch.cat([mu, memory], dim=-1), torch.cat([sigma, torch.zeros_like(memory)], dim=-1)

    def decode(self, latents: Tensor) -> NDArray[np.float32]:
        """Images of states (N, Z + H), as the encoder's."""
        return self._encoder.decode(latents[:, : self._encoder.latent_size])

    def read_macrostate(self, latents: Tensor) -> NDArray[np.int64]:
        """The probe's reading of the latents of states (N, Z + H). Shape (N, M)."""
        return self._encoder.read_macrostate(latents[:, : self._encoder.latent_size])


class Remembering(Perception):
    """States of single frames, and of the last of an episode so far."""

    encoder: StateEncoder

    def __init__(self, plain: Perception, units: int, recurrence: Callable[[], Recurrence]) -> None:
        super().__init__(StateEncoder(plain.encoder, units, recurrence))
        self.plain = plain
        self._recurrence = recurrence

    def posterior(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the state of a lone frame, each of shape (Z + H,)."""
        mu, sigma = self.plain.posterior(frame)
        states = self.encoder.remembering(mu.unsqueeze(0), sigma.unsqueeze(0))
        return states[0][0], states[1][0]

    @torch.no_grad()
    def recall(self, frames: Sequence[Frame], actions: Sequence[int]) -> tuple[Tensor, Tensor]:
        """The mean state after the frames of an episode so far (Z + H,), and the memory before the last (H,).

        ``actions`` are the macro-actions between them.
        """
        z = torch.stack([self.plain.posterior(frame)[0] for frame in frames]).unsqueeze(0)  # [1, T, Z]
        recurrence = self._recurrence()
        previous = torch.tensor([[START, *actions]], device=z.device)
        blank = recurrence.blank(1)
        memory = recurrence(z, previous, blank)[0]  # [T, H]
        return torch.cat([z[0, -1], memory[-1]]), memory[-2] if len(memory) > 1 else blank[0]
