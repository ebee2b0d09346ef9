"""A task with the exact facts of its rules, or a learner with its settings: ``imagine-bench describe``."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping
from importlib import resources
from typing import Any

import numpy as np

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, InvalidValueError, UnknownNameError
from imagine_bench.exact import motion
from imagine_bench.exact.certificate import Certificate, certificate, certificate_rows
from imagine_bench.interfaces import APPEARANCES, EXECUTIONS, TaskSpec, bundled_name
from imagine_bench.protocols.data import ProtocolData, TaskType
from imagine_bench.registry.entries import ENCODER_KINDS, AgentEntry, EncoderEntry, RegressorEntry, WorldModelEntry
from imagine_bench.rules import evaluate, greedy, is_random, optimal_policy, states_of, tabulate
from imagine_bench.running.bench import task_types
from imagine_bench.running.launchers.jobs import LAUNCHERS
from imagine_bench.store.encoders import bundled
from imagine_bench.sweep.grid import Study, all_grids
from imagine_bench.tools.settings import OF_AGENTS, settings_in_words

_EXECUTIONS = (
    "The arm moves in contact physics: the default.",
    "The outcome of a macro-action is set: quicker, and without faults.",
)
_APPEARANCES = (
    "The same light, colors and camera in every frame: the default.",
    "Light and the poses of objects and of the hand vary a little.",
    "Light, colors, camera and the poses of objects and of the hand vary much.",
    "Each frame is patched from fragments of a finite pool.",
    "As clean, with a shift, a shadow, noise and an occluder in frames, and noise in rewards.",
)
_LAUNCHERS = (
    "Processes of this machine: the default.",
    "The cluster at RAY_ADDRESS, else one that is started here; needs the extra ray.",
    "Jobs of a Slurm cluster; needs the extra slurm.",
    "One run after another in this process, for a debugger.",
)
"""Descriptions of executions, appearances and launchers, in their order."""
_MOST = 10
"""Plan lengths that are listed one by one."""


def describe(name: str) -> str:
    """A task, an agent, a regressor or a world model, in words and numbers.

    Raises:
        UnknownNameError: There is none of this name.
        SetupError: It is in a package that is not installed.
    """
    is_task = registry.has_task(registry.task_of_motion(name) or name) or name in registry.regressions()
    pages = [describe_task(name)] if is_task else []
    learners: dict[str, AgentEntry | RegressorEntry | WorldModelEntry] = {}
    for known in (_world_models(), registry.regressors(), _agents()):
        if name in known:
            pages.append(_learner(name, known[name]))
        learners |= known
    if not pages:
        tasks = (registry.TASK_GROUP, registry.REGRESSION_GROUP)
        for group in (*tasks, registry.AGENT_GROUP, registry.REGRESSOR_GROUP, registry.WORLD_MODEL_GROUP):
            if registry.guest_with(group, name) is not None:
                registry.offered(name, {}, group)  # raises
        moving = [each.env_id for each in registry.tasks().values() if each.motion]
        hands = [registry.motion_name(registry.motion_id(each)) for each in moving]
        known_names = [*registry.tasks(), *hands, *registry.regressions(), *learners]
        raise UnknownNameError("task, agent or world model", name, known_names)
    return "\n\n".join(pages)


def _learner(name: str, entry: AgentEntry | RegressorEntry | WorldModelEntry) -> str:
    """An agent, a regressor or a world model: its description, its name in commands, and its settings."""
    command = "judge TASK --models" if isinstance(entry, WorldModelEntry) else "bench TASK --agents"
    name += ":ARGUMENT" if getattr(entry, "argument", "") else ""
    page = _page(entry.title or name, entry.description, {"command": f"imagine-bench {command} {name}"})
    cases = OF_AGENTS
    if isinstance(entry, RegressorEntry):
        cases = {"": ("fast", name), "preset thesis": ("published", name)}
    if not entry.settings:
        return f"{page}\n\nIt has no settings."
    colon = "," if ":" in name else ":"
    head = f"Settings of the preset quick, in brackets of others; changed in a command as {name}{colon}NAME=VALUE"
    with registry.guests_faults(f"{name}, its settings", entry.settings):
        return f"{page}\n\n{head}\n{settings_in_words(entry.settings, cases)}"


def describe_task(name: str) -> str:
    """A control or regression task in words and numbers.

    Raises:
        UnknownNameError, InvalidValueError: As :func:`.registry.task`, or a parameter that continuous control cannot
            have, where that is described.
    """
    if name in registry.regressions():
        data = registry.regression(name)
        rows = {"learned from": f"data, in the variants {', '.join(data.variants)}", "error": data.error_name}
        return _page(data.title, data.description, rows)
    by_motion = registry.task_of_motion(name)
    spec = registry.task(by_motion or name)
    if by_motion:
        _require_motion(spec)
    facts = spec.facts()
    exact = certificate(spec)
    factors = (f"{n} ({', '.join(v)})" for n, v in zip(spec.macrostate_names, spec.macrostate_values, strict=True))
    chance = "some macro-actions have several outcomes" if is_random(spec.rules) else "none: each has one outcome"
    family, _, options = spec.id.partition(":")  # the family's id needs no look-up first
    made_by = spec.env_id
    if options and registry.has_task(family):
        made_by = f"{registry.task_entry(family).env_id}, with {options.replace(',', ', ')}"
    rows = {
        "Gymnasium id": made_by,
        "observation": f"64 x 64 RGB frame, for encoders preprocessed as {spec.preprocessing}",
        "macro-actions": f"{spec.n_actions}: {'; '.join(spec.action_names)}",
        "macrostate": "; ".join(factors),
        "macrostates": f"{exact.macrostates:,} can come up, {len(spec.rules.start_states):,} of them starts; "
        f"{len(states_of(spec.rules)):,} with those that cannot",
        "chance": chance,
        "horizon": f"{spec.horizon} macro-actions",
        "chance level": f"{100 * facts.chance_level:.1f} % of episodes solved by blind choice",
        "optimum": _optimum(exact),
        "plan lengths": f"{_plan_lengths(spec)}; mean {facts.mean_plan_length:.2f}",
        **_with_best_known(certificate_rows(exact), spec.id),
        "encoders": _encoders(spec),
    }
    if by_motion:
        hand = _by_hand(spec)
        return _page(spec.title, spec.description, hand | {"rules": "those of its macro-actions:"} | rows)
    if _has_motion(spec):
        rows |= dict(list(_by_hand(spec).items())[1:2])
    return _page(spec.title, spec.description, rows)


def _optimum(exact: Certificate) -> str:
    """Success and return of the best policy; first with memory, where frames hide something or are late."""
    seen = f"{100 * exact.seen_optimum:.1f} %, with a return of {exact.optimal_return:.2f}"
    if exact.memoryless is None:
        return seen
    bound = "at most " if exact.beliefs is None else ""
    return f"{bound}{100 * exact.optimum:.1f} %; if every frame showed everything, {seen}"


def _with_best_known(rows: dict[str, str], task: str) -> dict[str, str]:
    """Also the fewest macro-actions that an agent was measured to need, before the cautious learner's."""
    found = json.loads(resources.files("imagine_bench.exact").joinpath("best_known.json").read_text(encoding="utf-8"))
    if task not in found:
        return rows
    best = found[task]
    text = (
        f"{best['macro_actions']} macro-actions until 95 % of tests are solved: {best['agent']}, {best['seeds']} seeds"
    )
    cautious = {name: rows.pop(name) for name in ("cautious",) if name in rows}
    return {**rows, "best known": text, **cautious}


