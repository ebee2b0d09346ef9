"""The studies that come with the package, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from imagine_bench.study import BASE, Study, Variant

_DQN, _IMAGINATION, _FILTERED = "dqn", "imagination", "imagination_uncertainty"


def _variant(factor: str, name: str, settings: Mapping[str, Any], agent: str = _IMAGINATION) -> Variant:
    return Variant(name=name, factor=factor, agent=agent, against="imagination", settings=settings)


def _pair(factor: str, value: str, settings: Mapping[str, Any], appearance: str | None = None) -> tuple[Variant, ...]:
    """A factor that concerns DQN too: both agents have it."""
    return (
        Variant(name=f"dqn, {value}", factor=factor, agent=_DQN, settings=settings, appearance=appearance),
        Variant(
            name=f"imagination, {value}", factor=factor, agent=_IMAGINATION, against=f"dqn, {value}",
            settings=settings, appearance=appearance,
        ),
    )  # fmt: skip


_FACTORS = (
    Variant(name="dqn", factor=BASE, agent=_DQN),
    Variant(name="imagination", factor=BASE, agent=_IMAGINATION, against="dqn"),
    Variant(
        name="dqn, as many updates", factor="updates", agent=_DQN, against="dqn",
        settings={"controller.updates_per_step": 5},
    ),
    _variant("updates", "one imagined update a step", {"imagination.updates_per_step": 1}),
    _variant("start of rollouts", "from the current state", {"imagination.start_states": "current"}),
    _variant("rollouts", "depth 10, breadth 3", {"imagination.depth": 10, "imagination.breadth": 3}),
    _variant("start of imagination", "I_start 300", {"imagination.start_episode": 300}),
    _variant("sampling", "temperature 0.5", {"imagination.temperature": 0.5}),
    _variant("sampling", "temperature 1", {"imagination.temperature": 1.0}),
    _variant("reward", "reward counted in tens", {"model.reward_scale": 10.0}),
    _variant("reward", "reward and end from the transition", {"model.assessment_input": "transition"}),
    _variant("model's data", "latents spread five times", {"model.spread": 5.0}),
    _variant("model's data", "rare outcomes made up for", {"model.balance": 0.5}),
    _variant("filter", "max below 0.3", {}, _FILTERED),
    _variant("filter", "dynamics only", {"imagination.reward_threshold": None}, _FILTERED),
    _variant("filter", "sure of the end too", {"imagination.termination_threshold": 0.02}, _FILTERED),
    _variant("filter", "sum below 0.3", {"imagination.reduction": "sum"}, _FILTERED),
    _variant("filter", "mean below 0.3", {"imagination.reduction": "mean"}, _FILTERED),
    _variant("filter", "below the 90 % quantile", {"imagination.threshold_quantile": 0.9}, _FILTERED),
    _variant(
        "filter", "five networks, below the 90 % quantile",
        {
            "model.members": 5, "model.dropout": 0.0, "imagination.threshold_quantile": 0.9,
            "imagination.reward_threshold": None,
        },
        _FILTERED,
    ),
    *_pair("targets", "target network", {"controller.target_rate": 0.02}),
    *_pair("exploration", "thesis' epsilon", {"controller.epsilon_decay": 0.03}),
    *_pair("discount", "0.9", {"controller.discount": 0.9}),
    *_pair("discount", "0.99", {"controller.discount": 0.99}),
    *_pair("appearance", "clean", {}, "clean"),
    *_pair("appearance", "strong", {}, "strong"),
)  # fmt: skip

STUDIES: dict[str, Study] = {
    "factors": Study(
        name="factors",
        question="When does imagination help? One factor at a time",
        budgets=(500, 1000),
        seeds=(1000, 1001, 1002),
        evaluation_episodes=300,
        appearance="mild",
        execution="kinematic",
        variants=_FACTORS,
    ),
    "smoke": Study(
        name="smoke",
        question="Does every part of a study work?",
        budgets=(5,),
        seeds=(1000, 1001),
        evaluation_episodes=5,
        appearance="clean",
        execution="kinematic",
        variants=(
            Variant(name="dqn", factor=BASE, agent=_DQN),
            Variant(
                name="dqn, more updates", factor="updates", agent=_DQN, against="dqn",
                settings={"controller.updates_per_step": 2},
            ),
        ),
    ),
}  # fmt: skip
