"""Equation 4.8 (appendix A of the thesis): the expected squared error is the sum of its causes, and of no fewer."""

from __future__ import annotations

import numpy as np
import torch
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.uncertainty import decompose
from imagine_bench_regression import toy_regression as toy

PAIRS = 400_000
SURE = 4.5
"""Standard errors beyond which chance is no explanation."""
X = 12.5
"""Where all of the causes are worth mentioning: the branches are 13 apart (standard deviation)."""


def posterior() -> Mixture:
    """Four weight samples, mixtures of two components that lie beside the truth at X. Leading axes (4, 1)."""
    weights = torch.tensor([[0.5, 0.5], [0.9, 0.1], [0.2, 0.8], [0.4, 0.6]], dtype=torch.float64)
    means = torch.tensor([[20.0, 45.0], [30.0, 10.0], [35.0, 40.0], [22.0, 50.0]], dtype=torch.float64)
    sigmas = torch.tensor([[4.0, 6.0], [5.0, 5.0], [7.0, 3.0], [9.0, 2.0]], dtype=torch.float64)
    return Mixture(weights.log().view(4, 1, 2), means.view(4, 1, 2, 1), sigmas.log().view(4, 1, 2, 1))


def causes(samples: Mixture, sigma: float) -> dict[str, float]:
    parts = decompose(samples)
    mean = (samples.log_weights.exp()[..., None] * samples.means).sum(dim=-2).mean()
    return {
        "bias²": (toy.branches(np.array(X)).mean() - float(mean)) ** 2, "epistemic": float(parts.epistemic),
        "aleatoric": sigma**2, "modal": float(toy.branches(np.array(X)).var()),
        "spread": float(parts.aleatoric + parts.modal),
    }  # fmt: skip


def drawn(samples: Mixture, rng: np.random.Generator) -> np.ndarray:
    """Values of the mixtures of drawn weight samples. Shape (PAIRS,)."""
    parts = (samples.log_weights.exp(), samples.means, samples.log_sigmas.exp())
    weights, means, sigmas = (part.numpy().reshape(4, 2) for part in parts)
    t = rng.integers(len(weights), size=PAIRS)
    k = (rng.random(PAIRS) > weights[t, 0]).astype(int)
    return means[t, k] + sigmas[t, k] * rng.standard_normal(PAIRS)


def targets(sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Of the process of thesis 4.5.1 at X, by its definition. Shape (PAIRS,)."""
    f = np.array([7 * np.sin(0.75 * X) + 0.5 * X, 3 * np.sin(0.5 * X) + 3 * X - 5, 2 * np.sin(0.3 * X) - 0.2 * X + 20])
    return f[rng.integers(3, size=PAIRS)] + sigma * rng.standard_normal(PAIRS)


def test_the_error_is_the_sum_of_its_causes_and_of_no_fewer() -> None:
    rng, sigma, samples = np.random.default_rng(0), 3.0, posterior()
    squared = (targets(sigma, rng) - drawn(samples, rng)) ** 2
    error = squared.std() / np.sqrt(PAIRS)
    terms = causes(samples, sigma)
    assert abs(squared.mean() - sum(terms.values())) < SURE * error
    for name, value in terms.items():
        assert squared.mean() - sum(terms.values()) + value > SURE * error, f"{name} could be left out"
