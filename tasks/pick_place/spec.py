"""Pick-and-place with a human (thesis, chapter 3): the bench's description, and the environment.

Importing this module is cheap: MuJoCo loads when an environment or a frame is made.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from imagine_bench.interfaces import PerformanceTargets, State, TaskSpec
from imagine_bench.rules import facts
from imagine_bench.values import Setting

from .. import specs
from .rules import HANDED_OVER, N_OBJECTS, PickPlace, PickPlaceRules

if TYPE_CHECKING:
    from ..macro_env import MacroEnv

HORIZON = 50
"""Of no weight: an optimal agent needs 6 actions on average and is cut off once in 25,000 episodes."""
_OBJECTS = ("ball", "car", "cup")
_PLACES = ("left", "middle", "right")


_CHAPTER_3 = ("dqn", "imagination_only")
_COMPARED = ("random", "oracle", *_CHAPTER_3)
_FILTERED = "imagination_only_uncertainty"  # not in `quick`: there its filter was seen to discard nothing
_PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {"agents": (*_COMPARED, _FILTERED)},
    "quick": {
        "agents": (*_COMPARED, "factored:given"),
        "evaluation_episodes": 100,
        "seeds": (0, 1, 2),
        "budgets": (100, 250, 500),
    },
    "thesis": {  # section 3.2.3: 10 runs of 1000 episodes, each tested on 100
        "agents": _CHAPTER_3,
        "seeds": tuple(range(10)),
        "budgets": (1000,),
        "evaluation_episodes": 100,
    },
    "full": {
        "hyperparameters": "fast",  # without dropout the published values leave the filter nothing to compare
        "agents": (*_COMPARED, _FILTERED, "factored:given"),
        "budgets": (100, 250, 500, 1000),
    },
}

_RULES = PickPlaceRules()
SPEC = TaskSpec(
    id="pick_place",
    title="Pick-and-place with a human",
    description=(
        "A human points at one of three objects, which the arm picks; they then point at another, so that it must be "
        "put back first, or open their palm for a handover. Their next wish is random, and a wrong action ends it."
    ),
    env_id="imagine_bench/PickPlace-v0",
    horizon=HORIZON,
    action_names=(*(f"pick or place the {name}" for name in _OBJECTS), "hand over"),
    macrostate_names=(*(f"{place} object" for place in _PLACES), "gesture"),
    macrostate_values=(*(("placed", "picked", "handed over"),) * N_OBJECTS, (*_PLACES, "handover", "withdrawn")),
    preprocessing="small_rgb",
    encoder="pick_place",
    rules=_RULES,
    facts=functools.partial(facts, _RULES, HORIZON),
    render_macrostates=functools.partial(specs.render_macrostates, _RULES),
    reference="pick_place",
    config_group="chapter_3",
    targets=PerformanceTargets(
        objects=_OBJECTS,
        as_ruled=0.995,
        other_objects_mm=3.0,
        error_mm=5.0,
        physics_per_cpu_s=60,
        kinematic_per_cpu_s=5_000,
        encoders={"clean": 0.995, "mild": 0.995, "strong": 0.98, "photo": 0.995},
    ),
    presets=_PRESETS,
    success_threshold=0.98,
)


def spec_of(**world: Setting) -> TaskSpec:
    """The task in a world of these parameters. Raises as :class:`.rules.PickPlace`."""
    return _spec(PickPlace.taken_from(world))


def _is_handed_over(macrostate: State) -> bool:
    """Whether an object lies in the palm, which is then seen."""
    return HANDED_OVER in macrostate[:N_OBJECTS]


@functools.cache
def _spec(world: PickPlace) -> TaskSpec:
    if world == PickPlace():
        return SPEC
    rules = PickPlaceRules(world)
    return replace(
        SPEC,
        id=str(world),
        title=f"{SPEC.title} ({world.words})",
        env_id=f"imagine_bench/PickPlace-{world.hash}-v0",
        encoder=SPEC.encoder + world.encoder_suffix,
        sight=world.observation_model(always_shown=_is_handed_over),
        rules=rules,
        facts=functools.partial(facts, rules, HORIZON),
        render_macrostates=functools.partial(specs.render_macrostates, rules),
        reference=None,
    )


def make_env(**options: Any) -> MacroEnv:
    """Pick-and-place with a human; ``options`` are its parameters and the keyword arguments of MacroEnv.

    Actions 0, 1, 2 pick object i up, or put it back if it is held; action 3 hands over. The robot does as it is told as
    far as that is possible, asked for or not; for impossible things it reaches out in vain. The human answers after
    having seen the result.

    How the rules are read where the thesis is silent stands in ``docs/reference/environments.md``.
    """
    return specs.make_env(PickPlace, _spec, options)
