"""Every setting of an agent changes what it learns, and a bench refuses one that would not."""

from __future__ import annotations

import functools
import json
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import pytest
from fake_latents import SMALL, built, live, with_own_settings

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.capabilities import ModelOnlyTrainer
from imagine_bench.running.bench import plan

BASE: dict[str, Any] = {
    **SMALL,
    "memory.real": 9,
    "memory.imagined": 8,
    "memory.priority": 0.5,
    "controller.epsilon_max": 0.7,
    "controller.epsilon_min": 0.3,
    "controller.epsilon_decay": 0.4,
    "controller.target_rate": 0.5,
    "model.dropout": 0.5,
    "model.max_norm": 0.5,
    "model.precision": "float32",
    "imagination.start_episode": 1,
    "imagination.end_episode": 4,
    "imagination.breadth": 4,
    "imagination.threshold": 0.002,
    "imagination.exploration": 0.9,
    "imagination.curiosity": 0.5,
    "imagination.model_only_episodes": 30,
    "recurrence.burn_in": 1,
    "recurrence.sequence": 1,
    "reuse.reset_every": 8,
}
"""Settings with which all others count."""
OTHERS: dict[str, dict[str, Any]] = {
    "imagination.start_episode": {"imagination.start_episode": 2},
    "imagination.end_episode": {"imagination.end_episode": 3},
    "controller.epsilon_decay": {"controller.epsilon_decay": 5.0},
    "imagination.threshold": {"imagination.threshold": 1e-9},
    "model.precision": {"model.precision": "bfloat16"},
    "model.shared_hidden": {"model.shared_hidden": (8,), "model.reward_hidden": (), "model.termination_hidden": ()},
    "recurrence.burn_in": {"recurrence.burn_in": 0},
    "reuse.steps": {"reuse.steps": 1},
}
"""Other values than those that follow from the type of a setting, and the settings that they need."""
AGENTS = (
    "dqn",
    "dqn_efficient",
    "drqn",
    "imagination",
    "imagination_uncertainty",
    "imagination_only",
    "imagination_only_uncertainty",
)
_WEIGHED = {"imagination.confidence_scale": 0.5}
"""With it transitions are weighed by their uncertainty, which else only the filter reads."""


def other(setting: str, value: Any, allowed: Any) -> dict[str, Any]:
    """Another value of a setting."""
    if setting in OTHERS:
        return OTHERS[setting]
    if isinstance(allowed, tuple):
        return {setting: next(word for word in allowed if word != value)}
    if isinstance(value, bool):
        return {setting: not value}
    if isinstance(value, tuple):
        return {setting: (value[0] + 1, *value[1:])}
    return {setting: 0.1 if not value else value + 1 if isinstance(value, int) else 0.5 * value}


def settings_of(agent: str) -> dict[str, tuple[Any, Any]]:
    """The value of each setting, and the allowed ones; of training in the model alone those of its imagination."""
    found = registry.settings(agent, "published", BASE, "chapter_5")
    sections = {part.name: getattr(found, part.name) for part in fields(found)}
    only = {"imagination"} if agent.startswith("imagination_only") else sections.keys()
    return {
        f"{name}.{each.name}": (getattr(section, each.name), each.metadata["allowed"])
        for name, section in sections.items()
        if name in only
        for each in fields(section)
    }


@functools.cache
def learned(agent: str, settings: tuple[tuple[str, Any], ...] = ()) -> dict[str, Any]:
    """All that an agent has after six short episodes, but its settings."""
    maker = with_own_settings(agent, partial(registry.make_agent, agent))
    learner = built(maker, {**BASE, **dict(settings)})
    actions = live(learner, range(6), np.random.default_rng(1))
    if isinstance(learner, ModelOnlyTrainer):
        while learner.train_in_model():
            pass
        actions += live(learner, range(6, 7), np.random.default_rng(2))
    state = learner.state()
    values = {name: value for name, value in state.values.items() if name not in ("settings", "meters")}
    arrays = {name: array.tobytes() for name, array in state.arrays.items() if name != "imagination/threshold"}
    return {"actions": actions, **values, **arrays}


@pytest.mark.parametrize(("agent", "setting"), [(agent, name) for agent in AGENTS for name in settings_of(agent)])
def test_a_setting_changes_what_is_learned(agent: str, setting: str) -> None:
    changed = other(setting, *settings_of(agent)[setting])
    base = _WEIGHED if setting == "imagination.accumulates" else {}
    same = learned(agent, tuple({**base, **changed}.items())) == learned(agent, tuple(base.items()))
    assert same == (setting in registry.inert_settings(agent))
    if same:
        value = json.dumps(changed[setting])
        with pytest.raises(InvalidValueError, match=f"Setting {setting} has no effect on agent {agent}"):
            plan("arrow_puzzle", "smoke", agents=(f"{agent}:{setting}={value}",))
        with pytest.raises(InvalidValueError, match=f"Setting {setting} has no effect on any agent"):
            plan("arrow_puzzle", "smoke", agents=(agent,), overrides=tuple(changed.items()))
