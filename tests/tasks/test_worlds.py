"""Worlds: what is put into a scene is read back from it, however it looks."""

from __future__ import annotations

import numpy as np
import pytest
from imagine_bench.tasks.arrows.description import Arrows
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.pick_place.world import PickWorld
from imagine_bench.tasks.scenes.appearance import LEVELS, appearance

from imagine_bench import registry

NAMES = ["pick_place", *(f"arrows:cubes={cubes}" for cubes in range(1, 7))]


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", NAMES)
def test_macrostates_are_read_back_at_every_level(name, level):
    rules = registry.task(name).rules
    look = appearance(level)
    world = PickWorld(look) if name == "pick_place" else ArrowWorld(look, Arrows(cubes=rules.world.cubes))
    rng = np.random.default_rng(0)
    for index in rng.integers(len(rules.states), size=100):
        state = rules.states[index]
        world.place(state, rng)
        world.vary(rng)
        reading = world.read()
        assert (reading.macrostate, reading.problem) == (state, None)
