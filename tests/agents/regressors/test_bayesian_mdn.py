"""Batched networks against networks alone, weight samples against a loop, and the divergence of known mixtures."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.uncertainty import decompose
from imagine_bench.agents.networks.mlp import MemberMLP, dropout_mask
from imagine_bench.agents.networks.normed_mlp import NormedMLP
from imagine_bench.agents.networks.weight_samples import sample_outputs
from imagine_bench.agents.regressors.bayesian_mdn import BayesianMDN
from imagine_bench.agents.regressors.settings import MDNSettings
from imagine_bench.agents.regressors.stationarity import jensen_shannon
from scipy import integrate, stats

from imagine_bench.errors import DivergedError

_SMALL = MDNSettings(hidden=(16, 16), components=3)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def data(networks: int, rows: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    g = generator(99)
    x = torch.randn(networks, rows, 2, generator=g)
    return x, torch.sin(3 * x) + 0.1 * torch.randn(networks, rows, 2, generator=g)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_network_among_others_is_the_network_alone(precision: str) -> None:
    settings = MDNSettings(hidden=(16, 16), components=3, precision=precision, gradient_clip=1.0)
    x, y = data(3)
    together = BayesianMDN(2, 2, settings, [generator(i) for i in range(3)])
    losses = [together.update(x, y) for _ in range(15)]
    for index in range(3):
        alone = BayesianMDN(2, 2, settings, [generator(index)])
        own = [alone.update(x[index : index + 1], y[index : index + 1]) for _ in range(15)]
        tolerance = 2e-4 if precision == "float32" else 0.05
        torch.testing.assert_close(
            torch.stack(losses)[:, index], torch.stack(own)[:, 0], rtol=tolerance, atol=tolerance
        )
    assert losses[-1].mean() < losses[0].mean()  # they learned meanwhile


def test_clipping_one_member_leaves_the_others() -> None:
    settings = MDNSettings(hidden=(16,), components=2, gradient_clip=0.5, dropout=0.0)
    x, y = data(2)
    wild = y.clone()
    wild[0] *= 1e3
    results = []
    for targets in (y, wild):
        model = BayesianMDN(2, 2, settings, [generator(i) for i in range(2)])
        for _ in range(3):
            model.update(x, targets)
        results.append([p.detach()[1].clone() for p in model.network.parameters()])
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine, theirs)


def test_hidden_layers_decay_and_the_output_layer_does_not() -> None:
    """Without a gradient, Adam moves what decays and leaves the rest."""
    model = BayesianMDN(2, 2, MDNSettings(hidden=(16, 16), components=2), [generator()])
    before = [parameter.detach().clone() for parameter in model.network.parameters()]
    for parameter in model.network.parameters():
        parameter.grad = torch.zeros_like(parameter)
    model.optimiser.step()
    moved = [not torch.equal(old, new) for old, new in zip(before, model.network.parameters(), strict=True)]
    assert moved == [True, True, False, True, False, False], "weights, then biases; hidden biases begin at 0"


def test_folding_gives_what_the_normed_network_gives() -> None:
    network = NormedMLP((2, 16, 16, 3), generators=[generator(0), generator(1)], dropout=0.0)
    x, _ = data(2, rows=300)
    for _ in range(3):
        expected = network(x.mT.contiguous(), None).mT  # the same batch again: the running statistics are its own
        network.update_running_stats()
    torch.testing.assert_close(network.folded()(x), expected, rtol=1e-4, atol=1e-4)


def test_dropped_units_are_dropped_after_folding_too() -> None:
    """With one mask for all rows, training and folded prediction see the same statistics and give the same."""
    network = NormedMLP((2, 16, 16, 3), generators=[generator(0)], dropout=0.5)
    x, _ = data(1, rows=200)
    mask = [dropout_mask((1, 16), 0.5, generator(5)) for _ in range(2)]
    spread = [each.view(1, 16, 1).expand(1, 16, 200).contiguous() for each in mask]
    expected = network(x.mT.contiguous(), spread).mT
    network.update_running_stats()
    torch.testing.assert_close(sample_outputs(network.folded(), x[0], mask)[0], expected[0], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("rows", [1, 300])
@pytest.mark.parametrize("sizes", [(2, 32, 24, 16, 9), (2, 32, 9)])
def test_weight_samples_in_one_pass_are_those_of_a_loop(rows: int, sizes: tuple[int, ...]) -> None:
    """Layers beyond the masks drop nothing."""
    network = MemberMLP(sizes, members=1, dropout=0.25, generator=generator())
    x = torch.randn(rows, 2, generator=generator(1))
    masks = [dropout_mask((50, 32), 0.25, generator(2))]
    layers = [(weight[0], bias[0]) for weight, bias in zip(network.weights, network.biases, strict=True)]
    for t, found in enumerate(sample_outputs(network, x, masks)):
        h = x
        for layer, (weight, bias) in enumerate(layers[:-1]):
            h = (h @ weight + bias).relu()
            h = h * masks[layer][t] if layer < len(masks) else h
        torch.testing.assert_close(found, h @ layers[-1][0] + layers[-1][1], rtol=1e-4, atol=1e-5)
    ensemble = MemberMLP((2, 32, 9), members=5, dropout=0.0, generator=generator())
    torch.testing.assert_close(sample_outputs(ensemble, x, None), ensemble(x.expand(5, -1, -1)), rtol=1e-4, atol=1e-5)


def test_units_right_before_the_output_are_never_dropped() -> None:
    network = NormedMLP((2, 16, 24, 32, 3), generators=[generator(0), generator(1)], dropout=0.5)
    masks = network.draw_masks(200, [generator(2), generator(3)])
    assert masks is not None and [tuple(mask.shape) for mask in masks] == [(2, 16, 200), (2, 24, 200)]
    assert all(set(mask.unique().tolist()) == {0.0, 2.0} for mask in masks)
    assert NormedMLP((2, 16, 3), generators=[generator(0)], dropout=0.5).draw_masks(9, [generator(1)]) is None


def test_first_units_bend_all_over_the_data() -> None:
    """On standardised inputs a unit bends where w x + b = 0; with zero biases that is nowhere but at the centre."""
    network = NormedMLP((1, 2000, 8, 1), generators=[generator(0)], dropout=0.0)
    bends = -(network.biases[0] / network.weights[0]).detach().flatten()
    for low, high in ((-1.5, -0.5), (-0.5, 0.5), (0.5, 1.5)):
        assert ((bends > low) & (bends < high)).float().mean() > 0.1
    assert all(not bias.detach().any() for bias in list(network.biases)[1:])


def test_decay_leaves_first_units_their_bends() -> None:
    """Where only weights decayed, bends at -b / w would leave the data: a quarter of the units would be dead here."""
    x = torch.rand(2, 300, 1, generator=generator(5)) * 2.0 - 1.0
    y = torch.sin(6.0 * x) + 0.1 * torch.randn(x.shape, generator=generator(6))
    settings = MDNSettings(hidden=(64, 32), components=2, learning_rate=1e-2)
    model = BayesianMDN(1, 1, settings, [generator(0), generator(1)])
    for _ in range(250):
        model.update(x, y)
    spread = model.network.get_buffer("variance_1")
    assert (spread < 1e-6 * spread.amax()).float().mean() < 0.1


def gaussians(means: list[float], sigma: float) -> Mixture:
    """T mixtures of one component for one row of one dimension."""
    count = len(means)
    values = torch.tensor(means).view(count, 1, 1, 1)
    return Mixture(torch.zeros(count, 1, 1), values, torch.full_like(values, math.log(sigma)))


def test_equal_distributions_diverge_by_0_disjoint_ones_by_log_t() -> None:
    assert jensen_shannon(gaussians([1.0] * 5, 1.0), 50, generator())[0].item() == pytest.approx(0.0, abs=1e-5)
    apart = gaussians([100.0 * t for t in range(5)], 1.0)
    assert jensen_shannon(apart, 4, generator())[0].item() == pytest.approx(math.log(5), abs=1e-5)


def test_divergence_of_two_gaussians_is_the_integral() -> None:
    def integrand(y: float) -> float:
        p, q = stats.norm.pdf(y, 0, 1), stats.norm.pdf(y, 1.5, 1)
        m = (p + q) / 2
        return 0.5 * (p * np.log(p / m) + q * np.log(q / m))

    exact = integrate.quad(integrand, -10, 12)[0]
    estimate = jensen_shannon(gaussians([0.0, 1.5], 1.0), 40_000, generator())[0].item()
    assert estimate == pytest.approx(exact, abs=0.005)


def test_divergence_sees_what_the_variance_of_means_does_not() -> None:
    """Two samples with the same mean, one of two branches and one between them."""
    weights = torch.tensor([[[0.5, 0.5]], [[0.5, 0.5]]]).log()
    means = torch.tensor([[[[-3.0], [3.0]]], [[[0.0], [0.0]]]])
    samples = Mixture(weights, means, torch.full((2, 1, 2, 1), -1.0))
    assert decompose(samples).epistemic.item() == 0.0
    assert jensen_shannon(samples, 100, generator())[0].item() > 0.6


def test_a_likelihood_that_is_not_finite_changes_nothing() -> None:
    model = BayesianMDN(2, 2, _SMALL, [generator(0), generator(1)])
    x, y = data(2)
    y[1, 3, 0] = math.nan
    before = [values.clone() for values in model.network.state_dict().values()]
    with pytest.raises(DivergedError, match="likelihood of network 1 of 2 is no longer finite"):
        model.update(x, y)
    after = model.network.state_dict().values()
    assert len(before) > len(list(model.network.parameters())), "the running statistics must be among them"
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True)) and model.network.batches == 0
