"""Appearance by factors: names, the levels as their points, and that a factor varies its own part and nothing else."""

from __future__ import annotations

import dataclasses
import math

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.scenes.appearance import LEVELS, appearance, between, looks_of

from imagine_bench.appearance import FACTORS, NUISANCES, POINTS, appearance_name
from imagine_bench.errors import ImagineBenchError
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
        (dict.fromkeys(NUISANCES, 1), "harsh"),
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


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ("strng", "No appearance 'strng'. Did you mean 'strong'? Known: clean, mild, strong, patched, "),
        ("light=2", "Appearance has light='2'; give a number from 0 to 1."),
        ({"light": -0.1}, "Appearance has light=-0.1; give a number from 0 to 1."),
        ({"light": True}, "Appearance has light=True; give a number from 0 to 1."),
        ("light=nan", "Appearance has light='nan'; give a number from 0 to 1."),
        (
            "ligth=0.5",
            "No factor of appearance 'ligth'. Did you mean 'light'? Known: light, colors, camera, pose, hand, shift, "
            "shadow, noise, occlusion, reward_noise, reward_steps.",
        ),
        ("light=0.5,light=0.5", "names light twice; give it once."),
        ("light=0.5,strong", "No factor of appearance 'strong'. "),
        ("noise=2.1", "Appearance has noise='2.1'; give a number from 0 to 2."),
        (3, "No appearance '3'."),
    ],
)
def test_bad_appearances_end_with_one_sentence(given, complaint):
    asks = [appearance_name, lambda given: make(appearance=given)]
    asks += [lambda given: protocol("arrow_puzzle", "smoke", appearance=given)] if isinstance(given, str) else []
    for ask in asks:
        with pytest.raises(ImagineBenchError) as caught:
            ask(given)
        assert complaint in str(caught.value) and "\n" not in str(caught.value)


NUISANCE_FIELDS = ("shift_px", "shadow_depth", "noise_levels", "occluder_px", "reward_std", "reward_step")


@pytest.mark.parametrize("level", POINTS)
def test_levels_are_points_of_the_factors(level):
    found = between(level, POINTS[level])
    assert found == LEVELS[level]
    others = {"name", "pool", "gamma_half_width", "noise_std", *NUISANCE_FIELDS}
    widths = {field.name for field in dataclasses.fields(found)} - others
    half = between("", dict.fromkeys(FACTORS, 0.25))
    assert all(
        getattr(LEVELS["clean"], each) < getattr(half, each) < getattr(LEVELS["strong"], each) for each in widths
    )


SEEN = {"light": (1, 2), "colors": (3,), "camera": (4, 5)}
"""Of each factor, where in ``looks_of`` it shows; the other two show in positions."""


@pytest.mark.parametrize("factor", FACTORS)
def test_a_factor_varies_what_it_says_and_by_as_much_as_it_says(factor):
    """Within 200 draws nearly as far as the interpolated width, never further; everything else stays."""
    env, still = make(appearance={factor: 0.4}), make()
    rng, level = np.random.default_rng(0), between("", {factor: 0.4})
    usual = [each.copy() for each in looks_of(still.model)]
    reach = np.zeros((len(usual), 200))
    cubes, hands = np.empty((200, 3, 7)), np.empty((200, 3))
    for draw in range(200):
        env.world.place((0, 1, 2, 1), rng)
        env.world.vary(rng)
        looks = zip(looks_of(env.model), usual, strict=True)
        reach[:, draw] = [np.abs(now - then).max() for now, then in looks]
        cubes[draw], hands[draw] = env.world.object_poses(), env.data.mocap_pos[0]
    changed = set(np.flatnonzero(reach.max(axis=1)).tolist()) - {0}
    assert changed == set(SEEN.get(factor, ()))
    apart_m = np.ptp(cubes[:, :, :2], axis=0).max() / 2
    assert 0.95 * level.object_offset_m < apart_m <= level.object_offset_m * (1 + 1e-9)
    assert (np.ptp(hands, axis=0).max() > 0) == (factor == "hand")
    if factor == "hand":
        assert np.ptp(hands, axis=0) / 2 == pytest.approx(level.hand_offset_m, rel=0.1)
    if factor == "camera":
        assert 0.9 * level.camera_offset_m < reach[4].max() <= level.camera_offset_m * (1 + 1e-9)
        angle_rad = math.sqrt(3) * level.camera_angle_rad  # about three axes at once
        assert 0.2 * angle_rad < 2 * math.asin(reach[5].max()) <= angle_rad, "nothing adds up from frame to frame"
    if factor == "light":
        assert reach[1].max() == pytest.approx(level.light_fraction * usual[1].max(), rel=0.05)


def test_each_channel_of_a_color_varies_for_itself():
    env = make(appearance={"colors": 1.0})
    usual = looks_of(make().model)[3][:, :3]
    rng, tints = np.random.default_rng(0), []
    for _ in range(300):
        env.world.vary(rng)
        now = looks_of(env.model)[3][:, :3]
        varied = (now != usual).any(axis=1) & (usual > 0.1).all(axis=1) & (usual < 0.9).all(axis=1)
        tints.append((now / np.maximum(usual, 1e-9))[varied])
    channels = np.concatenate([tint for tint in tints if len(tint)]).T
    assert np.abs(np.corrcoef(channels) - np.eye(3)).max() < 0.2
    assert np.abs(channels - 1.0).max() == pytest.approx(between("", {"colors": 1.0}).color_fraction, rel=0.05)
