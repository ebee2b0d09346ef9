"""Settings of the recurrent DQN."""

from __future__ import annotations

from imagine_bench.agents.dqn_settings import HYPERPARAMETERS as DQN
from imagine_bench.agents.memory.settings import FAST_DQN, RecurrentDQNSettings, with_memory

HYPERPARAMETERS = with_memory(RecurrentDQNSettings, DQN, FAST_DQN)
