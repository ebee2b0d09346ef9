"""What is remembered of an episode: a GRU over the latents of its frames and the macro-actions between them.

Shapes: ``B`` sequences, ``T`` observations, ``Z`` latents, ``H`` units.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

START = -1
"""Stands for the macro-action before the first frame of an episode."""


class Recurrence(nn.Module):
    """A gated recurrent unit (Cho et al. 2014); the generator draws its weights, and its device is theirs."""

    def __init__(self, latent_size: int, n_actions: int, units: int, generator: torch.Generator) -> None:
        super().__init__()
        self.units = units
        device = generator.device
        with torch.device("meta"):  # torch would draw weights from its global generator
            gru = nn.GRU(latent_size + n_actions, units, batch_first=True)
        self.gru = gru.to_empty(device=device)
        with torch.no_grad():
            for weight in self.gru.parameters():
                weight.uniform_(-(units**-0.5), units**-0.5, generator=generator)
        self._one_hot = torch.eye(n_actions + 1, n_actions, device=device)  # the last row, START, is zero

    def forward(self, z: Tensor, previous: Tensor, memory: Tensor) -> Tensor:
        """What is remembered after each observation. Shape (B, T, H).

        Args:
            z: Latents. Shape (B, T, Z).
            previous: The macro-action before each, or :data:`START`. Shape (B, T).
            memory: What was remembered before the first. Shape (B, H).
        """
        return self.gru(torch.cat([z, self._one_hot[previous]], dim=-1), memory.unsqueeze(0))[0]

    def blank(self, count: int) -> Tensor:
        """What is remembered before an episode begins: nothing. Shape (count, H)."""
        return self._one_hot.new_zeros(count, self.units)
