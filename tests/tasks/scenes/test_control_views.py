"""The images of continuous control: they show hand and objects, and leave physics and other views as they are."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from imagine_bench.tasks.arrows.rules import Arrows
from imagine_bench.tasks.arrows.scene import layout
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.pick_place.rules import OPEN_PALM
from imagine_bench.tasks.pick_place.world import PickWorld
from imagine_bench.tasks.rendering import Renderer, View
from imagine_bench.tasks.rendering.cameras import DRAWN_GROUPS, agent_camera_view, control_view
from imagine_bench.tasks.scenes import constants as c
from imagine_bench.tasks.scenes.appearance import appearance
from imagine_bench.tasks.scenes.arm import FINGER_JOINTS, TIP_IN_NAME
from imagine_bench.tasks.scenes.control_views import _RGBA
from imagine_bench.tasks.scenes.tabletop import ROOM_CAMERAS
from scipy.spatial.transform import Rotation

CUBES = (1, 2, 3, 4, 5, 6)
PICK = 0
"""In place of a number of cubes: pick-and-place."""
OBJECTS = ("ball", "car", "cup")


def world_of(cubes, *, control):
    if cubes:
        return ArrowWorld(appearance("clean"), Arrows(cubes=cubes), control=control)
    return PickWorld(appearance("clean"), control=control)


class Scene:
    """A world with the views of continuous control."""

    def __init__(self, cubes):
        self.world = world_of(cubes, control=True)
        self.model, self.data = self.world.model, self.world.data
        self.objects = [f"cube_{cube}" for cube in range(cubes)] or OBJECTS
        self.cameras = {name: Renderer(self.model, control_view(name)) for name in c.CONTROL_CAMERAS}

    def place(self, macrostate, rng):
        self.world.place(tuple(int(each) for each in macrostate), rng)

    def frame(self, camera):
        return self.cameras[camera].frame(self.data)

    def shown_px(self, camera, names):
        """How many pixels change when the geoms whose names begin so are not drawn."""
        shown = self.frame(camera)
        geoms = [index for index in range(self.model.ngeom) if self.model.geom(index).name.startswith(names)]
        groups = self.model.geom_group[geoms]
        self.model.geom_group[geoms] = c.COLLISION_GROUP
        hidden = self.frame(camera)
        self.model.geom_group[geoms] = groups
        return int((shown != hidden).any(axis=-1).sum())

    def at_px(self, camera, point_m):
        """Column and row of a point of the world."""
        index = self.model.camera(camera).id
        x, y, z = self.data.cam_xmat[index].reshape(3, 3).T @ (point_m - self.data.cam_xpos[index])
        per_px = -z * np.tan(np.radians(self.model.cam_fovy[index] / 2)) / 32
        return 32 + x / per_px, 32 - y / per_px


def act(world, index):
    """The motion of turning or picking an object of a world at its start."""
    world.executor.capture_motion_hz = 20
    if isinstance(world, PickWorld):
        return world.executor.pick(index=index).motion
    return world.executor.turn(cube=index, clockwise=True).motion


@pytest.fixture(scope="module")
def scenes():
    made = {}
    return lambda cubes: made.setdefault(cubes, Scene(cubes))


@pytest.mark.parametrize("cubes", [PICK, 3])
def test_cameras_that_stand_in_the_room_are_upright_and_see_the_table(scenes, cubes):
    scene = scenes(cubes)
    names = {*ROOM_CAMERAS, c.FRONT_CAMERA}
    assert len(names) > 1 and names <= {scene.model.camera(index).name for index in range(scene.model.ncam)}
    for name in names:
        column, row = scene.at_px(name, np.array([0.55, 0.0, c.TABLE_HEIGHT_M]))
        _, above = scene.at_px(name, np.array([0.55, 0.0, c.TABLE_HEIGHT_M + 0.1]))
        right, up, _ = scene.data.cam_xmat[scene.model.camera(name).id].reshape(3, 3)[2]
        assert abs(right) < 1e-6 < up and 0 < column < 64 and 0 < above < row < 64, name


@pytest.mark.parametrize("cubes", [PICK, 1, 3, 6])
def test_control_views_leave_motions_as_they_are_to_the_bit(cubes):
    plain, drawn = world_of(cubes, control=False), world_of(cubes, control=True)
    drawn.model.opt.timestep = plain.model.opt.timestep  # pick-and-place has another in continuous control
    drawn.model.geom_solref[:] = plain.model.geom_solref[0] if cubes == PICK else drawn.model.geom_solref
    motions = []
    for each in (plain, drawn):
        each.place((0,) * (len(each.object_qpos) + 1), np.random.default_rng(0))
        motions.append(act(each, len(each.object_qpos) - 1))
    assert len(motions[0].qpos) > 20
    for now, then in zip(*motions, strict=True):
        np.testing.assert_array_equal(now, then)
    np.testing.assert_array_equal(plain.data.qpos, drawn.data.qpos)


def test_other_views_of_a_scene_with_control_views_stay_as_they_are(scenes):
    plain, drawn = world_of(3, control=False), scenes(3).world
    for view in (agent_camera_view(), View(camera=c.HUMAN_CAMERA, groups=DRAWN_GROUPS)):
        images = []
        for each in (plain, drawn):
            each.place((0, 1, 2, 1), np.random.default_rng(0))
            images.append(Renderer(each.model, view).frame(each.data))
        assert np.array_equal(*images)


def bounds_m(model, body, group):
    """Lowest and highest corner of the drawn parts of a body, in its frame."""
    corners = np.array(list(itertools.product((-1, 1), repeat=3)))
    found = []
    for index in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group == group)):
        turn = Rotation.from_quat(model.geom_quat[index], scalar_first=True)
        box = model.geom_aabb[index]
        found.append(model.geom_pos[index] + turn.apply(box[:3] + corners * box[3:]))
    return np.concatenate(found).min(axis=0), np.concatenate(found).max(axis=0)


def test_the_coarse_arm_is_where_the_arm_is(scenes):
    """Within 25 mm, and at least three quarters as long."""
    model = scenes(3).model
    bodies = np.unique(model.geom_bodyid[model.geom_group == c.CONTROL_GROUP])
    assert {model.body(body).name for body in bodies} >= {"right_l4", "right_l5", "right_hand"}
    for body in bodies:
        (low, high), (arm_low, arm_high) = (bounds_m(model, body, group) for group in (c.CONTROL_GROUP, c.ARM_GROUP))
        assert (low > arm_low - 0.025).all() and (high < arm_high + 0.025).all(), model.body(body).name
        assert (high - low).max() > 0.75 * (arm_high - arm_low).max()


@pytest.mark.parametrize("camera", c.CONTROL_CAMERAS)
@pytest.mark.parametrize("cubes", [PICK, *CUBES])
def test_at_rest_both_cameras_show_objects_fingers_and_gesture(scenes, cubes, camera):
    """The nearest of the images of another draw has the same gesture."""
    scene = scenes(cubes)
    gestures = range(OPEN_PALM + 1) if cubes == PICK else range(cubes)
    images = np.empty((2, len(gestures), 64, 64, 3), dtype=np.float32)
    for draw, gesture in np.ndindex(images.shape[:2]):
        scene.place([*[0] * len(scene.objects), gesture], np.random.default_rng(draw))
        images[draw, gesture] = scene.frame(camera)
        for name in scene.objects:
            assert scene.shown_px(camera, name) >= 12, (gesture, name)
        assert scene.shown_px(camera, ("hand_", "palm_")) >= 30, gesture
        for finger in ("left", "right"):
            assert scene.shown_px(camera, f"control_finger_{finger}") >= 8, finger
    away = np.abs(images[0][:, None] - images[1]).sum(axis=(2, 3, 4))
    assert away.argmin(axis=1).tolist() == list(gestures)


@pytest.mark.parametrize("cubes", [PICK, 1, 3, 6])
def test_the_hand_camera_shows_fingertips_and_the_held_object(scenes, cubes):
    scene = scenes(cubes)
    for index, name in enumerate(scene.objects):
        scene.place([0] * (len(scene.objects) + 1), np.random.default_rng(0))
        motion = act(scene.world, index)
        opening_m = motion.qpos[:, [scene.model.joint(each).qposadr[0] for each in FINGER_JOINTS]].mean(axis=1)
        scene.data.qpos[:] = motion.qpos[opening_m.argmin()]
        scene.world.update()
        tips = [geom for geom in range(scene.model.ngeom) if TIP_IN_NAME in scene.model.geom(geom).name]
        held_m = scene.data.xpos[scene.model.body(name).id]
        assert np.linalg.norm(scene.data.geom_xpos[tips].mean(axis=0) - held_m) < 0.01, "it is not held"
        at = [scene.at_px("hand", point_m) for point_m in (*scene.data.geom_xpos[tips], held_m)]
        assert np.min(at) > 2 and np.max(at) < 62
        assert scene.shown_px("hand", name) > 200
        for finger in ("left", "right"):
            assert scene.shown_px("hand", f"control_finger_{finger}") > 100


@pytest.mark.parametrize("camera", c.CONTROL_CAMERAS)
@pytest.mark.parametrize("cubes", [1, 3, 6])
def test_an_arrow_can_be_read_from_the_11_by_11_pixels_around_it(scenes, cubes, camera):
    """By the nearest of 24 other images a direction, whatever the other arrows and the pointing hand show."""
    scene, rng = scenes(cubes), np.random.default_rng(0)
    crops, directions = [], []
    for trial in range(100):
        arrows = rng.integers(4, size=cubes)
        arrows[0] = trial % 4
        scene.place([*arrows, rng.integers(cubes)], rng)
        image = np.pad(scene.frame(camera), ((8, 8), (8, 8), (0, 0))).astype(np.float32)
        slot_m = [*layout(cubes).slots_xy_m[0], c.TABLE_HEIGHT_M + c.CUBE_EDGE_M]
        column, row = (int(each) + 8 for each in scene.at_px(camera, slot_m))
        crops.append(image[row - 5 : row + 6, column - 5 : column + 6].ravel())
        directions.append(trial % 4)
    away = np.linalg.norm(np.array(crops)[:, None] - np.array(crops), axis=-1)
    np.fill_diagonal(away, np.inf)
    assert np.mean(np.array(directions)[away.argmin(axis=1)] == directions) >= 0.98


@pytest.mark.parametrize("control", [False, True])
@pytest.mark.parametrize("cubes", [3, PICK])
def test_a_strong_scene_varies_all_that_its_cameras_show(cubes: int, control: bool) -> None:
    """Each camera in its own way. The coarse arm is drawn for those of continuous control, and there it varies too."""
    looks = appearance("strong")
    world = ArrowWorld(looks, Arrows(cubes=cubes), control=control) if cubes else PickWorld(looks, control=control)
    model = world.model
    colors, places, turns = model.mat_rgba.copy(), model.cam_pos.copy(), model.cam_quat.copy()
    world.vary(np.random.default_rng(0))
    varied = {model.material(index).name for index in np.flatnonzero((model.mat_rgba != colors).any(axis=1))}
    moved = {model.camera(index).name for index in np.flatnonzero((model.cam_pos != places).any(axis=1))}
    assert moved == {c.AGENT_CAMERA, *(c.CONTROL_CAMERAS if control else ())}
    for change in (model.cam_pos - places, model.cam_quat - turns):
        assert len(np.unique(change[change.any(axis=1)], axis=0)) == len(moved)
    assert {name for name in varied if name.startswith("control_")} == (set(_RGBA) if control else set())
    drawn = np.isin(model.geom_group, (c.SETTING_GROUP, c.CONTROL_GROUP))
    assert drawn.sum() > 5 and not model.geom_contype[drawn].any() and not model.geom_conaffinity[drawn].any()
