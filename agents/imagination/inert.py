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

_OF_A_MODEL = (
    *(name for name in HYPERPARAMETERS.names() if name.startswith("model.")),
    "imagination.temperature",
    "imagination.predicts_with",
    "imagination.curiosity",
    "imagination.weight_samples",
    "imagination.reduction",
    "imagination.accumulates",
    "imagination.confidence_scale",
)

UNFILTERED = HYPERPARAMETERS.without(*_FILTER, _EPISODES)
FILTERED = HYPERPARAMETERS.without(_EPISODES)
MODEL_ONLY = HYPERPARAMETERS.without(*_BRANCHES, *_FILTER)
"""Of agents that imagine whole episodes, without branches from real states."""
MODEL_ONLY_FILTERED = HYPERPARAMETERS.without(*_BRANCHES)
KNOWING = HYPERPARAMETERS.without(*_OF_A_MODEL, *_FILTER, _EPISODES)
"""Of agents that imagine with the rules in place of a learned model."""
