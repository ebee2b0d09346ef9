"""Scenes and planned motions of the arrow puzzle, as the page in the browser reads them.

A scene is MJCF without textures. A motion is a table of commands to the servos, 50 a second: the browser's MuJoCo moves
the arm by them, and contact alone turns the cube.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from imagine_bench.tasks.arrows.rules import MAX_CUBES, Arrows
from imagine_bench.tasks.arrows.scene import add_cubes, layout
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.motion.executor import at_rest
from imagine_bench.tasks.scenes import constants as c
from imagine_bench.tasks.scenes.appearance import appearance
from imagine_bench.tasks.scenes.arm import arm_columns, arm_spec, let_arm_touch
from imagine_bench.tasks.scenes.hand import add_pointing_hand
from imagine_bench.tasks.scenes.tabletop import add_tabletop

from imagine_bench.arrays import Floats

EVERY = 4
"""Timesteps of 8 ms from one row of a motion to the next; between rows the page interpolates linearly."""


_FOR_LATER = re.compile(' input="[a-z]*"')
"""An attribute of servos that MuJoCo 3.17 writes and 3.14 does not read; its value is the default of these servos."""


@dataclass(frozen=True)
class Motion:
    """The commands of one macro-action."""

    cubes: int
    cube: int
    clockwise: bool
    slips: bool
    commands: Floats  #: seven joints (rad) and the opening of each finger (m). Shape (K, 8).
    steps: int  #: timesteps of the whole motion


def scene_xml(cubes: int) -> str:
    """The MJCF of a scene; its text may be read by another version of MuJoCo, a compiled model may not."""
    spec = arm_spec()
    spec.modelname = "arrow_puzzle"
    add_tabletop(spec)
    places = layout(cubes)
    add_cubes(spec, places.slots_xy_m)
    add_pointing_hand(spec, places.fingertips_m[cubes // 2])
    let_arm_touch(spec)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in list(spec.textures):
        spec.delete(texture)
    spec.compile()
    return _FOR_LATER.sub("", spec.to_xml())


def motions_of(cubes: int) -> list[Motion]:
    """Every turn of every cube, carried out and slipped."""
    world = ArrowWorld(appearance("clean"), Arrows(cubes=cubes, forbid="none"))
    found = []
    for cube in range(cubes):
        for clockwise in (True, False):
            for slips in (False, True):
                world.place((0,) * (cubes + 1), np.random.default_rng(0))
                result = world.executor.turn(cube=cube, clockwise=clockwise, slips=slips)
                assert result.fault is None, result.fault
                trajectory = world.executor.trajectory
                assert trajectory is not None
                commands = np.column_stack([trajectory.arm_command_rad, trajectory.opening_m])
                steps = len(commands)
                rows = np.append(np.arange(0, steps - 1, EVERY), steps - 1)
                found.append(Motion(cubes, cube, clockwise, slips, commands[rows], steps))
    return found


def scene_facts(cubes: int) -> dict[str, object]:
    """Where the page finds joints, servos, cubes and the hand of a scene, and how it looks at the table."""
    world = ArrowWorld(appearance("clean"), Arrows(cubes=cubes, forbid="none"))
    model = world.model
    qpos, ctrl = at_rest(model)
    columns = arm_columns(model)
    slots = [[*place, c.CUBE_REST_Z_M] for place in layout(cubes).slots_xy_m]
    return {
        "cubes": cubes,
        "qpos": qpos.tolist(),
        "ctrl": ctrl.tolist(),
        "arm_ctrl": columns.ctrl.tolist(),
        "arm_qpos": columns.qpos.tolist(),
        "cube_qpos": [int(model.joint(f"cube_{cube}_joint").qposadr[0]) for cube in range(cubes)],
        "slots_m": slots,
        "fingertips_m": [list(point) for point in layout(cubes).fingertips_m],
        "fovy_deg": layout(cubes).fovy_deg,
    }


def write(folder: Path) -> None:
    """Write the scenes, ``motions.json`` (an index) and ``motions.bin`` (float32 rows) into a folder."""
    index = []
    tables = []
    offset = 0
    for cubes in range(1, MAX_CUBES + 1):
        (folder / f"scene_{cubes}.xml").write_text(scene_xml(cubes))
        (folder / f"scene_{cubes}.json").write_text(json.dumps(scene_facts(cubes)))
        for each in motions_of(cubes):
            rows = len(each.commands)
            index.append([each.cubes, each.cube, int(each.clockwise), int(each.slips), offset, rows, each.steps])
            tables.append(each.commands.astype("<f4").tobytes())
            offset += rows
    (folder / "motions.bin").write_bytes(b"".join(tables))
    (folder / "motions.json").write_text(json.dumps({"every": EVERY, "columns": 8, "motions": index}))
