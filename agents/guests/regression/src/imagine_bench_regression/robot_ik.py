"""Inverse kinematics learned by motor babbling (thesis 4.5.2): which place can the robot trust itself to reach?

A planar arm of three links sets random joint configurations and sees where its tip comes to rest; networks learn the
way back, from places to configurations, of which there are several. Every predicted configuration is carried out in
MuJoCo.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from imagine_bench.arrays import Arrays, Floats
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.regression import Predict, Prediction, RegressionData, RegressionSpec
from imagine_bench.seeding import SeedTree

if TYPE_CHECKING:
    from .planar_arm import PlanarArm

LINKS_M = (0.5, 0.3, 0.2)
LOW_RAD = np.array([-2 * np.pi / 3, -3.6, -3.6])
HIGH_RAD = -LOW_RAD
NOISE_RAD = 0.01
"""Standard deviation of the noise on the joint positions that are learned."""
CANDIDATES = 20
DECISIONS = 50
"""Points to choose from, and choices cumulated (table 4.1)."""
MIN_SAMPLES = 20
MAX_SAMPLES = 1_000_000
GRID = 45
"""Points a side of the maps of figures 4.2 and 4.3, over the square that holds the workspace and a margin."""
MARGIN_M = 1.1


@functools.cache
def arm() -> PlanarArm:
    """This process' arm."""
    from .planar_arm import PlanarArm  # noqa: PLC0415 - MuJoCo loads with it, which a list of tasks does not need

    return PlanarArm()


def distance_to_workspace(points_m: Floats) -> Floats:
    """How far points lie outside of the arm's reach, in metres; 0 inside. Points (..., 2), result (...).

    With the elbow at polar angle t, |t| <= 120 degrees, the two outer links reach the ring of radii 0.1 and 0.5 m
    around it. A point is outside exactly if its nearest elbow is more than 0.5 m away, by the missing distance.
    """
    radius = np.linalg.norm(points_m, axis=-1)
    angle = np.arctan2(points_m[..., 1], points_m[..., 0])
    elbow = np.clip(angle, LOW_RAD[0], HIGH_RAD[0])
    nearest = np.sqrt(radius**2 + LINKS_M[0] ** 2 - 2 * radius * LINKS_M[0] * np.cos(angle - elbow))
    return np.maximum(nearest - LINKS_M[1] - LINKS_M[2], 0.0)


def draw_targets(rng: np.random.Generator, count: int) -> Floats:
    """Points drawn uniformly from the workspace. Shape (count, 2), in metres."""
    found = np.empty((0, 2))
    while len(found) < count:  # more than half of the square is workspace
        points = rng.uniform(-1.0, 1.0, size=(2 * count, 2))
        found = np.concatenate([found, points[distance_to_workspace(points) == 0]])
    return found[:count]


