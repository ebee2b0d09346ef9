"""This suite's own tasks, agents and models, by name. A task, an agent, a regressor or a world model costs one entry
here.
"""

from __future__ import annotations

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

from imagine_bench.interfaces import OBSERVATIONS
from imagine_bench.interfaces.regression import RegressionSpec
from imagine_bench.registry.entries import AgentEntry, RegressorEntry, TaskEntry, WorldModelEntry, players_named

_ARROWS = TaskEntry(
    spec="imagine_bench.tasks.arrows.spec:spec_of",
    env="imagine_bench.tasks.arrows.spec:make_limited_env",
    env_id="imagine_bench/Arrows-v0",
    horizon=None,
    world="imagine_bench.tasks.arrows.rules:Arrows",
    motion="imagine_bench.tasks.continuous.spec:make_arrows",
)
TASKS: dict[str, TaskEntry] = {
    **{
        name: dataclasses.replace(
            _ARROWS,
            env="imagine_bench.tasks.arrows.spec:make_env",
            env_id=f"imagine_bench/{gymnasium_name}-v0",
            horizon=horizon,
            options={"horizon": horizon, **options},
            reward_threshold=threshold,
        )
        for name, gymnasium_name, horizon, threshold, options in (
            ("arrow_puzzle", "ArrowPuzzle", 10, 45.8, {}),
            ("arrow_puzzle_hard", "ArrowPuzzleHard", 10, 45.3, {"forbid": "equal+agent"}),
            ("arrow_puzzle_toward", "ArrowPuzzleToward", 10, 45.8, {"goal": "toward_agent"}),
            ("arrow_puzzle_clockwise", "ArrowPuzzleClockwise", 10, 45.3, {"goal": "clockwise"}),
            ("arrow_puzzle_easy", "ArrowPuzzleEasy", 2, 47.1, {"cubes": 1}),
        )
    },
    "arrows": dataclasses.replace(_ARROWS, reward_threshold=45.8),
    "pick_place": TaskEntry(
        spec="imagine_bench.tasks.pick_place.spec:spec_of",
        env="imagine_bench.tasks.pick_place.spec:make_env",
        env_id="imagine_bench/PickPlace-v0",
        horizon=50,
        world="imagine_bench.tasks.pick_place.rules:PickPlace",
        reward_threshold=7.8,
        motion="imagine_bench.tasks.continuous.spec:make_pick_place",
    ),
}

_IMAGINATION_SETTINGS = "imagine_bench.agents.imagination.settings:HYPERPARAMETERS"
_EFFECTIVE = "imagine_bench.agents.imagination.inert"

AGENTS: dict[str, AgentEntry] = {
    "random": AgentEntry(
        make="imagine_bench.agents.baselines:make_random",
        learns=False,
        needs_encoder=False,
        observes=OBSERVATIONS,
        description="Picks every macro-action by chance.",
    ),
    "oracle": AgentEntry(
        make="imagine_bench.agents.baselines:make_oracle",
        learns=False,
        needs_encoder=False,
        privileged=True,
        observes=OBSERVATIONS,
        description="Is told the content of frames, remembers it, knows the rules, acts optimally: the ceiling.",
    ),
    "dqn": AgentEntry(
        make="imagine_bench.agents.dqn:make",
        settings="imagine_bench.agents.dqn_settings:HYPERPARAMETERS",
        title="DQN",
        description="Learns the value of each macro-action from real experience only (deep Q-learning): the baseline.",
    ),
    "dqn_more_updates": AgentEntry(
        make="imagine_bench.agents.dqn:make_more_updates",
        relative_cost=2.0,
        settings="imagine_bench.agents.dqn_settings:MORE_UPDATES",
        title="DQN, more updates",
        description="A control: the DQN with as many updates a real step as imagination makes of its controller.",
    ),
    "imagination": AgentEntry(
        make="imagine_bench.agents.imagination.agent:make",
        relative_cost=5.0,
        settings=f"{_EFFECTIVE}:UNFILTERED",
        description="DQN that also learns a world model and trains on all transitions that it imagines with it.",
    ),
    "imagination_uncertainty": AgentEntry(
        make="imagine_bench.agents.imagination.agent:make_uncertainty",
        relative_cost=5.0,
        settings=f"{_EFFECTIVE}:FILTERED",
        title="imagination + uncertainty",
        description="Like imagination, but an imagined transition is thrown away, with the rest of its rollout, where "
        "the model is uncertain.",
    ),
    "imagination_only": AgentEntry(
        make="imagine_bench.agents.imagination.model_only:make",
        relative_cost=4.0,
        settings=f"{_EFFECTIVE}:MODEL_ONLY",
        description="Explores like DQN and learns a world model on the side; a fresh controller that never meets the "
        "world is trained in that model alone, and is then tested.",
    ),
    "imagination_only_uncertainty": AgentEntry(
        make="imagine_bench.agents.imagination.model_only:make_uncertainty",
        relative_cost=4.0,
        settings=f"{_EFFECTIVE}:MODEL_ONLY_FILTERED",
        title="imagination only + uncertainty",
        description="Like imagination only, but an imagined episode ends where the model is uncertain.",
    ),
}

