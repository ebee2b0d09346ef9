"""Names to objects, of this suite and of installed packages; nothing heavy is imported until it is asked for."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Container, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium

from imagine_bench.errors import InvalidValueError, SetupError, brief, require_known, unprintable
from imagine_bench.interfaces import Agent, AgentContext, TaskSpec
from imagine_bench.interfaces.model import WorldModel
from imagine_bench.interfaces.regression import RegressionSpec, Regressor, RegressorContext
from imagine_bench.registry.builtin import (
    AGENTS,
    DEMONSTRATOR,
    REGRESSIONS,
    REGRESSORS,
    TASKS,
    WORLD_MODELS,
    Guest,
    guests,
)
from imagine_bench.registry.by_value import CodeByValue
from imagine_bench.registry.entries import (
    LABEL_OF_OLD_AGENT,
    AgentEntry,
    EncoderEntry,
    Entrant,
    RegressorEntry,
    TaskEntry,
    WorldModelEntry,
    entrant,
    parse_options,
    read_mapping,
)
from imagine_bench.registry.loading import fault, guests_faults, load, refuse_while_loading
from imagine_bench.values import Setting

__all__ = [
    "AGENTS",
    "DEMONSTRATOR",
    "REGRESSIONS",
    "REGRESSORS",
    "TASKS",
    "WORLD_MODELS",
    "AgentEntry",
    "EncoderEntry",
    "RegressorEntry",
    "TaskEntry",
    "WorldModelEntry",
    "load",
    "refuse_while_loading",
]

MOTION = "imagine-bench-motion"
"""The plug-in of continuous control."""
TASK_GROUP = "imagine_bench.tasks"
AGENT_GROUP = "imagine_bench.agents"
ENCODER_GROUP = "imagine_bench.encoders"
REGRESSION_GROUP = "imagine_bench.regressions"
REGRESSOR_GROUP = "imagine_bench.regressors"
STUDY_GROUP = "imagine_bench.studies"
WORLD_MODEL_GROUP = "imagine_bench.world_models"
"""Entry points in which installed packages make their offers: each the ``"module:attr"`` of a TaskEntry, AgentEntry,
EncoderEntry, RegressionSpec, RegressorEntry, Study or WorldModelEntry."""


class _Group(NamedTuple):
    """A group of entry points."""

    what: str  #: one of it, in words
    kind: type  #: the class of its objects
    own: Sequence[Container[str]]  #: where the names are that are this suite's


_GROUPS = {
    TASK_GROUP: _Group("task", TaskEntry, (TASKS, REGRESSIONS)),
    AGENT_GROUP: _Group("agent", AgentEntry, (AGENTS, REGRESSORS)),
    ENCODER_GROUP: _Group("encoder", EncoderEntry, ()),
    REGRESSION_GROUP: _Group("regression task", RegressionSpec, (TASKS, REGRESSIONS)),
    REGRESSOR_GROUP: _Group("regressor", RegressorEntry, (AGENTS, REGRESSORS)),
    WORLD_MODEL_GROUP: _Group("world model", WorldModelEntry, (WORLD_MODELS,)),
}


def describe_group(group: str, *, what: str, kind: type, own: Container[str]) -> None:
    """Say what packages offer in a group; a room above the registry says it of its own group when it is imported.

    Args:
        group: Name of the group of entry points.
        what: One of its objects, in a word.
        kind: The class of its objects.
        own: The names that are this suite's.
    """
    _GROUPS[group] = _Group(what, kind, (own,))


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


def usable(group: str) -> dict[str, Any]:
    """The usable offers of installed packages in a group of entry points, by name."""
    return {name: entry for name, entry in offers(group).items() if not isinstance(entry, SetupError)}


def refused_offers() -> list[SetupError]:
    """The reasons why some offers of installed packages cannot be used."""
    return [entry for group in _GROUPS for entry in offers(group).values() if isinstance(entry, SetupError)]


@functools.cache
def offers(group: str) -> Mapping[str, Any]:
    """The offers of installed packages in a group of entry points, by name: an object, or the error why it is none.

    A name of this suite's own stays this suite's.
    """
    found: dict[str, Any] = {}
    for point in entry_points(group=group):
        what, kind, own = _GROUPS[group]
        package = point.dist.name if point.dist else point.module
        offer = f"The package {package} offers {point.value} as {what} {point.name}"
        guest = guest_with(group, point.name)
        is_guests = guest is not None and guest.package != package
        if point.name in found or is_guests or any(point.name in names for names in own):
            found.setdefault(f"{package}:{point.name}", SetupError(f"{offer}, a name that is taken; give it another."))
            continue
        try:
            entry = load(f"{point.module}:{point.attr or ''}")
        except Exception as error:  # whatever a package does wrong, it is one sentence and costs nobody else anything
            entry = SetupError(f"{offer}, which cannot be loaded ({fault(error)}); mend or uninstall the package.")
        if not isinstance(entry, kind | SetupError):
            entry = SetupError(
                f"{offer}, which is {brief(entry)} and no {kind.__name__}; mend or uninstall the package."
            )
        if any(map(unprintable, vars(entry).values())):
            entry = SetupError(f"{offer}, whose texts have control characters; mend or uninstall the package.")
        found[point.name] = entry
    return found


def offered(name: str, own: Mapping[str, Any], group: str) -> Any:
    """The object of a name in a group: this suite's own, or a package's. Raises as :func:`task_entry`."""
    if isinstance(name, str) and name in own:
        return own[name]
    what = _GROUPS[group].what
    there = offers(group)
    guest = guest_with(group, name)
    if guest is not None and name not in there:
        raise SetupError(
            f"The {what} {name} is in the package {guest.package}, which is not installed. "
            f"Install it with: {guest.install}"
        )
    if group == AGENT_GROUP and name in LABEL_OF_OLD_AGENT and name not in there:
        raise InvalidValueError(f"Agent {name!r} is now called {LABEL_OF_OLD_AGENT[name]!r}; give that name.")
    entry = there[require_known(what, name, {**own, **there})]
    if isinstance(entry, SetupError):
        raise entry
    return entry


def guest_with(group: str, name: str) -> Guest | None:
    """The guest of this suite that offers a name in a group, installed or not; None where none does."""
    return next((guest for guest in guests() if name in guest.names.get(group, ())), None)


def installed_of(names: Sequence[str], group: str = AGENT_GROUP) -> tuple[tuple[str, ...], str]:
    """The names of a default, without those of this suite's guests that are not installed, and a sentence about these.

    Of the names of an entrant, its agent counts. The sentence is empty where nothing is left out.
    """
    absent = {}
    for name in names:
        guest = guest_with(group, entrant(name).agent)
        if guest is not None and entrant(name).agent not in offers(group):
            absent[name] = guest
    installs = "; ".join(dict.fromkeys(guest.install for guest in absent.values()))
    note = f"Left out, as not installed: {', '.join(absent)}. To install: {installs}" if absent else ""
    return tuple(name for name in names if name not in absent), note


def is_ours(target: str | CodeByValue) -> bool:
    """Whether code is this suite's: the core's, or that of a guest of its own that needs no library of others."""
    top = str(target).partition(":")[0].partition(".")[0]
    return top in {"imagine_bench", *(guest.module for guest in guests() if guest.is_ours_alone)}


def absent_guests() -> list[Guest]:
    """The guests of this suite that are not installed here."""
    installed = guest_packages()
    return [guest for guest in guests() if guest.package not in installed]


def require_guest(package: str, doing: str) -> None:
    """Raise SetupError, with the line that installs it, where a plug-in of this suite is missing that does something.

    Args:
        package: The plug-in, as pip knows it.
        doing: The work that needs it, as the beginning of a sentence.
    """
    for guest in absent_guests():
        if guest.package == package:
            raise SetupError(
                f"{doing} needs the package {package}, which is not installed. Install it with: {guest.install}"
            )


def guest_packages() -> dict[str, set[str]]:
    """The installed packages that offer anything, by name, and where their entries lie: names of top modules.

    None of them is imported.
    """
    found: dict[str, set[str]] = {}
    everything = entry_points()
    for group in {*_GROUPS, STUDY_GROUP}:
        for point in everything.select(group=group):
            if point.dist:
                found.setdefault(point.dist.name, set()).add(point.module.partition(".")[0])
    return dict(sorted(found.items()))


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


def register_env(entry: TaskEntry) -> None:
    """Register a task's environment with Gymnasium, unless its id is known already; a suite's own also as a vector."""
    if entry.env_id in gymnasium.registry:
        return
    gymnasium.register(
        entry.env_id,
        entry.env,
        reward_threshold=entry.reward_threshold,
        max_episode_steps=entry.horizon,
        kwargs=dict(entry.options),
    )
    own = entry.env.startswith("imagine_bench.")
    if own:
        _register_vector(entry.env_id, entry.env, entry, entry.horizon)
    if entry.motion:
        env_id = motion_id(entry.env_id)
        threshold = entry.reward_threshold
        gymnasium.register(env_id, entry.motion, reward_threshold=threshold, kwargs=dict(entry.options))
        if own:
            _register_vector(env_id, entry.motion, entry, None)


def _register_vector(env_id: str, env: str, entry: TaskEntry, horizon: int | None) -> None:
    gymnasium.register(
        vector_id(env_id),
        vector_entry_point="imagine_bench.tasks.vector_env:make",
        reward_threshold=entry.reward_threshold,
        max_episode_steps=horizon,
        kwargs={"env": env, **entry.options},
    )


def motion_id(env_id: str) -> str:
    """The id of a task's environment of continuous control, by that of its macro-actions."""
    name, _, version = env_id.rpartition("-v")
    return f"{name}Motion-v{version}"


