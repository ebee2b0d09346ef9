"""The planar arm: equation 4.29 against MuJoCo, execution, workspace, choices."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from imagine_bench_regression import robot_ik as ik
from imagine_bench_regression.planar_arm import MOVE_S, PlanarArm
from imagine_bench_regression.recordings import CHOICES, record_robot
from recordings import logged

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.regression import Prediction
from imagine_bench.seeding import SeedTree


def joints(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(ik.LOW_RAD, ik.HIGH_RAD, (count, 3))


def forward(joints_rad: np.ndarray) -> np.ndarray:
    """Equation 4.29: where joints (..., 3) put the tip, in metres. Shape (..., 2)."""
    angles = np.cumsum(joints_rad, axis=-1)
    return np.stack([np.cos(angles) @ ik.LINKS_M, np.sin(angles) @ ik.LINKS_M], axis=-1)


def test_equation_4_29_is_the_models_forward_kinematics() -> None:
    model = ik.arm().model
    data = mujoco.MjData(model)
    for q in joints(50):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.site("tip").xpos[:2], forward(q), atol=1e-12)


def test_joints_stop_at_their_limits() -> None:
    beyond = np.array([[3.0, 0.0, 0.0]])
    reached = ik.arm().execute(beyond)[0]
    np.testing.assert_allclose(reached, forward(np.array([ik.HIGH_RAD[0], 0.0, 0.0])), atol=1e-3)
    assert np.linalg.norm(reached - forward(beyond)[0]) > 0.5  # without limits it would be elsewhere


def test_every_movement_begins_at_rest_at_zero() -> None:
    """Whatever was carried out before: results are the same to the bit."""
    some = joints(3, seed=5)
    one, other = PlanarArm(), PlanarArm()
    reached = one.execute(some)
    assert np.array_equal(other.execute(some[::-1]), reached[::-1])
    first, again = (each.movement(some[0], 2.0).poses_in_world for each in (other, PlanarArm()))
    assert np.array_equal(first, again)


def test_joints_that_are_no_numbers_are_not_carried_out() -> None:
    with pytest.raises(InvalidValueError, match="NaN or infinite cannot be carried out"):
        ik.arm().execute(np.array([[0.0, 0.0, 0.0], [0.1, np.nan, 0.0]]))


def test_a_movement_is_sampled_to_its_end() -> None:
    q = joints(1, seed=4)
    motion = ik.arm().movement(q[0], 25.0)
    assert motion.time_s[0] == 0.0 and motion.time_s[-1] == pytest.approx(MOVE_S)
    np.testing.assert_allclose(np.diff(motion.time_s), 1 / 25)
    still = ik.arm().movement(q[0], 100.0).poses_in_world[-1]
    np.testing.assert_allclose(motion.poses_in_world[-1], still, atol=1e-12)


def test_distance_to_the_workspace_against_brute_force() -> None:
    points = np.random.default_rng(2).uniform(-1.3, 1.3, (300, 2))
    angles = np.linspace(ik.LOW_RAD[0], ik.HIGH_RAD[0], 4001)
    elbows = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    nearest = np.linalg.norm(points[:, None] - elbows, axis=-1).min(axis=1)
    expected = np.maximum(nearest - 0.5, 0.0)
    np.testing.assert_allclose(ik.distance_to_workspace(points), expected, atol=1e-6)
    assert 50 < (expected > 0).sum() < 250  # both cases occur


def test_targets_and_places_are_uniform() -> None:
    """The first over the workspace, the second over the disc of the stretched arm, which holds it."""
    targets = ik.draw_targets(np.random.default_rng(4), 20_000)
    places = ik.draw_places(np.random.default_rng(7), 40_000)
    assert ik.distance_to_workspace(targets).max() == 0.0
    within = (ik.distance_to_workspace(places) == 0).mean()
    for points, share in ((targets, 0.25 / within), (places, 0.25)):  # the inner disc lies inside as a whole
        assert (np.linalg.norm(points, axis=1) < 0.5).mean() == pytest.approx(share, rel=0.05)
        assert np.linalg.norm(points, axis=1).max() <= 1.0


def test_babbling_is_what_was_reached_and_the_joints_with_noise() -> None:
    data = ik.training("200", np.random.default_rng(6))
    commanded = joints(200, seed=6)
    np.testing.assert_allclose(data.inputs, forward(commanded), atol=2e-4)
    assert (data.targets - commanded).std() == pytest.approx(0.01, rel=0.1), "radians"


def test_a_number_of_samples_has_one_spelling() -> None:
    """So no bench compares a variant with itself."""
    assert ik.samples_of("50") == 50
    for other in ("050", "٥٠", "50.0", "+50"):
        with pytest.raises(InvalidValueError, match=re.escape(f"such as 2000, not {other!r}")):
            ik.samples_of(other)


def test_decisions_are_carried_out_by_the_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of networks with any output: the arm rests where equation 4.29 puts the joints, and misses by that."""

    def predict(points: np.ndarray, purpose: str) -> Prediction:
        shape, rng = points.shape[:2], np.random.default_rng(len(purpose))
        said: dict[str, Any] = {field.name: rng.random(shape) for field in dataclasses.fields(Prediction)}
        said |= {name: rng.random((*shape, 3)) for name in ("mean", "epistemic", "aleatoric", "modal")}
        said["prediction"] = rng.uniform(ik.LOW_RAD, ik.HIGH_RAD, (*shape, 3))
        return Prediction(**said)

    monkeypatch.setattr(ik, "DECISIONS", 5)
    monkeypatch.setattr(ik, "GRID", 9)
    found = ik.evaluate("100", predict, (SeedTree(0), SeedTree(1)))
    for part in ("decision", "disc"):
        reached, points = found[f"{part}/reached"], found[f"{part}/points"]
        assert reached.shape == points.shape == (2, ik.DECISIONS, ik.CANDIDATES, 2)
        np.testing.assert_allclose(reached, forward(found[f"{part}/joints"]), atol=2e-4)
        np.testing.assert_array_equal(found[f"{part}/error"], np.linalg.norm(reached - points, axis=-1))
        asked, said = points.reshape(-1, 2), found[f"{part}/joints"].reshape(-1, 3)
        np.testing.assert_array_equal(ik.errors("100", asked, said), found[f"{part}/error"].ravel())
    assert (ik.distance_to_workspace(points) > 0.1).any(), "some are out of reach"
    assert not np.array_equal(found["decision/points"][0], found["decision/points"][1]), "networks are asked elsewhere"
    np.testing.assert_array_equal(found["babbling"], ik.training("100", SeedTree(0).child("data").generator()).inputs)
    outside = found["map/outside_m"] > 0
    assert np.isnan(found["map/error"][:, outside]).all() and np.isfinite(found["map/error"][:, ~outside]).all()


