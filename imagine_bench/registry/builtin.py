"""What this suite itself offers, by name. A task, an agent, a regressor or a world model costs one entry here."""

from __future__ import annotations

import dataclasses

from imagine_bench.interfaces import OBSERVATIONS
from imagine_bench.registry.entries import AgentEntry, RegressorEntry, TaskEntry, WorldModelEntry

_ARROWS = TaskEntry(
    spec="imagine_bench.tasks.arrows.spec:spec_of",
    env="imagine_bench.tasks.arrows.spec:make_limited_env",
    env_id="imagine_bench/Arrows-v0",
    horizon=None,
    world="imagine_bench.tasks.arrows.description:Arrows",
)
TASKS: dict[str, TaskEntry] = {
    **{
        name: dataclasses.replace(
            _ARROWS,
            env="imagine_bench.tasks.arrows.spec:make_env",
            env_id=f"imagine_bench/{gymnasium_name}-v0",
            horizon=horizon,
            options={"horizon": horizon, **options},
        )
        for name, gymnasium_name, horizon, options in (
            ("arrow_puzzle", "ArrowPuzzle", 10, {}),
            ("arrow_puzzle_hard", "ArrowPuzzleHard", 10, {"forbid": "equal+agent"}),
            ("arrow_puzzle_toward", "ArrowPuzzleToward", 10, {"goal": "toward_agent"}),
            ("arrow_puzzle_clockwise", "ArrowPuzzleClockwise", 10, {"goal": "clockwise"}),
            ("arrow_puzzle_easy", "ArrowPuzzleEasy", 2, {"cubes": 1}),
        )
    },
    "arrows": _ARROWS,
    "pick_place": TaskEntry(
        spec="imagine_bench.tasks.pick_place.spec:spec_of",
        env="imagine_bench.tasks.pick_place.spec:make_env",
        env_id="imagine_bench/PickPlace-v0",
        horizon=50,
        world="imagine_bench.tasks.pick_place.rules:PickPlace",
    ),
}

_TRUE_STATE = "the true macrostate (privileged: other learners see frames)"
_COUNT_TABLE_SETTINGS = "imagine_bench.agents.tabular.settings:HYPERPARAMETERS"
_LIBRARY_SETTINGS = "imagine_bench.agents.library.settings:HYPERPARAMETERS"

