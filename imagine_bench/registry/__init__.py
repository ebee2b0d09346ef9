"""Names to objects, of this suite and of installed packages; nothing heavy is imported until it is asked for."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from imagine_bench.errors import InvalidValueError, SetupError, UnknownNameError, brief, require_known, unprintable
from imagine_bench.interfaces import Agent, AgentContext, TaskSpec
from imagine_bench.interfaces.model import WorldModel
from imagine_bench.interfaces.regression import RegressionSpec, Regressor, RegressorContext
from imagine_bench.registry.builtin import AGENTS, DEMONSTRATOR, PLAYERS, REGRESSIONS, REGRESSORS, TASKS, WORLD_MODELS
from imagine_bench.registry.by_value import CodeByValue
from imagine_bench.registry.entries import (
    AgentConfiguration,
    AgentEntry,
    EncoderEntry,
    RegressorEntry,
    TaskEntry,
    WorldModelEntry,
    parse_configuration,
    parse_options,
    read_mapping,
)
from imagine_bench.registry.environments import motion_id, motion_name, register_env, vector_id
from imagine_bench.registry.loading import guests_faults, load, refuse_while_loading
from imagine_bench.registry.plugins import (
    AGENT_GROUP,
    ENCODER_GROUP,
    MOTION,
    REGRESSION_GROUP,
    REGRESSOR_GROUP,
    STUDY_GROUP,
    TASK_GROUP,
    WORLD_MODEL_GROUP,
    absent_guests,
    command,
    describe_group,
    guest_packages,
    guest_with,
    installed_of,
    is_ours,
    offered,
    offers,
    package_code,
    packages_of,
    refused_offers,
    require_guest,
    usable,
)
from imagine_bench.values import Setting

__all__ = [
    "AGENTS",
    "AGENT_GROUP",
    "DEMONSTRATOR",
    "ENCODER_GROUP",
    "MOTION",
    "PLAYERS",
    "REGRESSIONS",
    "REGRESSION_GROUP",
    "REGRESSORS",
    "REGRESSOR_GROUP",
    "STUDY_GROUP",
    "TASKS",
    "TASK_GROUP",
    "WORLD_MODELS",
    "WORLD_MODEL_GROUP",
    "AgentEntry",
    "EncoderEntry",
    "RegressorEntry",
    "TaskEntry",
    "WorldModelEntry",
    "absent_guests",
    "command",
    "describe_group",
    "guest_packages",
    "guest_with",
    "guests_faults",
    "installed_of",
    "is_ours",
    "load",
    "motion_id",
    "motion_name",
    "offered",
    "offers",
    "package_code",
    "packages_of",
    "refuse_while_loading",
    "refused_offers",
    "register_env",
    "require_guest",
    "usable",
    "vector_id",
]

_METHODS = ("act", "observe", "diagnostics", "state", "restore")
"""Of every agent."""


def tasks() -> dict[str, TaskEntry]:
    """All control tasks by name, also those of installed packages, without those that cannot be loaded."""
    return {**TASKS, **usable(TASK_GROUP)}


def agents() -> dict[str, AgentEntry]:
    """All agents by name, also those of installed packages, without those that cannot be loaded and prefixes."""
    return {**AGENTS, **{name: entry for name, entry in usable(AGENT_GROUP).items() if not entry.argument}}


def is_own(task: str) -> bool:
    """Whether a task is this suite's, which needs no check and has its encoders."""
    base = task.partition(":")[0]
    return base in TASKS and TASKS[base].spec.startswith("imagine_bench.")


def regressions() -> dict[str, str | RegressionSpec]:
    """All regression tasks by name, likewise."""
    return {**REGRESSIONS, **usable(REGRESSION_GROUP)}


def regressors() -> dict[str, RegressorEntry]:
    """All regressors by name, likewise."""
    return {**REGRESSORS, **usable(REGRESSOR_GROUP)}


