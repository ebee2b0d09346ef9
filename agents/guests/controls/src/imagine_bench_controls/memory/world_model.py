"""The recurrent world model of the agent with memory (MDN-RNN, Ha and Schmidhuber 2018): it reads a whole history."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from imagine_bench.agents.encoders.perception import load_perception, prepare_torch
from imagine_bench.agents.replay import Batch
from imagine_bench.agents.world_models import latent
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.interfaces import AgentContext, Arrays, Frame
from imagine_bench.interfaces.episodes import Episodes

from .imagination import RecurrentImagination
from .sequences import START, SequenceMemory
from .settings import IMAGINATION_MEMORY, RecurrentSettings


class RecurrentLatentModel(latent.LatentModel):
    """Encoder, recurrent environment model and decoder as a world model."""

    settings: RecurrentSettings
    imagination: RecurrentImagination

    def new_imagination(self, context: AgentContext) -> RecurrentImagination:
        """The model that imagines, of which nothing is learned yet."""
        size = self.encoder.latent_size + self.settings.recurrence.units
        device = self.encoder.device
        return RecurrentImagination(
            size, context.n_actions, self.settings, filtered=True, seeds=context.seeds, device=device
        )

    def batches(self, columns: Arrays, dataset: Episodes, generator: torch.Generator) -> Iterator[Batch]:
        """Batches of sequences, each with all that came before it in its episode."""
        model = self.settings.model
        rows = len(columns["action"])
        units = self.settings.recurrence.units
        step = np.concatenate([np.arange(length) for length in dataset.lengths])
        before = np.where(step == 0, START, np.roll(columns["action"], 1))
        recurrence = self.imagination.model.recurrence
        memory = SequenceMemory(
            rows, self.encoder.latent_size, self.encoder.device,
            units=units, burn_in=int(dataset.lengths.max()), recurrence=lambda: recurrence,
        )  # fmt: skip
        stored = np.zeros((rows, units), dtype=np.float32)  # never read: the burn-in begins where the episode does
        memory.load({**columns, "step": step, "before": before, "stored": stored}, rows)
        for _ in range(latent.UPDATES):
            sequences = memory.draw(
                model.batch_size, self.settings.recurrence.sequence, generator,
                spread=model.spread, balance=model.balance,
            )  # fmt: skip
            states = sequences.states(recurrence)
            yield sequences.transitions(states, states)

    def states(self, frames: Frame, actions: NDArray[np.int64]) -> Tensor:
        """Latents of the latest frames and the memory of all K (N, K, 64, 64, 3): (N, Z + H)."""
        rows, count = frames.shape[:2]
        z = self.encoder.encode(frames.reshape(-1, *frames.shape[2:]))[0].view(rows, count, -1)
        start = np.full((rows, 1), START, dtype=np.int64)
        previous = torch.from_numpy(np.concatenate([start, actions[:, : count - 1]], axis=1)).to(z.device)
        recurrence = self.imagination.model.recurrence
        return torch.cat([z[:, -1], recurrence(z, previous, recurrence.blank(rows))[:, -1]], dim=-1)


def make(context: AgentContext) -> RecurrentLatentModel:
    """An ensemble on the memory of one GRU, at the settings of ``imagination_memory``."""
    settings = IMAGINATION_MEMORY.resolve(context.hyperparameters, {}, context.config_group)
    settings = replace(settings, model=replace(settings.model, members=3, dropout=0.0))
    prepare_torch(context.device)
    return RecurrentLatentModel(load_perception(context).encoder, settings, context)
