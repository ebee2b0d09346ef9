"""Networks among others and alone, weight samples against a loop, and predictions."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
import torch
from imagine_bench.agents.networks.mlp import MemberMLP, dropout_mask
from imagine_bench.agents.networks.weight_samples import sample_outputs
from imagine_bench_regression.normed_mlp import NormedMLP, clip_member_gradients
from imagine_bench_regression.regressor import MixtureRegressor, make_ensemble, make_mc_dropout

from imagine_bench.errors import DivergedError
from imagine_bench.interfaces.regression import RegressionData, RegressorContext
from imagine_bench.regression.runner import log_score
from imagine_bench.seeding import SeedTree

MAKERS = {"mc_dropout": make_mc_dropout, "ensemble": make_ensemble}


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def data(networks: int, rows: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    g = generator(99)
    x = torch.randn(networks, rows, 2, generator=g)
    return x, torch.sin(3 * x) + 0.1 * torch.randn(networks, rows, 2, generator=g)


def regressor(name: str, sets: list[RegressionData], seeds: list[int], **settings: Any) -> MixtureRegressor:
    overrides = {"hidden": (16, 16), "components": 3, "batch_size": None, "precision": "float32", **settings}
    context = RegressorContext(
        datasets=tuple(sets), seeds=tuple(map(SeedTree, seeds)), hyperparameters="minimal", overrides=overrides
    )
    return MAKERS[name](context)


def among(seeds: list[int], **settings: Any) -> MixtureRegressor:
    """Networks with dropout, each on a dataset of its own."""
    pairs = zip(*data(3), strict=True)
    sets = [RegressionData(inputs=x.double().numpy(), targets=y.double().numpy()) for x, y in pairs]
    return regressor("mc_dropout", [sets[seed] for seed in seeds], seeds, **settings)


def silent(done: int, epochs: int) -> None:
    pass


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_network_among_others_is_the_network_alone(precision: str) -> None:
    settings = {"precision": precision, "gradient_clip": 1.0, "epochs": 15}
    together = among([0, 1, 2], **settings)
    together.train(silent)
    tolerance = 2e-4 if precision == "float32" else 0.05
    for index in range(3):
        alone = among([index], **settings)
        alone.train(silent)
        for all_of_it, own in zip(together.network.parameters(), alone.network.parameters(), strict=True):
            torch.testing.assert_close(all_of_it[index], own[0], rtol=tolerance, atol=tolerance)


def test_hidden_layers_decay_and_the_output_layer_does_not() -> None:
    """Without a gradient, Adam moves decaying weights and leaves the rest."""
    model = among([0])
    before = [parameter.detach().clone() for parameter in model.network.parameters()]
    for parameter in model.network.parameters():
        parameter.grad = torch.zeros_like(parameter)
    model.optimiser.step()
    moved = [not torch.equal(old, new) for old, new in zip(before, model.network.parameters(), strict=True)]
    assert moved == [True, True, False, True, False, False], "weights, then biases; hidden biases begin at 0"


@pytest.mark.parametrize(("batch_size", "updates"), [(None, 1), (250, 3), (8, 75)])
def test_an_epoch_takes_the_fewest_batches_of_at_most_that_size(batch_size: int | None, updates: int) -> None:
    line = RegressionData(inputs=np.linspace(-1, 1, 600)[:, None], targets=np.ones((600, 1)))
    falling = {"learning_rate": 0.01, "final_rate": 0.2}
    model = regressor("mc_dropout", [line], [0], hidden=(4, 4), batch_size=batch_size, epochs=2, **falling)
    rates = list[float]()
    model.train(lambda done, epochs: rates.append(model.optimiser.learning_rate))
    assert model.network.batches == 2 * updates
    assert rates == pytest.approx([0.01, 0.006]), "half a cosine from the first rate to a fifth of it"


@pytest.mark.parametrize("name", MAKERS)
def test_variances_are_those_of_what_weight_samples_draw(name: str) -> None:
    """Of targets far from 0 and from unit variance, so that they must be scaled back rightly."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(64, 1))
    curve = RegressionData(inputs=x, targets=300.0 + 50.0 * (np.sin(x) + 0.3 * rng.normal(size=(64, 1))))
    wider = RegressionData(inputs=x, targets=280.0 + 1.5 * (curve.targets - 300.0))
    both = regressor(name, [curve, wider], [0, 1], batch_size=32, epochs=4)
    alone = regressor(name, [wider], [1], batch_size=32, epochs=4)
    for model in (both, alone):
        model.train(silent)
    inputs = rng.normal(size=(2, 20, 1))
    predicted = both.predict(inputs, rng)
    np.testing.assert_allclose(predicted.mean[1], alone.predict(inputs[1:], rng).mean[0], rtol=1e-4)
    among_many = np.concatenate([np.zeros((2, 256, 1)), inputs], axis=1)  # more rows than are predicted at a time
    np.testing.assert_allclose(both.predict(among_many, rng).mean[:, 256:], predicted.mean, rtol=1e-5)
    variance = predicted.scores["total"][..., None]
    assert 10.0 < np.sqrt(variance).mean() < 250.0
    assert abs(predicted.mean.mean() - 300.0) < 100.0
    if name == "ensemble":  # predicts from all its weight samples side by side
        weights = predicted.weights[..., None]
        mean = (weights * predicted.means).sum(axis=-2, keepdims=True)
        spread = (weights * (predicted.sigmas**2 + (predicted.means - mean) ** 2)).sum(axis=-2)
        np.testing.assert_allclose(predicted.mean, mean[..., 0, :], rtol=1e-5)
        np.testing.assert_allclose(variance, spread, rtol=1e-3)
        np.testing.assert_allclose(predicted.nll, log_score(predicted, predicted.prediction), atol=1e-3)
    drawn = (predicted.drawn - predicted.mean[:, :, None]) / np.sqrt(variance)[..., None, :]  # [E, N, S, D]
    assert drawn.shape == (2, 20, 16, 1)
    assert abs(drawn.mean()) < 0.2 and abs(drawn.var() - 1.0) < 0.25
    assert len(np.unique(drawn)) == drawn.size


