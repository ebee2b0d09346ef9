"""The memories of algorithm 1, real and imagined, of different kinds and never one buffer (thesis 5.2.2).

The real memory keeps the encoder's output, mean and standard deviation, and draws ``z ~ N(mu, sigma)`` anew
for every batch; the imagined memory keeps imagined latents and is short, since recent imagination is the better one.
A row is one transition with both its ends, so no batch ever pairs states of two episodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.errors import InvalidValueError

Posterior = tuple[Tensor, Tensor]
"""Mean and standard deviation of latents."""


@dataclass(frozen=True, slots=True)
class Batch:
    """B transitions between latents ``z`` and ``next_z`` (B, Z) by ``action`` (B,), int64, with ``reward`` (B,).

    ``terminated`` (B,) is 1 where the episode ended in a terminal state, else 0; truncation is 0. ``weight`` (B,) is
    the weight of their errors, at most 1; of prioritised draws ``rows`` (B,), int64, are where the memory holds them.
    """

    z: Tensor
    action: Tensor
    reward: Tensor
    next_z: Tensor
    terminated: Tensor
    rows: Tensor | None = None
    weight: Tensor | None = None

    def split(self, size: int) -> list[Batch]:
        """Batches of ``size`` transitions each, one behind another."""
        return [Batch(*parts) for parts in zip(*(column.split(size) for column in self._columns()), strict=True)]

    def where(self, chosen: Tensor) -> Batch:
        """The transitions that a mask (B,) chooses, with their weights."""
        weight = None if self.weight is None else self.weight[chosen]
        return replace(Batch(*(column[chosen] for column in self._columns())), weight=weight)

    def _columns(self) -> tuple[Tensor, ...]:
        return self.z, self.action, self.reward, self.next_z, self.terminated


class Ring:
    """Named columns of a fixed number of rows, the capacity; a full ring overwrites its oldest ones."""

    _latents: tuple[str, ...]
    _has_outcomes = True

    def __init__(self, capacity: int, latent_size: int, device: torch.device) -> None:
        self.capacity = capacity
        self.added = 0
        self._columns = {name: torch.zeros(capacity, latent_size, device=device) for name in self._latents}
        if self._has_outcomes:
            self._columns["action"] = torch.zeros(capacity, dtype=torch.int64, device=device)
            self._columns |= {name: torch.zeros(capacity, device=device) for name in ("reward", "terminated")}

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def clear(self) -> None:
        """Forget all rows."""
        self.added = 0

    def _put(self, **row: Tensor | float) -> None:
        """Store one row by column, in place of the oldest."""
        for name, value in row.items():
            self._columns[name][self.added % self.capacity] = value
        self.added += 1

    def _draw(self, count: int, generator: torch.Generator, weights: Tensor | None = None) -> dict[str, Tensor]:
        if self.added == 0:
            raise InvalidValueError("The memory is empty; store a transition before sampling from it.")
        if weights is None:
            index = torch.randint(len(self), (count,), generator=generator, device=generator.device)
        else:
            index = torch.multinomial(weights, count, replacement=True, generator=generator)
        return {"rows": index, **{name: column.index_select(0, index) for name, column in self._columns.items()}}

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Copies of the filled rows, by column."""
        return {name: column[: len(self)].cpu().numpy().copy() for name, column in self._columns.items()}

    def load(self, arrays: dict[str, NDArray[np.generic]], added: int) -> None:
        """Take up the rows of :meth:`arrays` and the number of rows ever added."""
        for name, column in self._columns.items():
            column[: len(arrays[name])] = torch.as_tensor(arrays[name]).to(column.device)
        self.added = added


