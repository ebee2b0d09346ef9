"""Other uncertainties of the ensemble: their formulas by hand, and the same networks below them."""

from __future__ import annotations

import math

import pytest
import torch
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench_controls.signals import InfopropLimits, lost_information, moments, round_trip


def bits(variance: float) -> float:
    return 0.5 * math.log2(2.0 * math.pi * math.e * variance)


def lost(means: list[float], variances: list[float]) -> float:
    """Of members that predict one number each."""
    given = (torch.tensor(values, dtype=torch.float64)[:, None] for values in (means, variances))
    return lost_information(*given).item()


def test_lost_information_of_two_gaussians_is_that_by_hand() -> None:
    """Variances 1 and 1/3: precisions 1 and 3, fused 1/2; means 0 and 1: fused 1/2 * (0 + 3) / 2 = 3/4."""
    epistemic = ((3 / 4) ** 2 + (1 / 4) ** 2) / 2
    left = 0.5 * epistemic / (0.5 + epistemic)
    assert lost([0.0, 1.0], [1.0, 1.0 / 3.0]) == pytest.approx(bits(left), abs=1e-6)


def test_members_lose_information_as_they_disagree() -> None:
    assert lost([1.0] * 3, [0.25] * 3) < -15.0
    apart = lost([-1e6, 0.0, 1e6], [0.25] * 3)
    assert apart == pytest.approx(bits(0.25), abs=1e-6), "no more is lost than the prediction itself leaves open"


def test_noise_is_no_loss_and_disagreement_is() -> None:
    some, much = (lost([0.0, 0.1], [variance] * 2) for variance in (1.0, 10.0))
    assert much - some < 0.01, "much noise hides the little disagreement, and little is lost"
    assert lost([0.0, 0.3], [1.0] * 2) > some + 1.0


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
