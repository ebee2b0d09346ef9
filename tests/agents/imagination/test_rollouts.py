"""Imagined rollouts: where they end, what the filter discards, where they are stored."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from counting_model import CPU, CountingModel, T, make, remembering
from imagine_bench.agents.dqn import Controller
from imagine_bench.agents.dqn_settings import ControllerSettings
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.rollouts import LATENT_LIMIT, Imagination
from imagine_bench.agents.imagination.settings import ImaginationSettings, Settings, WorldModelSettings
from imagine_bench.agents.imagination.world_model import EnvironmentModel
from imagine_bench.agents.replay import Batch, RealMemory
from imagine_bench.agents.snapshot import load_training, training_arrays

from imagine_bench.errors import DivergedError, InvalidValueError
from imagine_bench.seeding import SeedTree

NOTHING_REAL = RealMemory(1, 2, CPU)


def stored_counts(imagination: Imagination) -> list[float]:
    memory = imagination.memory
    return sorted(memory.arrays()["next_z"][:, 1].tolist())


def test_rollouts_run_to_their_full_depth_in_closed_loop() -> None:
    imagination, controller = make(filtered=True, model=CountingModel())
    counts = imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5)
    assert dataclasses.astuple(counts) == (3, 30, 30)
    assert stored_counts(imagination) == sorted(3 * [float(c) for c in range(1, 11)])
    rows = imagination.memory.arrays()
    assert (rows["reward"] == 10.0 * rows["next_z"][:, 1]).all()
    assert (rows["next_z"][:, 1] - rows["z"][:, 1] == 1.0).all()


def test_a_predicted_end_is_stored_and_ends_the_rollout() -> None:
    imagination, controller = make(filtered=True, model=CountingModel(end_at=4))
    imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5)
    rows = imagination.memory.arrays()
    assert stored_counts(imagination) == sorted(3 * [1.0, 2.0, 3.0, 4.0])
    assert (rows["terminated"] == (rows["next_z"][:, 1] == 4.0)).all()


def test_the_filter_ends_a_rollout_at_an_uncertain_transition() -> None:
    imagination, controller = make(filtered=True, model=CountingModel(uncertain_at=5))
    counts = imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5)
    assert stored_counts(imagination) == sorted(3 * [1.0, 2.0, 3.0, 4.0])
    assert dataclasses.astuple(counts) == (3, 15, 12)


@pytest.mark.parametrize("how", ["average", "network", "sample"])
def test_what_is_imagined_is_of_the_chosen_weights(how: str) -> None:
    """Means of one component each: over all weight samples, of the network without dropout, or of one sample a row."""
    model = WorldModelSettings(components=1, dropout=0.5, dynamics_hidden=(16,))
    settings = Settings(model=model, imagination=ImaginationSettings(temperature=0.0, predicts_with=how))
    imagination = Imagination(2, 2, settings, filtered=True, seeds=SeedTree(0), device=CPU)
    generator = torch.Generator().manual_seed(0)
    z, action = torch.ones(500, 2), torch.zeros(500, dtype=torch.int64)
    weights = imagination.draw_weights(generator)
    found = imagination.step(z, action, weights, generator).next_z
    means = imagination.model.predict(z, action, weights.dynamics).means[..., 0, :]  # [T, N, Z]
    whole = imagination.model.predict(z, action, None).means[0, :, 0]
    near = [torch.isclose(found, mean, atol=1e-6).all(dim=-1) for mean in (means.mean(dim=0), whole)]
    of_one = torch.isclose(found, means, atol=1e-6).all(dim=-1)  # [T, N]
    assert [bool(each.all()) for each in near] == [how == "average", how == "network"]
    assert bool(of_one.any(dim=0).all()) == (how == "sample")
    if how == "sample":
        assert of_one.any(dim=1).all(), "all of them are drawn"


@pytest.mark.parametrize("part", ["log_weights", "means", "log_sigmas"])
def test_imagination_that_is_no_number_is_not_stored(part: str) -> None:
    class Diverged(CountingModel):
        def predict(self, z: torch.Tensor, action: torch.Tensor, weights: None) -> Mixture:
            sound = super().predict(z, action, weights)
            return dataclasses.replace(sound, **{part: torch.full_like(getattr(sound, part), torch.nan)})

    imagination, controller = make(filtered=False, model=Diverged(), temperature=1.0)
    with pytest.raises(DivergedError, match=r"imagines is no longer a number\. Lower model\.learning_rate\."):
        imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5)
    assert stored_counts(imagination) == []


@pytest.mark.parametrize("filtered", [False, True])
def test_a_rollout_ends_before_its_variance_overflows(filtered: bool) -> None:
    class Exploding(CountingModel):
        def predict(self, z: torch.Tensor, action: torch.Tensor, weights: None) -> Mixture:
            sound = super().predict(z, action, weights)
            sigmas = sound.log_sigmas.clone()
            sigmas[:, z[:, 1].round() == 4] = 89.0  # a variance beyond float32
            return dataclasses.replace(sound, log_sigmas=sigmas)

    imagination, controller = make(filtered=filtered, model=Exploding(), temperature=1.0)
    counts = imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5)
    assert dataclasses.astuple(counts) == (3, 15, 12)
    assert [round(count) for count in stored_counts(imagination)] == sorted(3 * [1, 2, 3, 4])


def test_a_closed_loop_that_runs_away_stays_a_number() -> None:
    """As thesis-style imagination did once: log sigmas of 4, 10, 19 and then infinity within five steps."""
    imagination, _ = make(filtered=False, model=CountingModel(), temperature=1.0)
    generator = torch.Generator().manual_seed(1)
    imagination.model = EnvironmentModel(2, 2, WorldModelSettings(), generator)
    with torch.no_grad():
        imagination.model.dynamics.weights[-1].mul_(30.0)
    z, action, kept = torch.ones(8, 2), torch.zeros(8, dtype=torch.int64), []
    for _ in range(10):
        step = imagination.step(z, action, imagination.draw_weights(generator), generator)
        assert all(part.isfinite().all() for part in (step.next_z, step.reward, step.p_terminated))
        kept.append(imagination.keeps(step))
        z = step.next_z
    assert kept[0].all() and not kept[-1].any(), "it began as latents are and did run away"


def test_what_is_kept_of_a_diverging_rollout_can_be_learned_from() -> None:
    """A whole batch just below the limit leaves a controller finite that has learned; far beyond it would end the run.

    With rewards as a reward network gives them there, which has learned too and grows with the latents as well.
    """
    draws = torch.Generator().manual_seed(1)
    model, controller = (
        EnvironmentModel(24, 6, WorldModelSettings(), draws),
        Controller(24, 6, ControllerSettings(), draws),
    )
    memory = RealMemory(500, 24, CPU)
    for step in range(500):
        now, then = (torch.randn(24, generator=draws) for _ in range(2))
        spread = torch.full((24,), 0.1)
        memory.add((now, spread), step % 6, float(50 * (then[0] > 1)), (then, spread), terminated=bool(then[0] > 1))
    for _ in range(150):
        model.update(memory.sample(64, draws), draws)
        controller.update(memory.sample(64, draws))
    learned = training_arrays(controller, controller.optimiser)

    def learn(size: float) -> float:
        load_training(controller, controller.optimiser, learned)
        z, next_z = (size * torch.randn(64, 24, generator=draws).sign() for _ in range(2))
        action = torch.randint(6, (64,), generator=draws)
        reward, _ = model.predict_outcome(z, action, next_z)
        loss = controller.update(Batch(z, action, reward, next_z, torch.zeros(64)))
        assert all(bool(weight.isfinite().all()) for weight in controller.parameters())
        return loss

    assert np.isfinite(learn(0.99 * LATENT_LIMIT))
    with pytest.raises(DivergedError):
        learn(1e20)


def test_a_variance_that_overflowed_counts_as_infinite() -> None:
    imagination, _ = make(filtered=True, model=CountingModel())
    variances = torch.tensor([[0.1, 0.2], [0.1, torch.inf], [torch.nan, 0.2]])
    assert imagination.filter.score(variances).tolist() == [pytest.approx(0.2), torch.inf, torch.inf]


def test_without_the_filter_uncertain_transitions_are_kept() -> None:
    imagination, controller = make(filtered=False, model=CountingModel(uncertain_at=5))
    counts = imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5)
    assert counts.accepted == counts.predicted == 30


@pytest.mark.parametrize(("limit", "kept"), [(1.9, 4), (2.1, 10), (None, 10)])
def test_an_uncertain_reward_ends_a_rollout(limit: float | None, kept: int) -> None:
    imagination, controller = make(filtered=True, model=CountingModel(reward_uncertain_at=5), reward_threshold=limit)
    assert imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5).accepted == 3 * kept
    assert stored_counts(imagination) == sorted(3 * [float(count) for count in range(1, kept + 1)])


@pytest.mark.parametrize(("limit", "kept"), [(0.2, 4), (0.31, 10), (None, 10)])
def test_an_uncertain_termination_ends_a_rollout(limit: float | None, kept: int) -> None:
    imagination, controller = make(filtered=True, model=CountingModel(torn_at=5), termination_threshold=limit)
    assert imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5).accepted == 3 * kept
    unfiltered, controller = make(filtered=False, model=CountingModel(torn_at=5), termination_threshold=limit)
    assert unfiltered.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5).accepted == 30


def test_a_certain_termination_passes_the_filter() -> None:
    imagination, controller = make(filtered=True, model=CountingModel(end_at=4), termination_threshold=0.0)
    assert imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5).accepted == 12


def test_without_the_filter_an_uncertain_reward_is_kept() -> None:
    imagination, controller = make(filtered=False, model=CountingModel(reward_uncertain_at=5), reward_threshold=0.1)
    assert imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5).accepted == 30


def test_a_reward_threshold_without_dropout_is_refused() -> None:
    settings = Settings(
        model=WorldModelSettings(dropout=0.0, members=3), imagination=ImaginationSettings(reward_threshold=1.0)
    )
    with pytest.raises(InvalidValueError, match=r"dropout samples of the reward network.*model\.dropout above 0"):
        Imagination(2, 2, settings, filtered=True, seeds=SeedTree(0), device=CPU)


@pytest.mark.parametrize(("dropout", "samples"), [(0.5, 1), (0.0, 10)])
def test_a_filter_with_a_single_weight_sample_is_refused(dropout: float, samples: int) -> None:
    model, imagination = WorldModelSettings(dropout=dropout), ImaginationSettings(weight_samples=samples)
    settings = Settings(model=model, imagination=imagination)
    with pytest.raises(InvalidValueError, match=r"there is one\. Set model\.dropout above 0 and imagination\.w") as no:
        Imagination(2, 2, settings, filtered=True, seeds=SeedTree(0), device=CPU)
    assert str(no.value).startswith("The filter") and str(no.value).endswith("or choose the agent without the filter.")
    Imagination(2, 2, settings, filtered=False, seeds=SeedTree(0), device=CPU)
    curious = dataclasses.replace(settings, imagination=dataclasses.replace(imagination, curiosity=0.5))
    with pytest.raises(InvalidValueError, match=r"^imagination\.curiosity compares .*, or set it to 0\.$"):
        Imagination(2, 2, curious, filtered=False, seeds=SeedTree(0), device=CPU)


@pytest.mark.parametrize(("reduction", "accepted"), [("max", 12), ("mean", 30)])
def test_the_threshold_is_compared_with_the_named_reduction(reduction: str, accepted: int) -> None:
    # The epistemic variance at the uncertain step is (5, 0): 5 at most, 2.5 on average.
    imagination, controller = make(
        filtered=True, model=CountingModel(uncertain_at=5), reduction=reduction, threshold=4.0
    )
    assert imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5).accepted == accepted


def test_nothing_is_stored_where_all_is_uncertain() -> None:
    imagination, controller = make(filtered=True, model=CountingModel(uncertain_at=1))
    assert imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5).accepted == 0
    assert len(imagination.memory) == 0


def test_rollouts_explore_at_least_as_the_settings_say() -> None:
    greedy, controller = make(filtered=False, model=CountingModel(), breadth=200, depth=1)
    greedy.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.0)
    assert len(set(greedy.memory.arrays()["action"].tolist())) == 1
    exploring, controller = make(filtered=False, model=CountingModel(), breadth=200, depth=1, exploration=0.5)
    exploring.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.0)
    share = (exploring.memory.arrays()["action"] != greedy.memory.arrays()["action"][0]).mean()
    assert 0.1 < share < 0.4  # half of the random half
    following, controller = make(filtered=False, model=CountingModel(), breadth=200, depth=1, exploration=0.0)
    following.rollouts(controller, torch.zeros(2), NOTHING_REAL, 1.0)
    share = (following.memory.arrays()["action"] != greedy.memory.arrays()["action"][0]).mean()
    assert 0.3 < share < 0.7  # half: the robot's own exploration is larger


def test_the_components_of_different_networks_are_not_averaged() -> None:
    class Swapped(CountingModel):
        """Two networks that say the same, z - 1 or z + 1, with their components in another order."""

        members = 2

        def predict(self, z: torch.Tensor, action: torch.Tensor, weights: None) -> Mixture:
            order = torch.tensor([[-1.0, 1.0], [1.0, -1.0]]).repeat_interleave(T, dim=0)  # [2 T, K]
            means = z[None, :, None, :] + order[:, None, :, None]  # [2 T, N, K, Z]
            return Mixture(torch.full(means.shape[:3], -0.7), means, torch.full_like(means, -9.0))

    imagination, controller = make(filtered=False, model=Swapped(), depth=1, breadth=50)
    imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5)
    assert set(imagination.memory.arrays()["next_z"].ravel().tolist()) <= {-1.0, 1.0}


def test_rollouts_start_from_current_or_replayed_states() -> None:
    for start, seen in (("current", {(0.0, 0.0)}), ("replayed", {(float(index), 5.0) for index in range(4)})):
        imagination, controller = make(filtered=False, model=CountingModel(), breadth=60, depth=1, start_states=start)
        imagination.rollouts(controller, torch.zeros(2), remembering(4), 0.5)
        assert {tuple(row) for row in imagination.memory.arrays()["z"].tolist()} == seen


@pytest.mark.parametrize(("quantile", "threshold", "kept"), [(1.0, 49.0, [3, 0]), (0.0, 0.0, [0, 0])])
def test_a_moving_threshold_is_a_quantile_of_real_transitions(
    quantile: float, threshold: float, kept: list[int]
) -> None:
    class Graded(CountingModel):
        """Is less certain of a transition out of (i, c), the larger i: its variance is i squared."""

        def predict(self, z: torch.Tensor, action: torch.Tensor, weights: None) -> Mixture:
            spread = torch.tensor([-1.0, 1.0])[:, None] * z[:, 0]  # [2, N]
            means = torch.stack([spread, torch.zeros_like(spread)], dim=-1).unsqueeze(2)  # [2, N, 1, Z]
            return Mixture(torch.zeros(2, len(z), 1), means, torch.full_like(means, -9.0))

    imagination, controller = make(
        filtered=True, model=Graded(), depth=1, reduction="max", threshold_quantile=quantile, threshold=99.0
    )
    accepted = [
        imagination.rollouts(controller, torch.tensor([first, 0.0]), remembering(8), 0.5).accepted
        for first in (6.9, 7.1)
    ]
    assert imagination.filter.threshold == threshold
    assert accepted == kept


@pytest.mark.parametrize(
    ("model", "limits"),
    [
        (CountingModel(), {"threshold": 0.0}),
        (CountingModel(reward_uncertain_at=5), {"reward_threshold": 2.0}),
        (CountingModel(torn_at=5), {"termination_threshold": float(np.float32(0.3))}),
    ],
)
def test_what_is_as_uncertain_as_the_threshold_passes(model: CountingModel, limits: dict[str, float]) -> None:
    imagination, controller = make(filtered=True, model=model, **limits)
    assert imagination.rollouts(controller, torch.zeros(2), NOTHING_REAL, 0.5).accepted == 30


def test_a_moved_threshold_comes_back() -> None:
    def filtering() -> Imagination:
        settings = Settings(imagination=ImaginationSettings(threshold=99.0, threshold_quantile=0.5))
        return Imagination(2, 2, settings, filtered=True, seeds=SeedTree(0), device=CPU)

    moved, resumed = filtering(), filtering()
    moved.filter.move_threshold(moved.model, remembering(4), moved.draw_weights(moved.generators["dropout"]).dynamics,
                                moved.generators["replay"])  # fmt: skip
    assert moved.filter.threshold < 99.0
    resumed.load(moved.arrays(), 0)
    assert resumed.filter.threshold == moved.filter.threshold