class RealMemory(Ring):
    """Transitions that happened, as posteriors of their latents; with ``prioritised``, each with its latest error."""

    _latents = ("mu", "sigma", "next_mu", "next_sigma")

    def __init__(self, capacity: int, latent_size: int, device: torch.device, *, prioritised: bool = False) -> None:
        super().__init__(capacity, latent_size, device)
        if prioritised:
            self._columns["error"] = torch.zeros(capacity, device=device)

    def add(
        self, posterior: Posterior, action: int, reward: float, next_posterior: Posterior, terminated: bool
    ) -> None:
        """Store one transition between posteriors (mu, sigma), each of shape (Z,)."""
        mu, sigma = posterior
        next_mu, next_sigma = next_posterior
        row = {"mu": mu, "sigma": sigma, "next_mu": next_mu, "next_sigma": next_sigma}
        if "error" in self._columns:  # transitions that were never replayed come first
            row["error"] = self._columns["error"][: len(self)].max() if len(self) else torch.ones(())
        self._put(**row, action=action, reward=reward, terminated=float(terminated))

    def sample(self, count: int, generator: torch.Generator, *, spread: float = 1.0, balance: float = 0.0) -> Batch:
        """Draw transitions with replacement, and latents with ``spread`` times their posteriors' standard deviation.

        A transition's probability is proportional to n ** -balance, with n the number of those of the same reward and
        end: 0 makes all transitions equally likely, 1 all outcomes.
        """
        return self._batch(self._draw(count, generator, self._weights(balance) if balance else None), generator, spread)

    def sample_prioritised(
        self, count: int, generator: torch.Generator, *, exponent: float, correction: float
    ) -> Batch:
        """Draw transitions in proportion to error ** exponent, with the weights that correct for it.

        Proportional prioritised replay (Schaul et al. 2016): weight = (N P) ** -correction, over the largest drawn.
        """
        shares = self._columns["error"][: len(self)] ** exponent
        rows = self._draw(count, generator, shares)
        weight = shares[rows["rows"]] ** -correction
        return replace(self._batch(rows, generator, 1.0), rows=rows["rows"], weight=weight / weight.max())

    def prioritise(self, rows: Tensor, errors: Tensor) -> None:
        """Keep the latest Bellman errors (B,) of some rows (B,), at least a millionth so that all can be drawn."""
        self._columns["error"][rows] = errors.abs().clamp(min=1e-6)

    @staticmethod
    def _batch(rows: dict[str, Tensor], generator: torch.Generator, spread: float) -> Batch:
        noise = torch.empty(2, *rows["mu"].shape, device=generator.device).normal_(generator=generator) * spread
        z = torch.addcmul(rows["mu"], rows["sigma"], noise[0])
        next_z = torch.addcmul(rows["next_mu"], rows["next_sigma"], noise[1])
        return Batch(z, rows["action"], rows["reward"], next_z, rows["terminated"])

    def _weights(self, balance: float) -> Tensor:
        """Unnormalised probabilities of the filled rows. Shape (N,)."""
        rewards, ends = (self._columns[name][: len(self)] for name in ("reward", "terminated"))
        weights = torch.empty_like(rewards)
        for end in (0.0, 1.0):  # unique pairs in one call would be forty times slower
            rows = ends == end
            _, which, counts = rewards[rows].unique(return_inverse=True, return_counts=True)
            weights[rows] = counts[which].float() ** -balance
        return weights


class StartMemory(Ring):
    """Posteriors of the latents that real episodes began with."""

    _latents = ("mu", "sigma")
    _has_outcomes = False

    def add(self, posterior: Posterior) -> None:
        """Store the posterior (mu, sigma) of one start, each of shape (Z,)."""
        mu, sigma = posterior
        self._put(mu=mu, sigma=sigma)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw starts with replacement, and latents from their posteriors. Shape (count, Z)."""
        rows = self._draw(count, generator)
        noise = torch.empty(rows["mu"].shape, device=generator.device).normal_(generator=generator)
        return torch.addcmul(rows["mu"], rows["sigma"], noise)


class ImaginedMemory(Ring):
    """Transitions that were imagined; with ``weighted``, each with the weight of its error."""

    _latents = ("z", "next_z")

    def __init__(self, capacity: int, latent_size: int, device: torch.device, *, weighted: bool = False) -> None:
        super().__init__(capacity, latent_size, device)
        if weighted:
            self._columns["weight"] = torch.zeros(capacity, device=device)

    def add(self, batch: Batch) -> None:
        """Store every transition of a batch."""
        end = self.added + len(batch.z)
        kept = min(len(batch.z), self.capacity)
        index = torch.arange(end - kept, end, device=self._columns["z"].device) % self.capacity
        for name, column in self._columns.items():
            column[index] = getattr(batch, name)[-kept:]
        self.added = end

    def sample(self, count: int, generator: torch.Generator) -> Batch:
        """Draw transitions with replacement."""
        drawn = self._draw(count, generator)
        return Batch(**{name: drawn[name] for name in self._columns})


Transitions = RealMemory | ImaginedMemory
"""Memories that give batches to learn values from."""
