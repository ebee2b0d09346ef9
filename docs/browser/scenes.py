"""Scenes and planned motions of the tasks, as the page in the browser reads them.

A scene is MJCF without textures. A motion is a table of commands to the servos: the browser's MuJoCo moves the arm by
them, and contact alone moves objects.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from imagine_bench.tasks.arrows.rules import MAX_CUBES, Arrows
from imagine_bench.tasks.arrows.scene import add_cubes, layout
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.motion.executor import MacroExecutor, at_rest
from imagine_bench.tasks.pick_place import scene as pick_scene
from imagine_bench.tasks.pick_place import world as pick_world
from imagine_bench.tasks.pick_place.rules import N_OBJECTS, PickPlaceRules, held_object
from imagine_bench.tasks.scenes import constants as c
from imagine_bench.tasks.scenes.appearance import appearance
from imagine_bench.tasks.scenes.arm import arm_columns, arm_spec, let_arm_touch
from imagine_bench.tasks.scenes.hand import PALM_REACH_M, add_pointing_hand, fingertip_m
from imagine_bench.tasks.scenes.objects import OBJECTS, SLOTS_XY_M, standing_m
from imagine_bench.tasks.scenes.tabletop import add_tabletop
from imagine_bench.tasks.world import MAX_SKEW_RAD, MAX_TILT_RAD

from imagine_bench.arrays import Floats

EVERY = 4
"""Timesteps of 8 ms from one row of a motion to the next; between rows the page interpolates linearly."""
PICK_EVERY = 8
"""The same for pick-and-place, whose timesteps have 3 ms."""


_FOR_LATER = re.compile(' input="[a-z]*"')
"""An attribute of servos that MuJoCo 3.17 writes and 3.14 does not read; its value is the default of these servos."""


@dataclass(frozen=True)
class Motion:
    """The commands of one macro-action, or of one turn of a cube."""

    name: str  #: by which the page finds it
    commands: Floats  #: seven joints (rad) and the opening of each finger (m). Shape (K, 8).
    steps: int  #: timesteps of the whole motion

    @classmethod
    def of(cls, name: str, executor: MacroExecutor, every: int) -> Motion:
        """The latest motion of an executor, one row for so many timesteps."""
        trajectory = executor.trajectory
        assert trajectory is not None
        commands = np.column_stack([trajectory.arm_command_rad, trajectory.opening_m])
        steps = len(commands)
        rows = np.append(np.arange(0, steps - 1, every), steps - 1)
        return cls(name, commands[rows], steps)


def _plain_xml(spec: mujoco.MjSpec) -> str:
    """The MJCF of a scene without textures; another version of MuJoCo may read it, but no compiled model."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in list(spec.textures):
        spec.delete(texture)
    spec.compile()
    return _FOR_LATER.sub("", spec.to_xml())


