"""Appearance by factors: names, the levels as their points, and that a factor varies its own part and nothing else."""

from __future__ import annotations

import dataclasses

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.scenes.appearance import LEVELS, NUISANCE_FIELDS, appearance, appearance_arrays, between
from imagine_bench.tasks.scenes.nuisances import draw_nuisance
from whole_outputs import tabulated

from imagine_bench.appearance import FACTORS, NUISANCES, POINTS, appearance_name
from imagine_bench.judge.judgement import Judgement
from imagine_bench.protocols.control import protocol


def make(task="Arrows", **options):
    env = gymnasium.make(f"imagine_bench/{task}-v0", execution="kinematic", disable_env_checker=True, **options)
    return env.unwrapped


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ("mild", "mild"),
        ("photo", "photo"),
        ("patched", "photo"),
        ({}, "clean"),
        ({"light": 0, "hand": 0.0}, "clean"),
        ("light=0.5,pose=0.50,hand=5e-1", "mild"),
        (dict.fromkeys(FACTORS, 1), "strong"),
        (dict.fromkeys(NUISANCES[:6], 1), "harsh"),
        ("noise=1.5,pose=0.5", "pose=0.5,noise=1.5"),
        ("camera=0.2,light=0.5", "light=0.5,camera=0.2"),
        ({"camera": np.float64(0.2), "light": 0.5, "pose": 0}, "light=0.5,camera=0.2"),
        ("hand=1", "hand=1.0"),
    ],
)
def test_one_appearance_has_one_name(given, name):
    assert appearance_name(given) == name == appearance_name(name) == appearance(given).name
    wanted = protocol("arrow_puzzle", "smoke", agents=("random",), appearance=name)
    if isinstance(given, str):
        assert protocol("arrow_puzzle", "smoke", agents=("random",), appearance=given).hash == wanted.hash
        assert Judgement(task="arrow_puzzle", models=("copy",), appearance=given).appearance == name


@pytest.mark.parametrize("level", POINTS)
def test_levels_are_points_of_the_factors(level):
    found = between(level, POINTS[level])
    assert found == LEVELS[level]
    others = {"name", "pool", "gamma_half_width", "noise_std", *(field for field, _ in NUISANCE_FIELDS.values())}
    widths = {field.name for field in dataclasses.fields(found)} - others
    half = between("", dict.fromkeys(FACTORS, 0.25))
    assert all(
        getattr(LEVELS["clean"], each) < getattr(half, each) < getattr(LEVELS["strong"], each) for each in widths
    )


START = {"ArrowPuzzle": (0, 1, 2, 1), "PickPlace": (0, 0, 0, 1)}
DRAWN = (
    *(("ArrowPuzzle", level, 64) for level in ("clean", "mild", "strong", "patched", "harsh")),
    *(("PickPlace", level, 64) for level in ("clean", "mild", "strong", "patched")),
    *(("ArrowPuzzle", f"{factor}=0.4", 64) for factor in FACTORS),
    *(("ArrowPuzzle", f"{nuisance}=2", 64) for nuisance in NUISANCES),
    ("ArrowPuzzle", "shift=1.5,occlusion=1.5", 128),
)


def spread(values):
    """The half of the largest range of a coordinate over draws. Values (N, ...)."""
    return float(np.ptp(np.array(values), axis=0).max() / 2)


def places_of(poses):
    """x, y and z in m and yaw in rad of poses in draws: (N, B, 7) to (N, B, 4)."""
    poses = np.array(poses)
    return np.concatenate([poses[..., :3], 2 * np.arctan2(poses[..., 6:], poses[..., 3:4])], axis=-1)


def least_and_most(values):
    return f"{values.min():.3g} to {values.max():.3g}"


def drawn(task, given, size):
    """All that 200 starts vary, and by how much; the frame is gray with a white spot at row and column 30."""
    env, usual = make(task, appearance=given, size=size), appearance_arrays(make(task).model)
    world, rng, level = env.world, np.random.default_rng(0), appearance(given)
    frame = np.full((size, size, 3), 128, np.uint8)
    frame[30, 30] = 255
    poses, hands, looks, frames, stays = [], [], [], [], 0
    for _ in range(200):
        world.place(START[task], rng)
        world.vary(rng)
        poses.append(world.object_poses())
        hands.append(np.hstack([env.data.mocap_pos, env.data.mocap_quat]))
        looks.append([now - then for now, then in zip(appearance_arrays(env.model), usual, strict=True)])
        frames.append(world.composite(frame))
        assert np.array_equal(world.composite(frame), frames[-1]), "a moment that is seen twice is the same"
        world.vary(rng, move_objects=False)
        stays += np.array_equal(world.composite(frame), frames[-1])
    rewards = np.array([world.reward(-1.0, rng) for _ in range(4000)])
    assert abs(rewards.mean() + 1.0) <= 4.0 * rewards.std() / np.sqrt(len(rewards)), "on average those of the rules"
    off, hands_off = (np.ptp(places_of(each), axis=0) / 2 for each in (poses, hands))
    for found, widths in (
        (off, [level.object_offset_m] * 2 + [0.0, level.object_yaw_rad]),
        (hands_off, [level.hand_offset_m] * 3 + [level.hand_yaw_rad]),
    ):
        assert (found <= np.multiply(widths, 1 + 1e-9) + 1e-12).all() and (found >= np.multiply(widths, 0.75)).all()
    offset_m = off[:, :2].max()
    *lights, colors, places, turns = (np.array(each) for each in zip(*looks, strict=True))
    shown = np.array(frames)
    brightest = shown.sum(axis=3).reshape(len(shown), -1).argmax(axis=1)
    return {
        "task": task,
        "appearance": given,
        "size": size,
        "objects mm": 1e3 * offset_m,
        "turned": spread(np.array(poses)[..., 3:]),
        "hands mm": 1e3 * hands_off[:, :3].max(),
        "light": max(np.abs(each).max() for each in lights),
        "red, green, blue": np.abs(colors[..., :3]).max(axis=(0, 1)),
        "camera mm": 1e3 * np.abs(places).max(),
        "camera turned": np.abs(turns).max(),
        "mean of frame": least_and_most(shown.mean(axis=(1, 2, 3))),
        "std": shown.std(axis=(1, 2, 3)).mean(),
        "edge": np.abs(np.diff(shown[:, 40:].astype(float), axis=2)).max(),
        "changed pixels": least_and_most((shown != frame).any(axis=3).sum(axis=(1, 2))),
        "spot's row": least_and_most(brightest // size),
        "column": least_and_most(brightest % size),
        "stays": stays,
        "reward's std": rewards.std(),
        "kinds": len(set(rewards)),
        "generator": rng.bit_generator.state["state"]["state"] % 10**6,
    }


def test_all_that_an_appearance_varies_and_by_how_much(expected):
    rows = [drawn(*each) for each in DRAWN]
    expected("appearances", tabulated([rows[0], *(row.values() for row in rows)]), exactly=False)


def test_a_shadow_goes_on_and_turns_back_at_the_borders():
    """It moves by at most a quarter of the frame's edge along each axis."""
    white = np.full((64, 64, 3), 255, np.uint8)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        nuisance = draw_nuisance(appearance("shadow=1"), rng)
        places = []
        for _ in range(30):
            places.append(np.unravel_index(nuisance.of(white).sum(axis=2).argmin(), (64, 64)))
            nuisance = nuisance.following(rng)
        moved = np.abs(np.diff(np.array(places), axis=0))
        assert moved.max() <= 17
        assert moved.sum(axis=0).min() > 64, "it came to a border"
