"""Control tasks, which agents act in, as a type of task: how their benches are planned, run and read."""

from __future__ import annotations

import dataclasses
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench import registry
from imagine_bench.data.folder import read_dataset, require_fits
from imagine_bench.errors import InvalidValueError, UnknownNameError, brief, plain
from imagine_bench.protocols.control import Protocol, context_of, protocol, usual_agents
from imagine_bench.protocols.data import Encoders, RunSpec, TaskType, digest
from imagine_bench.protocols.presets import PRESETS
from imagine_bench.registry.entries import parse_configuration
from imagine_bench.rules import states_of
from imagine_bench.running import runner
from imagine_bench.running.run_state import make_env, require_able
from imagine_bench.store import encoders
from imagine_bench.store.loading import load_so_far
from imagine_bench.values import Json


def plan_control(
    task: str, preset: str, *, encoder: str | None = None, dataset: Path | str | None = None, **changes: Any
) -> tuple[Protocol, Encoders]:
    """The protocol of a control bench and the encoders it uses; errors as of :func:`imagine_bench.running.bench.plan`.

    ``encoder`` is a bundled name or a path, instead of the task's own. One that gives codes is for every agent, one
    that gives latents for those that read latents. ``dataset`` is a folder; without budgets, its episodes are all that
    learners have.
    """
    found = None if dataset is None else read_dataset(Path(dataset))
    if found is not None:
        changes = {"budgets": (len(found.episodes),), **changes, "dataset": found.identity}
    wanted = protocol(task, preset, **changes)
    if "agents" not in changes:
        _, note = registry.installed_of(usual_agents(task, preset))
        if note:
            print(note)
    if found is not None:
        require_fits(found, registry.task(task), wanted.appearance)
    _require_effect(wanted, wanted.demonstrations if found is None else len(found.episodes))
    if not registry.is_own(task):
        _require_sound(wanted)
    filled = {"settings_digest": digest(resolved_settings(wanted))}
    if encoder is None:
        _refuse_unable(wanted)
    paths = _encoders(wanted, encoder)
    names = {"encoder": "latents", "codes": "codes"}
    filled |= {field: encoders.identity(paths[kind]) for field, kind in names.items() if kind in paths}
    whole = protocol(task, preset, **{**changes, **filled})
    rests_on_others = any(map(_rests_on_others, whole.agents))
    if found is not None:
        paths = {**paths, "dataset": found.folder.resolve()}
    if encoder or whole.dataset or whole.after or whole.demonstrations or whole.queries or rests_on_others:
        _check_abilities(whole, paths)
    return whole, paths


def _require_effect(wanted: Protocol, watched: int) -> None:
    """Raise InvalidValueError for two options of which one undoes the other; ``watched`` are the training episodes that
    learners do not play themselves.
    """
    for option in ("dataset", "after"):
        if wanted.split is not None and getattr(wanted, option):
            raise InvalidValueError(
                f"With --split no training episode begins where tests begin, but those of --{option} begin anywhere; "
                "leave one of the two out."
            )
    for option in ("queries", "feedback"):
        if watched >= wanted.budgets[-1] and getattr(wanted, option):
            raise InvalidValueError(
                f"Learners only watch all {wanted.budgets[-1]:,} training episodes, so --{option} changes nothing; "
                "leave it out, or give a larger budget."
            )


def _require_sound(wanted: Protocol) -> None:
    """Raise InvalidValueError for a package's task whose rules, frames or environment would end every run or report."""
    spec = registry.task(wanted.task)
    some = np.array(states_of(spec.rules)[:1])
    try:
        spec.facts()
        frames = {"render_macrostates": spec.render_macrostates(some, wanted.appearance, np.random.default_rng(0))[0]}
        with closing(make_env(wanted, wanted.task)) as env:
            first = env.reset(seed=0)[0]
        if wanted.shows_frames_alone:
            frames["its environment"] = first
        elif set(first) != set(wanted.observation.split(",")):
            raise InvalidValueError(f"its environment shows {brief(first)}, not {wanted.observation}")
        for what, frame in frames.items():
            if (frame.shape, frame.dtype) != ((64, 64, 3), np.uint8):
                raise InvalidValueError(f"{what} gives frames of {frame.dtype} and shape {frame.shape}")
    except (Exception, SystemExit) as error:  # whatever a guest does wrong is one sentence
        why = " ".join(plain(error).split()).rstrip(".")
        more = f"'imagine-bench check --task {wanted.task}' says more"
        raise InvalidValueError(f"Task {wanted.task} cannot be run: {why}. {more}.") from error


