"""The studies that come with the package, by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from imagine_bench import registry
from imagine_bench.studies.study import BASE, Study, Variant

_DQN, _FILTERED = "dqn", "imagination_uncertainty"
_MC_DROPOUT = {"model.members": 1, "model.dropout": 0.25}


def _variant(factor: str, name: str, settings: Mapping[str, Any], agent: str = _FILTERED) -> Variant:
    return Variant(name=name, factor=factor, agent=agent, against=_FILTERED, settings=settings)


def _pair(factor: str, value: str, settings: Mapping[str, Any], appearance: str | None = None) -> tuple[Variant, ...]:
    """A factor that concerns DQN too: both agents have it."""
    world = {} if appearance is None else {"appearance": appearance}
    return (
        Variant(name=f"dqn, {value}", factor=factor, agent=_DQN, settings=settings, world=world),
        Variant(
            name=f"imagination, {value}", factor=factor, agent=_FILTERED, against=f"dqn, {value}",
            settings=settings, world=world,
        ),
    )  # fmt: skip


_BASE = (
    Variant(name=_DQN, factor=BASE, agent=_DQN),
    Variant(name=_FILTERED, factor=BASE, agent=_FILTERED, against=_DQN),
)

_FACTORS = (
    *_BASE,
    Variant(
        name="dqn, as many updates", factor="updates", agent=_DQN, against=_DQN,
        settings={"controller.updates_per_step": 5},
    ),
    _variant("updates", "one imagined update a step", {"imagination.updates_per_step": 1}),
    _variant("model's data", "latents not spread", {"model.spread": 1.0}),
    _variant("model's data", "uniform draws", {"model.balance": 0.0}),
    _variant("model", "MC-dropout 25 %, one network", _MC_DROPOUT),
    _variant("reward", "reward and end from the transition", {"model.head_input": "transition"}),
    _variant("reward", "reward counted in tens", {"model.reward_scale": 10.0}),
    _variant("rollouts", "from the current state", {"imagination.start_states": "current"}),
    _variant("rollouts", "depth 10, breadth 3", {"imagination.depth": 10, "imagination.breadth": 3}),
    _variant("rollouts", "half the actions random", {"imagination.exploration": 0.5}),
    _variant("start of imagination", "I_start 300", {"imagination.start_episode": 300}),
    _variant("sampling", "temperature 0.5", {"imagination.temperature": 0.5}),
    _variant("sampling", "temperature 1", {"imagination.temperature": 1.0}),
    _variant("filter", "none", {}, "imagination"),
    _variant("filter", "dynamics only", {"imagination.termination_threshold": None}),
    _variant("filter", "dynamics below 0.03", {"imagination.threshold": 0.03}),
    _variant("filter", "sum below 0.3", {"imagination.reduction": "sum"}),
    _variant("filter", "mean below 0.3", {"imagination.reduction": "mean"}),
    _variant("filter", "dynamics below the 90 % quantile", {"imagination.threshold_quantile": 0.9}),
    _variant(
        "filter", "MC-dropout, reward_std below 2.5",
        {**_MC_DROPOUT, "imagination.reward_threshold": 2.5, "imagination.termination_threshold": None},
    ),
    *_pair("targets", "target network", {"controller.target_rate": 0.02}),
    *_pair("exploration", "thesis' epsilon", {"controller.epsilon_decay": 0.03}),
    *_pair("discount", "0.9", {"controller.discount": 0.9}),
    *_pair("discount", "0.99", {"controller.discount": 0.99}),
    *_pair("appearance", "clean", {}, "clean"),
    *_pair("appearance", "strong", {}, "strong"),
)  # fmt: skip

_DEVIATIONS = (
    *_BASE,
    _variant("networks", "dynamics 3 x 256", {"model.dynamics_hidden": (256, 256, 256)}),
    _variant("networks", "five components", {"model.components": 5}),
    _variant("networks", "reward 3 x 512", {"model.reward_hidden": (512, 512, 512)}),
    _variant("networks", "ends 2 x 256", {"model.termination_hidden": (256, 256)}),
    _variant("likelihood", "z' instead of z' - z", {"model.predict_change": False}),
    _variant("likelihood", "sigma from 0.01", {"model.sigma_floor": 0.01}),
    _variant("model's updates", "rate 0.001", {"model.learning_rate": 1e-3}),
    _variant("model's updates", "sixteen a step", {"model.updates_per_step": 16}),
    _variant("model's updates", "batches of 512", {"model.batch_size": 512}),
    _variant("model's updates", "gradients not clipped", {"model.gradient_clip": None}),
    _variant("model's updates", "bfloat16", {"model.precision": "bfloat16"}),
    _variant("rollouts", "breadth 3", {"imagination.breadth": 3}),
    _variant("rollouts", "greedy", {"imagination.exploration": 0.0}),
)


def _of_quick(*names: str) -> dict[str, Any]:
    """What `quick` changes of the settings whose names begin so."""
    changes = (
        registry.load("imagine_bench.agents.imagination.settings:HYPERPARAMETERS").groups["chapter_5"].sets["fast"]
    )
    return {name: change.value for name, change in changes.items() if name.startswith(names)}


def _ladder() -> Iterator[Variant]:
    """From the thesis' settings to those of `quick`, one factor a rung, each on top of those before; no filter."""
    yield Variant(name=_DQN, factor=BASE, agent=_DQN)
    two: dict[str, Any] = {"controller.updates_per_step": 2}
    below = "dqn, two updates"
    yield Variant(name=below, factor="updates", agent=_DQN, against=_DQN, settings=two)
    longer = _of_quick("controller.")
    yield Variant(
        name=f"{below}, explores longer", factor="exploration", agent=_DQN, against=below, settings={**two, **longer}
    )
    settings: dict[str, Any] = {"imagination.start_episode": 300}
    yield Variant(name="the true model", factor="model", agent="imagination_exact", against=below, settings=settings)
    for name, more in (
        ("imagines from 300: average of 50 samples", {}),
        ("component's mean", {"imagination.predicts_with": "network", "imagination.temperature": 0.0}),
        ("model of quick", _of_quick("model.")),
        (
            "rollouts of quick",
            _of_quick(
                "imagination.start_states", "imagination.breadth", "imagination.depth", "imagination.exploration"
            ),
        ),
        ("explores longer", longer),
        ("updates of quick", _of_quick("imagination.updates_per_step")),
    ):
        settings = {**settings, **more}
        yield Variant(name=name, factor="ladder", agent="imagination", against=below, settings=settings)
        below = name