def _require_motion(spec: TaskSpec) -> None:
    """Raise InvalidValueError: the task's world has a parameter that has no meaning in continuous control."""
    world: Any = getattr(spec.rules, "world", None)
    if hasattr(world, "require_motion"):
        world.require_motion()


def _has_motion(spec: TaskSpec) -> bool:
    """Whether a task has an environment of continuous control."""
    base = spec.id.partition(":")[0]
    if not registry.has_task(base) or not registry.task_entry(base).motion:
        return False
    try:
        _require_motion(spec)
    except InvalidValueError:
        return False
    return True


def _by_hand(spec: TaskSpec) -> dict[str, str]:
    """A task in continuous control, and how far it can be solved."""
    base, colon, options = spec.id.partition(":")
    made_by = registry.motion_id(registry.task_entry(base).env_id)
    name = registry.motion_name(made_by)
    made_by += f", with {options.replace(',', ', ')}" if options else ""
    return {
        "continuous": f"{made_by}: commands to the hand or the joints at 25 Hz, judged by the same rules",
        **motion.rows(spec, name + colon + options),
    }


def names() -> str:
    """All tasks, agents, presets and so on, one a line with a description, by kind; then unusable ones, and why.

    The first line of each kind says in which words of a command its names stand.
    """
    groups: dict[str, Mapping[str, str]] = {
        "Control tasks, in which agents act (bench TASK)": _tasks(),
        "Agents (bench TASK --agents)": _described(_agents()),
        "Presets of their benches (--preset)": _presets(task_types()["control"]),
        "Regression tasks, learned from data (bench TASK)": _regressions(),
        "Regressors (bench TASK --agents)": _described(registry.regressors()),
        "Presets of their benches (bench TASK --preset)": _presets(task_types()["regression"]),
        "World models (judge TASK --models)": _described(_world_models()),
        "Studies, and suites of experiments (sweep --name)": {
            name: grid.question if isinstance(grid, Study) else f"{len(grid.experiments)} experiments."
            for name, grid in all_grids().items()
        },
        "Executions (--execution)": dict(zip(EXECUTIONS, _EXECUTIONS, strict=True)),
        "Appearances (--appearance)": dict(zip(APPEARANCES, _APPEARANCES, strict=True)),
        "Launchers (--launcher)": dict(zip(LAUNCHERS, _LAUNCHERS, strict=True)),
        "Encoders (--encoder)": {
            **{name: "Gives codes." if name.endswith("-codes") else "Gives latents." for name in bundled()},
            **_described(registry.usable(registry.ENCODER_GROUP)),
        },
        "Not installed": {
            name: guest.install for guest in registry.absent_guests() for each in guest.names.values() for name in each
        },
    }
    pages = []
    for title, members in groups.items():
        width = max(map(len, members), default=0) + 2
        lines = [f"  {name:{width}}{' '.join(words.split())}" for name, words in members.items()]
        pages += ["\n".join([title, *lines])] if lines else []
    return "\n\n".join([*pages, *map(str, registry.refused_offers())])


