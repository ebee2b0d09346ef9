"""The interfaces of regression tasks and regressors: numpy and the standard library only.

A regression *task* offers data whose truth is known. A *regressor* learns it and says how uncertain it is. One run
trains several *networks*, each on data drawn for it, on every *variant* of the task. Shapes: ``E`` networks, ``N``
rows, ``X`` inputs, ``D`` outputs, ``K`` mixture components, ``T`` weight samples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from imagine_bench.arrays import Arrays, Floats, read_only
from imagine_bench.interfaces.scene import Motion, Shape3D
from imagine_bench.seeding import SeedTree
from imagine_bench.values import Setting


@dataclass(frozen=True, slots=True, kw_only=True)
class RegressionData:
    """Pairs to learn from or to be tested on: inputs (N, X), targets (N, D). They cannot be written to."""

    inputs: Floats
    targets: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", read_only(self.inputs))
        object.__setattr__(self, "targets", read_only(self.targets))


Dataset = RegressionData
"""The former name of :class:`RegressionData`, which other packages' tasks may use."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mixtures:
    """Diagonal Gaussian mixtures with any leading axes."""

    weights: Floats  #: coefficients, of sum 1. Shape (..., K).
    means: Floats  #: shape (..., K, D)
    sigmas: Floats  #: standard deviations, above 0. Shape (..., K, D).


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction(Mixtures):
    """The predictions of E networks and their uncertainties: the mixtures that values are sampled from, and more."""

    prediction: Floats  #: one value sampled from the predictive mixture. Shape (E, N, D).
    mean: Floats  #: mean over the weight samples. Shape (E, N, D).
    epistemic: Floats  #: variance of the mean over weight samples (equation 4.25). Shape (E, N, D).
    aleatoric: Floats  #: mean variance of the components (equation 4.26). Shape (E, N, D).
    modal: Floats  #: mean spread of the components (equation 4.27). Shape (E, N, D).
    stationarity: Floats  #: Jensen-Shannon divergence of the weight samples' distributions, in nats. Shape (E, N).
    #: Variance of the component that the prediction was sampled from, noise and weights together, summed over the
    #: outputs. Shape (E, N).
    sampled_variance: Floats
    nll: Floats  #: negative log-likelihood of the prediction under all weight samples together, in nats. Shape (E, N).
    drawn: Floats  #: values drawn as in equation 4.8, each from the mixture of one weight sample. Shape (E, N, S, D).

    @property
    def scores(self) -> Arrays:
        """One number a row, (E, N), by the names in :data:`SCORES`: the higher, the less sure.

        Variances are summed over the outputs.
        """
        epistemic = self.epistemic
        aleatoric = self.aleatoric
        modal = self.modal
        variances = (epistemic, aleatoric, modal, epistemic + aleatoric, epistemic + aleatoric + modal)
        sums = [variance.sum(axis=-1) for variance in variances]
        return dict(zip(SCORES, (*sums, self.stationarity, self.sampled_variance, self.nll), strict=True))


SCORES = (
    "epistemic",
    "aleatoric",
    "modal",
    "epistemic_plus_aleatoric",
    "total",
    "stationarity",
    "sampled_component",
    "nll",
)
"""Every measure of how unsure a prediction is."""


class Regressor(Protocol):
    """E networks that learn to predict distributions. Equal seeds give equal bits."""

    def train(self, on_epoch: Callable[[int, int], None]) -> dict[str, float]:
        """Train to the end, and return means of the measures meanwhile, by slashed name.

        ``on_epoch`` is told now and then how many epochs are done, and how many there are in all.

        Raises:
            DivergedError: A loss is no longer finite.
        """

    def predict(self, inputs: Floats, rng: np.random.Generator) -> Prediction:
        """Predict from each network's own inputs (E, N, X); ``rng`` samples predictions and Monte-Carlo sums."""


@dataclass(frozen=True, kw_only=True)
class RegressorContext:
    """The arguments of a regressor's factory."""

    datasets: tuple[RegressionData, ...]  #: one a network, all of the same size. Length E.
    seeds: tuple[SeedTree, ...]  #: one node of the seed tree a network. Length E.
    hyperparameters: str = "fast"  #: name of the set of settings: ``"minimal"``, ``"fast"`` or ``"published"``
    overrides: Mapping[str, Setting] = field(default_factory=dict)  #: single settings that replace the set's
    device: str = "cpu"


Predict = Callable[[Floats, str], Prediction]
"""Inputs (E, N, X) and a name, which stands for the random numbers, to the networks' predictions for them."""


Evaluate = Callable[[str, Predict, tuple[SeedTree, ...]], Arrays]
"""A task's own measurements of networks that were trained on a variant: the arrays, by name, that its figures and
tables are made of. The first axis is the network, where there is one; one seed node a network draws test inputs."""


class MovingScene(Protocol):
    """A robot that predictions are carried out with, for recordings."""

    def shapes(self) -> tuple[Shape3D, ...]:
        """Every drawable shape."""

    def movement(self, prediction: Floats, hz: float) -> Motion:
        """How every body moves while one prediction (D,) is carried out, sampled ``hz`` a second."""


@dataclass(frozen=True, kw_only=True)
class RegressionSpec:
    """Everything the bench needs to know of a regression task. Building one is cheap."""

    id: str
    title: str
    description: str
    variants: tuple[str, ...]  #: those of the thesis, in its order
    #: Raises InvalidValueError or UnknownNameError for a variant that does not exist.
    require_variant: Callable[[str], object]
    training: Callable[[str, np.random.Generator], RegressionData]  #: data of a variant, drawn from a generator
    #: The given number of rows of the same process, never trained on.
    testing: Callable[[str, np.random.Generator, int], RegressionData]
    #: How wrong predictions are: variant, inputs (N, X), predictions (N, D) to (N,).
    errors: Callable[[str, Floats, Floats], Floats]
    error_name: str  #: name of ``errors``, with its unit; above ``wrong_above`` a prediction counts as wrong
    wrong_above: float
    evaluate: Evaluate
    #: ``"module:attr"`` of the function that makes sections of the report of them; another package's task has one.
    sections: str | None = None
    recorder: str | None = None  #: ``"module:attr"`` of the function that records them, or None
    scene: Callable[[], MovingScene] | None = None  #: gives the robot that carries out predictions, where there is one
