"""Other uncertainties of the suite's ensemble, so that a judge compares them: networks and their training are the same.

Each is offered as the epistemic uncertainty of a world model:

- *Infoprop* (Frauenknecht et al., arXiv 2501.16918; the formulas are those of the code of one of its authors,
  dsubhasish09/Infoprop-JAX). It has a stopping rule for rollouts, too, which is the filter of that model.
- *Round trip* (Hansen and Wang, arXiv 2606.27326; formulas of their code, nicklashansen/mmbench2): how far an imagined
  latent moves if it is decoded and encoded again, divided by how far the macro-action moved it.
- *Spread* (the same paper): the variance of imagined latents over futures that differ in their random numbers only.

Our reading: Infoprop is defined for Gaussians; of a mixture, mean and variance are taken. The paper's round trip is of
the mean latent over futures; where several outcomes are possible that mean is none of them, so each future makes its
own, and the mean is over futures.

Shapes: ``E`` members, ``N`` rollouts, ``Z`` dimensions.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from imagine_bench.agents.encoders.encoder import Encoder
from imagine_bench.agents.encoders.perception import load_perception, prepare_torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.rollouts import Imagination, ImaginedStep, Weights
from imagine_bench.agents.imagination.settings import HYPERPARAMETERS, Settings
from imagine_bench.agents.world_models.latent import LatentModel
from torch import Tensor

from imagine_bench.arrays import Ints
from imagine_bench.interfaces import AgentContext, Frame
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined

_ENSEMBLE = {"model.members": 3, "model.dropout": 0.0}
_LEAST_MOTION = 1e-3  # of latents, in the round trip, as in the authors' code
_LEAST_VARIANCE = 1e-12  # likewise, in Infoprop
_LOW = 0.01  # quantile of real transitions below which no information counts as lost (the authors' code)
_HIGH = 0.95  # quantile above which a step loses too much (likewise)
_LONGEST = 1_000  # imagined steps (likewise)
_SPREAD_OF = 64  # real transitions that are looked at together


def lost_information(means: Tensor, variances: Tensor) -> Tensor:
    """Bits of the state that are lost to epistemic uncertainty, up to a constant (Infoprop). Shape (..., Z).

    The members' Gaussians are fused by precision: variance ``v = 1 / mean(1 / variances)`` and mean
    ``m = v mean(means / variances)``. The epistemic variance is ``e = mean((means - m) ** 2)``. If the prediction is a
    measurement of the state with noise of variance e, the variance that stays is ``v e / (v + e)``, and the result is
    its differential entropy.

    Args:
        means: Of each member. Shape (E, ..., Z).
        variances: Likewise.
    """
    precision = 1.0 / (variances + _LEAST_VARIANCE)
    fused = 1.0 / precision.mean(dim=0)
    mean = fused * (means * precision).mean(dim=0)
    epistemic = (means - mean).square().mean(dim=0)
    left = fused * epistemic / (fused + epistemic)
    return 0.5 * torch.log2(2.0 * math.pi * math.e * (left + _LEAST_VARIANCE))


def moments(samples: Mixture) -> tuple[Tensor, Tensor]:
    """Mean and variance of mixtures, two of shape (..., Z)."""
    weights = samples.log_weights.exp().unsqueeze(-1)
    mean = mdn.mean(samples)
    around = (samples.means - mean.unsqueeze(-2)).square() + torch.exp(2.0 * samples.log_sigmas)
    return mean, (weights * around).sum(dim=-2)


class InfopropLimits(NamedTuple):
    """Infoprop's limits, of real transitions. Each of shape (Z,), in bits."""

    nothing: Tensor  # entropy below which nothing counts as lost
    of_step: Tensor  # most that one step may lose
    of_rollout: Tensor  # most that all steps of a rollout may lose together

    @classmethod
    def of_real(cls, entropies: Tensor) -> InfopropLimits:
        """Those of N real transitions (N, Z)."""
        nothing = entropies.quantile(_LOW, dim=0) - 1.0
        lost = (entropies - nothing).clamp(min=0.0)
        return cls(nothing, lost.quantile(_HIGH, dim=0), lost.quantile(_LOW, dim=0) * _LONGEST)