def task_entry(name: str) -> TaskEntry:
    """The registry line of a task, this suite's or an installed package's; also of ``NAME:key=value,...``.

    Raises:
        UnknownNameError: No such task, or no such option; the message lists those that there are.
        InvalidValueError: The task takes no options, or none of this value.
        SetupError: Its package offers something else under this name, or nothing that can be loaded.
    """
    base, colon, said = name.partition(":") if isinstance(name, str) else (name, "", "")
    if base not in TASKS and base in regressions():
        raise InvalidValueError(f"{base} is a regression task, in which no agent acts; give one of agents.")
    if not colon or name in offers(TASK_GROUP):
        entry: TaskEntry = offered(name, TASKS, TASK_GROUP)
    else:
        line: TaskEntry = offered(base, TASKS, TASK_GROUP)
        with guests_faults(f"Task {name}", line.spec):
            options = {**line.options, **_options(base, line, said)}
            spec: TaskSpec = load(line.spec)(**options)
            horizon = line.horizon and spec.horizon
            threshold = line.reward_threshold if options == dict(line.options) else None
            entry = dataclasses.replace(line, options=options, env_id=spec.env_id, horizon=horizon)
            entry = dataclasses.replace(entry, reward_threshold=threshold)
    register_env(entry)
    return entry


def _options(base: str, entry: TaskEntry, said: str) -> dict[str, Setting]:
    """The options after the colon, ``key=value,...`` or ``@`` and a JSON file, by option."""
    if not entry.world:
        raise InvalidValueError(f"Task {base} takes no options; leave out {brief(':' + said)}.")
    world = load(entry.world)
    kinds = {each.name: str(each.type) for each in dataclasses.fields(world)}
    kinds |= {old: kinds[new] for new, old in getattr(world, "NAMED", {}).items()}
    given = read_mapping(Path(said[1:])) if said.startswith("@") else parse_options(said, kinds, f"task {base}:")
    for key in given:
        require_known(f"option of task {base}", key, kinds)
    return given


def task_name(name: str) -> str:
    """The one name of a task, however its options were written. Raises as :func:`task`."""
    return task(name).id if isinstance(name, str) and ":" in name else name


def has_task(name: str) -> bool:
    """Whether a name is that of a control task, or of one with options, whatever these are."""
    return name in tasks() or name.partition(":")[0] in tasks()


def task_of_motion(name: str) -> str | None:
    """The task whose environment of continuous control has a name, such as ``ArrowPuzzleMotion``, or that id.

    Options follow as a task's do: ``ArrowsMotion:cubes=1``. None for any other name.
    """
    base, colon, said = name.partition(":")
    for task, entry in tasks().items():
        if entry.motion and motion_name(motion_id(entry.env_id)) == motion_name(base):
            return f"{task}{colon}{said}"
    return None


def agent_entry(name: str) -> AgentEntry:
    """The registry line of an agent, this suite's or an installed package's; the title says the settings of its own.

    Raises:
        UnknownNameError: No such agent.
        InvalidValueError: The name is a prefix without an argument, or an argument follows that is none.
        SetupError: As :func:`task_entry`.
    """
    return _configured_entry(name, AGENTS, AGENT_GROUP)


def _configured_entry(name: str, own: Mapping[str, Any], group: str) -> Any:
    one = (
        parse_configuration(name)
        if isinstance(name, str) and name not in offers(group)
        else AgentConfiguration(name, {})
    )
    entry = _named_entry(one, own, group)
    if not one.settings:
        return entry
    return dataclasses.replace(entry, title=f"{entry.title or one.agent.replace('_', ' ')} ({one.words})")


def known_entry(agent: str) -> AgentEntry | None:
    """The registry line of an agent, None of one whose package is not installed here.

    Raises:
        InvalidValueError: As :func:`agent_entry`.
    """
    with suppress(UnknownNameError, SetupError):
        return agent_entry(agent)
    return None


def is_player(agent: str) -> bool:
    """Whether an agent's name is that of a person, or of a program elsewhere, such as ``person:anna``."""
    with suppress(UnknownNameError, InvalidValueError, SetupError):
        return agent_entry(agent).is_player
    return False


def _prefixes(group: str) -> Mapping[str, Any]:
    """The offers of a group, in which prefixes are, and the players."""
    return {**offers(group), **(PLAYERS if group == AGENT_GROUP else {})}