def draw_places(rng: np.random.Generator, count: int) -> Floats:
    """Points drawn uniformly from the disc of the stretched arm, within reach or not. Shape (count, 2), in metres."""
    radius = sum(LINKS_M) * np.sqrt(rng.random(count))
    angle = rng.uniform(-np.pi, np.pi, size=count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def samples_of(variant: str) -> int:
    """The number of motor babbling samples that a variant names.

    Raises:
        InvalidValueError: It is not a whole number in the allowed range.
    """
    written = variant.isdecimal() and str(int(variant)) == variant  # each number in one way: 50, not 050
    if not written or not MIN_SAMPLES <= int(variant) <= MAX_SAMPLES:
        raise InvalidValueError(
            f"A variant of robot_ik is a number of samples in [{MIN_SAMPLES}, {MAX_SAMPLES}], such as 2000, "
            f"not {variant!r}."
        )
    return int(variant)


def training(variant: str, rng: np.random.Generator) -> RegressionData:
    """Motor babbling: uniform joint configurations, carried out; the place reached, and the joints with noise."""
    return testing(variant, rng, samples_of(variant))


def testing(variant: str, rng: np.random.Generator, count: int) -> RegressionData:
    """More of the same babbling."""
    joints_rad = rng.uniform(LOW_RAD, HIGH_RAD, size=(count, 3))
    noise_rad = NOISE_RAD * rng.standard_normal(joints_rad.shape)
    return RegressionData(inputs=arm().execute(joints_rad), targets=joints_rad + noise_rad)


def errors(variant: str, inputs: Floats, predictions: Floats) -> Floats:
    """How far from places (N, 2) the tip comes to rest when joints (N, 3) are carried out, in metres. Shape (N,).

    A place out of reach is missed by its distance from the workspace at least.
    """
    return np.linalg.norm(arm().execute(predictions) - inputs, axis=-1)


def evaluate(variant: str, predict: Predict, seeds: tuple[SeedTree, ...]) -> Arrays:
    """The decisions of table 4.1 and the maps of figures 4.2 and 4.3.

    Returns:
        ``decision/...``: ``points`` and where the tip came to rest instead, ``reached`` (E, DECISIONS, CANDIDATES, 2),
        ``error``, ``joints`` and one entry a score of the same leading shape.
        ``disc/...``: the same of choices among points of the whole disc of the stretched arm, some out of reach.
        ``map/...``: ``points`` (G, 2), ``outside_m`` (G,), ``error`` (E, G), NaN where unreachable, ``stationarity``
        (E, G), and the three uncertainties a joint (E, G, 3). ``babbling``: the first network's places (N, 2).
    """
    count = DECISIONS * CANDIDATES
    within = np.stack([draw_targets(node.child("candidates").generator(), count) for node in seeds])
    anywhere = np.stack([draw_places(node.child("disc").generator(), count) for node in seeds])
    return {
        **_map(variant, predict, len(seeds)),
        **_decide("decision", within, predict(within, "decisions")),
        **_decide("disc", anywhere, predict(anywhere, "disc")),
        "babbling": training(variant, seeds[0].child("data").generator()).inputs,
    }


def _decide(part: str, points_m: Floats, predicted: Prediction) -> Arrays:
    """Candidates (E, DECISIONS CANDIDATES, 2): how far each would be missed, and every score of it."""
    reached = np.stack([arm().execute(joints_rad) for joints_rad in predicted.prediction])
    measured = {
        "points": points_m,
        "error": np.linalg.norm(reached - points_m, axis=-1),
        "reached": reached,
        "joints": predicted.prediction,
        **predicted.scores,
    }
    shape = (len(points_m), DECISIONS, CANDIDATES)
    return {f"{part}/{name}": values.reshape(*shape, *values.shape[2:]) for name, values in measured.items()}


def _map(variant: str, predict: Predict, networks: int) -> Arrays:
    side = np.linspace(-MARGIN_M, MARGIN_M, GRID)
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    outside_m = distance_to_workspace(points)
    inside = outside_m == 0
    predicted = predict(np.broadcast_to(points, (networks, *points.shape)), "map")
    error = np.full((networks, len(points)), np.nan)
    error[:, inside] = [errors(variant, points[inside], joints_rad[inside]) for joints_rad in predicted.prediction]
    return {
        "map/points": points,
        "map/outside_m": outside_m,
        "map/error": error,
        "map/stationarity": predicted.stationarity,
        "map/epistemic": predicted.epistemic,
        "map/aleatoric": predicted.aleatoric,
        "map/modal": predicted.modal,
    }


SPEC = RegressionSpec(
    id="robot_ik",
    title="Robot inverse kinematics",
    description=(
        "A planar arm of three links moves at random and sees where its tip ends; from that it learns which joint "
        "angles lead to a place. Then it may choose one of 20 places to reach for: does it choose one it can reach?"
    ),
    variants=("1000", "2000", "3000"),
    require_variant=samples_of,
    training=training,
    testing=testing,
    errors=errors,
    error_name="distance between the place asked for and the place reached (m)",
    wrong_above=0.1,
    evaluate=evaluate,
    sections="imagine_bench_regression.sections:robot_sections",
    recorder="imagine_bench_regression.recordings:record_robot",
    scene=arm,
)