def scene_xml(cubes: int) -> str:
    """The scene of the arrow puzzle."""
    spec = arm_spec()
    spec.modelname = "arrow_puzzle"
    add_tabletop(spec)
    places = layout(cubes)
    add_cubes(spec, places.slots_xy_m)
    add_pointing_hand(spec, places.fingertips_m[cubes // 2])
    let_arm_touch(spec)
    return _plain_xml(spec)


def motions_of(cubes: int) -> list[Motion]:
    """Every turn of every cube, carried out and slipped. Names: cubes, cube, clockwise, slips."""
    world = ArrowWorld(appearance("clean"), Arrows(cubes=cubes, forbid="none"))
    found = []
    for cube in range(cubes):
        for clockwise in (True, False):
            for slips in (False, True):
                world.place((0,) * (cubes + 1), np.random.default_rng(0))
                result = world.executor.turn(cube=cube, clockwise=clockwise, slips=slips)
                assert result.fault is None, result.fault
                name = f"{cubes},{cube},{int(clockwise)},{int(slips)}"
                found.append(Motion.of(name, world.executor, EVERY))
    return found


def pick_motions() -> list[Motion]:
    """Every macro-action of pick-and-place, with every held object, carried out and in vain.

    Names: action, held object or -1, whether all objects stay where they are.
    """
    world = pick_world.PickWorld(appearance("clean"))
    rules = PickPlaceRules()
    found: dict[str, Motion] = {}
    for state in filter(lambda each: not rules.is_terminal(each), rules.states):
        held = held_object(state)
        for action in range(rules.n_actions):
            carried_out = rules.outcomes(state, action)[0].macrostate
            for intended in (carried_out, state):
                in_vain = intended[:N_OBJECTS] == state[:N_OBJECTS]
                name = f"{action},{-1 if held is None else held},{int(in_vain)}"
                if name in found:
                    continue
                world.place(state, np.random.default_rng(0))
                result = world.execute(action, intended)
                assert result.fault is None, result.fault
                found[name] = Motion.of(name, world.executor, PICK_EVERY)
    return list(found.values())


def _common_facts(model: mujoco.MjModel) -> dict[str, object]:
    """Where the page finds joints and servos of the arm, and everything at rest."""
    qpos, ctrl = at_rest(model)
    columns = arm_columns(model)
    return {
        "qpos": qpos.tolist(),
        "ctrl": ctrl.tolist(),
        "arm_ctrl": columns.ctrl.tolist(),
        "arm_qpos": columns.qpos.tolist(),
    }


def scene_facts(cubes: int) -> dict[str, object]:
    """Where the page finds joints, servos, cubes and the hand of a scene, and how it looks at the table."""
    model = ArrowWorld(appearance("clean"), Arrows(cubes=cubes, forbid="none")).model
    places = layout(cubes)
    return {
        **_common_facts(model),
        "object_qpos": [int(model.joint(f"cube_{cube}_joint").qposadr[0]) for cube in range(cubes)],
        "slots_m": [[*place, c.CUBE_REST_Z_M] for place in places.slots_xy_m],
        "fingertips_m": [list(point) for point in places.fingertips_m],
        "hands": ["hand"],
        "fovy_deg": places.fovy_deg,
    }


def pick_facts() -> dict[str, object]:
    """The same for pick-and-place, and the limits by which the page reads a macrostate."""
    world = pick_world.PickWorld(appearance("clean"))
    model = world.model
    return {
        **_common_facts(model),
        "object_qpos": [int(model.joint(f"{spec.name}_joint").qposadr[0]) for spec in OBJECTS],
        "slots_m": [list(standing_m(index)) for index in range(N_OBJECTS)],
        "fingertips_m": [list(fingertip_m(place)) for place in SLOTS_XY_M],
        "hands": ["hand", "palm"],
        "fovy_deg": float(model.camera(c.AGENT_CAMERA).fovy[0]),
        "objects": [
            {
                "grip_height_m": spec.grip_height_m,
                "grip_opening_m": spec.grip_opening_m,
                "squeeze_m": spec.squeeze_m,
                "upright": spec.upright,
            }
            for spec in OBJECTS
        ],
        "tcp_m": list(world._tcp_at_rest_m),
        "idle_fingertip_m": list(pick_scene.IDLE_FINGERTIP_M),
        "palm_m": list(pick_scene.PALM_M),
        "idle_palm_m": list(pick_scene.IDLE_PALM_M),
        "table_m": c.TABLE_HEIGHT_M,
        "limits": {
            "in_the_air_m": pick_world._IN_THE_AIR_M,
            "off_grip_m": pick_world.MAX_OFF_GRIP_M,
            "off_slot_m": pick_world.MAX_OFF_SLOT_M,
            "lift_off_m": pick_world.MAX_LIFT_OFF_M,
            "palm_reach_m": PALM_REACH_M,
            "tilt_rad": MAX_TILT_RAD,
            "skew_rad": MAX_SKEW_RAD,
        },
    }


def _write_motions(folder: Path, name: str, every: int, motions: list[Motion]) -> None:
    """Write an index, ``NAME.json``, and the float32 rows of motions, ``NAME.bin``."""
    offset = 0
    index = []
    for each in motions:
        index.append([each.name, offset, len(each.commands), each.steps])
        offset += len(each.commands)
    rows = np.concatenate([each.commands for each in motions])
    (folder / f"{name}.bin").write_bytes(rows.astype("<f4").tobytes())
    (folder / f"{name}.json").write_text(json.dumps({"every": every, "columns": rows.shape[1], "motions": index}))


def write(folder: Path) -> None:
    """Write the scenes, and the motions of both tasks, into a folder."""
    turns = []
    for cubes in range(1, MAX_CUBES + 1):
        (folder / f"scene_{cubes}.xml").write_text(scene_xml(cubes))
        (folder / f"scene_{cubes}.json").write_text(json.dumps(scene_facts(cubes)))
        turns += motions_of(cubes)
    _write_motions(folder, "motions", EVERY, turns)
    (folder / "scene_pick_place.xml").write_text(_plain_xml(pick_scene.pick_scene_spec()))
    (folder / "scene_pick_place.json").write_text(json.dumps(pick_facts()))
    _write_motions(folder, "motions_pick_place", PICK_EVERY, pick_motions())