def _named_entry(one: AgentConfiguration, own: Mapping[str, Any], group: str) -> Any:
    """The entry of a name; of a prefix and an argument its title says both."""
    known = {**own, **_prefixes(group)}
    prefix, colon, argument = one.agent.partition(":") if isinstance(one.agent, str) else (one.agent, "", "")
    is_prefix = bool(getattr(known.get(prefix), "argument", ""))
    if is_prefix and argument:
        entry = known[prefix]
        return dataclasses.replace(entry, title=f"{entry.title or prefix} {re.sub('@[0-9a-f]{12}$', '', argument)}")
    if is_prefix:
        raise InvalidValueError(f"{prefix} alone is no name; give {prefix}:ARGUMENT. {known[prefix].description}")
    has_variants = any(name.startswith(f"{prefix}:") for name in known)  # such as factored:given
    if colon and prefix in known and not (has_variants and argument.isidentifier()):
        example = "controller.discount=0.9"
        raise InvalidValueError(f"In {one.agent!r}, {argument!r} is not of the form name=value, such as {example}.")
    is_absent = prefix not in known and guest_with(group, prefix) is not None
    return offered(prefix if is_absent else one.agent, own, group)


def spelled(name: str, group: str) -> str:
    """The one spelling of a typed name: an argument is written as the package of its prefix writes it.

    A package writes ``ARGUMENT@<12 hex digits>`` where content decides, such as that of a file: then a protocol with
    this name holds for that content alone.

    Raises:
        InvalidValueError: The argument names nothing, or a text after ``@`` is not that of its content now.
    """
    if not isinstance(name, str) or ":" not in name:
        return name
    one = parse_configuration(name)
    prefix = one.agent.partition(":")[0]
    target = getattr(_prefixes(group).get(prefix), "argument", "")
    if not target:
        return name
    with guests_faults(f"The argument of {name}", target):
        return str(one._replace(agent=f"{prefix}:{load(target)(one.argument)}"))


def setting_names(agent: str) -> frozenset[str]:
    """The dotted names of all settings that an agent has. Raises SetupError: its package offers them wrongly."""
    where = agent_entry(agent).settings
    with guests_faults(f"Agent {agent}, its settings", where):
        return frozenset(load(where).names()) if where else frozenset()


def inert_settings(agent: str) -> frozenset[str]:
    """The dotted names of an agent's settings that have no effect on it, as far as it says so.

    Raises SetupError: its package offers them wrongly.
    """
    where = agent_entry(agent).settings
    with guests_faults(f"Agent {agent}, its settings", where):
        inert = getattr(load(where), "inert", None) if where else None
        return frozenset() if inert is None else frozenset(inert())


def own_settings(agent: str, overrides: Mapping[str, Setting]) -> dict[str, Setting]:
    """Those of a protocol's overrides that this agent has settings for, and above them those in the agent's name.

    Raises:
        UnknownNameError: The agent has no setting that its name gives it.
    """
    own = parse_configuration(agent).settings
    names = setting_names(agent) if overrides or own else frozenset()
    for name in own:
        require_known("setting", name, sorted(names))
    return {**{name: value for name, value in overrides.items() if name in names}, **own}


def settings(agent: str, hyperparameters: str, overrides: Mapping[str, Setting], group: str) -> Any:
    """An agent's settings, a dataclass, with those of the overrides that it has; None of an agent without settings.

    Raises:
        UnknownNameError: No such hyper-parameter set or config group.
        InvalidValueError: A value of the wrong type or out of its range.
    """
    entry = agent_entry(agent)
    with guests_faults(f"Agent {agent}, its settings", entry.settings):
        given = own_settings(agent, overrides)
        return load(entry.settings).resolve(hyperparameters, given, group) if entry.settings else None


