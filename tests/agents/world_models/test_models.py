"""Every registered world model keeps the contract, and learns and draws from the given data alone."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from imagine_bench.agents.world_models import convolutional, latent
from imagine_bench.agents.world_models.patches import Patch, Patches
from same_values import assert_same

from imagine_bench import registry
from imagine_bench.interfaces.episodes import Episodes, joined
from imagine_bench.interfaces.model import Imagined, WorldModel, require_imagined
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.testing.checks import CheckedModel

LEARNED = [name for name, entry in registry.world_models().items() if not entry.privileged]
"""All that learn; those of guests, too."""


@functools.cache
def data(task: str = "arrow_puzzle", episodes: int = 80) -> Episodes:
    spec = registry.task(task)
    policy = policy_of("uniform", spec, 1000)
    return collect(spec, policy, episodes=episodes, seed=1000, execution="kinematic", appearance="clean")[0]


def fitted(name: str, episodes: Episodes | None = None, task: str = "arrow_puzzle") -> WorldModel:
    model = CheckedModel(name, task).make()
    model.fit(data() if episodes is None else episodes, np.random.default_rng(1))
    return model


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Models that are fitted in a few updates."""
    monkeypatch.setattr(latent, "UPDATES", 3)
    monkeypatch.setattr(convolutional, "_STEPS", 3)


def imagined(model: WorldModel, history: int = 1, depth: int = 3, n_actions: int = 6, skip: int = 0) -> Imagined:
    frames = np.stack([data().frames[row : row + history] for row in (0, 2, 4, 6, 8)])
    actions = np.random.default_rng(2).integers(n_actions, size=(5, history - 1 + depth))
    found = model.imagine(frames[:, skip:], actions[:, skip:], 4, np.random.default_rng(3))
    return require_imagined(found, name="it", rows=5, depth=depth, samples=4)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("name", LEARNED)
def test_each_keeps_the_contract(name: str) -> None:
    model = fitted(name)
    first = imagined(model)
    assert_same(vars(first), vars(imagined(fitted(name))))
    assert np.array_equal(imagined(model).pictures, first.pictures), "it was changed by imagining"
    told, alone = (imagined(model, history=2, depth=1, skip=skip) for skip in (0, 1))
    assert name == "mdn_rnn" or np.array_equal(told.pictures, alone.pictures), "its future follows from the last frame"
    if first.p_ended is not None:
        assert (np.diff(first.p_ended, axis=2) >= -1e-6).all(), "an ended episode begins again"
    assert isinstance(model.parameters(), int)
    real = data().frames[[0, 2, 4, 6, 8]].mean(axis=-1)
    drawn = first.pictures[:, 0, 0].reshape(*real.shape, -1).mean(axis=-1)
    mirrored = [real, real.swapaxes(1, 2), real[:, ::-1], real[:, :, ::-1]]
    assert np.argmin([np.abs(drawn - each).mean() for each in mirrored]) == 0, "a picture stands upright"


@pytest.mark.parametrize("name", LEARNED)
def test_rewards_are_in_the_unit_of_the_data(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Data in which every macro-action costs 4, and none ends an episode, teach that within sixty updates."""
    monkeypatch.setattr(latent, "UPDATES", 60)
    monkeypatch.setattr(convolutional, "_STEPS", 60)
    few = data().first(60)
    never = np.zeros_like(few.terminated)
    cut = few.terminated | few.truncated
    lost = np.zeros_like(few.success)
    costly = replace(few, rewards=np.full_like(few.rewards, -4.0), terminated=never, truncated=cut, success=lost)
    found = imagined(fitted(name, costly))
    if name == "copy":
        assert found.rewards is found.p_ended is None, "it says nothing of them"
    else:
        assert found.rewards is not None and found.p_ended is not None
        assert -8.0 < found.rewards.mean() < -2.0
        assert found.p_ended.max() < 0.05


_SLOW = ("mdn_thesis", "mdn_whole_layer")
"""Sixty updates at the settings of the thesis teach little."""


@pytest.mark.parametrize("name", [name for name in LEARNED if name not in ("copy", *_SLOW)])
def test_what_is_learned_of_a_frame_is_what_followed_it(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In episodes of three frames, of which leaving the first costs 7 and leaving the second 1."""
    monkeypatch.setattr(latent, "UPDATES", 60)
    monkeypatch.setattr(convolutional, "_STEPS", 60)
    frames = data().frames[[0, 12, 30]]
    rng = np.random.default_rng(0)
    one = {
        "frames": frames, "rewards": [-7.0, -1.0], "terminated": [False] * 2, "truncated": [False, True],
        "success": False, "action_masks": np.ones((3, 6), dtype=np.int8),
    }  # fmt: skip
    model = fitted(name, joined([{**one, "actions": rng.integers(6, size=2)} for _ in range(40)]))
    found = model.imagine(frames[:2, None], np.array([[0], [3]]), 4, rng).rewards
    assert found is not None
    dear, cheap = found.mean(axis=(1, 2))
    assert dear < cheap - 2.0


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    "name", ["mdn_dropout", "mdn_ensemble", "mdn_thesis", "gaussian", "ensemble_spread", "ensemble_round_trip"]
)
def test_latent_models_offer_three_uncertainties(name: str) -> None:
    found = imagined(fitted(name))
    assert found.epistemic is not None and found.aleatoric is not None and found.modal is not None
    assert (found.epistemic > 0).all() and (found.aleatoric > 0).all()
    assert (found.modal == 0).all() == (name == "gaussian")
    assert (found.accepted is None) == name.startswith("ensemble_"), "a filter would compare another uncertainty"


