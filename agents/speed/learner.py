"""How fast algorithm 1 learns its model, beside plain PyTorch and beside what the processor could do at best."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch

from ..controller import Controller
from ..controller import update_together as update_controllers
from ..encoders.perception import prepare_torch
from ..imagination.world_model import Update, WorldModel, update_together
from ..networks.precision import hidden_dtype, settle
from ..networks.products import product
from ..presets import resolve
from ..replay import Batch
from ..settings import WorldModelSettings
from .plain_model import PlainWorldModel
from .regressors import least_cpu_s

LATENTS, ACTIONS = 24, 6
"""Those of the arrow puzzle's bundled encoders."""
_SIDE = 512
"""Rows and columns of the product that measures the peak."""


@dataclass(frozen=True, kw_only=True)
class ModelSpeed:
    """CPU time of one update of the three networks, all measured in turn in one run.

    Attributes:
        plain_ms: By :class:`.plain_model.PlainWorldModel`, float32.
        float32_ms: By the world model, in float32.
        settled_ms: The same in the format that ``auto`` chooses here.
        precision: That format.
        roofline_ms: The matrix products of one update at the peak rate measured for that format.
        peak_gflops: That rate, of 512 x 512 x 512 products.
    """

    plain_ms: float
    float32_ms: float
    settled_ms: float
    precision: str
    roofline_ms: float
    peak_gflops: float


def measure(rounds: int = 25) -> ModelSpeed:
    """Measure at the thesis' settings, on one thread with denormals flushed; the least of ``rounds`` readings counts.

    Args:
        rounds: Readings of each, taken in turn, so that all see the same neighbours.
    """
    device = prepare_torch("cpu")
    settings = WorldModelSettings()
    precision = settle("auto", device.type)
    draws = torch.Generator().manual_seed(0)
    batch = _batch(settings.batch_size, draws)
    plain = PlainWorldModel(LATENTS, ACTIONS, settings, draws)
    models = {name: _model(settings, name) for name in ("float32", precision)}
    square = torch.randn(1, _SIDE, _SIDE, generator=draws).to(hidden_dtype(precision, device.type))
    best = least_cpu_s(
        {
            "plain": lambda: plain.update(batch),
            "peak": lambda: product(square, square),
            **{name: partial(model.update, batch, draws) for name, model in models.items()},
        },
        rounds,
    )
    peak_flops = 2 * _SIDE**3 / best["peak"]
    return ModelSpeed(
        plain_ms=1e3 * best["plain"],
        float32_ms=1e3 * best["float32"],
        settled_ms=1e3 * best[precision],
        precision=precision,
        roofline_ms=1e3 * _flops(models[precision], settings.batch_size) / peak_flops,
        peak_gflops=peak_flops / 1e9,
    )


def measure_abreast(preset: str, seeds: int, rounds: int = 15) -> tuple[float, float]:
    """How much faster the updates of several seeds are as one computation than one after another.

    Args:
        preset: Of the arrow puzzle's settings.
        seeds: S.
        rounds: Readings of each, taken in turn; the least counts.

    Returns:
        The ratio of CPU times of the three networks of the model, and that of the controller.
    """
    prepare_torch("cpu")
    settings, draws = resolve(preset, {}, "chapter_5"), torch.Generator().manual_seed(0)
    weights = [torch.Generator().manual_seed(seed) for seed in range(seeds)]
    models = [WorldModel(LATENTS, ACTIONS, settings.model, generator) for generator in weights]
    lessons = [Update(model, _batch(settings.model.batch_size, draws), draws) for model in models]
    controllers = [Controller(LATENTS, ACTIONS, settings.controller, generator) for generator in weights]
    batches = [(controller, _batch(settings.controller.batch_size, draws)) for controller in controllers]
    best = least_cpu_s(
        {
            "model": lambda: [update_together([lesson]) for lesson in lessons],
            "models": lambda: update_together(lessons),
            "controller": lambda: [update_controllers([batch]) for batch in batches],
            "controllers": lambda: update_controllers(batches),
        },
        rounds,
    )
    return best["model"] / best["models"], best["controller"] / best["controllers"]


def _model(settings: WorldModelSettings, precision: str) -> WorldModel:
    return WorldModel(LATENTS, ACTIONS, replace(settings, precision=precision), torch.Generator().manual_seed(0))


def _batch(rows: int, draws: torch.Generator) -> Batch:
    return Batch(
        z=torch.randn(rows, LATENTS, generator=draws),
        action=torch.randint(ACTIONS, (rows,), generator=draws),
        reward=torch.randn(rows, generator=draws),
        next_z=torch.randn(rows, LATENTS, generator=draws),
        terminated=(torch.rand(rows, generator=draws) < 0.3).float(),
    )


def _flops(model: WorldModel, rows: int) -> float:
    """Two a weight and row forward, four backward, but that no gradient of the inputs is wanted."""
    weights = [[weight.numel() for weight in network.weights] for network in model.networks]
    return 2.0 * rows * sum(3 * sum(sizes) - sizes[0] for sizes in weights)