def _agents() -> dict[str, AgentEntry]:
    """All agents by name, and prefixes of agents' names; no people, and no programs elsewhere."""
    found = {**registry.agents(), **registry.usable(registry.AGENT_GROUP)}
    return {name: entry for name, entry in found.items() if not entry.is_player}


def _world_models() -> dict[str, WorldModelEntry]:
    """All world models by name, and prefixes of their names."""
    return {**registry.world_models(), **registry.usable(registry.WORLD_MODEL_GROUP)}


def _described(entries: Mapping[str, AgentEntry | EncoderEntry | RegressorEntry | WorldModelEntry]) -> dict[str, str]:
    return {name: entry.description for name, entry in entries.items()}


def _tasks() -> dict[str, str]:
    """The description of each control task, or why it cannot be used."""
    found = {}
    for name in registry.tasks():
        try:
            found[name] = registry.task(name).description
        except ImagineBenchError as error:
            found[name] = str(error)
    return found


def _regressions() -> dict[str, str]:
    return {name: registry.regression(name).description.partition(". ")[0] for name in registry.regressions()}


def _presets(kind: TaskType[ProtocolData]) -> dict[str, str]:
    """The size of each preset: the values of a protocol that it changes."""
    found = {}
    for name, changes in kind.presets.items():
        sizes: dict[str, Any] = {
            **{field.name: field.default for field in dataclasses.fields(kind.protocol)},
            **changes,
        }
        counts = {len(sizes["seeds"]), *dict(sizes.get("few_seeds", ())).values()}
        most = f" to {max(counts)}, by agent" if len(counts) > 1 else ""
        words = [f"seeds: {min(counts)}{most}"]
        if "budgets" in sizes:
            words.append(f"tests: {sizes['evaluation_episodes']:,} after each of {sizes['budgets']} real episodes")
        if "networks" in sizes:
            words.append(f"networks a seed: {sizes['networks']}")
        found[name] = "; ".join(words)
    return found


def _page(title: str, description: str, rows: dict[str, str]) -> str:
    return "\n".join([title, description, "", *(f"{name:16}{value}" for name, value in rows.items())])


def _plan_lengths(spec: TaskSpec) -> str:
    """Mean macro-actions of the optimal agent, to one decimal, and how many starts need so many."""
    tables = tabulate(spec.rules)
    values = evaluate(tables, greedy(optimal_policy(tables), spec.n_actions), spec.horizon)
    lengths = Counter(np.round(values.length[tables.starts], 1).tolist())
    if len(lengths) > _MOST:
        return f"{min(lengths):g} to {max(lengths):g}"
    return ", ".join(f"{length:g} ({lengths[length]} starts)" for length in sorted(lengths))


def _encoders(spec: TaskSpec) -> str:
    names = [bundled_name(spec.encoder, look, kind) for look in APPEARANCES for kind in ENCODER_KINDS]
    return ", ".join(name for name in names if name in bundled()) or "trained on first use"
