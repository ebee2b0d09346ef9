"""Other uncertainties of the ensemble: their formulas by hand, and the same networks below them."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from counting_model import CPU, CountingModel
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.rollouts import Imagination, ImaginedStep, Weights
from imagine_bench.agents.imagination.settings import ImaginationSettings, Settings
from imagine_bench_controls.signals import (
    InfopropImagination,
    InfopropLimits,
    RoundTripImagination,
    SpreadImagination,
    lost_information,
    moments,
    round_trip,
)

from imagine_bench.seeding import SeedTree


def bits(variance: float) -> float:
    return 0.5 * math.log2(2.0 * math.pi * math.e * variance)


@pytest.mark.parametrize(
    ("means", "variances", "fused", "mean"),
    [
        ([0.0, 1.0], [1.0, 1.0 / 3.0], 0.5, 0.75),  # precisions 1 and 3
        ([1.0] * 3, [0.25] * 3, 0.25, 1.0),  # nothing is lost
        ([-1e6, 0.0, 1e6], [0.25] * 3, 0.25, 0.0),  # no more than the prediction itself leaves open
        ([0.0, 0.1], [10.0] * 2, 10.0, 0.05),  # much noise hides disagreement
        ([0.0, 0.3], [1.0] * 2, 1.0, 0.15),
    ],
)
def test_lost_information_is_that_by_hand(
    means: list[float], variances: list[float], fused: float, mean: float
) -> None:
    """Of members that predict one number each."""
    epistemic = sum((each - mean) ** 2 for each in means) / len(means)
    left = fused * epistemic / (fused + epistemic) + 1e-12
    given = (torch.tensor(values, dtype=torch.float64)[:, None] for values in (means, variances))
    assert lost_information(*given).item() == pytest.approx(bits(left), abs=1e-6)


def test_mixtures_count_with_their_mean_and_whole_variance() -> None:
    mixture = Mixture(
        log_weights=torch.tensor([0.25, 0.75]).log(),
        means=torch.tensor([[0.0], [4.0]]),
        log_sigmas=torch.tensor([[1.0], [2.0]]).log(),
    )
    mean, variance = moments(mixture)
    assert mean.item() == pytest.approx(3.0)
    assert variance.item() == pytest.approx(0.25 * (1.0 + 9.0) + 0.75 * (4.0 + 1.0))


def test_limits_are_quantiles_of_what_real_transitions_lose() -> None:
    entropies = torch.arange(101.0)[:, None].double()
    limits = InfopropLimits.of_real(entropies)
    assert limits.nothing.item() == pytest.approx(0.0)  # the first hundredth, and 1 bit below it
    assert limits.of_step.item() == pytest.approx(95.0)
    assert limits.of_rollout.item() == pytest.approx(1_000.0)  # 1 bit of each of 1,000 steps


def test_the_round_trip_is_measured_by_the_motion() -> None:
    z = torch.tensor([[3.0, 4.0], [3.0, 4.0]])
    again = torch.tensor([[3.0, 4.0], [0.0, 0.0]])
    before = torch.tensor([[0.0, 0.0], [3.0, 2.0]])
    assert round_trip(z, again, before).tolist() == pytest.approx([0.0, 5.0 / 2.0])
    assert round_trip(z, again, z)[1].item() == pytest.approx(5.0 / math.sqrt(2.0) / 1e-3), "of no motion at least this"


def made(kind: type[Imagination], **attributes: Any) -> Any:
    settings = Settings(imagination=ImaginationSettings(temperature=0.0))
    imagination = kind(2, 2, settings, filtered=False, seeds=SeedTree(0), device=CPU)
    vars(imagination).update(model=CountingModel(), **attributes)
    return imagination


def stepped(imagination: Any, z: list[list[float]]) -> ImaginedStep:
    return imagination.step(
        torch.tensor(z), torch.zeros(len(z), dtype=torch.int64), Weights(None, None), torch.Generator()
    )


def test_each_uncertainty_is_that_of_its_own_futures() -> None:
    """Every step adds (0, 1); three futures of each of two questions, whose first latents have variances 6 and 0."""
    z = [[0.0, 0.0], [3.0, 0.0], [6.0, 0.0], *[[1.0, 1.0]] * 3]
    there_and_back = SimpleNamespace(round_trip=lambda z: z + torch.tensor([0.0, 3.0]))
    for imagination, wanted in (
        (made(SpreadImagination, futures=3), [3.0] * 3 + [0.0] * 3),
        (made(RoundTripImagination, encoder=there_and_back), [3.0] * 6),
    ):
        found = imagination.uncertainties(stepped(imagination, z))["epistemic"]
        assert found.tolist() == pytest.approx(wanted)


@pytest.mark.parametrize(
    ("of_step", "of_rollout", "kept"), [((1, 2), (5, 6), True), ((9, 1), (9, 9), False), ((9, 9), (4, 9), False)]
)
def test_infoprop_stops_where_one_or_all_steps_lose_too_much(of_step: Any, of_rollout: Any, kept: bool) -> None:
    """Of a step that loses 1 bit of one dimension and 2 of the other, after 4 of each."""
    imagination = made(InfopropImagination)
    step = stepped(imagination, [[0.0, 0.0]])
    nothing = imagination.lost(step)[0] - torch.tensor([1.0, 2.0])
    imagination.limits = InfopropLimits(nothing, torch.tensor(of_step) + 0.1, torch.tensor(of_rollout) + 0.1)
    assert imagination.uncertainties(step)["epistemic"].item() == pytest.approx(3.0, abs=1e-4)
    assert imagination.keeps(step, torch.full((1, 2), 4.0)).tolist() == [kept]
