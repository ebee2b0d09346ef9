"""The checks of each guest, and their results. Each check is a sentence, and raises where it does not hold."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, plain
from imagine_bench.testing.checks import (
    AGENT_CHECKS,
    MODEL_CHECKS,
    TASK_CHECKS,
    CheckedModel,
    NotOffered,
    checked_agent,
)
from imagine_bench.testing.options import OPTION_ROWS, CheckedOptions, watching_teaches_as_living

Checks = Mapping[str, Callable[[], None]]
_USUAL = "arrow_puzzle"


def checks(task: str | None = None, agent: str | None = None, model: str | None = None) -> Checks:
    """The contract of a task; or of an agent or a world model in it, in the arrow puzzle where no task is named.

    Raises:
        InvalidValueError: Nothing to check, an agent and a world model at once, or a model that is given the rules.
        UnknownNameError: No such task, agent or world model.
        SetupError: Its package offers nothing that can be loaded.
    """
    if agent is not None and model is not None:
        raise InvalidValueError("An agent and a world model are checked one at a time; give --agent or --model.")
    where = task or _USUAL
    if agent is not None:
        one, options = checked_agent(agent, where), CheckedOptions(agent, where)
        found = {what: functools.partial(check, one) for what, check in AGENT_CHECKS.items()}
        found["watched episodes teach it the same as its own"] = functools.partial(watching_teaches_as_living, one)
        for option in OPTION_ROWS:
            found[f"the option {option} has an effect or is refused"] = functools.partial(options.check, option)
        return found
    if model is not None:
        if registry.world_model_entry(model).privileged:
            raise InvalidValueError(f"World model {model} is given the rules and learns nothing; name one that learns.")
        return {what: functools.partial(check, CheckedModel(model, where)) for what, check in MODEL_CHECKS.items()}
    if task is None:
        raise InvalidValueError("There is nothing to check; give --task, --agent or --model.")
    return {what: functools.partial(check, registry.task(task)) for what, check in TASK_CHECKS.items()}


def report(checks: Checks) -> int:
    """Carry all out, print the result of each, and count those that failed."""
    failed = 0
    for what, check in checks.items():
        try:
            check()
        except NotOffered as why:
            print(f"none   {what}: {why}")
        except (Exception, SystemExit) as error:  # whatever a guest does wrong is a finding
            failed += 1
            print(f"wrong  {what}: {' '.join(plain(error).split()) or type(error).__name__}")
        else:
            print(f"ok     {what}")
    return failed
