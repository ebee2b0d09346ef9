"""The type of the Gymnasium environments that the bench and its tools work with."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from imagine_bench.arrays import Action, Ints, Observed

Env = gymnasium.Env[Observed, Action]
"""An environment of macro-actions, ours or of another package."""
Wrapper = gymnasium.Wrapper[Observed, Action, Observed, Action]
"""A wrapper that changes neither the type of observations nor that of actions."""
Lanes = VectorEnv[Observed, Ints, NDArray[Any]]
"""A vector environment of macro-actions."""
