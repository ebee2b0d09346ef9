"""The regressors of chapter 4: Bayesian mixture density networks whose weight samples are dropout masks or members.

E networks, each on its own data, train as one batched computation; of an ensemble every network is M members on the
same data. Inputs are standardised by the network itself; targets are scaled to unit variance for training, and
mixtures scaled back, so that one set of rates fits metres, radians and any other unit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentState, Floats
from imagine_bench.interfaces.regression import Mixtures, Prediction, RegressionData, RegressorContext

from ..encoders.perception import prepare_torch
from ..imagination import mixture as mdn
from ..imagination.mixture import Mixture
from ..imagination.uncertainty import decompose, nll, sampled_component_variance
from ..networks.mlp import MemberMLP, dropout_mask
from ..networks.precision import settle
from ..networks.weight_samples import sample_outputs
from ..snapshot import (
    below,
    generator_array,
    jsonable,
    load_generator,
    load_training,
    prefixed,
    require_fit,
    training_arrays,
)  # fmt: skip
from .bayesian_mdn import BayesianMDN, members
from .settings import HYPERPARAMETERS, RegressorSettings
from .stationarity import jensen_shannon

_ROWS = 256
"""Rows predicted at a time: T mixtures of each are in memory."""
_DRAWN = 16
"""Values of equation 4.8 drawn for each row."""


class MixtureRegressor:
    """E Bayesian mixture density networks.

    Raises:
        InvalidValueError: Data of unequal sizes, of wrong shapes, or not finite.
    """

    def __init__(self, context: RegressorContext, settings: RegressorSettings) -> None:
        _require_data(context)
        settings = dataclasses.replace(settings, precision=settle(settings.precision, context.device))
        self.settings = settings
        self.networks = len(context.datasets)
        self._device = prepare_torch(context.device)
        inputs = np.stack([data.inputs for data in context.datasets])
        targets = np.stack([data.targets for data in context.datasets])
        self._shift = self._tensor(targets.mean(axis=1))  # [E, D]
        self._scale = self._tensor(np.maximum(targets.std(axis=1), 1e-6))
        self._x = self._tensor(inputs)
        self._y = (self._tensor(targets) - self._shift[:, None]) / self._scale[:, None]
        nodes = [seeds.child("member", m) for seeds in context.seeds for m in range(settings.members)]
        self._generators = {  # of weights and dropout masks, of the order of rows
            kind: [self._generator(node.child(kind).integer()) for node in nodes] for kind in ("network", "batches")
        }
        self._samples = [seeds.child("weight_samples") for seeds in context.seeds]
        self._model = BayesianMDN(inputs.shape[-1], targets.shape[-1], settings, self._generators["network"])
        self.epoch = 0
        self.epochs = settings.epochs
        self._losses: list[float] = []
        self._folded: MemberMLP | None = None

    def train(self, epochs: int) -> None:
        """Train for so many more epochs: in each, every member sees each of its rows once, in an order of its own."""
        self._folded = None
        rows = self._x.shape[1]
        batches = 1 if self.settings.batch_size is None else -(-rows // self.settings.batch_size)
        owner = torch.arange(self.networks, device=self._device).repeat_interleave(self.settings.members)[:, None]
        for _ in range(epochs):
            self._model.optimiser.learning_rate = self._rate()
            orders = torch.stack(
                [torch.randperm(rows, generator=g, device=self._device) for g in self._generators["batches"]]
            )
            chosen = orders.tensor_split(batches, dim=1)
            losses = [self._model.update(self._x[owner, batch], self._y[owner, batch]) for batch in chosen]
            self._losses.append(float(torch.stack(losses).mean()))
            self.epoch += 1

    def _rate(self) -> float:
        """The learning rate of the coming epoch."""
        final = self.settings.final_rate
        gone = min(1.0, self.epoch / self.epochs)
        return self.settings.learning_rate * (final + (1.0 - final) * 0.5 * (1.0 + math.cos(math.pi * gone)))

    def diagnostics(self) -> dict[str, float]:
        """Mean negative log-likelihood of the standardised targets while training, since the last call."""
        losses = self._losses
        self._losses = []
        return {"loss/likelihood": float(np.mean(losses))} if losses else {}

    def predict(self, inputs: Floats, rng: np.random.Generator) -> Prediction:
        """Predict, with uncertainties; see :class:`imagine_bench.interfaces.regression.Regressor`."""
        self._require_inputs(inputs)
        own, other = (self._generator(int(rng.integers(2**62))) for _ in range(2))
        networks = []
        for e in range(self.networks):
            parts = [self._predict_rows(e, rows, own, other) for rows in self._tensor(inputs[e]).split(_ROWS)]
            networks.append({name: torch.cat([part[name] for part in parts]) for name in parts[0]})
        found = _stacked(networks)
        mixture = {name: found.pop(name) for name in ("weights", "means", "sigmas")}
        return Prediction(predictive=Mixtures(**mixture), **found)

    def pooled(self, inputs: Floats) -> Mixtures:
        """All weight samples' mixtures side by side, equally likely."""
        self._require_inputs(inputs)
        networks = [self._weight_samples(e, self._tensor(inputs[e])) for e in range(self.networks)]
        return Mixtures(**_stacked([_parts(mdn.average(samples, len(samples.means))) for samples in networks]))

    def state(self) -> AgentState:
        """Weights, moments, running statistics, generators, epochs."""
        arrays = prefixed("network", training_arrays(self._model.network, self._model.optimiser))
        arrays |= {f"statistics/{name}": b.cpu().numpy().copy() for name, b in self._model.network.named_buffers()}
        for kind, generators in self._generators.items():
            arrays[f"generators/{kind}"] = np.stack([generator_array(generator) for generator in generators])
        values = {
            "settings": dataclasses.asdict(self.settings),
            "epoch": self.epoch,
            "losses": self._losses,
            "batches": self._model.network.batches,
        }
        return AgentState(arrays=arrays, values=jsonable(values))

    def restore(self, state: AgentState) -> None:
        """Continue from ``state``, bit for bit; ArtefactError where it does not fit."""
        require_fit(state, self.state(), equal=("settings",))
        arrays = state.arrays
        load_training(self._model.network, self._model.optimiser, below("network", arrays))
        for name, buffer in self._model.network.named_buffers():
            buffer.copy_(torch.tensor(arrays[f"statistics/{name}"]))
        for kind, generators in self._generators.items():
            for generator, array in zip(generators, arrays[f"generators/{kind}"], strict=True):
                load_generator(generator, array)
        self.epoch = state.values["epoch"]
        self._model.network.batches = state.values["batches"]
        self._losses = list(state.values["losses"])
        self._folded = None

    def _tensor(self, values: Floats) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self._device)

    def _generator(self, seed: int) -> torch.Generator:
        return torch.Generator(device=self._device).manual_seed(seed)

    def _weight_samples(self, network: int, x: Tensor) -> Mixture:
        """Mixtures (T, N) in the units of the targets; a network's weight samples are always the same ones."""
        if self._folded is None:
            self._folded = self._model.network.folded()
        settings = self.settings
        part = members(self._folded, network * settings.members, settings.members)
        masks = None
        if settings.dropout > 0.0:
            generator = self._generator(self._samples[network].integer())
            shapes = [(settings.weight_samples, units) for units in settings.hidden[:-1]]
            masks = [dropout_mask(shape, settings.dropout, generator) for shape in shapes]
        samples = self._model.mixture(sample_outputs(part, x, masks))
        shift = self._shift[network]
        scale = self._scale[network]
        means = samples.means * scale + shift
        return dataclasses.replace(samples, means=means, log_sigmas=samples.log_sigmas + scale.log())

    def _predict_rows(
        self, network: int, x: Tensor, generator: torch.Generator, other: torch.Generator
    ) -> dict[str, Tensor]:
        """Fields of a prediction of one network for a few rows, those of its mixture by themselves."""
        samples = self._weight_samples(network, x)
        pooled = mdn.average(samples, len(samples.means))
        parts = decompose(samples)
        predictive = mdn.average(samples, self.settings.members)
        prediction = mdn.sample(predictive, 1.0, generator)
        return {
            "prediction": prediction,
            "sampled_variance": sampled_component_variance(samples, predictive, prediction, self.settings.members),
            "nll": nll(samples, prediction),
            "mean": mdn.mean(samples).mean(dim=0),
            "epistemic": parts.epistemic,
            "aleatoric": parts.aleatoric,
            "modal": parts.modal,
            "stationarity": jensen_shannon(samples, self.settings.divergence_draws, generator),
            "drawn": torch.stack([mdn.sample(pooled, 1.0, other) for _ in range(_DRAWN)], dim=1),
            **_parts(predictive),
        }

    def _require_inputs(self, inputs: Floats) -> None:
        wanted = (self.networks, "N", self._x.shape[-1])
        shape = np.shape(inputs)
        fits = len(shape) == 3 and shape[::2] == wanted[::2] and shape[1] > 0
        if not (fits and np.isfinite(inputs).all()):
            raise InvalidValueError(f"Inputs must be finite numbers of shape {wanted}, N at least 1, not {shape}.")