_LADDER = Study(
    name="ladder", question="From the thesis' settings to those of quick, which step makes imagination help?",
    preset="thesis", budgets=(500, 1000), seeds=(1000, 1001, 1002), evaluation_episodes=300, appearance="mild",
    execution="kinematic", variants=tuple(_ladder()),
)  # fmt: skip


_CONTROLLER = Study(
    name="controller", question="What do the thesis' remarks on its DQN come to here?", preset="thesis",
    budgets=(500, 1000, 2000), seeds=(1000, 1001, 1002, 1003, 1004), evaluation_episodes=300, appearance="mild",
    execution="kinematic",
    variants=(
        Variant(name=_DQN, factor=BASE, agent=_DQN),
        *(
            Variant(name=name, factor=factor, agent=_DQN, against=_DQN, settings=settings)
            for factor, name, settings in (
                ("updates a step", "two", {"controller.updates_per_step": 2}),
                ("updates a step", "four", {"controller.updates_per_step": 4}),
                ("targets", "target network", {"controller.target_rate": 0.02}),
                ("replay", "prioritised", {"memory.priority": 0.6}),
            )
        ),
    ),
)  # fmt: skip


def _study(
    name: str, question: str, variants: tuple[Variant, ...], *, budgets: tuple[int, ...] = (250, 500), seeds: int = 3
) -> Study:
    """At low budgets, where agents differ most, on so many tuning seeds."""
    return Study(
        name=name, question=question, budgets=budgets, seeds=tuple(range(1000, 1000 + seeds)), evaluation_episodes=300,
        appearance="mild", execution="kinematic", variants=variants,
    )  # fmt: skip


