"""A second process that draws lanes: the same bits, and nothing but time is lost with it."""

from __future__ import annotations

import os
import time
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from imagine_bench.tasks import second_process
from imagine_bench.tasks.second_process import SharedRenderer

LANES = 4
NAME = "imagine_bench/{}-vector-v0"


@pytest.fixture
def at_once(monkeypatch):
    """The second process begins with the first scene, and is waited for."""
    monkeypatch.setattr(second_process, "PATIENCE", 0)
    listen = second_process._Process.listen

    def patient(process):
        process.tell()
        while listen(process) < process.asked:
            time.sleep(0.001)
        return process.done

    monkeypatch.setattr(second_process._Process, "listen", patient)


def make(task="ArrowPuzzle", **options):
    vector = gymnasium.make_vec(NAME.format(task), num_envs=LANES, execution="kinematic", **{"threads": 2, **options})
    camera = vector.unwrapped.envs[0]._observer._cameras.get("frame")
    return vector, camera


def walk(vector, steps=8):
    """All observations and final observations of a seeded walk."""
    rng, seen = np.random.default_rng(0), [vector.reset(seed=0)[0]]
    for _ in range(steps):
        frames, *_, infos = vector.step(rng.integers(vector.single_action_space.n, size=LANES))
        seen += [frames, *(each for each in infos.get("final_obs", ()) if each is not None)]
    return np.concatenate([each.reshape(-1, 64, 64, 3) for each in seen])


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("ArrowPuzzle", {"appearance": "strong"}),
        ("ArrowPuzzle", {"appearance": "photo", "autoreset_mode": AutoresetMode.NEXT_STEP}),
        ("PickPlace", {"appearance": "strong", "distractors": 4}),
    ],
)
def test_the_second_process_draws_the_same_bits(task, options, at_once):
    alone, _ = make(task, threads=1, **options)
    expected = walk(alone)
    alone.close()
    vector, camera = make(task, **options)
    drawn_here = []
    draw = camera._renderer.frame
    camera._renderer.frame = lambda *scene: drawn_here.append(scene) or draw(*scene)
    assert np.array_equal(walk(vector), expected)
    assert len(expected) > 9 * LANES or "autoreset_mode" in options
    assert not drawn_here
    child = camera._process._child
    vector.close()
    assert child.poll() is not None


def test_scenes_it_has_not_drawn_are_drawn_here(monkeypatch):
    """A process that is never ready, or always too late, is asked for no more than it can do."""
    monkeypatch.setattr(second_process, "PATIENCE", 0)
    alone, _ = make(threads=1)
    expected = walk(alone, 20)
    alone.close()
    for ready in (-1, 0):
        monkeypatch.setattr(second_process._Process, "listen", lambda process, ready=ready: ready)
        vector, camera = make()
        assert np.array_equal(walk(vector, 20), expected)
        assert camera._process.asked == (0 if ready < 0 else 1 + second_process._BACKLOG * LANES)
        vector.close()


def test_one_that_dies_is_missed_by_one_warning(at_once):
    alone, _ = make(threads=1)
    expected = walk(alone, 3)
    alone.close()
    vector, camera = make()
    assert np.array_equal(walk(vector, 3), expected)
    camera._process._child.kill()
    with pytest.warns(RuntimeWarning, match="has died; this one draws all of them"):
        assert np.array_equal(walk(vector, 3), expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(walk(vector, 3), expected)
    vector.close()


def test_one_that_cannot_start_is_no_error(monkeypatch):
    monkeypatch.setattr(second_process, "PATIENCE", 0)
    monkeypatch.setattr(second_process.sys, "executable", "/no/python")
    vector, _ = make()
    with pytest.warns(RuntimeWarning, match="could not start"):
        walk(vector, 1)
    vector.close()


def test_a_forked_process_leaves_its_parent_s_alone(at_once):
    vector, camera = make()
    expected = walk(vector, 2)
    child = camera._process._child
    pid = os.fork()
    if pid == 0:
        camera._numbers[0] = 1  # as if asked for by the parent
        same = np.array_equal(walk(vector, 2), expected)
        mine = camera._process._child.pid
        vector.close()
        os._exit(0 if same and mine != child.pid else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert child.poll() is None
    assert np.array_equal(walk(vector, 2), expected)
    vector.close()


@pytest.mark.parametrize("options", [{"threads": 1}, {"execution": "physics"}, {"observation": "state"}])
def test_it_is_begun_only_where_it_helps(options):
    vector = gymnasium.make_vec(
        NAME.format("ArrowPuzzle"), num_envs=LANES, **{"execution": "kinematic", "threads": 2, **options}
    )
    assert not isinstance(vector.envs[0]._observer._cameras.get("frame"), SharedRenderer)
    vector.close()
