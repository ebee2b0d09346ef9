"""Places of objects off their slots: where they are drawn, and that all readings refer to them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from by_hand import FAMILIES, FREE, STARTS, carry_out, environment
from imagine_bench.tasks.arrows.world import MAX_OFF_SLOT_M
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench.tasks.continuous.segments import measure
from imagine_bench.tasks.continuous.spec import make_pick_place
from imagine_bench.tasks.motion.orientation import about_vertical
from imagine_bench.tasks.motion.orientation import yaw_rad as yaw_of
from imagine_bench.tasks.pick_place.scene import PALM_M
from imagine_bench.tasks.scenes.objects import standing_m
from imagine_bench.tasks.world import Reading, World

from imagine_bench.errors import InvalidValueError


@pytest.mark.parametrize(
    ("family", "most_m", "options"),
    [("arrows", 0.04, {"cubes": 1}), ("arrows", 0.02, {}), ("arrows", 0.04, {"cubes": 6}), ("pick_place", 0.04, {})],
)
def test_a_placement_moves_each_object_and_reads_as_before(family: str, most_m: float, options: dict[str, int]) -> None:
    """Of 4 cm: in 100 starts some object is more than 3 cm off its slot, none more than 4.3, and two are 8 cm apart.

    The hand points at the object where it is.
    """
    (placed, _), (plain, _) = environment(family, placement=most_m, **options), environment(family, **options)
    plain.reset(seed=0)
    hand = int(plain.model.body("hand").mocapid[0])
    slots_m = plain.world.object_poses()[:, :2]
    later, earlier = np.tril_indices(len(slots_m), -1)
    off_m = []
    turned_rad: list[float] = []
    apart_m = [1.0]
    for seed in range(100):
        _, info = placed.reset(seed=seed)
        assert placed.world.read() == Reading(macrostate=tuple(info["macrostate"]), problem=None)
        plain.reset(options={"macrostate": info["macrostate"]})
        aside_m = placed.data.mocap_pos[hand] - plain.data.mocap_pos[hand]
        assert aside_m == pytest.approx((*placed.world.places[info["macrostate"][-1]][:2], 0.0))
        places_m = placed.world.object_poses()[:, :2]
        off_m.append(np.abs(places_m - slots_m).max())
        assert np.abs(places_m - slots_m - np.array(placed.world.places)[:, :2]).max() < 0.005
        for pose, (*_, yaw_rad) in zip(placed.world.object_poses(), placed.world.places, strict=True):
            turned_rad.append(abs(yaw_rad))
            assert abs(math.remainder(yaw_of(*pose[3:]) - yaw_rad, math.pi / 2)) < math.radians(2.001)
        apart_m.extend(np.abs(places_m[later] - places_m[earlier]).max(axis=1))
    assert min(apart_m) >= 0.08  # a cube's edge is 55 mm
    assert 0.75 * most_m < max(off_m) < most_m + 0.005
    assert math.radians(4.0) < max(turned_rad) <= math.radians(5.0)
    places = placed.world.places
    placed.reset(seed=0)
    assert placed.world.places != places
    placed.reset(seed=99)
    assert placed.world.places == places


YAWS_DEG = (2, 23, 43, 67, 88, 108, 113, 158, 178)
"""Turns of an object, none of them by a limit, from its place."""


def readings(world: World, index: int, pose: list[float], values: range) -> tuple[object, ...]:
    """The value and the fault of an object's pose, and its values in the hand and its progress from and to values."""
    in_hand = tuple(world.value_in_hand(index, pose, before, gripped=True) for before in values)
    progress = tuple(round(world.progress(index, pose, 0, after), 9) + 0.0 for after in values)
    return *world.read_object(index, pose), in_hand, progress


@pytest.mark.parametrize(("family", "values"), [("arrows", range(4)), ("pick_place", range(2))])
def test_readings_of_an_object_refer_to_its_place(family: str, values: range) -> None:
    """An object that is moved and turned with its place is read as before."""
    world = FAMILIES[family](observation="proprio", **FREE[family]).world
    slots = world.places
    starts = world.object_poses()[:, :3]
    drawn = [(0.03, -0.02, math.radians(5.0)), (-0.025, 0.01, math.radians(-4.0)), (0.01, 0.03, math.radians(3.0))]
    faults = set()
    for index, yaw_deg, off_m in itertools.product(range(3), YAWS_DEG, (0.0, 0.01, 0.04)):
        found = []
        for places in (slots, drawn):
            world.places = tuple(places)
            x_m, y_m, turned_rad = places[index]
            position_m = starts[index] + (x_m + off_m, y_m, off_m / 2)
            pose = [*position_m.tolist(), *about_vertical(math.radians(yaw_deg * (-1) ** index) + turned_rad)]
            found.append(readings(world, index, pose, values))
        assert found[1] == found[0]
        faults.add(found[0][1])
    assert len(faults) > 6


def test_progress_of_an_object_is_a_share_of_5_cm_up_or_of_30_cm_away() -> None:
    """Gripped and lifted by so much, it is picked."""
    world = make_pick_place(observation="proprio").world
    for index, from_m, off_m, (before, after), share in (
        (2, standing_m(2), (0.0, 0.0, 0.02), (0, 1), 0.4),
        (1, standing_m(1), (0.09, 0.0, 0.12), (1, 0), 0.5),
        (0, PALM_M, (0.0, -0.06, 0.0), (1, 2), 0.8),
    ):
        pose = [*np.add(from_m, off_m).tolist(), 1.0, 0.0, 0.0, 0.0]
        assert world.progress(index, pose, before, after) == pytest.approx(share)
    for lifted_m, gripped, value in ((0.049, True, 0), (0.051, True, 1), (0.2, False, 0)):
        pose = [*np.add(standing_m(1), (0.1, 0.1, lifted_m)).tolist(), 1.0, 0.0, 0.0, 0.0]
        assert world.value_in_hand(1, pose, 0, gripped=gripped) == value


def test_a_turned_cube_belongs_to_the_place_of_its_start() -> None:
    """And not to its slot; also in an environment that was set to this state, and whatever its own starts were."""
    env, _ = environment("arrows", placement=0.04, **FREE["arrows"])
    again = FAMILIES["arrows"](observation="proprio", placement=0.04, **FREE["arrows"])
    again.reset(seed=1)
    expert = Expert(again)
    off_m = []
    for seed in range(3):
        env.reset(seed=seed, options={"macrostate": STARTS["arrows"]})
        before_m = env.world.object_poses()[:, :2]
        off_m.append(math.hypot(*env.world.places[0][:2]))
        again.set_state(env.get_state())
        events = [carry_out(again, expert, action)[0] for action in (0, 5)]
        assert [each["macro_action"] for each in events] == [0, 5]
        assert np.abs(again.world.object_poses()[:, :2] - before_m).max() < 0.005
    assert max(off_m) > MAX_OFF_SLOT_M


def test_certificates_refuse_a_placement() -> None:
    with pytest.raises(InvalidValueError, match="a certificate is of objects on their slots"):
        measure(environment("arrows", placement=0.04)[0], tries=1, turns=1)