PLAYERS = players_named("person", "A person at the keyboard, in the window of 'imagine-bench play'.")
"""Prefixes of people whose episodes are kept, such as ``person:anna``."""
OUR_AGENTS = frozenset({*AGENTS, *PLAYERS})
"""The names of this suite's agents and players, which nobody else may take."""
DEMONSTRATOR = "oracle"
"""The registered agent, privileged and optimal, that plays the episodes which learners are shown."""


REGRESSIONS: dict[str, str | RegressionSpec] = {}
"""Regression tasks that this process registered, each a RegressionSpec or its ``"module:attr"``. Those of the suite are
in its plug-in package ``imagine-bench-regression``."""

REGRESSORS: dict[str, RegressorEntry] = {}
"""Regressors that this process registered."""

WORLD_MODELS: dict[str, WorldModelEntry] = {
    "copy": WorldModelEntry(
        make="imagine_bench.agents.world_models.limits:Copy",
        title="copy the last frame",
        description="Says that nothing ever changes: one end of the scale.",
    ),
    "patches": WorldModelEntry(
        make="imagine_bench.agents.world_models.patches:Patches",
        title="patches and tables",
        description="No network: patches that change, groups of their looks, tables of the next groups; a plain model.",
    ),
    "convolutional": WorldModelEntry(
        make="imagine_bench.agents.world_models.convolutional:make",
        title="convolutional",
        description="A convolutional network from the latest frame and the action to the next frame, in plain torch.",
    ),
    "gaussian": WorldModelEntry(
        make="imagine_bench.agents.world_models.latent:make_gaussian",
        title="VAE + one Gaussian",
        encoder_kind="latents",
        settings=_IMAGINATION_SETTINGS,
        description="The thesis' model with a single Gaussian, which cannot hold two outcomes apart.",
    ),
    "mdn_dropout": WorldModelEntry(
        make="imagine_bench.agents.world_models.latent:make_dropout",
        title="VAE + MDN, MC dropout",
        encoder_kind="latents",
        settings=_IMAGINATION_SETTINGS,
        description="The thesis' model: a mixture density network between latents, uncertain by Monte-Carlo dropout.",
    ),
    "mdn_ensemble": WorldModelEntry(
        make="imagine_bench.agents.world_models.latent:make_ensemble",
        title="VAE + MDN, ensemble",
        encoder_kind="latents",
        settings=_IMAGINATION_SETTINGS,
        description="Three mixture density networks between latents, uncertain where they disagree.",
    ),
    "mdn_thesis": WorldModelEntry(
        make="imagine_bench.agents.world_models.latent:make_thesis",
        title="VAE + MDN, thesis' settings",
        encoder_kind="latents",
        settings=_IMAGINATION_SETTINGS,
        description="The same at the settings that the thesis prints; a minute to fit, so judged only when named.",
        by_default=False,
    ),
    "exact": WorldModelEntry(
        make="imagine_bench.agents.world_models.limits:Exact",
        title="exact",
        privileged=True,
        description="The rules and the renderer (privileged): the other end of the scale.",
    ),
}
"""World models that ``imagine-bench judge`` judges."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Guest:
    """A package of this suite that is installed apart from it, known by name also where it is not installed."""

    package: str  #: its name as pip knows it
    module: str  #: its name as Python imports it
    is_ours_alone: bool  #: whether it needs no library of others, beyond those of this suite
    names: Mapping[str, Mapping[str, str]]  #: its offers and their places in its code, by group of entry points
    install: str  #: the command line that installs it


@functools.cache
def guests() -> tuple[Guest, ...]:
    """All guests of this suite, installed or not, in the order of their folders.

    Their ``pyproject.toml`` files lie in the checkout and in the wheel; a guest's code is in its own package alone.
    """
    found = []
    for file in sorted(Path(str(resources.files("imagine_bench.agents"))).glob("guests/*/pyproject.toml")):
        project = tomllib.loads(file.read_text())["project"]
        what = f"-e {file.parent}" if (file.parent / "src").is_dir() else project["name"]
        package = project["name"]
        found.append(
            Guest(
                package=package,
                module=package.replace("-", "_"),
                is_ours_alone=all(needed.startswith("imagine-bench") for needed in project["dependencies"]),
                names=project["entry-points"],
                install=f"pip install {what}",
            )
        )
    return tuple(found)
