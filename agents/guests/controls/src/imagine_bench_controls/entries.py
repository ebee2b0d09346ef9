"""The registry line of each control; torch is not imported before an agent is made."""

from __future__ import annotations

from imagine_bench.registry import AgentEntry, WorldModelEntry

_COUNT_TABLE_SETTINGS = "imagine_bench_controls.tabular.settings:HYPERPARAMETERS"
_DIRECTED_SETTINGS = "imagine_bench_controls.tabular.settings:DIRECTED"
_POSTERIOR_SETTINGS = "imagine_bench_controls.tabular.settings:POSTERIOR_SAMPLING"
_Q_LEARNING_SETTINGS = "imagine_bench_controls.tabular.settings:Q_LEARNING"
_DYNA_Q_SETTINGS = "imagine_bench_controls.tabular.settings:DYNA_Q"
_CODE = "its state is the code of a frame."
_TRUE_STATE = "its state is the true macrostate (privileged: other learners see frames)."

DRQN = AgentEntry(
    make="imagine_bench_controls.memory.drqn:make",
    settings="imagine_bench_controls.memory.settings:DRQN",
    title="DQN + memory",
    description="The DQN with a recurrent network (DRQN), which remembers the frames of the episode; replays "
    "sequences as R2D2 does.",
)
IMAGINATION_MEMORY = AgentEntry(
    make="imagine_bench_controls.memory.imagination:make",
    title="imagination + memory",
    settings="imagine_bench_controls.memory.settings:IMAGINATION_MEMORY",
    description="Like imagination + uncertainty, but the world model is recurrent (MDN-RNN), and rollouts carry "
    "its memory.",
)
IMAGINATION_EXACT = AgentEntry(
    make="imagine_bench_controls.exact:make",
    settings="imagine_bench_controls.settings:KNOWING",
    privileged=True,
    needs_exact_world=True,
    title="imagination, exact model",
    description="A control (privileged): like imagination, with the rules and rendered frames for its world model.",
)
IMAGINATION_EXACT_FILTER = AgentEntry(
    make="imagine_bench_controls.exact:make_filter",
    settings="imagine_bench.agents.imagination.inert:UNFILTERED",
    privileged=True,
    needs_exact_world=True,
    title="imagination, exact filter",
    description="A control (privileged): like imagination, but it learns only from imagined transitions that are "
    "right by the rules.",
)
DQN_EFFICIENT = AgentEntry(
    make="imagine_bench_controls.efficient:make",
    settings="imagine_bench_controls.settings:EFFICIENT",
    title="DQN, data-efficient",
    description="A control: the DQN with many updates, n-step targets and periodic resets, as SR-SPR and BBF.",
)
DQN_CODES = AgentEntry(
    make="imagine_bench.agents.dqn:make",
    settings="imagine_bench.agents.dqn_settings:HYPERPARAMETERS",
    encoder_kind="codes",
    title="DQN (codes)",
    description="A control: the DQN, which reads the discrete codes that factored:given sees in place of latents.",
)
DQN_SWAPS = AgentEntry(
    make="imagine_bench_controls.swaps:make",
    settings="imagine_bench_controls.settings:SWAPPING",
    encoder_kind="codes",
    title="DQN (codes), swaps",
    description="A control: the same, also trained on real transitions that have untouched factors of others (CoDA).",
)
COUNT_TABLE = AgentEntry(
    make="imagine_bench_controls.tabular.count_table:make",
    settings=_COUNT_TABLE_SETTINGS,
    encoder_kind="codes",
    description="A control: counts the outcomes of each action in each code of a frame, and plans by value iteration; "
    "explores by chance as DQN does.",
)
COUNT_TABLE_DIRECTED = AgentEntry(
    make="imagine_bench_controls.tabular.count_table:make_directed",
    settings=_DIRECTED_SETTINGS,
    encoder_kind="codes",
    title="count table, directed",
    description="A control: like count table, but it explores by optimism about untried actions (R-max).",
)
COUNT_TABLE_DIRECTED_MACROSTATE = AgentEntry(
    make="imagine_bench_controls.tabular.count_table:make_directed_macrostate",
    settings=_DIRECTED_SETTINGS,
    encoder_kind="codes",
    needs_encoder=False,
    privileged=True,
    title="count table, directed (true state)",
    description=f"A control: the same R-max; {_TRUE_STATE}",
)
COUNT_TABLE_OWN = AgentEntry(
    make="imagine_bench_controls.tabular.own:make",
    settings="imagine_bench_controls.tabular.settings:OWN",
    needs_encoder=False,
    title="count table, learned perception",
    description="A control: like count table, directed, but it learns to see from its own frames as factored.",
)
ELIMINATION = AgentEntry(
    make="imagine_bench_controls.elimination:make",
    settings=_DIRECTED_SETTINGS,
    needs_encoder=False,
    privileged=True,
    title="elimination (true state)",
    description="A control: R-max whose model is learned by elimination, a table for each object and a cause of few "
    f"values for each unusual reward; {_TRUE_STATE}",
)
POSTERIOR_SAMPLING = AgentEntry(
    make="imagine_bench_controls.tabular.posterior_sampling:make",
    settings=_POSTERIOR_SETTINGS,
    encoder_kind="codes",
    title="posterior sampling",
    description=f"A control: a count table that follows, each episode, a model drawn from its beliefs (PSRL); {_CODE}",
)
POSTERIOR_SAMPLING_MACROSTATE = AgentEntry(
    make="imagine_bench_controls.tabular.posterior_sampling:make_macrostate",
    settings=_POSTERIOR_SETTINGS,
    encoder_kind="codes",
    needs_encoder=False,
    privileged=True,
    title="posterior sampling (true state)",
    description="A control: a count table that follows, each episode, a model drawn from its beliefs (PSRL); "
    f"{_TRUE_STATE}",
)
Q_LEARNING = AgentEntry(
    make="imagine_bench_controls.tabular.dyna_q:make_q_learning",
    settings=_Q_LEARNING_SETTINGS,
    encoder_kind="codes",
    title="Q-learning",
    description=f"Learns values in a table from real transitions; {_CODE}",
)
Q_LEARNING_MACROSTATE = AgentEntry(
    make="imagine_bench_controls.tabular.dyna_q:make_q_learning_macrostate",
    settings=_Q_LEARNING_SETTINGS,
    encoder_kind="codes",
    needs_encoder=False,
    privileged=True,
    title="Q-learning (true state)",
    description=f"Learns values in a table from real transitions; {_TRUE_STATE}",
)
DYNA_Q = AgentEntry(
    make="imagine_bench_controls.tabular.dyna_q:make_dyna_q",
    settings=_DYNA_Q_SETTINGS,
    encoder_kind="codes",
    title="Dyna-Q",
    description=f"Q-learning, also from transitions that its model recalls: imagination's ancestor; {_CODE}",
)
DYNA_Q_MACROSTATE = AgentEntry(
    make="imagine_bench_controls.tabular.dyna_q:make_dyna_q_macrostate",
    settings=_DYNA_Q_SETTINGS,
    encoder_kind="codes",
    needs_encoder=False,
    privileged=True,
    title="Dyna-Q (true state)",
    description=f"Q-learning, also from transitions that its model recalls: imagination's ancestor; {_TRUE_STATE}",
)
MDN_RNN = WorldModelEntry(
    make="imagine_bench_controls.memory.world_model:make",
    title="VAE + MDN-RNN",
    encoder_kind="latents",
    description="The ensemble on a recurrent network's memory of all frames of the history.",
    by_default=False,
)
MDN_WHOLE_LAYER = WorldModelEntry(
    make="imagine_bench_controls.whole_layer:make",
    title="VAE + MDN, thesis' settings, whole layers",
    encoder_kind="latents",
    settings="imagine_bench.agents.imagination.settings:HYPERPARAMETERS",
    description="mdn_thesis with the norm of each whole layer limited to 3, not that of each unit's weights.",
    by_default=False,
)
_SIGNAL = "The networks of mdn_ensemble, with another uncertainty:"
INFOPROP = WorldModelEntry(
    make="imagine_bench_controls.signals:make_infoprop",
    title="ensemble, Infoprop",
    encoder_kind="latents",
    settings="imagine_bench.agents.imagination.settings:HYPERPARAMETERS",
    description=f"{_SIGNAL} lost information, which also stops its rollouts (Infoprop).",
    by_default=False,
)
ROUND_TRIP = WorldModelEntry(
    make="imagine_bench_controls.signals:make_round_trip",
    title="ensemble, round trip",
    encoder_kind="latents",
    settings="imagine_bench.agents.imagination.settings:HYPERPARAMETERS",
    description=f"{_SIGNAL} how far an imagined latent moves if it is decoded and encoded again.",
    by_default=False,
)
SPREAD = WorldModelEntry(
    make="imagine_bench_controls.signals:make_spread",
    title="ensemble, spread of futures",
    encoder_kind="latents",
    settings="imagine_bench.agents.imagination.settings:HYPERPARAMETERS",
    description=f"{_SIGNAL} the variance of imagined latents over futures.",
    by_default=False,
)
