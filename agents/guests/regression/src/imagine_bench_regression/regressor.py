"""The regressors of chapter 4: Bayesian mixture density networks whose weight samples are dropout masks or members.

E networks, each on its own data, train as one batched computation; of an ensemble every network is M members on the
same data. Inputs are standardised by the network itself; targets are scaled to unit variance for training, and
mixtures scaled back, so that one set of rates fits metres, radians and any other unit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import torch
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.uncertainty import decompose, nll
from imagine_bench.agents.networks.adam import Adam
from imagine_bench.agents.networks.mlp import dropout_mask
from imagine_bench.agents.networks.precision import hidden_dtype, settle
from imagine_bench.agents.networks.weight_samples import sample_outputs
from torch import Tensor

from imagine_bench.arrays import Floats
from imagine_bench.errors import DivergedError
from imagine_bench.interfaces.regression import Prediction, RegressorContext

from .normed_mlp import NormedMLP, clip_member_gradients
from .settings import HYPERPARAMETERS, RegressorSettings
from .uncertainty import jensen_shannon, sampled_component_variance

_ROWS = 256
"""Rows predicted at a time: T mixtures of each are in memory."""
_DRAWN = 16
"""Values of equation 4.8 drawn for each row."""


class MixtureRegressor:
    """E Bayesian mixture density networks (Bishop 1994; thesis 4.4), or E ensembles of M of them.

    Every member has its generators, so that it is the same, up to rounding, whether it trains alone or among others.
    """

    def __init__(self, context: RegressorContext, settings: RegressorSettings) -> None:
        settings = dataclasses.replace(settings, precision=settle(settings.precision, context.device))
        self.settings = settings
        self._device = prepare_torch(context.device)
        data = [each for each in context.datasets for _ in range(settings.members)]
        nodes = [seeds.child("member", m) for seeds in context.seeds for m in range(settings.members)]
        self._orders = [self._generator(node.child("batches").integer()) for node in nodes]  # of the rows
        self._draws = [self._generator(node.child("network").integer()) for node in nodes]  # of weights, then masks
        self._samples = [seeds.child("weight_samples").integer() for seeds in context.seeds]
        targets = np.stack([each.targets for each in data])
        self._x = self._tensor(np.stack([each.inputs for each in data]))  # [E M, N, X]
        self._shift = self._tensor(targets.mean(axis=1))  # [E M, D]
        self._scale = self._tensor(np.maximum(targets.std(axis=1), 1e-6))
        self._y = (self._tensor(targets) - self._shift[:, None]) / self._scale[:, None]
        n_outputs = mdn.output_size(settings.components, self._y.shape[-1])
        sizes = (self._x.shape[-1], *settings.hidden, n_outputs)
        precision = hidden_dtype(settings.precision, context.device)
        self.network = NormedMLP(sizes, generators=self._draws, dropout=settings.dropout, precision=precision)
        hidden = [*self.network.weights[:-1], *self.network.biases[:-1]]
        output = [self.network.weights[-1], self.network.biases[-1]]
        self.optimiser = Adam([(hidden, settings.weight_decay), (output, 0.0)], settings.learning_rate)

    def train(self, on_epoch: Callable[[int, int], None]) -> dict[str, float]:
        """Train to the end: in each epoch every member sees each of its rows once, in an order of its own.

        Returns the mean negative log-likelihood of the standardised targets.
        """
        settings = self.settings
        rows = self._x.shape[1]
        batches = 1 if settings.batch_size is None else -(-rows // settings.batch_size)
        member = torch.arange(len(self._x), device=self._device)[:, None]
        losses = []
        for epoch in range(settings.epochs):
            falling = 0.5 * (1.0 + math.cos(math.pi * epoch / settings.epochs))
            share = settings.final_rate + (1.0 - settings.final_rate) * falling
            self.optimiser.learning_rate = settings.learning_rate * share
            orders = torch.stack([torch.randperm(rows, generator=g, device=self._device) for g in self._orders])
            chosen = orders.tensor_split(batches, dim=1)
            updates = [self.update(self._x[member, batch], self._y[member, batch]) for batch in chosen]
            losses.append(float(torch.stack(updates).mean()))
            on_epoch(epoch + 1, settings.epochs)
        return {"loss/likelihood": float(np.mean(losses))}

    def update(self, x: Tensor, y: Tensor) -> Tensor:
        """One step of Adam on the mean negative log-likelihood of each member's own batch (equation 4.28).

        From ``x`` (E M, N, X) and ``y`` (E M, N, D) to the losses (E M,) before the step, in nats.

        Raises:
            DivergedError: A loss or gradient is NaN or infinite; weights and statistics are left as they were.
        """
        masks = self.network.draw_masks(x.shape[1], self._draws)
        outputs = self.network(x.mT.contiguous(), masks).mT  # [E M, N, out]
        losses = -mdn.log_likelihood(self._mixture(outputs), y).mean(dim=1)
        self.optimiser.zero_grad()
        losses.sum().backward()
        norms = clip_member_gradients(self.network, self.settings.gradient_clip)
        if not bool((losses + norms).isfinite().all()):
            raise DivergedError(
                "A likelihood is not finite, or its gradient. Are the data? If so, lower learning_rate or raise "
                f"sigma_floor. Losses of the networks: {losses.tolist()}."
            )
        self.optimiser.step()
        self.network.update_running_stats()
        return losses.detach()

    def _mixture(self, outputs: Tensor) -> Mixture:
        """Network outputs (..., out) as mixtures of standardised targets."""
        settings = self.settings
        floor = math.log(settings.sigma_floor)
        ceiling = math.log(settings.sigma_ceiling)
        return mdn.from_outputs(outputs, settings.components, self._y.shape[-1], floor, ceiling)

    def predict(self, inputs: Floats, rng: np.random.Generator) -> Prediction:
        """Predict, with uncertainties; see :class:`imagine_bench.interfaces.regression.Regressor`."""
        own = self._generator(int(rng.integers(2**62)))
        other = self._generator(int(rng.integers(2**62)))
        networks = []
        for network, x in enumerate(self._tensor(inputs)):
            parts = [self._measure(self._weight_samples(network, rows), own, other) for rows in x.split(_ROWS)]
            networks.append({name: torch.cat([part[name] for part in parts]) for name in parts[0]})
        fields = {name: torch.stack([network[name] for network in networks]) for name in networks[0]}
        return Prediction(**{name: values.double().cpu().numpy() for name, values in fields.items()})

    def _weight_samples(self, network: int, x: Tensor) -> Mixture:
        """Inputs (N, X) to mixtures (T, N) in the units of the targets; the weight samples are always the same."""
        settings = self.settings
        first = network * settings.members
        folded = self.network.folded(slice(first, first + settings.members))
        masks = None
        if settings.dropout > 0.0:
            generator = self._generator(self._samples[network])
            shapes = [(settings.weight_samples, units) for units in settings.hidden[:-1]]
            masks = [dropout_mask(shape, settings.dropout, generator) for shape in shapes]
        samples = self._mixture(sample_outputs(folded, x, masks))
        scale = self._scale[first]
        means = samples.means * scale + self._shift[first]
        return Mixture(samples.log_weights, means, samples.log_sigmas + scale.log())

    def _measure(self, samples: Mixture, generator: torch.Generator, other: torch.Generator) -> dict[str, Tensor]:
        """Fields of a prediction of one network for a few rows."""
        pooled = mdn.average(samples, len(samples.means))
        uncertainty = decompose(samples)
        predictive = mdn.average(samples, self.settings.members)
        prediction = mdn.sample(predictive, 1.0, generator)
        return {
            "weights": predictive.log_weights.exp(),
            "means": predictive.means,
            "sigmas": predictive.log_sigmas.exp(),
            "prediction": prediction,
            "sampled_variance": sampled_component_variance(samples, predictive, prediction, self.settings.members),
            "nll": nll(samples, prediction),
            "mean": mdn.mean(samples).mean(dim=0),
            "epistemic": uncertainty.epistemic,
            "aleatoric": uncertainty.aleatoric,
            "modal": uncertainty.modal,
            "stationarity": jensen_shannon(samples, self.settings.divergence_draws, generator),
            "drawn": torch.stack([mdn.sample(pooled, 1.0, other) for _ in range(_DRAWN)], dim=1),
        }

    def _tensor(self, values: Floats) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self._device)

    def _generator(self, seed: int) -> torch.Generator:
        return torch.Generator(device=self._device).manual_seed(seed)


def make_mc_dropout(context: RegressorContext) -> MixtureRegressor:
    """The ``mc_dropout`` regressor: one network a dataset, its weight samples are dropout masks (thesis 4.5)."""
    return MixtureRegressor(context, HYPERPARAMETERS.resolve(context.hyperparameters, context.overrides, "mc_dropout"))


def make_ensemble(context: RegressorContext) -> MixtureRegressor:
    """The ``ensemble`` regressor: M networks a dataset without dropout, each of them a weight sample."""
    return MixtureRegressor(context, HYPERPARAMETERS.resolve(context.hyperparameters, context.overrides, "ensemble"))