def _require_data(context: RegressorContext) -> None:
    datasets = context.datasets
    if not datasets or len(datasets) != len(context.seeds):
        raise InvalidValueError(
            f"A regressor needs at least one dataset and a seed for each, not {len(datasets)} and {len(context.seeds)}."
        )
    first = _shapes(datasets[0])
    if [len(shape) for shape in first] != [2, 2] or first[0][0] != first[1][0] or first[0][0] < 2:
        raise InvalidValueError(f"Dataset 0 must have inputs (N, X) and targets (N, D), N at least 2, not {first}.")
    for index, data in enumerate(datasets):
        if _shapes(data) != first:
            raise InvalidValueError(
                f"Dataset {index} has inputs and targets of shapes {_shapes(data)}; all must have those of the first, "
                f"{first}."
            )
        if not (np.isfinite(data.inputs).all() and np.isfinite(data.targets).all()):
            raise InvalidValueError(f"Dataset {index} holds values that are not finite.")


def _shapes(data: RegressionData) -> tuple[tuple[int, ...], tuple[int, ...]]:
    return np.shape(data.inputs), np.shape(data.targets)


def _parts(mixture: Mixture) -> dict[str, Tensor]:
    """The fields of :class:`Mixtures`."""
    return {"weights": mixture.log_weights.exp(), "means": mixture.means, "sigmas": mixture.log_sigmas.exp()}


def _stacked(networks: Sequence[dict[str, Tensor]]) -> dict[str, Floats]:
    """Tensors by name as arrays whose first axis is the network."""
    names = networks[0]
    return {name: torch.stack([each[name] for each in networks]).double().cpu().numpy() for name in names}


def make_mc_dropout(context: RegressorContext) -> MixtureRegressor:
    """The ``mc_dropout`` regressor: one network a dataset, its weight samples are dropout masks (thesis 4.5)."""
    return MixtureRegressor(context, HYPERPARAMETERS.resolve(context.hyperparameters, context.overrides, "mc_dropout"))


def make_ensemble(context: RegressorContext) -> MixtureRegressor:
    """The ``ensemble`` regressor: M networks a dataset without dropout, each of them a weight sample."""
    return MixtureRegressor(context, HYPERPARAMETERS.resolve(context.hyperparameters, context.overrides, "ensemble"))
