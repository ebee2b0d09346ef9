"""Imagined rollouts: their ends, the filter, their storage."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from counting_model import CPU, CountingModel, T, imagined, make, remembering
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import ImaginationSettings, Settings, WorldModelSettings
from imagine_bench.agents.imagination.world_model import EnvironmentModel

from imagine_bench.errors import DivergedError, InvalidValueError
from imagine_bench.seeding import SeedTree

_ALL = {"threshold": 0.3, "reward_threshold": 1.9, "termination_threshold": 0.2}
"""Of which each limit discards by itself."""


@pytest.mark.parametrize(
    ("model", "filtered", "limits", "kept"),
    [
        ({}, True, {"threshold": 0.0}, 10),  # as uncertain as the threshold
        ({"uncertain_at": 5}, True, {}, 4),
        ({"uncertain_at": 5}, False, {}, 10),
        ({"uncertain_at": 1}, True, {}, 0),
        ({"uncertain_at": 5}, True, {"reduction": "max", "threshold": 4.0}, 4),  # the variance there is (5, 0)
        ({"uncertain_at": 5}, True, {"reduction": "mean", "threshold": 4.0}, 10),
        ({"reward_uncertain_at": 5}, True, {"reward_threshold": 1.9}, 4),
        ({"reward_uncertain_at": 5}, True, {"reward_threshold": 2.0}, 10),
        ({"torn_at": 5}, True, {"termination_threshold": 0.2}, 4),
        ({"torn_at": 5}, True, {"termination_threshold": float(np.float32(0.3))}, 10),
        ({"end_at": 4}, True, {"termination_threshold": 0.0}, 4),  # a certain end
        *(({which: 3}, True, _ALL, 2) for which in ("uncertain_at", "reward_uncertain_at", "torn_at")),
    ],
)
def test_rollouts_run_until_they_end_are_full_or_too_uncertain(
    model: dict[str, int], filtered: bool, limits: dict[str, Any], kept: int
) -> None:
    imagination, counts = imagined(CountingModel(**model), filtered=filtered, **limits)
    end = model.get("end_at", 10)
    predicted = kept if kept == end else kept + 1
    assert counts == (3, 3 * predicted, 3 * kept)
    rows = imagination.memory.arrays()
    reached = rows["next_z"][:, 1]
    assert sorted(reached) == sorted(3 * list(range(1, kept + 1)))
    assert (reached - rows["z"][:, 1] == 1.0).all()
    assert (rows["reward"] == 10.0 * reached).all()
    assert (rows["terminated"] == (reached == model.get("end_at"))).all()


@pytest.mark.parametrize("how", ["average", "network", "sample"])
def test_imagination_predicts_with_the_chosen_weights(how: str) -> None:
    """Means of one component each: over all weight samples, of the network without dropout, or of one sample a row."""
    imagination = made({"temperature": 0.0, "predicts_with": how}, components=1, dropout=0.5, dynamics_hidden=(16,))
    generator = torch.Generator().manual_seed(0)
    z = torch.ones(500, 2)
    action = torch.zeros(500, dtype=torch.int64)
    weights = imagination.draw_weights(generator)
    found = imagination.step(z, action, weights, generator).next_z
    means = imagination.model.predict(z, action, weights.dynamics).means[..., 0, :]  # [T, N, Z]
    whole = imagination.model.predict(z, action, None).means[0, :, 0]
    average, network = (torch.isclose(found, mean, atol=1e-6).all() for mean in (means.mean(dim=0), whole))
    of_one = torch.isclose(found, means, atol=1e-6).all(dim=-1)  # [T, N]
    sample = of_one.any(dim=0).all() and of_one.any(dim=1).all()  # each row is of one, and all of them are drawn
    assert (average, network, sample) == (how == "average", how == "network", how == "sample")


@pytest.mark.parametrize("part", ["log_weights", "means"])
def test_imagination_that_is_no_number_is_not_stored(part: str) -> None:
    def diverged(sound: Mixture, z: torch.Tensor) -> Mixture:
        return dataclasses.replace(sound, **{part: torch.full_like(getattr(sound, part), torch.nan)})

    imagination, controller = make(filtered=False, model=CountingModel(change=diverged), temperature=1.0)
    with pytest.raises(DivergedError, match=r"of the world model is no longer a number\. Lower model\.learning_rate\."):
        imagination.rollouts(controller, torch.zeros(2), remembering(1), 0.5)
    assert len(imagination.memory) == 0


def test_a_rollout_ends_before_its_variance_overflows() -> None:
    def exploding(sound: Mixture, z: torch.Tensor) -> Mixture:
        sigmas = sound.log_sigmas.clone()
        sigmas[:, z[:, 1].round() == 4] = 89.0  # a variance beyond float32
        return dataclasses.replace(sound, log_sigmas=sigmas)

    imagination, counts = imagined(CountingModel(change=exploding), temperature=1.0)
    assert counts == (3, 15, 12)
    overflowed = torch.tensor([[0.1, 0.2], [0.1, torch.inf], [torch.nan, 0.2]])
    assert imagination.filter.score(overflowed).tolist() == [pytest.approx(0.2), torch.inf, torch.inf]


def test_a_closed_loop_that_runs_away_stays_a_number() -> None:
    """As thesis-style imagination did once: log sigmas of 4, 10, 19 and then infinity within five steps."""
    imagination, _ = make(filtered=False, model=CountingModel(), temperature=1.0)
    generator = torch.Generator().manual_seed(1)
    imagination.model = EnvironmentModel(2, 2, WorldModelSettings(), generator)
    with torch.no_grad():
        imagination.model.dynamics.weights[-1].mul_(30.0)
    z = torch.ones(8, 2)
    for _ in range(10):
        weights = imagination.draw_weights(generator)
        step = imagination.step(z, torch.zeros(8, dtype=torch.int64), weights, generator)
        z = step.next_z
        assert all(part.isfinite().all() for part in (z, step.reward, step.p_terminated))
    assert not imagination.keeps(step).any(), "it did run away"


def made(imagination: dict[str, Any], *, filtered: bool = True, **model: Any) -> Imagination:
    settings = Settings(model=WorldModelSettings(**model), imagination=ImaginationSettings(**imagination))
    return Imagination(2, 2, settings, filtered=filtered, seeds=SeedTree(0), device=CPU)


def test_a_single_weight_sample_cannot_be_compared() -> None:
    for reader, imagination, filtered, model in (
        ("The filter", {}, True, {"dropout": 0.0}),
        ("The filter", {"weight_samples": 1}, True, {}),
        ("imagination.curiosity", {"curiosity": 0.5}, False, {"dropout": 0.0}),
        ("imagination.confidence_scale", {"confidence_scale": 1.0}, False, {"dropout": 0.0}),
        ("imagination.reward_threshold", {"reward_threshold": 1.0}, True, {"dropout": 0.0, "members": 3}),
    ):
        with pytest.raises(InvalidValueError, match=f"^{reader} compares .* here is one. Set model.dropout above 0"):
            made(imagination, filtered=filtered, **model)
    made({"weight_samples": 1}, filtered=False, dropout=0.0)
    made({"weight_samples": 2, "curiosity": 0.5, "confidence_scale": 1.0, "reward_threshold": 1.0})


@pytest.mark.parametrize(
    ("exploration", "epsilon", "least", "most"),
    [(0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.1, 0.4), (0.0, 1.0, 0.3, 0.7), (0.2, 1.0, 0.3, 0.7)],
)
def test_rollouts_explore_at_least_as_the_settings_say(
    exploration: float, epsilon: float, least: float, most: float
) -> None:
    """Half of two random actions are the greedy one."""
    imagination, controller = make(filtered=False, model=CountingModel(), breadth=200, depth=1, exploration=exploration)
    imagination.rollouts(controller, torch.zeros(2), remembering(1), epsilon)
    greedy = int(controller.values(torch.zeros(1, 2)).argmax())
    assert least <= (imagination.memory.arrays()["action"] != greedy).mean() <= most


def test_rollouts_start_from_current_or_replayed_states() -> None:
    for start, seen in (("current", {(0.0, 0.0)}), ("replayed", {(float(index), 5.0) for index in range(4)})):
        imagination, _ = imagined(CountingModel(), states=4, breadth=60, depth=1, start_states=start)
        assert {tuple(row) for row in imagination.memory.arrays()["z"].tolist()} == seen


def graded(sound: Mixture, z: torch.Tensor) -> Mixture:
    """Less certain of a transition out of (i, c), the larger i: its variance is i squared."""
    means = sound.means.clone()
    means[..., 0] = (torch.tensor([-1.0, 1.0]).repeat(T // 2)[:, None] * z[:, 0]).unsqueeze(2)
    return dataclasses.replace(sound, means=means)


@pytest.mark.parametrize(("quantile", "threshold", "kept"), [(1.0, 49.0, 3), (0.0, 0.0, 0)])
def test_a_moving_threshold_is_a_quantile_of_real_transitions(quantile: float, threshold: float, kept: int) -> None:
    moving = {"reduction": "max", "threshold_quantile": quantile, "threshold": 99.0}
    imagination, controller = make(filtered=True, model=CountingModel(change=graded), depth=1, **moving)
    for first, accepted in ((6.9, kept), (7.1, 0)):
        counts = imagination.rollouts(controller, torch.tensor([first, 0.0]), remembering(8), 0.5)
        assert counts.accepted == accepted
    assert imagination.filter.threshold == threshold
