"""The planar arm: equation 4.29 against MuJoCo, execution, workspace, mink."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.robot_ik import spec as ik
from imagine_bench.tasks.robot_ik.planar_arm import MOVE_S

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.regression import Prediction
from imagine_bench.seeding import SeedTree


def joints(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(ik.LOW_RAD, ik.HIGH_RAD, (count, 3))


def forward(joints_rad: np.ndarray) -> np.ndarray:
    """Equation 4.29: joints (..., 3) to the tip's place (..., 2)."""
    angles = np.cumsum(joints_rad, axis=-1)
    return np.stack([np.cos(angles) @ ik.LINKS_M, np.sin(angles) @ ik.LINKS_M], axis=-1)


def test_equation_4_29_is_the_models_forward_kinematics() -> None:
    model = ik.arm().model
    data = mujoco.MjData(model)
    for q in joints(50):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.site("tip").xpos[:2], forward(q), atol=1e-12)


def test_the_arm_comes_to_rest_where_it_was_sent() -> None:
    q = joints(100, seed=1)
    missed_m = np.linalg.norm(ik.arm().execute(q) - forward(q), axis=1)
    assert missed_m.max() < 2e-4 and np.median(missed_m) < 1e-5


def test_joints_stop_at_their_limits() -> None:
    beyond = np.array([[3.0, 0.0, 0.0]])
    reached = ik.arm().execute(beyond)[0]
    np.testing.assert_allclose(reached, forward(np.array([ik.HIGH_RAD[0], 0.0, 0.0])), atol=1e-3)
    assert np.linalg.norm(reached - forward(beyond)[0]) > 0.5  # without limits it would be elsewhere


def test_joints_that_are_no_numbers_are_not_carried_out() -> None:
    with pytest.raises(InvalidValueError, match="NaN or infinite cannot be carried out"):
        ik.arm().execute(np.array([[0.0, 0.0, 0.0], [0.1, np.nan, 0.0]]))


@pytest.mark.parametrize("hz", [30.0, 1e6])
def test_a_movement_is_sampled_to_its_end(hz: float) -> None:
    q = joints(1, seed=4)
    motion = ik.arm().movement(q[0], hz)
    assert motion.time_s[0] == 0.0 and motion.time_s[-1] == pytest.approx(MOVE_S)
    timestep_s = ik.arm().model.opt.timestep
    gaps_s = np.diff(motion.time_s)
    assert gaps_s[:-1].min() >= 1 / hz - 1e-9 and gaps_s.max() <= 1 / hz + 2 * timestep_s
    still = ik.arm().movement(q[0], 1e6).poses_in_world[-1]
    np.testing.assert_allclose(motion.poses_in_world[-1], still, atol=1e-12)


def test_distance_to_the_workspace_against_brute_force() -> None:
    points = np.random.default_rng(2).uniform(-1.3, 1.3, (300, 2))
    angles = np.linspace(ik.LOW_RAD[0], ik.HIGH_RAD[0], 4001)
    elbows = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    nearest = np.linalg.norm(points[:, None] - elbows, axis=-1).min(axis=1)
    expected = np.maximum(nearest - 0.5, 0.0)
    np.testing.assert_allclose(ik.distance_to_workspace(points), expected, atol=1e-6)
    assert 50 < (expected > 0).sum() < 250  # both cases occur


def test_mink_reaches_every_kind_of_target() -> None:
    rng = np.random.default_rng(3)
    targets = ik.draw_targets(rng, 40)
    solved = ik.arm().solve(targets, rng)
    assert np.linalg.norm(forward(solved) - targets, axis=1).max() < 2e-3
    assert (solved >= ik.LOW_RAD - 1e-6).all() and (solved <= ik.HIGH_RAD + 1e-6).all()


