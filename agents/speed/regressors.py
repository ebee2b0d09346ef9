"""CPU seconds of what is computed together against the same done one after another, for ``make speed``."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from ..encoders.perception import prepare_torch
from ..imagination.mixture import output_size
from ..networks.mlp import MemberMLP, dropout_mask
from ..networks.precision import settle
from ..networks.weight_samples import sample_outputs
from ..regressors.bayesian_mdn import BayesianMDN, MDNSettings

_SIZES = (2, 256, 256, 256, output_size(10, 3))
_DROPOUT = 0.2


def weight_samples(rows: int, samples: int, repeats: int) -> tuple[float, float]:
    """CPU seconds of T weight samples of the network of chapter 4 for a batch: in one pass, and in a loop of forwards.

    Args:
        rows: Batch size, N.
        samples: T.
        repeats: Both are measured so often, in turns; the least counts.
    """
    prepare_torch("cpu")
    generator = torch.Generator().manual_seed(0)
    network = MemberMLP(_SIZES, members=1, dropout=_DROPOUT, generator=generator)
    x = torch.randn(rows, _SIZES[0], generator=generator)
    masks = [dropout_mask((samples, h), _DROPOUT, generator) for h in _SIZES[1:-1]]

    @torch.no_grad()
    def loop() -> None:
        outputs = x.new_empty(samples, rows, _SIZES[-1])
        for t in range(samples):
            outputs[t] = network(x[None], tuple(mask[t].view(1, 1, -1) for mask in masks))[0]

    least = least_cpu_s({"pass": lambda: sample_outputs(network, x, masks), "loop": loop}, repeats)
    return least["pass"], least["loop"]


def training(networks: int, rows: int, updates: int, repeats: int) -> tuple[float, float]:
    """CPU seconds of a number of updates of E networks of chapter 4: as one batch, and one network after another."""
    prepare_torch("cpu")
    settings = MDNSettings(precision=settle("auto", "cpu"))
    generators = [torch.Generator().manual_seed(index) for index in range(networks)]
    together = BayesianMDN(2, 3, settings, generators)
    alone = [BayesianMDN(2, 3, settings, [generator]) for generator in generators]
    x, y = (
        torch.randn(networks, rows, 2, generator=generators[0]),
        torch.randn(networks, rows, 3, generator=generators[0]),
    )

    def as_one() -> None:
        for _ in range(updates):
            together.update(x, y)

    def one_by_one() -> None:
        for index, model in enumerate(alone):
            for _ in range(updates):
                model.update(x[index : index + 1], y[index : index + 1])

    least = least_cpu_s({"together": as_one, "alone": one_by_one}, repeats)
    return least["together"], least["alone"]


def least_cpu_s(actions: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Least CPU seconds of each action, taken in turn: noise on a shared machine only ever adds."""
    least = dict.fromkeys(actions, float("inf"))
    for _ in range(rounds):
        for name, action in actions.items():
            start = time.process_time()
            action()
            least[name] = min(least[name], time.process_time() - start)
    return least
