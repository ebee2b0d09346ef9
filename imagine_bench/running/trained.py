"""A trained agent, taken up again from the last checkpoint of its run."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from imagine_bench import registry
from imagine_bench.errors import AbsentError, ArtefactError, InvalidValueError, UnknownNameError
from imagine_bench.interfaces import Agent, AgentContext, AgentState, TaskSpec
from imagine_bench.interfaces.capabilities import Imaginer, ModelOnlyTrainer
from imagine_bench.protocols.control import Protocol, context_of
from imagine_bench.protocols.data import Result, RunSpec
from imagine_bench.registry.by_value import CodeByValue
from imagine_bench.registry.entries import AgentEntry, agent_label, parse_configuration
from imagine_bench.registry.loading import importable
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.bench_folder import BenchStore, is_archive, read_control
from imagine_bench.store.files import reading
from imagine_bench.store.results import BenchResult, RunResult
from imagine_bench.store.run_folder import load_newest
from imagine_bench.values import dotted


@dataclass(frozen=True, kw_only=True)
class Trained:
    """An agent as its run left it."""

    agent: Agent  #: The agent itself
    spec: RunSpec[Protocol]  #: Protocol, agent, seed and encoder of its run
    task: TaskSpec  #: The task it was trained on
    episodes: int  #: Real training episodes it has had on its task, without those on tasks before
    folder: Path  #: Its run's folder

    @property
    def imaginer(self) -> Imaginer:
        """The same agent, as one that imagines. Raises InvalidValueError: it does not imagine."""
        return imaginer_of(self.agent, self)


class KeptAgent(NamedTuple):
    """The factory, the context and the last checkpoint of a run's agent, with the settings it ran with."""

    make: str | CodeByValue  #: the factory, as :class:`.AgentEntry` has it
    context: AgentContext
    state: AgentState
    spec: RunSpec[Protocol]  #: Protocol, agent, seed and encoder of its run
    episodes: int  #: As of :class:`Trained`
    folder: Path  #: Its run's folder


def agent_of(kept: KeptAgent) -> Agent:
    """The agent, restored. Raises ArtefactError: the checkpoint does not fit this version."""
    name = kept.spec.agent
    agent: Agent = registry.made(f"Agent {name}", kept.make, kept.context)
    with reading(kept.folder / run_folder.CHECKPOINTS, f"a checkpoint of {name!r}"):
        agent.restore(kept.state)
    if isinstance(agent, ModelOnlyTrainer):  # as before every test; there is nothing left to do in a finished run
        while agent.train_in_model():
            pass
    return agent


def imaginer_of(agent: Agent, of: KeptAgent | Trained) -> Imaginer:
    """The agent of a run, as one that imagines. Raises InvalidValueError: it does not imagine."""
    if not isinstance(agent, Imaginer):
        raise InvalidValueError(
            f"The agent {of.spec.agent!r} of {of.folder} does not imagine; give the run of one that does."
        )
    return agent


def load_trained(folder: Path, *, encoder: str | None = None) -> Trained:
    """Build the agent of a run. Arguments and errors are those of :func:`read_agent`."""
    kept = read_agent(folder, encoder=encoder)
    task = registry.task(kept.spec.protocol.task)
    return Trained(agent=agent_of(kept), spec=kept.spec, task=task, episodes=kept.episodes, folder=folder)


def read_agent(folder: Path, *, encoder: str | None = None) -> KeptAgent:
    """Read the factory, the context and the last checkpoint of a run's agent.

    ``folder`` is such as ``runs/arrow_puzzle/quick-<hash>/imagination/seed_0``; ``encoder`` is a bundled name or a
    path, where the run used an encoder that is not bundled.

    Raises:
        ArtefactError: No run of an agent, an agent that this process does not know, no checkpoint, another encoder, or
            a snapshot that does not fit this version.
        UnknownNameError: No such encoder.
        InvalidValueError: An agent that sees other observations than frames.
    """
    config = run_folder.read_config(folder)
    with reading(folder / "config.json", "a run's configuration"):
        task = config["protocol"]["task"]
        name = agent_label(config["agent"], config["protocol"])
        seed = config["seed"]
        settings = dotted(config["settings"])
    require_control(task, str(folder))
    with reading(folder / "config.json", "a run's configuration"):
        protocol = Protocol.from_dict(config["protocol"])
    if not protocol.shows_frames_alone:
        raise InvalidValueError(
            f"{folder} is of an agent that sees {protocol.observation} at {protocol.observation_size} pixels, and it "
            "would be asked with 64 x 64 frames alone; give the run of one that sees these."
        )
    make = kept_entry(name, folder).make
    spec = RunSpec(protocol=protocol, agent=name, seed=seed, encoder=encoder_of_run(protocol, name, encoder))
    snapshot = load_newest(folder / run_folder.CHECKPOINTS)
    if snapshot is None:
        raise ArtefactError(f"{folder} has no checkpoint; finish its bench first.")
    as_it_ran = registry.own_settings(parse_configuration(name).agent, settings)  # whatever presets say by now
    context = dataclasses.replace(context_of(spec), overrides=as_it_ran)
    if isinstance(make, str):
        make = importable(make)
    return KeptAgent(make, context, snapshot.agent, spec, snapshot.episode, folder)