def test_batches_count_equally_at_first_and_later_a_hundredth() -> None:
    network = NormedMLP((2, 4, 1), generators=[generator()], dropout=0.0)
    x, _ = data(3)
    for batch in x:
        network(batch.mT[None].contiguous(), None)
        network.update_running_stats()
    batches = {"mean": x.mean(dim=1), "variance": x.var(dim=1, correction=0)}
    for name, of_each in batches.items():
        torch.testing.assert_close(network.get_buffer(f"{name}_0")[0, :, 0], of_each.mean(dim=0))
    network.batches = 500
    network.update_running_stats()  # by the third of them again
    for name, of_each in batches.items():
        expected = 0.99 * of_each.mean(dim=0) + 0.01 * of_each[2]
        torch.testing.assert_close(network.get_buffer(f"{name}_0")[0, :, 0], expected)


def test_dropped_units_are_dropped_after_folding_too() -> None:
    """With one mask for all rows, training and folded prediction see the same statistics and give the same."""
    network = NormedMLP((2, 16, 16, 3), generators=[generator(0), generator(1)], dropout=0.5)
    x, _ = data(2, rows=200)
    mask = [dropout_mask((1, 16), 0.5, generator(5)) for _ in range(2)]
    spread = [each.view(1, 16, 1).expand(2, 16, 200).contiguous() for each in mask]
    expected = network(x.mT.contiguous(), spread).mT
    network.update_running_stats()
    for member in range(2):
        folded = network.folded(slice(member, member + 1))
        found = sample_outputs(folded, x[member], mask)[0]
        torch.testing.assert_close(found, expected[member], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("sizes", [(2, 32, 24, 16, 9), (2, 32, 9)])
def test_weight_samples_in_one_pass_are_those_of_a_loop(sizes: tuple[int, ...]) -> None:
    """Layers beyond the masks drop nothing."""
    network = MemberMLP(sizes, members=1, dropout=0.25, generator=generator())
    x = torch.randn(300, 2, generator=generator(1))
    masks = [dropout_mask((50, 32), 0.25, generator(2))]
    layers = [(weight[0], bias[0]) for weight, bias in zip(network.weights, network.biases, strict=True)]
    for t, found in enumerate(sample_outputs(network, x, masks)):
        h = x
        for layer, (weight, bias) in enumerate(layers[:-1]):
            h = (h @ weight + bias).relu()
            h = h * masks[layer][t] if layer < len(masks) else h
        torch.testing.assert_close(found, h @ layers[-1][0] + layers[-1][1], rtol=1e-4, atol=1e-5)


def test_units_right_before_the_output_are_never_dropped() -> None:
    network = NormedMLP((2, 16, 24, 32, 3), generators=[generator()], dropout=0.5)
    masks = network.draw_masks(200, [generator(2)])
    assert masks is not None and [tuple(mask.shape) for mask in masks] == [(1, 16, 200), (1, 24, 200)]
    assert all(set(mask.unique().tolist()) == {0.0, 2.0} for mask in masks)
    assert NormedMLP((2, 16, 3), generators=[generator()], dropout=0.5).draw_masks(9, [generator(1)]) is None


def test_first_units_bend_all_over_the_data() -> None:
    """On standardised inputs a unit bends where w x + b = 0; with zero biases that is nowhere but at the centre."""
    network = NormedMLP((1, 2000, 8, 1), generators=[generator(0)], dropout=0.0)
    bends = -(network.biases[0] / network.weights[0]).detach().flatten()
    for low, high in ((-1.5, -0.5), (-0.5, 0.5), (0.5, 1.5)):
        assert ((bends > low) & (bends < high)).float().mean() > 0.1
    assert all(not bias.detach().any() for bias in list(network.biases)[1:])


def test_a_likelihood_that_is_not_finite_changes_nothing() -> None:
    model = among([0, 1])
    x, y = data(2)
    y[1, 3, 0] = math.nan
    before = copy.deepcopy(model.network.state_dict())
    with pytest.raises(DivergedError, match=r"A likelihood is not finite, .* Losses of the networks: \[\d.*, nan\]"):
        model.update(x, y)
    after = model.network.state_dict()
    assert len(before) > len(list(model.network.parameters())), "the running statistics must be among them"
    assert all(torch.equal(each, after[name]) for name, each in before.items())
    assert model.network.batches == 0


def member_norms(network: MemberMLP) -> list[float]:
    """Of the gradients of each member's weights and biases."""
    gradients = [parameter.grad.flatten(start_dim=1) for parameter in network.parameters()]
    return torch.cat(gradients, dim=1).norm(dim=1).tolist()


def test_member_gradients_are_clipped_one_by_one() -> None:
    network = MemberMLP((3, 4, 1), members=2, dropout=0.0, generator=generator())
    x = torch.randn(2, 5, 3, generator=generator(1)) * torch.tensor([1e-6, 1e3]).view(2, 1, 1)
    network(x).square().sum().backward()
    before = member_norms(network)
    norms = clip_member_gradients(network, 0.5)
    assert norms.tolist() == pytest.approx(before)
    assert member_norms(network) == pytest.approx([min(norm, 0.5) for norm in before], rel=1e-4)
    assert before[0] < 0.5 < before[1], "one within the limit, one beyond"
