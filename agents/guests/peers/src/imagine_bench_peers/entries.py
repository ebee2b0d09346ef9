"""The registry line of each agent; no library is imported before an agent is made."""

from __future__ import annotations

from imagine_bench.interfaces import OBSERVATIONS
from imagine_bench.registry import AgentEntry

_SB3_SETTINGS = "imagine_bench_peers.sb3_settings:HYPERPARAMETERS"
_PIXEL_SETTINGS = "imagine_bench_peers.sb3_settings:PIXELS"
_QUANTILE_SETTINGS = "imagine_bench_peers.sb3_settings:QUANTILES"
_IMAGINING_SETTINGS = "imagine_bench_peers.sb3_settings:IMAGINING"
_DREAMER_SETTINGS = "imagine_bench_peers.dreamer_settings:HYPERPARAMETERS"

SB3_DQN = AgentEntry(
    make="imagine_bench_peers.sb3:make_dqn",
    settings=_PIXEL_SETTINGS,
    needs_encoder=False,
    observes=OBSERVATIONS,
    external_training_loop=True,
    title="SB3 DQN (pixels)",
    description="Stable-Baselines3's DQN with its convolutional policy, trained on pixels in its own loop.",
)
SB3_QRDQN = AgentEntry(
    make="imagine_bench_peers.sb3:make_qrdqn",
    settings=_QUANTILE_SETTINGS,
    needs_encoder=False,
    observes=OBSERVATIONS,
    external_training_loop=True,
    title="SB3 QR-DQN (pixels)",
    description="Stable-Baselines3's QR-DQN, which learns the distribution of the return, on pixels.",
)
SB3_DQN_LATENTS = AgentEntry(
    make="imagine_bench_peers.sb3:make_dqn_latents",
    settings=_SB3_SETTINGS,
    external_training_loop=True,
    title="SB3 DQN (latents)",
    description="Stable-Baselines3's DQN on the latents that the suite's own DQN sees.",
)
SB3_PPO_LATENTS = AgentEntry(
    make="imagine_bench_peers.sb3:make_ppo",
    settings=_SB3_SETTINGS,
    external_training_loop=True,
    title="SB3 PPO (latents)",
    description="Stable-Baselines3's PPO, which learns a policy, on the same latents.",
)
SB3_PPO_RND_LATENTS = AgentEntry(
    make="imagine_bench_peers.sb3:make_curious_ppo",
    settings="imagine_bench_peers.sb3_settings:CURIOUS",
    external_training_loop=True,
    title="SB3 PPO + RND (latents)",
    description="The same PPO, with a bonus for observations that were seldom seen: random network distillation.",
)
SB3_DQN_IMAGINED = AgentEntry(
    make="imagine_bench_peers.sb3:make_imagining_dqn",
    settings=_IMAGINING_SETTINGS,
    external_training_loop=True,
    title="SB3 DQN + imagination",
    description="The same DQN of the library, trained on real episodes and on those that a world model imagines.",
)
SB3_PPO_IMAGINED = AgentEntry(
    make="imagine_bench_peers.sb3:make_imagining_ppo",
    settings=_IMAGINING_SETTINGS,
    external_training_loop=True,
    title="SB3 PPO + imagination",
    description="The same PPO of the library, trained on real episodes and on those that a world model imagines.",
)
DREAMER_V3 = AgentEntry(
    make="imagine_bench_peers.dreamer:make",
    settings=_DREAMER_SETTINGS,
    needs_encoder=False,
    title="DreamerV3 (pixels)",
    description="sheeprl's DreamerV3: a recurrent world model of pixels, and a policy trained in its imagination.",
)
DREAMER_V3_LATENTS = AgentEntry(
    make="imagine_bench_peers.dreamer:make",
    settings=_DREAMER_SETTINGS,
    title="DreamerV3 (latents)",
    description="DreamerV3 on the latents that the suite's own DQN sees.",
)
LEWM = AgentEntry(
    make="imagine_bench_peers.lewm:make",
    settings="imagine_bench_peers.lewm_settings:HYPERPARAMETERS",
    needs_encoder=False,
    title="LeWM (pixels)",
    description="torch-world's LeWM: a latent world model of pixels without rewards; plans toward frames that "
    "earned most.",
)