def test_targets_and_places_are_uniform() -> None:
    """The first over the workspace, the second over the disc of the stretched arm, which holds it."""
    targets = ik.draw_targets(np.random.default_rng(4), 20_000)
    places = ik.draw_places(np.random.default_rng(7), 40_000)
    assert ik.distance_to_workspace(targets).max() == 0.0 and np.linalg.norm(places, axis=1).max() <= 1.0
    within = (ik.distance_to_workspace(places) == 0).mean()
    inner, all_inner = ((np.linalg.norm(points, axis=1) < 0.5).mean() for points in (targets, places))
    assert inner == pytest.approx(0.25 / within, rel=0.05), "that disc lies inside as a whole"
    assert all_inner == pytest.approx(0.25, abs=0.01) and np.abs(places.mean(axis=0)).max() < 0.02


def test_a_place_out_of_reach_is_missed_by_its_distance_at_least() -> None:
    places = ik.draw_places(np.random.default_rng(8), 200)
    joints = np.random.default_rng(9).uniform(ik.LOW_RAD, ik.HIGH_RAD, (200, 3))
    assert (ik.missed(places, joints) >= ik.distance_to_workspace(places) - 1e-4).all()
    assert (ik.distance_to_workspace(places) > 0.1).any()


def test_babbling_is_what_was_reached_and_the_joints_with_noise() -> None:
    data = ik.training("200", np.random.default_rng(6))
    commanded = np.random.default_rng(6).uniform(ik.LOW_RAD, ik.HIGH_RAD, (200, 3))
    np.testing.assert_allclose(data.inputs, forward(commanded), atol=2e-4)
    assert (data.targets - commanded).std() == pytest.approx(ik.NOISE_RAD, rel=0.1)


def test_unreachable_targets_are_refused_with_their_distance() -> None:
    with pytest.raises(InvalidValueError, match=r"1 of 2 targets are unreachable.*\[1.2, 0.0\] m, lies 0.200 m out"):
        ik.errors("1000", np.array([[0.5, 0.0], [1.2, 0.0]]), np.zeros((2, 3)))
    at_a_stop = np.array([[2 * np.pi / 3, 2 * np.pi / 3 - 0.1, 0.0]])  # the edge there is hollow
    for edge, joints_rad in ((np.array([[1.0, 0.0]]), np.zeros((1, 3))), (forward(at_a_stop), at_a_stop)):
        assert ik.distance_to_workspace(edge)[0] < 1e-9
        assert ik.errors("1000", edge, joints_rad)[0] < 1e-3  # the edge itself is reachable


@pytest.mark.parametrize("variant", ["19", "1000001", "1e3"])
def test_sample_counts_out_of_range_name_the_range(variant: str) -> None:
    with pytest.raises(InvalidValueError, match=r"number of samples in \[20, 1000000\], such as 2000, not"):
        ik.require_variant(variant)


def test_decisions_are_carried_out_by_the_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of networks that say what they like: the arm rests where equation 4.29 puts the joints, and misses by that."""

    def predict(points: np.ndarray, purpose: str) -> Prediction:
        shape, rng = points.shape[:2], np.random.default_rng(len(purpose))
        said = {name: rng.random((*shape, 3)) for name in ("mean", "epistemic", "aleatoric", "modal")}
        scores = {name: rng.random(shape) for name in ("stationarity", "sampled_variance", "nll")}
        told = rng.uniform(ik.LOW_RAD, ik.HIGH_RAD, (*shape, 3))
        return Prediction(prediction=told, **said, **scores, predictive=None, drawn=None)  # type: ignore[arg-type]

    monkeypatch.setattr(ik, "DECISIONS", 5)
    monkeypatch.setattr(ik, "GRID", 9)
    found = ik.evaluate("100", predict, (SeedTree(0), SeedTree(1)))
    for part in ("decision", "disc"):
        reached, points = found[f"{part}/reached"], found[f"{part}/points"]
        assert reached.shape == points.shape == (2, ik.DECISIONS, ik.CANDIDATES, 2)
        np.testing.assert_allclose(reached, forward(found[f"{part}/joints"]), atol=2e-4)
        np.testing.assert_array_equal(found[f"{part}/error"], np.linalg.norm(reached - points, axis=-1))
    assert not np.array_equal(found["decision/points"][0], found["decision/points"][1]), "networks are asked elsewhere"
