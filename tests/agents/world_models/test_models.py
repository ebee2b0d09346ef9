"""Every registered world model keeps the contract, and learns and draws from the given data alone."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from imagine_bench.agents.world_models import convolutional, latent
from imagine_bench.agents.world_models.patches import Patch, Patches

from imagine_bench import registry
from imagine_bench.interfaces import AgentContext
from imagine_bench.interfaces.episodes import Episodes, joined
from imagine_bench.interfaces.model import Imagined, WorldModel, require_imagined
from imagine_bench.registry.entries import parse_configuration
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders

LEARNED = [name for name, entry in registry.world_models().items() if not entry.privileged]


@functools.cache
def data(task: str = "arrow_puzzle", episodes: int = 80) -> Episodes:
    spec = registry.task(task)
    policy = policy_of("uniform", spec, 1000)
    return collect(spec, policy, episodes=episodes, seed=1000, execution="kinematic", appearance="clean")[0]


def made(name: str, task: str = "arrow_puzzle") -> WorldModel:
    entry, spec = registry.world_model_entry(name), registry.task(task)
    path = None if entry.encoder_kind is None else encoders.own(spec, "clean", entry.encoder_kind)
    context = AgentContext(
        n_actions=spec.n_actions, preprocessing=spec.preprocessing, encoder=path, seeds=SeedTree(1000).child("models"),
        config_group=spec.config_group, overrides=parse_configuration(name).settings,
    )  # fmt: skip
    model: WorldModel = registry.load(entry.make)(context)
    return model


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], WorldModel]:
    """Models that were fitted in a few updates."""
    monkeypatch.setattr(latent, "UPDATES", 3)
    monkeypatch.setattr(convolutional, "_STEPS", 3)

    def fitted(name: str) -> WorldModel:
        model = made(name)
        model.fit(data(), np.random.default_rng(1))
        return model

    return fitted


def imagined(model: WorldModel, history: int = 1, depth: int = 3, n_actions: int = 6) -> Imagined:
    frames = np.stack([data().frames[row : row + history] for row in (0, 2, 4, 6, 8)])
    actions = np.random.default_rng(2).integers(n_actions, size=(5, history - 1 + depth))
    found = model.imagine(frames, actions, 4, np.random.default_rng(3))
    return require_imagined(found, name="it", rows=5, depth=depth, samples=4)


@pytest.mark.parametrize("name", LEARNED)
def test_each_keeps_the_contract(name: str, quick: Callable[[str], WorldModel]) -> None:
    model, again = quick(name), quick(name)
    first, second = imagined(model), imagined(again)
    for field, array in vars(first).items():
        assert np.array_equal(array, getattr(second, field)), field
    assert np.array_equal(imagined(model).pictures, first.pictures), "it was changed by imagining"
    assert imagined(model, history=2, depth=1).pictures.shape[2] == 1
    if first.p_ended is not None:
        assert (np.diff(first.p_ended, axis=2) >= -1e-6).all(), "an ended episode begins again"
    assert isinstance(model.parameters(), int)


@pytest.mark.parametrize("name", ["mdn_dropout", "mdn_ensemble", "mdn_thesis", "gaussian"])
def test_latent_models_offer_three_uncertainties(name: str, quick: Callable[[str], WorldModel]) -> None:
    found = imagined(quick(name))
    assert found.epistemic is not None and found.aleatoric is not None and found.modal is not None
    assert (found.epistemic > 0).all() and (found.aleatoric > 0).all()
    assert (found.modal == 0).all() == (name == "gaussian")


@pytest.mark.parametrize("name", ["mdn_thesis", "structured"])
def test_one_network_offers_no_epistemic_uncertainty_and_pictures_are_as_the_task_draws_them(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Chapter 3 of the thesis, pick-and-place, has neither dropout nor an ensemble: a dash, not zeros."""
    monkeypatch.setattr(latent, "UPDATES", 3)
    model = made(name, "pick_place")
    model.fit(data("pick_place", 20), np.random.default_rng(1))
    found = imagined(model, depth=2, n_actions=4)
    assert found.pictures.shape == (5, 4, 2, 32, 32, 3), "in color, of 32 pixels"
    if name == "mdn_thesis":
        assert found.epistemic is None and found.accepted is None and found.aleatoric is not None


def test_the_filter_discards_what_its_threshold_says_and_all_that_follows(quick: Callable[[str], WorldModel]) -> None:
    model = quick("mdn_thesis")
    assert isinstance(model, latent.LatentModel)
    first = imagined(model).epistemic
    assert first is not None
    model.imagination.filter.threshold = float(np.median(first[:, 0]))
    kept = imagined(model).accepted
    assert kept is not None and kept.dtype == bool
    assert np.array_equal(kept[:, 0], first[:, 0] <= model.imagination.filter.threshold)
    assert not (kept[:, 1:] & ~kept[:, :-1]).any()


def test_a_model_has_the_settings_that_its_name_says(quick: Callable[[str], WorldModel]) -> None:
    mean = "imagination.predicts_with=network,imagination.temperature=0"
    drawn = imagined(quick("mdn_thesis:model.components=1")).pictures
    means = imagined(quick(f"mdn_thesis:model.components=1,{mean}")).pictures
    assert (drawn != drawn[:, :1]).any() and (means == means[:, :1]).all(), "every future of a point is the same"
    assert registry.world_model_entry(f"mdn_thesis:{mean}").title.endswith("(predicts_with network, temperature 0)")


