"""The thesis' world models: a VAE that was trained beforehand, and a mixture density network between its latents.

Networks of three kinds: one with Monte-Carlo dropout, an ensemble, and one with a single Gaussian, which cannot hold
two outcomes. Networks, losses and uncertainties are those of the agents that imagine (:mod:`..imagination`), at the
settings of ``quick``, or those printed in the thesis; how long they train is fixed here and the same for all data.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np
import torch
from torch import Tensor

from imagine_bench.arrays import Array, Arrays, Frame, Ints
from imagine_bench.interfaces import AgentContext
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined, until_the_end
from imagine_bench.values import Setting

from ..encoders.encoder import Encoder
from ..encoders.perception import load_perception, prepare_torch
from ..imagination.filter import weight_samples
from ..imagination.rollouts import Imagination
from ..imagination.settings import HYPERPARAMETERS, Settings
from ..replay import Batch, RealMemory

UPDATES = 1_500
_MOST = 0.5  # share of its futures that the filter keeps of a step that counts as kept
_MC_DROPOUT = {"model.members": 1, "model.dropout": 0.25, "imagination.weight_samples": 20}


class LatentModel:
    """Encoder, environment model and decoder as a world model."""

    imagination_kind: type[Imagination] = Imagination

    def __init__(self, encoder: Encoder, settings: Settings, context: AgentContext) -> None:
        self.encoder = encoder
        self.settings = settings
        self.compares = settings.model.members * weight_samples(settings) > 1
        """Whether there are several networks, whose disagreement is an epistemic uncertainty."""
        self.imagination = self.new_imagination(context)
        self.imagination.require_no_confidence("A world model that is judged")

    def new_imagination(self, context: AgentContext) -> Imagination:
        """The model that imagines, of which nothing is learned yet."""
        size = self.encoder.latent_size
        seeds = context.seeds
        device = self.encoder.device
        return self.imagination_kind(
            size, context.n_actions, self.settings, filtered=self.compares, seeds=seeds, device=device
        )

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Encode every frame once and make :data:`UPDATES` updates."""
        generator = self._generator(rng)
        before = torch.from_numpy(dataset.rows[0])
        mu, sigma = (each.cpu() for each in self.encoder.encode(dataset.frames))
        columns = {
            "mu": mu[before], "sigma": sigma[before], "next_mu": mu[before + 1], "next_sigma": sigma[before + 1],
            "action": dataset.actions.copy(), "reward": dataset.rewards.astype(np.float32),
            "terminated": dataset.terminated.astype(np.float32),
        }  # fmt: skip
        for batch in self.batches({name: np.asarray(column) for name, column in columns.items()}, dataset, generator):
            self.imagination.model.update(batch, generator)

    def batches(self, columns: Arrays, dataset: Episodes, generator: torch.Generator) -> Iterator[Batch]:
        """The training data: :data:`UPDATES` batches of transitions, whose columns are given."""
        del dataset
        model = self.settings.model
        rows = len(columns["action"])
        memory = RealMemory(rows, self.encoder.latent_size, self.encoder.device)
        memory.load(columns, rows)
        for _ in range(UPDATES):
            yield memory.sample(model.batch_size, generator, spread=model.spread, balance=model.balance)

    def states(self, frames: Frame, actions: Ints) -> Tensor:
        """The start of imagination: here the latents (N, Z) of the latest of frames (N, K, 64, 64, 3)."""
        del actions
        return self.encoder.encode(frames[:, -1])[0]

    @torch.no_grad()
    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """Futures in closed loop through latents; see :class:`.interfaces.model.WorldModel`."""
        generator = self._generator(rng)
        rows = len(frames)
        asked = torch.tensor(actions[:, frames.shape[1] - 1 :]).repeat_interleave(samples, dim=0)
        turns = iter(asked.unbind(dim=1))
        z = self.states(frames, actions).repeat_interleave(samples, dim=0)  # [N S, Z]
        weights = self.imagination.draw_weights(generator)
        kept = torch.ones(len(z), dtype=torch.bool)
        steps: defaultdict[str, list[Array]] = defaultdict(list)
        depth = asked.shape[1]
        for each in self.imagination.unroll(z, lambda _: next(turns), weights, generator, depth, cut=False):
            step = each.step
            images = self.encoder.decode(step.next_z[:, : self.encoder.latent_size])
            steps["pictures"].append((images * 255.0).round().astype(np.uint8))
            steps["rewards"].append(step.reward.numpy())
            steps["p_ended"].append(step.p_terminated.numpy())
            kept = kept & each.kept  # steps after a discarded one are discarded, too
            steps["accepted"].append(kept.view(rows, samples).float().mean(dim=1).numpy() >= _MOST)
            for name, values in self.imagination.uncertainties(step).items():
                steps[name].append(values.view(rows, samples).mean(dim=1).numpy())
        found: Arrays = {name: np.stack(each, axis=1) for name, each in steps.items()}
        for name in ("pictures", "rewards", "p_ended"):
            found[name] = found[name].reshape(rows, samples, *found[name].shape[1:])
        found["rewards"], found["p_ended"] = until_the_end(found["rewards"], found["p_ended"])
        if not self.compares:
            del found["epistemic"], found["accepted"]  # not offered, which is another thing than 0
        return Imagined(**found)

    def parameters(self) -> int:
        """Weights and biases of the environment model; the encoder's were there before."""
        return sum(parameter.numel() for parameter in self.imagination.model.parameters())

    def _generator(self, rng: np.random.Generator) -> torch.Generator:
        return torch.Generator(self.encoder.device).manual_seed(int(rng.integers(2**63)))


def _make(
    context: AgentContext, *, overrides: Mapping[str, Setting], hyperparameters: str | None = None
) -> LatentModel:
    given = {**overrides, **context.overrides}
    settings = HYPERPARAMETERS.resolve(hyperparameters or context.hyperparameters, given, context.config_group)
    prepare_torch(context.device)
    return LatentModel(load_perception(context).encoder, settings, context)


make_dropout = partial(_make, overrides=_MC_DROPOUT)
"""One network whose hidden units are dropped again and again."""
make_ensemble = partial(_make, overrides={"model.members": 3, "model.dropout": 0.0})
"""Three networks without dropout."""
make_gaussian = partial(_make, overrides={**_MC_DROPOUT, "model.components": 1})
"""One network with dropout and one Gaussian."""
make_thesis = partial(_make, overrides={}, hyperparameters="published")
"""At the settings that the thesis prints; those of chapter 3 have one network, and so no epistemic uncertainty."""