AGENTS: dict[str, AgentEntry] = {
    "random": AgentEntry(
        make="imagine_bench.agents.baselines:make_random",
        learns=False,
        needs_encoder=False,
        observes=OBSERVATIONS,
        description="Picks every macro-action by chance: the floor.",
    ),
    "oracle": AgentEntry(
        make="imagine_bench.agents.baselines:make_oracle",
        learns=False,
        needs_encoder=False,
        privileged=True,
        observes=OBSERVATIONS,
        description="Is told what frames show, remembers it, knows the rules, acts optimally: the ceiling, no learner.",
    ),
    "dqn": AgentEntry(
        make="imagine_bench.agents.dqn:make",
        settings="imagine_bench.agents.dqn_settings:HYPERPARAMETERS",
        title="DQN",
        description="Learns the value of each macro-action from real experience only (deep Q-learning): the baseline.",
    ),
    "imagination": AgentEntry(
        make="imagine_bench.agents.imagination.agent:make",
        description="DQN that also learns a world model and trains on all transitions that it imagines with it.",
    ),
    "imagination_uncertainty": AgentEntry(
        make="imagine_bench.agents.imagination.agent:make_uncertainty",
        title="imagination + uncertainty",
        description="Like imagination, but an imagined transition is thrown away, with the rest of its rollout, where "
        "the model is uncertain.",
    ),
    "drqn": AgentEntry(
        make="imagine_bench.agents.memory.drqn:make",
        settings="imagine_bench.agents.memory.settings:DRQN",
        title="DQN + memory",
        description="The DQN with a recurrent network (DRQN), which remembers what the episode showed; replays "
        "sequences as R2D2 does.",
    ),
    "imagination_memory": AgentEntry(
        make="imagine_bench.agents.memory.imagination:make",
        title="imagination + memory",
        settings="imagine_bench.agents.memory.settings:IMAGINATION_MEMORY",
        description="Like imagination + uncertainty, but the world model is recurrent (MDN-RNN), and rollouts carry "
        "what it remembers.",
    ),
    "factored": AgentEntry(
        make="imagine_bench.agents.factored.learned:make",
        needs_encoder=False,
        settings="imagine_bench.agents.factored.settings:LEARNED",
        description="Begins with nothing: from its own frames it learns discrete factors, which of them an action "
        "changes and what is rewarded; it explores where it is uncertain and plans in its model.",
    ),
    "factored:given": AgentEntry(
        make="imagine_bench.agents.factored.given:make",
        encoder_kind="codes",
        settings="imagine_bench.agents.factored.settings:HYPERPARAMETERS",
        description="Like factored, but it is given an encoder of discrete factors and learns no perception; it can "
        "also show what it imagines and query an oracle.",
    ),
    "sb3_dqn": AgentEntry(
        make="imagine_bench.agents.library.sb3:make_dqn",
        needs_encoder=False,
        settings=_LIBRARY_SETTINGS,
        external_training_loop=True,
        title="SB3 DQN (pixels)",
        observes=OBSERVATIONS,
        description="Stable-Baselines3's DQN with its convolutional policy, trained on pixels in its own loop.",
    ),
    "sb3_qrdqn": AgentEntry(
        make="imagine_bench.agents.library.sb3:make_qrdqn",
        needs_encoder=False,
        settings=_LIBRARY_SETTINGS,
        external_training_loop=True,
        title="SB3 QR-DQN (pixels)",
        observes=OBSERVATIONS,
        description="Stable-Baselines3's QR-DQN, which learns the distribution of the return, on pixels.",
    ),
    "sb3_dqn_latents": AgentEntry(
        make="imagine_bench.agents.library.sb3:make_dqn",
        settings=_LIBRARY_SETTINGS,
        external_training_loop=True,
        title="SB3 DQN (latents)",
        description="Stable-Baselines3's DQN on the latents that the suite's own DQN sees.",
    ),
    "imagination_only": AgentEntry(
        make="imagine_bench.agents.imagination.model_only:make",
        description="Explores like DQN and learns a world model on the side; a fresh controller that never meets the "
        "world is trained in that model alone, and is what is tested.",
    ),
    "imagination_only_uncertainty": AgentEntry(
        make="imagine_bench.agents.imagination.model_only:make_uncertainty",
        title="imagination only + uncertainty",
        description="Like imagination only, but an imagined episode ends where the model is uncertain.",
    ),
    "dqn_more_updates": AgentEntry(
        make="imagine_bench.agents.dqn:make_more_updates",
        settings="imagine_bench.agents.dqn_settings:MORE_UPDATES",
        title="DQN, more updates",
        description="A control: the DQN with as many updates a real step as imagination makes of its controller.",
    ),
    "count_table": AgentEntry(
        make="imagine_bench.agents.tabular.count_table:make",
        encoder_kind="codes",
        settings=_COUNT_TABLE_SETTINGS,
        description="A control: counts what followed each action in each code of a frame, and plans by value "
        "iteration; explores by chance as DQN does.",
    ),
    "count_table_directed": AgentEntry(
        make="imagine_bench.agents.tabular.count_table:make_directed",
        encoder_kind="codes",
        settings=_COUNT_TABLE_SETTINGS,
        title="count table, directed",
        description="A control: like count table, but it explores by optimism about what it never tried (R-max).",
    ),
    "count_table_own": AgentEntry(
        make="imagine_bench.agents.tabular.own:make",
        needs_encoder=False,
        title="count table, own eyes",
        settings="imagine_bench.agents.tabular.settings:OWN",
        description="A control: like count table, directed, but it learns to see from its own frames as factored.",
    ),
    **{
        f"{name}{twin}": AgentEntry(
            make=f"imagine_bench.agents.tabular.dyna_q:make_{name}{twin}",
            encoder_kind="codes",
            settings=f"imagine_bench.agents.tabular.settings:{name.upper()}",
            needs_encoder=not twin,
            privileged=bool(twin),
            title=f"{title} (true state)" if twin else title,
            description=f"{description}; its state is {_TRUE_STATE if twin else 'the code of a frame'}.",
        )
        for name, title, description in (
            ("q_learning", "Q-learning", "Learns values in a table from real transitions"),
            ("dyna_q", "Dyna-Q", "Q-learning, also from transitions that its model recalls: imagination's ancestor"),
        )
        for twin in ("", "_macrostate")
    },
    "dreamer_v3": AgentEntry(
        make="imagine_bench.agents.library.dreamer:make",
        needs_encoder=False,
        title="DreamerV3 (pixels)",
        settings="imagine_bench.agents.library.dreamer_settings:HYPERPARAMETERS",
        description="sheeprl's DreamerV3: a recurrent world model of pixels, and a policy trained in its imagination.",
    ),
    "sb3_ppo_latents": AgentEntry(
        make="imagine_bench.agents.library.sb3:make_ppo",
        settings=_LIBRARY_SETTINGS,
        external_training_loop=True,
        title="SB3 PPO (latents)",
        description="Stable-Baselines3's PPO, which learns a policy, on the same latents.",
    ),
    "sb3_dqn_imagined": AgentEntry(
        make="imagine_bench.agents.library.sb3:make_imagining_dqn",
        settings="imagine_bench.agents.library.settings:IMAGINING",
        external_training_loop=True,
        title="SB3 DQN + imagination",
        description="The same DQN of the library, trained on real episodes and on those that a world model imagines.",
    ),
    "sb3_ppo_imagined": AgentEntry(
        make="imagine_bench.agents.library.sb3:make_imagining_ppo",
        settings="imagine_bench.agents.library.settings:IMAGINING",
        external_training_loop=True,
        title="SB3 PPO + imagination",
        description="The same PPO of the library, trained on real episodes and on those that a world model imagines.",
    ),
    "imagination_exact": AgentEntry(
        make="imagine_bench.agents.controls.exact:make",
        privileged=True,
        title="imagination, exact model",
        description="A control (privileged): like imagination, with the rules and rendered frames for its world model.",
    ),
    "imagination_exact_filter": AgentEntry(
        make="imagine_bench.agents.controls.exact:make_filter",
        privileged=True,
        title="imagination, exact filter",
        description="A control (privileged): like imagination, but it learns only from imagined transitions that are "
        "right by the rules.",
    ),
    "dqn_efficient": AgentEntry(
        make="imagine_bench.agents.controls.efficient:make",
        title="DQN, data-efficient",
        settings="imagine_bench.agents.controls.settings:EFFICIENT",
        description="A control: the DQN with many updates, n-step targets and periodic resets, as SR-SPR and BBF.",
    ),
    "dqn_codes": AgentEntry(
        make="imagine_bench.agents.dqn:make",
        settings="imagine_bench.agents.dqn_settings:HYPERPARAMETERS",
        encoder_kind="codes",
        title="DQN (codes)",
        description="A control: the DQN, which reads the discrete codes that factored:given sees in place of latents.",
    ),
    "dqn_swaps": AgentEntry(
        make="imagine_bench.agents.controls.swaps:make",
        encoder_kind="codes",
        title="DQN (codes), swaps",
        settings="imagine_bench.agents.controls.settings:SWAPPING",
        description="A control: the same, also trained on real transitions that have untouched factors of others "
        "(CoDA).",
    ),
    "count_table_directed_macrostate": AgentEntry(
        make="imagine_bench.agents.tabular.count_table:make_directed_macrostate",
        settings=_COUNT_TABLE_SETTINGS,
        needs_encoder=False,
        privileged=True,
        encoder_kind="codes",
        title="count table, directed (true state)",
        description=f"A control: the same R-max; its state is {_TRUE_STATE}.",
    ),
    **{
        f"posterior_sampling{twin}": AgentEntry(
            make=f"imagine_bench.agents.tabular.posterior_sampling:make{twin}",
            encoder_kind="codes",
            settings="imagine_bench.agents.tabular.settings:POSTERIOR_SAMPLING",
            needs_encoder=not twin,
            privileged=bool(twin),
            title="posterior sampling" + " (true state)" * bool(twin),
            description="A control: a count table that follows, each episode, a model drawn from what it believes "
            f"(PSRL); its state is {_TRUE_STATE if twin else 'the code of a frame'}.",
        )
        for twin in ("", "_macrostate")
    },
    "dreamer_v3_latents": AgentEntry(
        make="imagine_bench.agents.library.dreamer:make",
        title="DreamerV3 (latents)",
        settings="imagine_bench.agents.library.dreamer_settings:HYPERPARAMETERS",
        description="DreamerV3 on the latents that the suite's own DQN sees.",
    ),
    "lewm": AgentEntry(
        make="imagine_bench.agents.library.lewm:make",
        needs_encoder=False,
        title="LeWM (pixels)",
        settings="imagine_bench.agents.library.lewm_settings:HYPERPARAMETERS",
        description="torch-world's LeWM: a latent world model of pixels without rewards; plans toward frames that "
        "earned most.",
    ),
}

