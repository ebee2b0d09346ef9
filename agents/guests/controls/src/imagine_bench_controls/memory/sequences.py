"""Replay of sequences with stored memory and burn-in (Kapturowski et al. 2019, R2D2).

A state is the latents of a frame and the memory after it. Of each real transition, the memory before its frame is kept,
by the network of that time. A replayed sequence begins some macro-actions earlier, within the episode, so that the
network of today remembers them anew; no gradient goes there. Where these reach back to the start of the episode,
nothing stored is used. Shapes: ``B`` sequences of ``L`` transitions, ``K`` before them, ``Z``, ``H``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from imagine_bench.agents.replay import Batch, Posterior, RealMemory
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
        """The memory after each observation. Shape (B, T, H).

        Args:
            z: Latents. Shape (B, T, Z).
            previous: The macro-action before each, or :data:`START`. Shape (B, T).
            memory: The memory before the first. Shape (B, H).
        """
        return self.gru(torch.cat([z, self._one_hot[previous]], dim=-1), memory.unsqueeze(0))[0]

    def blank(self, count: int) -> Tensor:
        """The memory before an episode begins: none. Shape (count, H)."""
        return self._one_hot.new_zeros(count, self.units)


@dataclass(frozen=True, slots=True)
class Sequences:
    """Replayed sequences; rows of ``valid`` that are false are padding."""

    stored: Tensor  #: the memory before the burn-in. Shape (B, H).
    burned: Tensor  #: observations of the burn-in, which come first in the next two. Shape (B,), at most K.
    burn_z: Tensor  #: shape (B, K, Z)
    burn_previous: Tensor  #: macro-action before each. Shape (B, K).
    z: Tensor  #: latents of the sequence's observations. Shape (B, L + 1, Z).
    previous: Tensor  #: macro-action before each. Shape (B, L + 1).
    action: Tensor  #: shape (B, L)
    reward: Tensor  #: shape (B, L)
    terminated: Tensor  #: shape (B, L)
    valid: Tensor  #: whether the episode got so far. Shape (B, L), bool.

    def states(self, recurrence: Recurrence) -> Tensor:
        """Latents and the memory after each observation of the sequences. Shape (B, L + 1, Z + H)."""
        start = self.stored
        if self.burn_z.shape[1]:
            with torch.no_grad():
                burnt = recurrence(self.burn_z, self.burn_previous, start)
            last = burnt[torch.arange(len(burnt), device=burnt.device), (self.burned - 1).clamp_min(0)]
            start = torch.where((self.burned > 0).unsqueeze(1), last, start)
        return torch.cat([self.z, recurrence(self.z, self.previous, start)], dim=-1)

    def transitions(self, now: Tensor, then: Tensor) -> Batch:
        """The valid transitions between states, each (B, L + 1, Z + H): from those of ``now`` to those of ``then``."""
        valid = self.valid
        outcome = (column[valid] for column in (self.action, self.reward, self.terminated))
        action, reward, terminated = outcome
        return Batch(now[:, :-1][valid], action, reward, then[:, 1:][valid], terminated)


class SequenceMemory(RealMemory):
    """Transitions that happened, which can be replayed with their neighbours.

    ``recurrence`` gives the network that remembers now, ``burn_in`` is K.
    """

    def __init__(
        self,
        capacity: int,
        latent_size: int,
        device: torch.device,
        *,
        units: int,
        burn_in: int,
        recurrence: Callable[[], Recurrence],
    ) -> None:
        super().__init__(capacity, latent_size, device)
        self._recurrence = recurrence
        self._burn_in = burn_in
        self._columns |= {name: torch.zeros(capacity, dtype=torch.int64, device=device) for name in ("step", "before")}
        self._columns["stored"] = torch.zeros(capacity, units, device=device)

    def add_step(
        self,
        posterior: Posterior,
        action: int,
        reward: float,
        next_posterior: Posterior,
        terminated: bool,
        *,
        step: int,
        before: int,
        stored: Tensor,
    ) -> None:
        """Store transition ``step`` of an episode, which goes on from the one stored last unless that is 0.

        ``before`` is the macro-action before it, or :data:`START`; ``stored`` the memory of that time, shape (H,).
        """
        row = self.added % self.capacity
        columns = self._columns
        columns["step"][row] = step
        columns["before"][row] = before
        columns["stored"][row] = stored
        self.add(posterior, action, reward, next_posterior, terminated)

    def draw(
        self, count: int, length: int, generator: torch.Generator, *, spread: float = 1.0, balance: float = 0.0
    ) -> Sequences:
        """Sequences of at most ``length`` transitions that begin with drawn ones; see :meth:`RealMemory.sample`."""
        drawn = self._draw(count, generator, self._weights(balance) if balance else None)
        columns = self._columns
        step = drawn["step"]
        oldest = self.added - len(self)
        number = oldest + (drawn["rows"] - oldest) % self.capacity  # how many were stored before it
        burned = torch.minimum(step.clamp_max(self._burn_in), number - oldest)
        first = number - burned

        def rows(begin: Tensor, many: int) -> tuple[Tensor, Tensor]:
            numbers = begin.unsqueeze(1) + torch.arange(many, device=begin.device)
            return numbers.clamp_max(self.added - 1) % self.capacity, numbers < self.added

        early, _ = rows(first, int(burned.max()))
        late, there = rows(number, length)
        valid = there & (columns["step"][late] - torch.arange(length, device=step.device) == step.unsqueeze(1))
        longest = int(valid.sum(dim=1).max())
        late = late[:, :longest]
        valid = valid[:, :longest]
        mu = torch.cat([columns["mu"][early], drawn["mu"].unsqueeze(1), columns["next_mu"][late]], dim=1)
        sigma = torch.cat([columns["sigma"][early], drawn["sigma"].unsqueeze(1), columns["next_sigma"][late]], dim=1)
        noise = torch.empty(mu.shape, device=generator.device).normal_(generator=generator)
        z = torch.addcmul(mu, sigma, noise * spread)
        many = early.shape[1]
        return Sequences(
            stored=columns["stored"][first % self.capacity],
            burned=burned,
            burn_z=z[:, :many],
            burn_previous=columns["before"][early],
            z=z[:, many:],
            previous=torch.cat([drawn["before"].unsqueeze(1), columns["action"][late]], dim=1),
            action=columns["action"][late],
            reward=columns["reward"][late],
            terminated=columns["terminated"][late],
            valid=valid,
        )

    @torch.no_grad()
    def sample(self, count: int, generator: torch.Generator, *, spread: float = 1.0, balance: float = 0.0) -> Batch:
        """Draw transitions between states, with the present memory in them; see :meth:`RealMemory.sample`."""
        sequences = self.draw(count, 1, generator, spread=spread, balance=balance)
        states = sequences.states(self._recurrence())
        return sequences.transitions(states, states)
