"""Settings of all agents: published values, sets, overrides and ranges."""

from __future__ import annotations

from typing import Any

import pytest
from imagine_bench.agents.imagination.settings import Settings
from imagine_bench.agents.settings import CONFIG_GROUPS, INSIDE, SETS, Hyperparameters, flatten, replaced
from imagine_bench_regression import settings as regressor_settings

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, UnknownNameError

ALL: dict[str, Hyperparameters[Any]] = {
    **{name: registry.load(entry.settings) for name, entry in registry.agents().items() if entry.settings},
    "regressors": regressor_settings.HYPERPARAMETERS,
}
SETS_OF_ALL = [(agent, group, name) for agent in ALL for group in ALL[agent].groups for name in SETS]


def resolve(name: str, overrides: dict[str, Any], group: str = "chapter_5") -> Settings:
    found: Settings = ALL["imagination"].resolve(name, overrides, group)
    return found


def test_the_defaults_are_the_published_numbers_of_chapter_5() -> None:
    assert resolve("published", {}) == Settings()
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
    taken = flatten(resolve("published", {"controller.hidden": [4, 5], "model.gradient_clip": 3}))
    assert (taken["controller.hidden"], taken["model.gradient_clip"]) == ((4, 5), 3.0), "as JSON gives them"


def test_chapter_3_has_the_numbers_of_section_3_2_2() -> None:
    flat = flatten(resolve("published", {}, "chapter_3"))
    printed = {
        "model.dynamics_hidden": (256, 256, 256),
        "model.components": 24,
        "model.shared_hidden": (512, 256),
        "model.head_input": "next_state",
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


@pytest.mark.parametrize(("agent", "group", "name"), SETS_OF_ALL)
def test_every_override_is_applied_allowed_and_has_a_reason(agent: str, group: str, name: str) -> None:
    hyperparameters = ALL[agent]
    chosen = hyperparameters.groups[group]
    flat, published = flatten(hyperparameters.resolve(name, {}, group)), flatten(chosen.published)
    for setting, override in chosen.sets[name].items():
        assert flat[setting] == override.value != published[setting]
        assert len(override.reason) > 7
    assert {setting for setting in flat if flat[setting] != published[setting]} == set(chosen.sets[name])
    own = {setting: value for setting, value in flat.items() if setting not in chosen.unused}
    assert hyperparameters.resolve("published", own, group) == hyperparameters.resolve(name, {}, group)


def test_sizes_that_no_network_has_are_refused() -> None:
    with pytest.raises(InvalidValueError, match=r"model\.reward_hidden \(64,\) .* give either the first"):
        resolve("fast", {"model.reward_hidden": [64]}, "chapter_3")
    apart = {"model.shared_hidden": [], "model.reward_hidden": [64], "model.termination_hidden": [32]}
    assert resolve("fast", apart, "chapter_3").model.reward_hidden == (64,)
    shared = {"model.shared_hidden": [8], "model.reward_hidden": [], "model.termination_hidden": []}
    assert resolve("published", shared).model.shared_hidden == (8,)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("controller.hidden", (), r"controller.hidden is \(\); .* of one layer or more"),
        ("model.dropout", 0.001, r"model.dropout is 0.001; it must be 0 or lie in \[1/256, 255/256\]"),
        ("controller.epsilon_min", 0.9, r"epsilon_min 0.9 is above controller.epsilon_max 0.8: exploration would rise"),
        ("imagination.start_episode", 1000, r"end_episode 1000 is not above imagination.start_episode 1000: nothing"),
        ("model.components", 2.5, "'model.components' was given 2.5; it takes a whole number"),
        ("imagination.reduction", "median", "No value of setting imagination.reduction: 'median'"),
        ("imagination.temperature", float("nan"), r"imagination.temperature is nan; it must lie in \[0, 1e\+06\]"),
        ("memory.priority_correction", 1.5, r"memory.priority_correction is 1.5; it must lie in \[0, 1\]"),
        ("imagination.termination_threshold", 0.9, r"is 0.9; it must lie in \[0, 0.5\]: it bounds the less likely"),
    ],
)
def test_wrong_values_are_named_with_what_is_allowed(name: str, value: Any, message: str) -> None:
    with pytest.raises((InvalidValueError, UnknownNameError), match=message):
        resolve("fast", {name: value})


@pytest.mark.parametrize(
    ("name", "allowed", "refused"),
    [
        ("controller.target_rate", [1e-9, 1.0], [0.0, 1.01]),
        ("controller.learning_rate", [1e-9, 1e6], [0.0, 1.01e6]),
        ("controller.discount", [0.0, 1.0], [-0.01, 1.01]),
        ("controller.updates_per_step", [0, 1000], [-1, 1001]),
        ("controller.batch_size", [1, 10_000], [0, 10_001]),
        ("controller.hidden", [[1], [8192] * 16], [[0], [8193], [1] * 17, [True], 1]),
        ("memory.real", [1, 5_000_000], [0, 5_000_001, True, 1.0]),
        ("memory.priority", [0, 1e6], [-0.01, 1.01e6, None, True]),
        ("model.dropout", [0.0, 1 / 256, 255 / 256], [0.003, 0.997]),
        ("model.updates_per_step", [1, 1000], [0, 1001]),
        ("model.max_norm", [None, 1e-9, 1e6], [0.0, "3"]),
    ],
)
def test_a_range_ends_where_it_says(name: str, allowed: list[Any], refused: list[Any]) -> None:
    for value in allowed:
        found = flatten(resolve("published", {name: value}))[name]
        assert found == (tuple(value) if isinstance(value, list) else value)
    for value in refused:
        with pytest.raises(InvalidValueError, match=name):
            resolve("published", {name: value})
    assert [INSIDE.holds(value) for value in (0.0, 1e-9, 0.999, 1.0)] == [False, True, True, False]


@pytest.mark.parametrize("group", CONFIG_GROUPS)
@pytest.mark.parametrize("name", SETS)
def test_more_updates_are_those_of_imagination(group: str, name: str) -> None:
    """Real and imagined updates together, and what keeps five a step steady; all else is the DQN's.

    Imagining agents have the controller and the memory of the DQN.
    """
    more, plain, imagining = (
        ALL[agent].resolve(name, {}, group) for agent in ("dqn_more_updates", "dqn", "imagination")
    )
    assert plain.controller == imagining.controller
    assert plain.memory.real == imagining.memory.real
    as_many = imagining.controller.updates_per_step + imagining.imagination.updates_per_step
    steady = {"controller.hidden": (256, 128), "controller.target_rate": 0.05} if as_many == 5 else {}
    assert more == replaced(plain, {"controller.updates_per_step": as_many, **steady})


@pytest.mark.parametrize("agent", ALL)
def test_every_number_has_a_largest_value(agent: str) -> None:
    """Absurd ones, which no machine could hold or finish, are refused before anything starts."""
    group, chosen = next(iter(ALL[agent].groups.items()))
    for name, value in flatten(chosen.published).items():
        if isinstance(value, bool | str):
            continue
        for absurd in (10**10, 10**400, float("inf")):
            with pytest.raises(InvalidValueError, match=name):
                ALL[agent].resolve("fast", {name: [absurd] if isinstance(value, tuple) else absurd}, group)