DEMONSTRATOR = "oracle"
"""The registered agent, privileged and optimal, that plays the episodes which learners are shown."""


REGRESSIONS = {
    "toy_regression": "imagine_bench.tasks.toy_regression:SPEC",
    "robot_ik": "imagine_bench.tasks.robot_ik.spec:SPEC",
}
"""Regression tasks, each the ``"module:attr"`` of its RegressionSpec."""

REGRESSORS: dict[str, RegressorEntry] = {
    "mc_dropout": RegressorEntry(
        make="imagine_bench.agents.regressors.regressor:make_mc_dropout",
        title="MC dropout",
        description="One network whose hidden units are dropped at random, again and again: the thesis' Bayesian MDN.",
    ),
    "ensemble": RegressorEntry(
        make="imagine_bench.agents.regressors.regressor:make_ensemble",
        title="deep ensemble",
        description="Several networks that began and trained differently; where they disagree, they do not know.",
    ),
}

_WORLD_MODELS = "imagine_bench.agents.world_models"
_SETTINGS = "imagine_bench.agents.imagination.settings:HYPERPARAMETERS"
WORLD_MODELS: dict[str, WorldModelEntry] = {
    "copy": WorldModelEntry(
        make="imagine_bench.judge.models.ends:make_copy",
        title="copy the last frame",
        description="Says that nothing ever changes: one end of the scale.",
    ),
    "convolutional": WorldModelEntry(
        make=f"{_WORLD_MODELS}.convolutional:make",
        title="convolutional",
        description="A convolutional network from the latest frame and the action to the next frame, in plain torch.",
    ),
    "gaussian": WorldModelEntry(
        make=f"{_WORLD_MODELS}.latent:make_gaussian",
        title="VAE + one Gaussian",
        encoder_kind="latents",
        settings=_SETTINGS,
        description="The thesis' model with a single Gaussian, which cannot hold two outcomes apart.",
    ),
    "mdn_dropout": WorldModelEntry(
        make=f"{_WORLD_MODELS}.latent:make_dropout",
        title="VAE + MDN, MC dropout",
        encoder_kind="latents",
        settings=_SETTINGS,
        description="The thesis' model: a mixture density network between latents, uncertain by Monte-Carlo dropout.",
    ),
    "mdn_ensemble": WorldModelEntry(
        make=f"{_WORLD_MODELS}.latent:make_ensemble",
        title="VAE + MDN, ensemble",
        encoder_kind="latents",
        settings=_SETTINGS,
        description="Three mixture density networks between latents, uncertain where they disagree.",
    ),
    "mdn_rnn": WorldModelEntry(
        make=f"{_WORLD_MODELS}.recurrent:make",
        title="VAE + MDN-RNN",
        encoder_kind="latents",
        description="The ensemble on what a recurrent network remembers of all frames of the history.",
        by_default=False,
    ),
    "mdn_thesis": WorldModelEntry(
        make=f"{_WORLD_MODELS}.latent:make_thesis",
        title="VAE + MDN, thesis' settings",
        encoder_kind="latents",
        settings=_SETTINGS,
        description="The same at the settings that the thesis prints; a minute to fit, so judged only when named.",
        by_default=False,
    ),
    "structured": WorldModelEntry(
        make=f"{_WORLD_MODELS}.structured:make",
        title="structured",
        encoder_kind="codes",
        description="The model of the agent factored: tables over discrete factors, whose structure it learns.",
    ),
    "exact": WorldModelEntry(
        make="imagine_bench.judge.models.ends:make_exact",
        title="exact",
        privileged=True,
        description="The rules and the renderer (privileged): the other end of the scale.",
    ),
}
"""World models that ``imagine-bench judge`` judges."""