def motion_name(env_id: str) -> str:
    """The name of an environment of continuous control on a command line: ``ArrowPuzzleMotion``."""
    return env_id.rpartition("/")[2].partition("-v")[0]


def task_of_motion(name: str) -> str | None:
    """The task whose environment of continuous control has a name, such as ``ArrowPuzzleMotion``, or that id.

    Options follow as a task's do: ``ArrowsMotion:cubes=1``. None for any other name.
    """
    base, colon, said = name.partition(":")
    for task, entry in tasks().items():
        if entry.motion and motion_name(motion_id(entry.env_id)) == motion_name(base):
            return f"{task}{colon}{said}"
    return None


def vector_id(env_id: str) -> str:
    """The id of an environment's own vector environment; that of the single one keeps Gymnasium's default, sync."""
    name, _, version = env_id.rpartition("-v")
    return f"{name}-vector-v{version}"


def agent_entry(name: str) -> AgentEntry:
    """The registry line of an agent, this suite's or an installed package's; an entrant's title says its settings.

    Raises:
        UnknownNameError: No such agent.
        InvalidValueError: The name is a prefix without an argument, or an argument follows that is none.
        SetupError: As :func:`task_entry`.
    """
    return _entrant_entry(name, AGENTS, AGENT_GROUP)


def _entrant_entry(name: str, own: Mapping[str, Any], group: str) -> Any:
    one = entrant(name) if isinstance(name, str) and name not in offers(group) else Entrant(name, {})
    entry = _named_entry(one, own, group)
    if not one.settings:
        return entry
    return dataclasses.replace(entry, title=f"{entry.title or one.agent.replace('_', ' ')} ({one.words})")


