"""The macrostate in a memory: a linear read-out for people, which no agent acts on or learns from.

It is fitted on replayed episodes. Its labels are the readings of the encoder's evaluation-only probe in their frames:
of each coordinate of the macrostate the value that was seen last, which is the truth as long as nothing changes unseen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from imagine_bench.agents.encoders.encoder import Encoder
from numpy.typing import NDArray
from torch import Tensor

from .sequences import Recurrence, SequenceMemory

_EPISODES = 300
"""The newest episodes that a read-out is fitted on."""
_RIDGE = 1e-2
NEVER_SEEN = -1


@dataclass(frozen=True)
class ReadOut:
    """Weights (H + 1, V) of the V values of all coordinates, one behind the other."""

    weights: Tensor
    sizes: tuple[int, ...]  #: numbers of values, 0 of a coordinate that was never seen. Length M.

    def __call__(self, memory: Tensor) -> NDArray[np.int64]:
        """The likeliest value of each coordinate in a memory (H,), :data:`NEVER_SEEN` where there is none. (M,)."""
        parts = (torch.cat([memory, memory.new_ones(1)]) @ self.weights).split(list(self.sizes))
        return np.array([int(part.argmax()) if len(part) else NEVER_SEEN for part in parts])


def last_seen(read: NDArray[np.int64], sizes: Sequence[int]) -> NDArray[np.int64]:
    """Of readings (T, M), the newest so far that is a value of each coordinate, else :data:`NEVER_SEEN`. (T, M)."""
    found = np.where(read < np.asarray(sizes), read, NEVER_SEEN)
    for now, then in pairwise(found):
        then[then == NEVER_SEEN] = now[then == NEVER_SEEN]
    return found


@torch.no_grad()
def fit(memory: SequenceMemory, recurrence: Recurrence, encoder: Encoder, sizes: Sequence[int]) -> ReadOut:
    """Ridge regression from memories to the values that were seen last, over the newest replayed episodes."""
    rows = memory.arrays()
    starts = np.flatnonzero(rows["step"] == 0)[-_EPISODES:]
    features = [recurrence.blank(0)]
    labels = [np.zeros((0, len(sizes)), dtype=np.int64)]
    for begin, end in pairwise([*starts, len(rows["step"])]):
        mu = torch.as_tensor(rows["mu"][begin:end], device=encoder.device)
        previous = torch.as_tensor(rows["before"][begin:end], device=encoder.device)
        features.append(recurrence(mu.unsqueeze(0), previous.unsqueeze(0), recurrence.blank(1))[0])
        labels.append(last_seen(encoder.read_macrostate(mu), sizes))
    x = torch.cat(features)
    y = np.concatenate(labels)
    x = torch.cat([x, torch.ones_like(x[:, :1])], dim=1)  # [N, H + 1]
    seen = tuple(size if (column != NEVER_SEEN).any() else 0 for size, column in zip(sizes, y.T, strict=True))
    parts = [np.arange(size) == column[:, None] for size, column in zip(seen, y.T, strict=True)]  # never seen: all 0
    wanted = torch.as_tensor(np.concatenate(parts, axis=1), dtype=x.dtype, device=x.device)  # [N, V]
    gram = x.T @ x + _RIDGE * torch.eye(x.shape[1], device=x.device)
    return ReadOut(torch.linalg.solve(gram, x.T @ wanted), seen)
