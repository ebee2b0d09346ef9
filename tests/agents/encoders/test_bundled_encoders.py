"""The encoders that come with the package: their reading of fresh frames, and their speed."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from imagine_bench.agents.encoders.encoder import Encoder, EncoderCard, bundled_encoder
from imagine_bench.agents.encoders.latent_observation import LatentObservation
from imagine_bench.agents.encoders.probe import Latents
from imagine_bench.agents.encoders.recipes import RECIPES
from imagine_bench.agents.encoders.training import draw_frames

import imagine_bench  # noqa: F401  (registers the environments)
from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import appearance_of_tests
from imagine_bench.seeding import SeedTree

TARGETS = [
    (name, appearance, required)
    for name in registry.TASKS
    if (targets := registry.task(name).targets)
    for appearance, required in targets.encoders.items()
]
"""Share of fresh frames whose whole macrostate must be read right."""
FRESH = 500


@pytest.mark.parametrize(("task", "appearance", "required"), TARGETS)
def test_bundled_encoder_reads_fresh_frames_as_its_card_says(task: str, appearance: str, required: float) -> None:
    """Frames of a seed that made nothing else; the margin is three binomial standard deviations."""
    spec = registry.task(task)
    path = bundled_encoder(f"{spec.encoder}-{appearance}")
    encoder = Encoder.load(path)
    assert path.stat().st_size < 2_000_000
    assert (encoder.card.task, encoder.card.appearance) == (spec.id, appearance)
    assert encoder.card == EncoderCard.from_json(path.with_suffix(".json").read_text())
    assert encoder.card.recipe == RECIPES[spec.config_group]["default"] and encoder.card.cpu_s["total"] <= 120
    assert encoder.card.recipe.held_out_frames >= 4000 and encoder.card.probe["mlp"] >= required
    rng = SeedTree(987_654_321).child("encoder_probe", appearance).generator()
    frames, macrostates = draw_frames(spec, appearance_of_tests(appearance), FRESH, rng)
    mu, sigma = encoder.encode(frames)
    information = float(encoder.network.information(mu, 2.0 * sigma.log()))
    assert information == pytest.approx(encoder.card.kl_nats, rel=0.05)
    read = (encoder.read_macrostate(mu) == macrostates).all(axis=1).mean()
    assert read >= required - 3 * math.sqrt(required * (1 - required) / FRESH)
    sampled = Latents(mu=mu, sigma=sigma).sample(torch.Generator().manual_seed(0))
    expected = encoder.card.probe["mlp_sampled"]
    read_sampled = (encoder.read_macrostate(sampled) == macrostates).all(axis=1).mean()
    frames_of_both = 1 / FRESH + 1 / encoder.card.recipe.held_out_frames
    assert read_sampled >= expected - 3 * math.sqrt(max(expected * (1 - expected), 0.005) * frames_of_both)
    shuffled = (encoder.read_macrostate(mu) == np.roll(macrostates, 1, axis=0)).all(axis=1).mean()
    assert shuffled < 2 / len(spec.rules.states) + 0.04  # the same measure fails where it should


@pytest.mark.parametrize("wrapped", [False, True])
def test_an_encoder_of_other_preprocessing_is_refused(wrapped: bool) -> None:
    with closing(gymnasium.make("imagine_bench/PickPlace-v0", disable_env_checker=True)) as made:
        env = made if wrapped else made.unwrapped
        seen, encoder = LatentObservation(env, "pick_place-clean"), Encoder.load(bundled_encoder("pick_place-clean"))
        assert seen.observation_space.shape == (4,)
        frame, _ = env.reset(seed=0)
        assert np.array_equal(seen.reset(seed=0)[0], encoder.encode(frame[None])[0][0].numpy())
        with pytest.raises(InvalidValueError, match="reads frames as 'gray_strips', this environment's task declares"):
            LatentObservation(env, "arrow_puzzle-clean")


@pytest.mark.parametrize("seen", [{"observation": "frame,state"}, {"observation": "state"}, {"size": 96}])
def test_latents_of_other_observations_than_frames_are_refused(seen: dict[str, Any]) -> None:
    with closing(gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic", **seen)) as env:
        with pytest.raises(InvalidValueError, match="an encoder takes frames of 64 x 64 pixels"):
            LatentObservation(env, "arrow_puzzle-clean")


@pytest.mark.parametrize("task", sorted({name for name, *_ in TARGETS}))
def test_bundled_encoder_reads_what_physics_leaves_behind(task: str) -> None:
    """It was trained on frames whose outcomes were set; objects that were carried or turned lie a little elsewhere."""
    spec = registry.task(task)
    encoder = Encoder.load(bundled_encoder(f"{spec.encoder}-mild"))
    env = gymnasium.make(spec.env_id, appearance="mild", disable_env_checker=True).unwrapped
    rng, frames, macrostates, over = SeedTree(5).generator(), [], [], True
    for step in range(40):
        if over:
            env.reset(seed=step)
        frame, _, over, _, info = env.step(int(rng.integers(spec.n_actions)))
        frames.append(frame)
        macrostates.append(info["macrostate"])
    env.close()
    read = encoder.read_macrostate(encoder.encode(np.array(frames))[0])
    assert (read == np.array(macrostates)).all(axis=1).sum() >= 39
    assert len(np.unique(macrostates, axis=0)) > 5


@pytest.mark.parametrize("appearance", ["clean", "mild"])
@pytest.mark.parametrize("task", sorted({name for name, *_ in TARGETS}))
def test_bundled_codes_give_every_macrostate_a_code_of_its_own(task: str, appearance: str) -> None:
    """Neither torn by jitter nor mixed up. A code for every fourth frame of a macrostate would be a third torn."""
    spec = registry.task(task)
    encoder = Encoder.load(bundled_encoder(f"{spec.encoder}-{appearance}-codes"))
    rng = SeedTree(987_654_321).child("encoder_probe", appearance, "codes").generator()
    frames, macrostates = draw_frames(spec, appearance, 1000, rng)
    mu, sigma = encoder.encode(frames)
    nats = math.log(math.prod(encoder.network.code_sizes))
    assert encoder.card.kl_nats == pytest.approx(nats, abs=1e-3)
    assert float(encoder.network.information(mu, 2.0 * sigma.log())) == pytest.approx(nats)
    codes = [tuple(row) for row in mu.tolist()]
    pairs = Counter(zip(map(tuple, macrostates.tolist()), codes, strict=True))
    usual: dict[tuple[int, ...], tuple[float, ...]] = {}
    for (macrostate, code), _ in pairs.most_common():
        usual.setdefault(macrostate, code)
    assert len(set(usual.values())) == len(usual)
    assert sum(pairs[macrostate, code] for macrostate, code in usual.items()) >= 995