def _named_entry(one: Entrant, own: Mapping[str, Any], group: str) -> Any:
    """The entry of a name; of a prefix and an argument its title says both."""
    known = {**own, **offers(group)}
    prefix, colon, argument = one.agent.partition(":") if isinstance(one.agent, str) else (one.agent, "", "")
    is_prefix = bool(getattr(known.get(prefix), "argument", ""))
    if is_prefix and argument:
        entry = known[prefix]
        return dataclasses.replace(entry, title=f"{entry.title or prefix} {argument.partition('@')[0]}")
    if is_prefix:
        raise InvalidValueError(f"{prefix} alone is no name; give {prefix}:ARGUMENT. {known[prefix].description}")
    if colon and prefix in known and not argument.isidentifier():
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
    one = entrant(name)
    prefix = one.agent.partition(":")[0]
    target = getattr(offers(group).get(prefix), "argument", "")
    if not target:
        return name
    with guests_faults(f"The argument of {name}", target):
        return str(one._replace(agent=f"{prefix}:{load(target)(one.argument)}"))


def setting_names(agent: str) -> frozenset[str]:
    """The dotted names of all settings that an agent has."""
    where = agent_entry(agent).settings
    return load(where).names() if where else frozenset()


def own_settings(agent: str, overrides: Mapping[str, Setting]) -> dict[str, Setting]:
    """Those of a protocol's overrides that this agent has settings for, and above them those of an entrant's own.

    Raises:
        UnknownNameError: The agent has no setting that the entrant's name gives it.
    """
    own = entrant(agent).settings
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
    """A new agent by its registered name. Raises SetupError: that of a package cannot be made."""
    return made(f"Agent {name}", agent_entry(name).make, context)


def made(what: str, target: str | CodeByValue, *given: Any) -> Any:
    """The object that a package's target makes; ``what`` names it in an error. Raises as :func:`make_agent`."""
    with guests_faults(what, str(target)):
        return load(target)(*given)


def regression(name: str) -> RegressionSpec:
    """The RegressionSpec of a registered regression task. Raises as :func:`task_entry`."""
    found = offered(name, REGRESSIONS, REGRESSION_GROUP)
    return load(found) if isinstance(found, str) else found


def regressor_entry(name: str) -> RegressorEntry:
    """The registry line of a regressor; an entrant's title says its settings. Raises as :func:`agent_entry`."""
    return _entrant_entry(name, REGRESSORS, REGRESSOR_GROUP)


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
    entry: WorldModelEntry = _entrant_entry(name, WORLD_MODELS, WORLD_MODEL_GROUP)
    one = entrant(name)
    if one.settings and not entry.settings:
        raise InvalidValueError(
            f"World model {one.agent} takes no settings; leave out {brief(name[len(one.agent) :])}."
        )
    for given in one.settings:
        require_known("setting", given, sorted(load(entry.settings).names()))
    return entry


def make_regressor(name: str, context: RegressorContext) -> Regressor:
    """A new regressor by its registered name. Raises as :func:`make_agent`."""
    return made(f"Regressor {name}", regressor_entry(name).make, context)


def make_world_model(name: str, *given: Any) -> WorldModel:
    """A new world model by its registered name, from the arguments that its entry names. Raises as
    :func:`make_agent`.
    """
    return made(f"World model {name}", world_model_entry(name).make, *given)