def _rests_on_others(agent: str) -> bool:
    """Whether code decides that may not be there: a library that is an extra, or a package that offers the agent."""
    entry = registry.agent_entry(agent)
    is_script = parse_configuration(agent).agent in registry.AGENTS and isinstance(entry.make, str)
    return entry.external_training_loop or not (is_script or registry.is_ours(entry.make))


def _refuse_unable(wanted: Protocol) -> None:
    """Raise UnableError for a learner that lacks an ability, before an encoder is trained for it, which takes minutes.

    The learner is made with a bundled encoder of the same kind in place of its own.
    """
    entries = {agent: registry.agent_entry(agent) for agent in wanted.agents}
    if not wanted.helps or not any(entry.needs_encoder for entry in entries.values()):
        return
    for agent, entry in entries.items():
        stand_in = next(path for path in encoders.bundled().values() if encoders.kind(path) == entry.encoder_kind)
        spec = RunSpec(protocol=wanted, agent=agent, seed=wanted.seeds[0], encoder=stand_in)
        learner = None
        with suppress(Exception, SystemExit):  # it is made once more, with its own encoder, and then says why
            prepared = encoders.card_of(stand_in)["preprocessing"]
            learner = registry.make_agent(agent, dataclasses.replace(context_of(spec), preprocessing=prepared))
        if learner is not None and entry.learns:
            require_able(learner, agent, wanted)


def _check_abilities(wanted: Protocol, paths: Encoders) -> None:
    """Build every learner once, to see whether it can use its encoder and has the abilities that are asked for."""
    for agent in wanted.agents:
        entry = registry.agent_entry(agent)
        if entry.learns:
            encoder = paths[entry.encoder_kind] if entry.needs_encoder else None
            spec = RunSpec(protocol=wanted, agent=agent, seed=wanted.seeds[0], encoder=encoder)
            require_able(registry.make_agent(agent, context_of(spec)), agent, wanted)


def resolved_settings(wanted: Protocol) -> dict[str, Json]:
    """All settings of every learner by its name, each override checked by the agents that have such a setting.

    Raises:
        UnknownNameError: No agent of the protocol has it.
        InvalidValueError: A value of the wrong type or out of its range, or a setting that has no effect.
    """
    overrides = dict(wanted.overrides)
    known: set[str] = set()
    acting: set[str] = set()
    for agent in wanted.agents:
        inert = registry.inert_settings(agent)
        known |= registry.setting_names(agent)
        acting |= registry.setting_names(agent) - inert
        one = parse_configuration(agent)
        for name in sorted(inert & one.settings.keys()):
            raise InvalidValueError(f"Setting {name} has no effect on agent {one.agent}; leave it out.")
    for name in overrides:
        if name not in known:
            raise UnknownNameError("setting", name, sorted(acting))
        if name not in acting:
            raise InvalidValueError(f"Setting {name} has no effect on any agent of this bench; leave it out.")
    name = wanted.hyperparameters
    group = wanted.config_group
    found = {agent: registry.settings(agent, name, overrides, group) for agent in wanted.agents}
    learners = [agent for agent in wanted.agents if registry.agent_entry(agent).learns]
    return {agent: {} if found[agent] is None else dataclasses.asdict(found[agent]) for agent in learners}


def _encoders(wanted: Protocol, given: str | None) -> Encoders:
    """The encoder of each kind that an agent needs. Raises InvalidValueError: no agent reads the given encoder."""
    entries = [registry.agent_entry(agent) for agent in wanted.agents]
    needed = {entry.encoder_kind for entry in entries if entry.needs_encoder}
    spec = registry.task(wanted.task)
    if given is None:
        return {kind: encoders.own(spec, wanted.appearance, kind) for kind in sorted(needed)}
    path = encoders.resolve(spec, wanted.appearance, given)
    kind = encoders.kind(path)
    if not needed:
        raise InvalidValueError(f"No agent of this bench sees through an encoder; leave --encoder {given} out.")
    if kind == "latents" and kind not in needed:
        raise InvalidValueError(
            f"No agent of this bench reads the latents that encoder {path.stem!r} gives; give one made with "
            "'imagine-bench encoder --recipe codes', or leave --encoder out."
        )
    replaced = needed | {kind} if kind == "codes" else {kind}
    own = {other: encoders.own(spec, wanted.appearance, other) for other in sorted(needed - replaced)}
    return {**own, **dict.fromkeys(sorted(replaced), path)}


CONTROL = TaskType(
    tasks=registry.tasks, learners=registry.agents, draws=True, protocol=Protocol, presets=PRESETS, plan=plan_control,
    run=runner.run, load_so_far=load_so_far,
)  # fmt: skip
