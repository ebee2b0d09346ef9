"""Presets and overrides: what is named is set, what is not exists nowhere."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from imagine_bench.agents.presets import FAMILIES, flatten
from imagine_bench.agents.presets import resolve as resolve_in
from imagine_bench.agents.settings import Settings

from imagine_bench.errors import InvalidValueError, UnknownNameError
from imagine_bench.protocols.control import PRESETS as BENCH_PRESETS

PRESETS = [(family, preset) for family in FAMILIES for preset in FAMILIES[family].presets]


def resolve(preset: str, overrides: dict[str, Any]) -> Settings:
    return resolve_in(preset, overrides, "chapter_5")


@pytest.mark.parametrize("family", FAMILIES)
def test_every_preset_of_the_bench_has_settings_in_every_family(family: str) -> None:
    assert set(FAMILIES[family].presets) == set(BENCH_PRESETS)


def test_thesis_and_full_are_the_defaults_and_those_the_thesis_numbers() -> None:
    assert resolve("thesis", {}) == resolve("full", {}) == Settings()
    flat = flatten(Settings())
    printed = {
        "model.dynamics_hidden": (256, 256, 256),
        "model.components": 5,
        "model.reward_hidden": (512, 512, 512),
        "model.termination_hidden": (256, 256),
        "model.dropout": 0.5,
        "model.max_norm": 3.0,
        "model.updates_per_step": 16,
        "model.batch_size": 512,
        "controller.hidden": (512, 256, 128),
        "model.learning_rate": 1e-3,
        "controller.learning_rate": 1e-3,
        "controller.batch_size": 64,
        "controller.updates_per_step": 1,
        "controller.epsilon_min": 0.001,
        "controller.epsilon_max": 0.8,
        "controller.epsilon_decay": 0.03,
        "imagination.start_episode": 1000,
        "imagination.updates_per_step": 1,
        "imagination.breadth": 3,
        "imagination.depth": 10,
        "imagination.temperature": 1.0,
        "imagination.threshold": 0.3,
        "memory.real": 50_000,
        "memory.imagined": 3_000,
    }
    assert {name: flat[name] for name in printed} == printed
    of_the_suite = {  # what algorithm 1 has not, at rest
        "model.members": 1,
        "model.shared_hidden": (),
        "model.assessment_input": "next_state",
        "model.reward_scale": 1.0,
        "model.spread": 1.0,
        "model.balance": 0.0,
        "model.predict_change": False,
        "model.gradient_clip": None,
        "controller.gradient_clip": None,
        "controller.target_rate": 1.0,
        "imagination.end_episode": None,
        "imagination.start_states": "current",
        "imagination.exploration": 0.0,
        "imagination.threshold_quantile": None,
        "imagination.reward_threshold": None,
        "imagination.termination_threshold": None,
    }
    assert {name: flat[name] for name in of_the_suite} == of_the_suite


def test_chapter_3_has_the_numbers_of_section_3_2_2() -> None:
    assert resolve_in("thesis", {}, "chapter_3") == FAMILIES["chapter_3"].thesis
    flat = flatten(resolve_in("thesis", {}, "chapter_3"))
    printed = {
        "model.dynamics_hidden": (256, 256, 256),
        "model.components": 24,
        "model.shared_hidden": (512, 256),
        "model.assessment_input": "next_state",
        "model.learning_rate": 1e-3,
        "model.updates_per_step": 4,
        "model.batch_size": 64,
        "controller.hidden": (512, 256),
        "controller.learning_rate": 2.5e-4,
        "controller.batch_size": 64,
        "controller.updates_per_step": 1,
        "controller.epsilon_min": 0.001,
        "controller.epsilon_max": 0.8,
        "controller.epsilon_decay": 0.03,
        "imagination.temperature": 1.0,
    }
    assert {name: flat[name] for name in printed} == printed


@pytest.mark.parametrize(("family", "preset"), PRESETS)
def test_every_deviation_is_applied_and_has_a_reason(family: str, preset: str) -> None:
    flat, thesis = flatten(resolve_in(preset, {}, family)), flatten(FAMILIES[family].thesis)
    for name, deviation in FAMILIES[family].presets[preset].items():
        assert flat[name] == deviation.value != thesis[name]
        assert len(deviation.reason) > 20
    assert {name for name in flat if flat[name] != thesis[name]} == set(FAMILIES[family].presets[preset])


def test_sizes_that_no_network_has_are_refused() -> None:
    with pytest.raises(InvalidValueError, match=r"model\.reward_hidden \[64\] is not read beside model\.shared_hidden"):
        resolve_in("quick", {"model.reward_hidden": [64]}, "chapter_3")
    with pytest.raises(InvalidValueError, match=r"Without model\.shared_hidden .* model\.termination_hidden too"):
        resolve_in("quick", {"model.shared_hidden": [], "model.reward_hidden": [64]}, "chapter_3")
    apart = {"model.shared_hidden": [], "model.reward_hidden": [64], "model.termination_hidden": [32]}
    assert resolve_in("quick", apart, "chapter_3").model.reward_hidden == (64,)
    assert resolve("thesis", {"model.shared_hidden": []}) == resolve("thesis", {})
    assert resolve("thesis", {"model.shared_hidden": [8]}).model.shared_hidden == (8,)


def test_an_unknown_family_lists_what_exists() -> None:
    with pytest.raises(UnknownNameError, match=r"No settings family 'chapter_4'.* Known: chapter_3, chapter_5"):
        resolve_in("quick", {}, "chapter_4")


def test_an_override_replaces_one_value_of_the_preset() -> None:
    before, after = flatten(resolve("quick", {})), flatten(resolve("quick", {"controller.discount": 0.5}))
    assert {name for name in after if after[name] != before[name]} == {"controller.discount"}


@pytest.mark.parametrize(
    ("name", "given", "kept"),
    [
        ("controller.hidden", [4, 5], (4, 5)),
        ("controller.discount", 1, 1.0),
        ("model.gradient_clip", None, None),
        ("model.gradient_clip", 3, 3.0),
    ],
)
def test_values_are_taken_as_json_gives_them(name: str, given: Any, kept: Any) -> None:
    value = flatten(resolve("thesis", {name: given}))[name]
    assert value == kept
    assert type(value) is type(kept)


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Settings().controller.discount = 0.1  # type: ignore[misc]


def test_an_unknown_setting_lists_what_exists_and_the_nearest_name() -> None:
    with pytest.raises(
        UnknownNameError, match=r"No setting 'controller.discont'. Did you mean 'controller.discount'"
    ) as e:
        resolve("quick", {"controller.discont": 0.9})
    assert all(name in str(e.value) for name in flatten(Settings()))


def test_an_unknown_preset_lists_what_exists() -> None:
    with pytest.raises(
        UnknownNameError, match=r"No preset 'quik'. Did you mean 'quick'\? Known: smoke, quick, thesis, f"
    ):
        resolve("quik", {})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("controller.discount", "high", "'controller.discount' was given 'high'; it takes float"),
        ("controller.discount", True, "'controller.discount' was given True; it takes float"),
        ("controller.discount", 1.5, r"controller.discount is 1.5; it must lie in \[0, 1\]"),
        ("controller.hidden", (8, 0), r"controller.hidden is \(8, 0\); it must be at least 1"),
        ("controller.epsilon_min", -0.1, r"controller.epsilon_min is -0.1; it must lie in \[0, 1\]"),
        ("controller.epsilon_decay", float("inf"), "controller.epsilon_decay is inf; it must be at least 0 and finite"),
        ("controller.epsilon_min", 0.9, r"epsilon_min 0.9 is above controller.epsilon_max 0.8: exploration would rise"),
        ("imagination.start_episode", 1000, r"end_episode 1000 is not above imagination.start_episode 1000: nothing"),
        ("model.dropout", 1.0, r"model.dropout is 1.0; it must lie in \[0, 1\)"),
        ("model.gradient_clip", 0.0, "model.gradient_clip is 0.0; it must be above 0"),
        ("model.components", 2.5, "'model.components' was given 2.5; it takes int"),
        ("imagination.reduction", "median", "No uncertainty reduction 'median'"),
        ("imagination.depth", 0, "imagination.depth is 0; it must be at least 1"),
        ("imagination.temperature", float("nan"), "imagination.temperature is nan; it must be at least 0"),
        ("imagination.termination_threshold", 0.9, r"is 0.9; it must lie in \[0, 0.5\]: it bounds the less likely"),
        ("memory.real", -5, "memory.real is -5; it must be at least 1"),
    ],
)
def test_wrong_values_are_named_with_what_is_allowed(name: str, value: Any, message: str) -> None:
    with pytest.raises((InvalidValueError, UnknownNameError), match=message):
        resolve("quick", {name: value})


@pytest.mark.parametrize("network", ["model.dynamics_hidden", "model.reward_hidden"])
def test_dropout_without_a_hidden_layer_is_refused(network: str) -> None:
    with pytest.raises(
        InvalidValueError, match=r"model\.dropout acts on hidden layers: give model\.dynamics_hidden and"
    ):
        resolve("thesis", {network: ()})
    resolve("thesis", {network: (), "model.dropout": 0.0})