def test_a_recording_shows_the_surest_choice_and_by_how_much_it_misses(tmp_path: Path) -> None:
    """It misses by the line from the place reached to the place asked for. All candidates miss by more on average."""
    shape = (1, CHOICES, 3)
    rng = np.random.default_rng(10)
    data = {f"decision/{end}": rng.random((*shape, 2)) for end in ("points", "reached")}
    data["decision/joints"] = joints(CHOICES * 3).reshape(*shape, 3)
    data["decision/epistemic"] = np.tile([0.3, 0.1, 0.2], (*shape[:2], 1))
    data["decision/error"] = np.linspace(0.01, 0.9, CHOICES * 3).reshape(shape)
    path = record_robot({"100": data}, task=ik.SPEC, name="mdn", path=tmp_path / "arm.rrd")

    def shown(entity: str, column: str) -> dict[int, Any]:
        """The last value of each choice."""
        return dict(logged(path, f"/{entity}", column, "choice"))

    texts = shown("choice/text", "TextDocument:text")
    lines, rings = (shown(f"choice/{name}", "LineStrips3D:strips") for name in ("error_line", "chosen"))
    colors = shown("choice/candidates", "Points3D:colors")
    arms = shown("scene/link_3", "Transform3D:translation")
    for choice, errors in enumerate(100.0 * data["decision/error"][0], start=1):
        surest = (0, choice - 1, 1)
        said = [float(number) for number in re.findall(r"misses by ([\d.]+) cm", texts[choice][0])]
        np.testing.assert_allclose(said, [errors[1], errors.mean()], atol=0.051)
        ends = [[*data[f"decision/{end}"][surest], 0.02] for end in ("reached", "points")]
        np.testing.assert_allclose(lines[choice][0], ends, atol=1e-6)
        np.testing.assert_allclose(np.mean(rings[choice][0][:-1], axis=0), ends[1], atol=1e-6)
        assert [tuple(each.to_bytes(4)[:3]) for each in colors[choice]] == [(213, 94, 0), (0, 114, 178), (106, 104, 89)]
        reaches = ik.arm().movement(data["decision/joints"][surest], 25.0)
        link = reaches.poses_in_world[-1, reaches.body_names.index("link_3"), :3]
        np.testing.assert_allclose(arms[choice][0], link, atol=1e-6)
