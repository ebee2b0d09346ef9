"""A trained agent, taken up again from the last checkpoint of its run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import Agent, TaskSpec
from imagine_bench.interfaces.capabilities import Imaginer, ModelOnlyTrainer
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.runs import Result, RunSpec
from imagine_bench.registry.entries import agent_label, entrant
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.bench_folder import BenchStore, is_archive, read_control
from imagine_bench.store.checkpoints import load_newest
from imagine_bench.store.files import reading
from imagine_bench.store.results import BenchResult, RunResult
from imagine_bench.values import Setting


@dataclass(frozen=True, kw_only=True)
class Trained:
    """An agent as its run left it."""

    agent: Agent  #: The agent itself
    spec: RunSpec[Protocol]  #: What its run was
    task: TaskSpec  #: The task it was trained on
    episodes: int  #: Real training episodes it has had on its task, without those on tasks before
    folder: Path  #: Its run's folder

    @property
    def imaginer(self) -> Imaginer:
        """The same agent, as one that imagines. Raises InvalidValueError: it does not imagine."""
        if not isinstance(self.agent, Imaginer):
            raise InvalidValueError(
                f"The agent {self.spec.agent!r} of {self.folder} does not imagine; give the run of one that does."
            )
        return self.agent


def load_trained(folder: Path, *, encoder: str | None = None) -> Trained:
    """Build the agent of a run with the settings it ran with, and restore its last checkpoint.

    ``folder`` is such as ``runs/arrow_puzzle/quick-<hash>/imagination/seed_0``; ``encoder`` is a bundled name or a
    path, where the run used an encoder that is not bundled.

    Raises:
        ArtefactError: No run of an agent, no checkpoint, another encoder, or a snapshot that does not fit this version.
        UnknownNameError: No such encoder.
        InvalidValueError: An agent that sees other observations than frames.
    """
    config = run_folder.read_config(folder)
    with reading(folder / "config.json", "a run's configuration"):
        task = config["protocol"]["task"]
        name = agent_label(config["agent"], config["protocol"])
        seed = config["seed"]
        settings = _flat(config["settings"])
    require_control(task, str(folder))
    with reading(folder / "config.json", "a run's configuration"):
        protocol = Protocol.from_dict(config["protocol"])
    if not protocol.shows_frames_alone:
        raise InvalidValueError(
            f"{folder} is of an agent that sees {protocol.observation} at {protocol.observation_size} pixels, and it "
            "would be asked with 64 x 64 frames alone; give the run of one that sees these."
        )
    spec = RunSpec(protocol=protocol, agent=name, seed=seed, encoder=_encoder(protocol, name, encoder))
    snapshot = load_newest(folder / run_folder.CHECKPOINTS)
    if snapshot is None:
        raise ArtefactError(f"{folder} has no checkpoint; finish its bench first.")
    as_it_ran = registry.own_settings(entrant(name).agent, settings)  # whatever presets say by now
    agent = registry.make_agent(name, dataclasses.replace(spec.context(), overrides=as_it_ran))
    with reading(folder / run_folder.CHECKPOINTS, f"a checkpoint of {name!r}"):
        agent.restore(snapshot.agent)
    if isinstance(agent, ModelOnlyTrainer):  # as before every test; there is nothing left to do in a finished run
        while agent.train_in_model():
            pass
    return Trained(agent=agent, spec=spec, task=registry.task(protocol.task), episodes=snapshot.episode, folder=folder)


def require_control(task: str, what: str) -> None:
    """Raise ArtefactError for a task in which no agent acts."""
    if not registry.has_task(task):
        raise ArtefactError(f"{what} is of a regression task, in which no agent acts; give one of agents.")


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
    entries = {agent: registry.agent_entry(agent) for agent in protocol.agents}
    able = [agent for agent, entry in entries.items() if entry.learns and not entry.external_training_loop]
    folders = [store.run_folder(agent, seed) for agent in able for seed in protocol.seeds]
    found = tuple(folder for folder in folders if _has_learned(folder))
    if not found:
        raise ArtefactError(
            f"No run below {bench} has a checkpoint of an agent that learns and can be taken up again (a library's "
            "cannot); give the folder of a bench with one, such as of dqn."
        )
    return found


def _has_learned(run: Path) -> bool:
    """Whether a run has had an episode on its task; one with tasks before may have a checkpoint without."""
    snapshot = load_newest(run / run_folder.CHECKPOINTS)
    return snapshot is not None and snapshot.episode > 0


def best_run(result: Result) -> RunResult:
    """The imagining run that solves most of its last test, of equals most of the one before, or ArtefactError."""
    runs = [run for run in result.runs if run.imagined] if isinstance(result, BenchResult) else []
    if not runs:
        raise ArtefactError(f"No agent of {result.folder} imagines; give a bench with one that does.")
    return max(runs, key=lambda run: [test.success_rate for test in reversed(run.checkpoints)])


def _encoder(protocol: Protocol, agent: str, given: str | None) -> Path | None:
    entry = registry.agent_entry(agent)
    used = protocol.encoder_of(entry.encoder_kind)
    if not entry.needs_encoder or used is None:
        return None
    task = registry.task(protocol.task)
    if given is not None and _is_other(task, protocol, given, used):
        given = None
    path = encoders.find(used) if given is None else encoders.resolve(task, protocol.appearance, given)
    if path is None:
        raise ArtefactError(f"The run saw through encoder {used}, which is not here; give its file with --encoder.")
    if encoders.identity(path) != used:
        raise ArtefactError(
            f"The run saw through encoder {used}, and {path} is {encoders.identity(path)}; give the right "
            "file with --encoder."
        )
    return path


def _is_other(task: TaskSpec, protocol: Protocol, given: str, used: str) -> bool:
    """Whether an encoder was given for the agents of the bench that see through another kind than this one."""
    found = encoders.identity(encoders.resolve(task, protocol.appearance, given))
    return found != used and found in (protocol.encoder, protocol.codes)


def _flat(settings: Mapping[str, Setting], prefix: str = "") -> dict[str, Setting]:
    """Nested settings by dotted name."""
    flat: dict[str, Setting] = {}
    for name, value in settings.items():
        flat.update(_flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value})
    return flat