class InfopropImagination(Imagination):
    """Imagination whose uncertainty is lost information, and whose filter is Infoprop's stopping rule."""

    limits: InfopropLimits | None = None

    def lost(self, step: ImaginedStep) -> Tensor:
        """Bits that each step loses. Shape (N, Z)."""
        entropy = lost_information(*moments(step.samples))
        return entropy if self.limits is None else (entropy - self.limits.nothing).clamp(min=0.0)

    def uncertainties(self, step: ImaginedStep) -> dict[str, Tensor]:
        """As ever, with the bits that are lost, summed over dimensions, as the epistemic one."""
        return super().uncertainties(step) | {"epistemic": self.lost(step).sum(dim=-1)}

    def keeps(self, step: ImaginedStep, gathered: Tensor | float = 0.0) -> Tensor:
        """Whether neither the step nor the rollout so far loses too much, in any dimension. Shape (N,), bool."""
        if self.limits is None:
            return super().keeps(step)
        lost = self.lost(step)
        too_much = (lost > self.limits.of_step) | (self.gathered_with(step, gathered) > self.limits.of_rollout)
        return ~too_much.any(dim=-1)

    def gathered_with(self, step: ImaginedStep, gathered: Tensor | float) -> Tensor:
        """Bits that each rollout has lost with this step. Shape (N, Z)."""
        before = torch.as_tensor(gathered)
        return self.lost(step) + (before.unsqueeze(-1) if before.ndim == 1 else before)


class Infoprop(LatentModel):
    """The ensemble with Infoprop's uncertainty and stopping rule."""

    imagination: InfopropImagination
    imagination_kind = InfopropImagination

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """As ever; then the limits are taken from the same real transitions."""
        super().fit(dataset, rng)
        z = self.encoder.encode(dataset.frames[dataset.rows[0]])[0]
        actions = torch.from_numpy(dataset.actions.copy())
        found = [
            lost_information(*moments(self.imagination.model.predict(*each, None)))
            for each in zip(z.split(_SPREAD_OF), actions.split(_SPREAD_OF), strict=True)
        ]
        self.imagination.limits = InfopropLimits.of_real(torch.cat(found))


class SignalImagination(Imagination):
    """Imagination that remembers where its latest step began, and how many futures each question has."""

    before: Tensor
    futures: int = 1

    def step(self, z: Tensor, action: Tensor, weights: Weights, generator: torch.Generator) -> ImaginedStep:
        """As ever."""
        self.before = z
        return super().step(z, action, weights, generator)


class RoundTripImagination(SignalImagination):
    """Imagination whose uncertainty is the round trip through images, divided by the motion."""

    encoder: Encoder

    def uncertainties(self, step: ImaginedStep) -> dict[str, Tensor]:
        """As ever, with the round trip as the epistemic one."""
        again = self.encoder.round_trip(step.next_z)
        return super().uncertainties(step) | {"epistemic": round_trip(step.next_z, again, self.before)}


class SpreadImagination(SignalImagination):
    """Imagination whose uncertainty is the variance over futures."""

    def uncertainties(self, step: ImaginedStep) -> dict[str, Tensor]:
        """As ever, with the variance over the futures of each question as the epistemic one."""
        by_question = step.next_z.unflatten(0, (-1, self.futures))
        spread = by_question.var(dim=1, correction=0).mean(dim=-1)
        return super().uncertainties(step) | {"epistemic": spread.repeat_interleave(self.futures)}


def round_trip(z: Tensor, again: Tensor, before: Tensor) -> Tensor:
    """How far latents move when they are decoded and encoded again, by how far they moved before. Shape (N,).

    Args:
        z: Imagined latents. Shape (N, Z).
        again: The same, decoded and encoded again.
        before: The latents before the macro-action.
    """
    moved = (z - before).square().mean(dim=-1).sqrt()
    return (z - again).square().mean(dim=-1).sqrt() / moved.clamp(min=_LEAST_MOTION)


class _Signal(LatentModel):
    """The ensemble with another uncertainty, and no filter."""

    imagination: SignalImagination

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """As ever, without the filter, which reads another uncertainty."""
        self.imagination.futures = samples
        return replace(super().imagine(frames, actions, samples, rng), accepted=None)


class RoundTrip(_Signal):
    """The ensemble with the round trip as its uncertainty."""

    imagination_kind = RoundTripImagination
    imagination: RoundTripImagination

    def __init__(self, encoder: Encoder, settings: Settings, context: AgentContext) -> None:
        super().__init__(encoder, settings, context)
        self.imagination.encoder = encoder


class Spread(_Signal):
    """The ensemble with the spread over futures as its uncertainty."""

    imagination_kind = SpreadImagination


def _make(context: AgentContext, *, model: type[LatentModel]) -> LatentModel:
    given = {**_ENSEMBLE, **context.overrides}
    settings = HYPERPARAMETERS.resolve(context.hyperparameters, given, context.config_group)
    prepare_torch(context.device)
    return model(load_perception(context).encoder, settings, context)


make_infoprop = partial(_make, model=Infoprop)
make_round_trip = partial(_make, model=RoundTrip)
make_spread = partial(_make, model=Spread)