def task(name: str) -> TaskSpec:
    """The TaskSpec of a registered task.

    Raises:
        UnknownNameError: No such task.
        InvalidValueError: It contradicts its registry line, or its names its rules.
    """
    entry = task_entry(name)
    known = tasks()
    with guests_faults(f"Task {name}", entry.spec):
        loaded = load(entry.spec)
        spec: TaskSpec = loaded(**entry.options) if callable(loaded) else loaded
        if not isinstance(spec, TaskSpec):
            raise TypeError(f"it is {brief(spec)} and no TaskSpec")
    if any(map(unprintable, vars(spec).values())):
        raise InvalidValueError(f"The texts of {entry.spec} have control characters; leave them out.")
    listed = getattr(spec.rules, "states", None)
    values = tuple(map(len, spec.macrostate_values))
    counts = tuple(1 + max(column) for column in zip(*listed, strict=True)) if listed else values
    for what, ours, theirs in (
        ("id", name if name in known else spec.id, spec.id),
        ("env_id", entry.env_id, spec.env_id),
        ("horizon", entry.horizon or spec.horizon, spec.horizon),
        ("n_actions", spec.rules.n_actions, spec.n_actions),
        ("number of macrostate_names", len(spec.rules.start_states[0]), len(spec.macrostate_names)),
        ("numbers of macrostate_values", counts, values),
    ):
        if ours != theirs:
            raise InvalidValueError(
                f"{entry.spec} says {what} {theirs!r} where the registry line or the rules of {name} say {ours!r}; "
                "make them one."
            )
    return spec


def make_agent(name: str, context: AgentContext) -> Agent:
    """A new agent by its registered name.

    Raises SetupError: that of a package cannot be made, or lacks a method of :class:`~.interfaces.Agent`.
    """
    agent: Agent = made(f"Agent {name}", agent_entry(name).make, context)
    lacking = [method for method in _METHODS if not callable(getattr(agent, method, None))]
    if lacking:
        raise SetupError(
            f"Agent {name} has no method {' and no '.join(lacking)}; an agent has {', '.join(_METHODS)}. A class that "
            "inherits from imagine_bench.agents.baselines.RandomAgent has them all."
        )
    return agent


def made(what: str, target: str | CodeByValue, *given: Any) -> Any:
    """The object that a package's target makes; ``what`` names it in an error. Raises as :func:`make_agent`."""
    with guests_faults(what, str(target)):
        return load(target)(*given)


def regression(name: str) -> RegressionSpec:
    """The RegressionSpec of a registered regression task. Raises as :func:`task_entry`."""
    found = offered(name, REGRESSIONS, REGRESSION_GROUP)
    return load(found) if isinstance(found, str) else found


def regressor_entry(name: str) -> RegressorEntry:
    """The registry line of a regressor; the title says the settings of its own. Raises as :func:`agent_entry`."""
    return _configured_entry(name, REGRESSORS, REGRESSOR_GROUP)


def world_models() -> dict[str, WorldModelEntry]:
    """All world models by name, as :func:`agents`."""
    return {**WORLD_MODELS, **{name: each for name, each in usable(WORLD_MODEL_GROUP).items() if not each.argument}}


def world_model_entry(name: str) -> WorldModelEntry:
    """The registry line of a world model, as of :func:`agent_entry`.

    Raises:
        UnknownNameError: No such world model, or no such setting.
        InvalidValueError: It takes no settings and is given some.
        SetupError: As :func:`task_entry`.
    """
    entry: WorldModelEntry = _configured_entry(name, WORLD_MODELS, WORLD_MODEL_GROUP)
    one = parse_configuration(name)
    if one.settings and not entry.settings:
        raise InvalidValueError(
            f"World model {one.agent} takes no settings; leave out {brief(name[len(one.agent) :])}."
        )
    if one.settings:
        with guests_faults(f"World model {name}, its settings", entry.settings):
            known = sorted(load(entry.settings).names())
        for given in one.settings:
            require_known("setting", given, known)
    return entry


def make_regressor(name: str, context: RegressorContext) -> Regressor:
    """A new regressor by its registered name. Raises as :func:`make_agent`."""
    return made(f"Regressor {name}", regressor_entry(name).make, context)


def make_world_model(name: str, *given: Any) -> WorldModel:
    """A new world model by its registered name, from the arguments that its entry names. Raises as
    :func:`make_agent`.
    """
    return made(f"World model {name}", world_model_entry(name).make, *given)
