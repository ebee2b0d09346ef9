"""Models of several seeds that learn as one become what each becomes alone."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from imagine_bench.agents.controller import Controller
from imagine_bench.agents.controller import update_together as update_controllers
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.imagination.world_model import ModelLosses, Update, WorldModel, update_together
from imagine_bench.agents.networks import joint
from imagine_bench.agents.replay import Batch
from imagine_bench.agents.settings import ControllerSettings, WorldModelSettings

from imagine_bench.bench.cohort import side_by_side
from imagine_bench.errors import DivergedError

Z, A = 6, 3
SMALL = WorldModelSettings(
    dynamics_hidden=(24, 16), components=2, reward_hidden=(16, 8), termination_hidden=(8, 4), precision="float32"
)


def batches(count: int, seed: int = 0, rows: int = 32) -> list[Batch]:
    draws = torch.Generator().manual_seed(seed)
    return [
        Batch(
            z=torch.randn(rows, Z, generator=draws),
            action=torch.randint(A, (rows,), generator=draws),
            reward=torch.randn(rows, generator=draws),
            next_z=torch.randn(rows, Z, generator=draws),
            terminated=(torch.rand(rows, generator=draws) < 0.3).float(),
        )
        for _ in range(count)
    ]


def models(count: int, settings: WorldModelSettings) -> list[tuple[WorldModel, torch.Generator]]:
    """World models of seeds 0 to ``count`` - 1, each with what draws its masks."""
    return [
        (WorldModel(Z, A, settings, torch.Generator().manual_seed(seed)), torch.Generator().manual_seed(100 + seed))
        for seed in range(count)
    ]


def assert_same(one: dict[str, np.ndarray], other: dict[str, np.ndarray], tolerance: float) -> None:
    for name, array in one.items():
        np.testing.assert_allclose(other[name], array, rtol=tolerance, atol=tolerance, err_msg=name)


@pytest.mark.parametrize(
    ("changes", "tolerance"),
    [
        ({}, 1e-5),
        ({"dropout": 0.0, "members": 3, "predict_change": True, "gradient_clip": 0.1}, 1e-5),
        ({"shared_hidden": (16, 8), "assessment_input": "transition", "max_norm": None}, 1e-5),
        ({"precision": "bfloat16"}, 1e-3),
    ],
)
def test_world_models_learn_together_as_alone(changes: dict[str, Any], tolerance: float) -> None:
    settings = dataclasses.replace(SMALL, **changes)
    alone, abreast = models(3, settings), models(3, settings)
    for step in range(4):
        given = batches(3, seed=step)
        said = [model.update(batch, dropout) for (model, dropout), batch in zip(alone, given, strict=True)]
        heard = update_together(
            [Update(model, batch, dropout) for (model, dropout), batch in zip(abreast, given, strict=True)]
        )
        for one, other in zip(said, heard, strict=True):
            assert isinstance(other, ModelLosses)
            assert dataclasses.astuple(other) == pytest.approx(dataclasses.astuple(one), rel=tolerance)
    for (one, _), (other, _), (first, _) in zip(alone, abreast, models(3, settings), strict=True):
        assert_same(one.optimiser.arrays(), other.optimiser.arrays(), tolerance)
        moved = np.abs(other.optimiser.arrays()["value"] - first.optimiser.arrays()["value"]).max()
        assert moved > 3 * tolerance, "they must have learned something to agree on"


@pytest.mark.parametrize("target_rate", [1.0, 0.1])
def test_controllers_learn_together_as_alone(target_rate: float) -> None:
    settings = ControllerSettings(hidden=(16, 8), target_rate=target_rate, gradient_clip=1.0)
    alone, abreast = (
        [Controller(Z, A, settings, torch.Generator().manual_seed(seed)) for seed in range(3)] for _ in range(2)
    )
    for step in range(4):
        given = batches(3, seed=step)
        said = [controller.update(batch) for controller, batch in zip(alone, given, strict=True)]
        assert update_controllers(list(zip(abreast, given, strict=True))) == pytest.approx(said, rel=1e-5)
    for one, other in zip(alone, abreast, strict=True):
        assert_same(one.arrays(), other.arrays(), 1e-5)


def test_one_that_diverges_stops_alone() -> None:
    alone, abreast = models(2, SMALL), models(2, SMALL)
    fine, bad = batches(2)
    bad = dataclasses.replace(bad, z=bad.z * float("inf"))
    before = abreast[1][0].optimiser.arrays()
    alone[0][0].update(fine, alone[0][1])
    losses, error = update_together(
        [Update(model, batch, dropout) for (model, dropout), batch in zip(abreast, (fine, bad), strict=True)]
    )
    assert isinstance(losses, ModelLosses) and isinstance(error, DivergedError)
    assert_same(alone[0][0].optimiser.arrays(), abreast[0][0].optimiser.arrays(), 1e-5)
    assert_same(before, abreast[1][0].optimiser.arrays(), 0.0)


def test_company_may_change_and_a_snapshot_is_a_model_s_own() -> None:
    """Learning with two others, with one, alone, and after a snapshot was loaded is all the same to a model."""
    alone, abreast = models(3, SMALL), models(3, SMALL)
    for step, present in enumerate(((0, 1, 2), (0, 2), (2, 0), (0,), (0, 1, 2))):
        given = batches(3, seed=step)
        for seed in present:
            alone[seed][0].update(given[seed], alone[seed][1])
        update_together([Update(abreast[seed][0], given[seed], abreast[seed][1]) for seed in present])
        other = abreast[0][0].optimiser
        other.load(other.arrays())
    for (one, _), (other, _) in zip(alone, abreast, strict=True):
        assert_same(one.optimiser.arrays(), other.optimiser.arrays(), 1e-5)
        z, action = batches(1)[0].z, batches(1)[0].action
        torch.testing.assert_close(other.predict(z, action, None).means, one.predict(z, action, None).means)


def test_denormals_are_flushed_where_a_cohort_learns(monkeypatch: pytest.MonkeyPatch) -> None:
    """The flag belongs to a greenlet, and what a cohort does together is done by another than its members.

    Moments of units that have died decay through the denormals; on some processors each costs a hundred times more.
    """
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no flag to flush them by")
    tiny = torch.full((64,), 1e-39)
    assert (tiny * 0.5).any(), "they must count before"
    descend, found = WorldModel.descend, []
    monkeypatch.setattr(
        WorldModel, "descend", lambda self, *how: (found.append(bool((tiny * 0.5).any())), descend(self, *how))[1]
    )

    def work(seed: int) -> None:
        prepare_torch("cpu")
        model = WorldModel(Z, A, SMALL, torch.Generator().manual_seed(seed))
        model.update(batches(1, seed)[0], torch.Generator().manual_seed(seed))

    ended = side_by_side([lambda: work(0), lambda: work(1)])
    torch.set_flush_denormal(True)  # as every learner of the suite runs
    assert ended == [None, None] and found == [False, False]


def test_one_tensor_is_not_copied() -> None:
    x = torch.ones(3)
    assert joint.stacked([x]).data_ptr() == x.data_ptr() and joint.stacked([x, x]).shape == (2, 3)