def test_the_structured_model_knows_what_it_never_tried() -> None:
    model = made("structured")
    model.fit(data(), np.random.default_rng(1))
    little = made("structured")
    little.fit(data().first(5), np.random.default_rng(1))
    much, few = (imagined(each).epistemic for each in (model, little))
    assert much is not None and few is not None and few.mean() > much.mean() + 0.1
    found: Any = imagined(model)
    assert found.aleatoric is None  # it has no such noise, and says so


def test_every_future_of_a_question_begins_in_its_own_frame() -> None:
    """How probable the likeliest step is depends on frame and macro-action alone, however many futures are drawn."""
    model = made("structured")
    model.fit(data().first(30), np.random.default_rng(1))
    frames, actions = data().frames[:5, None], data().actions[:5, None]
    one, many = (model.imagine(frames, actions, samples, np.random.default_rng(3)).modal for samples in (1, 4))
    assert one is not None and many is not None and len(np.unique(one)) > 1
    assert np.allclose(one, many)


def test_patches_finds_the_cubes_and_the_hand_and_how_many_looks_each_has() -> None:
    model = made("patches")
    assert isinstance(model, Patches)
    model.fit(data(), np.random.default_rng(1))
    assert sorted(len(patch.gray) for patch in model.patches) == [3, 4, 4, 4], "the hand, and three arrows"


def test_a_look_is_recognised_where_it_is_shifted_by_up_to_two_pixels() -> None:
    """Shifted by more, a pattern is as far from itself as from any other, and gray is nearer."""
    pattern = np.random.default_rng(0).normal(size=(64, 64))
    pixels = np.arange(64 * 64).reshape(64, 64)[20:40, 20:40].ravel()
    looks = np.stack([np.zeros(len(pixels)), pattern.ravel()[pixels]])
    patch = Patch(pixels, looks, np.zeros((2, len(pixels), 3), dtype=np.uint8))
    for shift in itertools.product(range(-3, 4), repeat=2):
        (found,) = patch.looks(np.roll(pattern, shift, axis=(0, 1)).reshape(1, -1))
        assert found == (max(map(abs, shift)) <= 2), shift


def squares(states: Sequence[Sequence[int]]) -> np.ndarray:
    """Frames of two squares, each of one of three colors."""
    frames = np.full((len(states), 64, 64, 3), 100, dtype=np.uint8)
    for index, state in enumerate(states):
        for square, color in enumerate(state):
            frames[index, 10:30, 10 + 30 * square : 25 + 30 * square] = (20, 120, 220)[color]
    return frames


def walked(slip: float, episodes: int = 60) -> Episodes:
    """Macro-actions 0 and 1 step the color of a square on, but for slips; color 2 of both is rewarded and ends."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(episodes):
        states, actions = [[0, 0]], []
        while len(actions) < 8 and states[-1] != [2, 2]:
            actions.append(int(rng.integers(2)))
            after = list(states[-1])
            after[actions[-1]] = (after[actions[-1]] + (rng.random() >= slip)) % 3
            states.append(after)
        ends = [state == [2, 2] for state in states[1:]]
        found.append(
            {
                "frames": squares(states), "actions": actions, "rewards": [5.0 * end for end in ends],
                "terminated": ends, "truncated": [False] * (len(ends) - 1) + [not ends[-1]], "success": ends[-1],
                "action_masks": np.ones((len(states), 3), dtype=np.int8),
            }
        )  # fmt: skip
    return joined(found)


@pytest.mark.parametrize("slip", [0.0, 0.3])
def test_patches_draws_what_happened_as_often_as_it_did(slip: float) -> None:
    model = made("patches")
    model.fit(walked(slip), np.random.default_rng(1))
    before, stepped, ended = squares([[1, 2], [2, 2], [0, 2]])
    found = model.imagine(before[None, None], np.array([[0]]), 400, np.random.default_rng(2))
    moved = (found.pictures[0, :, 0] == stepped).all(axis=(1, 2, 3))
    stayed = (found.pictures[0, :, 0] == before).all(axis=(1, 2, 3))
    assert (moved | stayed).all() and stayed.mean() == pytest.approx(slip, abs=0.15)
    assert found.rewards is not None and found.p_ended is not None and found.epistemic is not None
    assert np.array_equal(found.rewards[0, :, 0], 5.0 * moved) and np.array_equal(found.p_ended[0, :, 0], moved)
    never = model.imagine(ended[None, None], np.array([[2]]), 1, np.random.default_rng(2))
    assert (never.pictures == ended).all() and never.epistemic is not None
    assert never.epistemic[0, 0] == 1.0 > found.epistemic[0, 0], "no transition of this macro-action was seen"


def test_patches_of_frames_that_never_change_are_none() -> None:
    model = made("patches")
    model.fit(walked(slip=1.0, episodes=3), np.random.default_rng(1))
    found = model.imagine(squares([[0, 0]])[None], np.array([[1, 0]]), 2, np.random.default_rng(2))
    assert (found.pictures == squares([[0, 0]])).all()