def kept_entry(agent: str, folder: Path) -> AgentEntry:
    """The registry line of the agent of a run. Raises ArtefactError: this process does not know the agent."""
    try:
        return registry.agent_entry(agent)
    except UnknownNameError as error:
        raise ArtefactError(
            f"The agent {agent!r} of {folder} is that of a script, or of a package that is not installed here. Install "
            f"the package, or call imagine_bench.register_agent({agent!r}, ...) first, in the same Python process."
        ) from error


def require_control(task: str, what: str) -> None:
    """Raise ArtefactError for a task in which no agent acts."""
    if not registry.has_task(task):
        is_one = "is" if what == task else "is of"
        raise ArtefactError(f"{what} {is_one} a regression task, in which no agent acts; give one of agents.")


def protocol_of_agents(bench: Path) -> Protocol:
    """The protocol of a bench whose agents can be taken up again. Raises ArtefactError: there is none such."""
    protocol = read_control(bench)
    if is_archive(bench):
        raise ArtefactError(
            f"{bench} holds kept results and no agents; give a bench's own folder, runs/<task>/<preset>-<hash>."
        )
    return protocol


def learners(bench: Path) -> tuple[Path, ...]:
    """The run folders of a bench, finished or not, whose agents have learned and are at hand, or ArtefactError."""
    protocol = read_control(bench)
    store = BenchStore(bench, protocol)
    found = []
    for agent, seed in protocol.runs:
        entry = registry.known_entry(agent)  # none of a script, or of a package that is not installed here
        if entry is not None and entry.learns and not entry.external_training_loop:
            folder = store.run_folder(agent, seed)
            snapshot = load_newest(folder / run_folder.CHECKPOINTS, agent=False)
            if snapshot is not None and snapshot.episode > 0:  # none on its own task: it is at those before
                found.append(folder)
    if not found:
        raise ArtefactError(
            f"No run below {bench} has a checkpoint of an agent that learns and can be taken up again. (One of a "
            "library, of a script, or of a package that is not installed here cannot.) Give the folder of a bench with "
            "one, such as of dqn."
        )
    return tuple(found)


def best_run(result: Result) -> RunResult:
    """The imagining run that solves most of its last test, of equals most of the one before, or ArtefactError."""
    runs = [run for run in result.runs if run.imagined] if isinstance(result, BenchResult) else []
    if not runs:
        raise ArtefactError(f"No agent of {result.folder} imagines; give a bench with one that does.")
    return max(runs, key=lambda run: [test.success_rate for test in reversed(run.checkpoints)])


def encoder_of_run(protocol: Protocol, agent: str, given: str | None) -> Path | None:
    """The encoder that an agent saw through; ``given`` may be that of the bench's agents of the other kind.

    Raises:
        AbsentError: It is not here.
        ArtefactError: It is not here, and a file of its name, or the given one, is damaged.
        UnknownNameError: No such encoder as the given one.
    """
    entry = registry.agent_entry(agent)
    used = protocol.encoder_of(entry.encoder_kind)
    if not entry.needs_encoder or used is None:
        return None
    here = encoders.find(used)
    path = here
    others = encoders.of_name(used)
    if given is not None:
        path = encoders.resolve(registry.task(protocol.task), protocol.appearance, given)
        others.append(path)
        found = encoders.identity(path)
        if found != used:
            path = here if found in (protocol.encoder, protocol.codes) else None
    if path is None:
        for other in others:
            encoders.card_of(other)  # raises, if it is damaged
        raise AbsentError(
            f"The run saw through encoder {used}, which {'is not here' if given is None else f'{given} is not'}; give "
            "its file with --encoder."
        )
    return path
