"""The settings of agents that imagine, each kind with those that have no effect on it."""

from __future__ import annotations

from .settings import HYPERPARAMETERS

_FILTER = tuple(
    f"imagination.{name}" for name in ("threshold", "threshold_quantile", "reward_threshold", "termination_threshold")
)
_BRANCHES = tuple(
    f"imagination.{name}" for name in ("start_episode", "end_episode", "start_states", "breadth", "updates_per_step")
)
_EPISODES = "imagination.model_only_episodes"

UNFILTERED = HYPERPARAMETERS.without(*_FILTER, _EPISODES)
FILTERED = HYPERPARAMETERS.without(_EPISODES)
MODEL_ONLY = HYPERPARAMETERS.without(*_BRANCHES, *_FILTER)
"""Of agents that imagine whole episodes, without branches from real states."""
MODEL_ONLY_FILTERED = HYPERPARAMETERS.without(*_BRANCHES)
