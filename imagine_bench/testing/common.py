"""What the checks of tasks, agents and world models share."""

from __future__ import annotations

import gymnasium

from imagine_bench.environments import Env
from imagine_bench.errors import ImagineBenchError, InvalidValueError
from imagine_bench.interfaces import TaskSpec


class NotOffered(ImagineBenchError):
    """What is checked is something that a guest may do without."""


def require(holds: bool, otherwise: str) -> None:
    """Raise InvalidValueError with these words unless it holds."""
    if not holds:
        raise InvalidValueError(otherwise)


def make_env(spec: TaskSpec) -> Env:
    """A task's environment as it is checked: kinematic where it can be, clean."""
    return gymnasium.make(spec.env_id, execution=spec.executions[-1], appearance="clean", disable_env_checker=True)