@pytest.mark.usefixtures("quick")
def test_the_filter_discards_from_its_threshold_on() -> None:
    model = fitted("mdn_thesis")
    assert isinstance(model, latent.LatentModel)
    first = imagined(model).epistemic[:, 0]
    model.imagination.filter.threshold = float(np.median(first))
    kept = imagined(model).accepted
    assert kept[:, 0].tolist() == (first <= np.median(first)).tolist()
    assert not (kept[:, 1:] & ~kept[:, :-1]).any()


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("name", ["mdn_thesis", "structured"])
def test_one_network_has_no_epistemic_uncertainty(name: str) -> None:
    """Chapter 3 of the thesis, pick-and-place, has neither dropout nor an ensemble: a dash, not zeros."""
    found = imagined(fitted(name, data("pick_place", 20), "pick_place"), depth=2, n_actions=4)
    assert found.pictures.shape == (5, 4, 2, 32, 32, 3), "in color, of 32 pixels"
    if name == "mdn_thesis":
        assert found.epistemic is None and found.accepted is None and found.aleatoric is not None


@pytest.mark.usefixtures("quick")
def test_a_model_has_the_settings_that_its_name_says() -> None:
    mean = "imagination.predicts_with=network,imagination.temperature=0"
    drawn, means = (imagined(fitted(f"mdn_thesis:model.components=1{more}")).pictures for more in ("", f",{mean}"))
    assert (drawn != drawn[:, :1]).any() and (means == means[:, :1]).all(), "every future of a point is the same"
    assert registry.world_model_entry(f"mdn_thesis:{mean}").title.endswith("(predicts_with network, temperature 0)")


def test_the_structured_model_knows_what_it_never_tried() -> None:
    """How probable the likeliest step is depends on frame and macro-action alone, however many futures are drawn."""
    much, few = (fitted("structured", data().first(count)) for count in (len(data().actions), 5))
    assert imagined(few).epistemic.mean() > imagined(much).epistemic.mean() + 0.1
    assert imagined(much).aleatoric is None  # it has no such noise, and says so
    question = data().frames[:5, None], data().actions[:5, None]
    one, many = (few.imagine(*question, samples, np.random.default_rng(3)).modal for samples in (1, 4))
    assert len(np.unique(one)) > 1
    assert np.allclose(one, many)


def test_patches_finds_cubes_hand_and_their_appearances() -> None:
    model = fitted("patches")
    assert isinstance(model, Patches)
    assert sorted(len(patch.gray) for patch in model.patches) == [3, 4, 4, 4], "the hand, and three arrows"


def test_a_look_is_recognised_where_it_is_shifted_by_up_to_two_pixels() -> None:
    """Shifted by more, a pattern is as far from itself as from any other, and gray is nearer."""
    pattern = np.random.default_rng(0).normal(size=(64, 64))
    pixels = np.arange(64 * 64).reshape(64, 64)[20:40, 20:40].ravel()
    appearances = np.stack([np.zeros(len(pixels)), pattern.ravel()[pixels]])
    patch = Patch(pixels, appearances, np.zeros((2, len(pixels), 3), dtype=np.uint8))
    for shift in itertools.product(range(-3, 4), repeat=2):
        (found,) = patch.appearances(np.roll(pattern, shift, axis=(0, 1)).reshape(1, -1))
        assert found == (max(map(abs, shift)) <= 2), shift


def squares(states: Sequence[Sequence[int]]) -> np.ndarray:
    """Frames of two squares, each of one of three colors."""
    frames = np.full((len(states), 64, 64, 3), 100, dtype=np.uint8)
    for index, state in enumerate(states):
        for square, color in enumerate(state):
            frames[index, 10:30, 10 + 30 * square : 25 + 30 * square] = (20, 120, 220)[color]
    return frames


def walked(slip: float, episodes: int = 60, n_actions: int = 2) -> Episodes:
    """Macro-actions 0 and 1 step the color of a square on, but for slips; color 2 of both is rewarded and ends.

    A third one steps both on, each with slips of its own.
    """
    rng = np.random.default_rng(0)
    found = []
    for _ in range(episodes):
        states, actions = [[0, 0]], []
        while len(actions) < 8 and states[-1] != [2, 2]:
            actions.append(int(rng.integers(n_actions)))
            after = list(states[-1])
            for square in ((0,), (1,), (0, 1))[actions[-1]]:
                after[square] = (after[square] + (rng.random() >= slip)) % 3
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
    model = fitted("patches", walked(slip))
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


def test_patches_draws_each_patch_by_itself() -> None:
    model = fitted("patches", walked(slip=0.5, n_actions=3))
    found = model.imagine(squares([[0, 0]])[None], np.array([[2]]), 400, np.random.default_rng(2))
    moved = found.pictures[0, :, 0, 20, [15, 45], 0] == squares([[1, 1]])[0, 20, [15, 45], 0][:, None]
    assert moved.mean(axis=1) == pytest.approx(0.5, abs=0.2)
    assert abs(np.corrcoef(moved)[0, 1]) < 0.25, "one square tells nothing of the other"


def test_patches_of_frames_that_never_change_are_none() -> None:
    model = fitted("patches", walked(slip=1.0, episodes=3))
    found = model.imagine(squares([[0, 0]])[None], np.array([[1, 0]]), 2, np.random.default_rng(2))
    assert (found.pictures == squares([[0, 0]])).all()