_CURIOSITY = _study(
    "curiosity", "Does a reward for epistemic uncertainty explore better?", budgets=(100, 250), seeds=5,
    variants=(
        Variant(name=_FILTERED, factor=BASE, agent=_FILTERED),
        _variant("curiosity", "curiosity 1", {"imagination.curiosity": 1.0}),
        _variant("curiosity", "curiosity 10", {"imagination.curiosity": 10.0}),
        _variant("exploration", "thesis' epsilon", {"controller.epsilon_decay": 0.03}),
        Variant(
            name="thesis' epsilon, curiosity 10", factor="exploration", agent=_FILTERED, against="thesis' epsilon",
            settings={"controller.epsilon_decay": 0.03, "imagination.curiosity": 10.0},
        ),
    ),
)  # fmt: skip

_OF_DYNAMICS = {"imagination.termination_threshold": None}
_USES = (
    ("filter", "thesis' filter", _FILTERED, _OF_DYNAMICS),
    ("weights", "weighed by confidence", "imagination", {"imagination.confidence_scale": 0.3}),
    (
        "length", "rollouts as long as known", _FILTERED,
        {**_OF_DYNAMICS, "imagination.accumulates": True, "imagination.depth": 10},
    ),
    ("exploration", "curiosity 10", "imagination", {"imagination.curiosity": 10.0}),
)  # fmt: skip


def _uses(appearance: str) -> Iterator[Variant]:
    """Imagination at an appearance: without a use of uncertainty, and with each."""
    none, world = f"{appearance}, none", {"appearance": appearance}
    yield Variant(name=none, factor=BASE, agent="imagination", world=world)
    for factor, name, agent, settings in _USES:
        yield Variant(
            name=f"{appearance}, {name}", factor=factor, agent=agent, against=none, settings=settings, world=world
        )


_UNCERTAINTY = Study(
    name="uncertainty", question="Which use of the model's uncertainty is worth it?", budgets=(250, 500),
    seeds=tuple(range(1000, 1010)), evaluation_episodes=300, execution="kinematic",
    variants=(*_uses("clean"), *_uses("mild")),
)  # fmt: skip

_REMARKS = _study(
    "remarks", "What do the thesis' remarks on its imagination come to here?", seeds=5,
    variants=(
        Variant(name=_FILTERED, factor=BASE, agent=_FILTERED),
        _variant("model's data", "latents drawn as the encoder says", {"model.spread": 1.0}),
        Variant(
            name="latents not drawn", factor="model's data", agent=_FILTERED,
            against="latents drawn as the encoder says", settings={"model.spread": 0.0},
        ),
        _variant("memory", "300 imagined transitions", {"memory.imagined": 300}),
        _variant("memory", "30,000 imagined transitions", {"memory.imagined": 30_000}),
        _variant("start of imagination", "I_start 0", {"imagination.start_episode": 0}),
        _variant("start of imagination", "I_start 250", {"imagination.start_episode": 250}),
    ),
)  # fmt: skip

_SMOKE = Study(
    name="smoke", question="Does every part of a study work?", budgets=(5,), seeds=(1000, 1001),
    evaluation_episodes=5, appearance="clean", execution="kinematic",
    variants=(
        Variant(name="dqn", factor=BASE, agent=_DQN),
        Variant(
            name="dqn, more updates", factor="updates", agent=_DQN, against="dqn",
            settings={"controller.updates_per_step": 2},
        ),
    ),
)  # fmt: skip

STUDIES: dict[str, Study] = {
    study.name: study
    for study in (
        _study("factors", "When does imagination help? One factor at a time", _FACTORS),
        _study("deviations", "What is a value of the thesis worth in place of that of quick?", _DEVIATIONS),
        _LADDER,
        _CONTROLLER,
        _CURIOSITY,
        _UNCERTAINTY,
        _REMARKS,
        _SMOKE,
    )
}
