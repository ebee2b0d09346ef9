"""Where world models come from: those of the registry, and agents that imagine, which are world models too.

An agent's own reading of its images counts for nothing when it is judged: they are read as those of any model.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Arrays, Floats, Frame, Ints, State
from imagine_bench.errors import ArtefactError, InvalidValueError, UnknownNameError
from imagine_bench.interfaces import AgentContext, TaskSpec
from imagine_bench.interfaces.capabilities import Imaginer, begin_episode
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import (
    UNCERTAINTIES,
    GraphLearner,
    Imagined,
    LearnedGraph,
    Untaught,
    WorldModel,
    until_the_end,
)
from imagine_bench.judge.predictions import call, imagined_by
from imagine_bench.judge.reading import RenderedFrameIndex
from imagine_bench.registry.entries import WorldModelEntry, agent_label, parse_configuration
from imagine_bench.registry.loading import importable
from imagine_bench.running.isolation import Isolated
from imagine_bench.running.trained import KeptAgent, agent_of, imaginer_of, kept_entry, read_agent
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders
from imagine_bench.store.files import read_sealed
from imagine_bench.store.run_folder import load_run, mark_digest

__path__: list[str] = []  # the old path imagine_bench.judge.models.outcomes is looked for below this module
_CONFIG = "config.json"
_TASKS = "imagine_bench.tasks"
_MOST = 0.5  # share of its futures that a filter keeps of a step that counts as kept


@dataclass(frozen=True)
class AgentModel(Untaught):
    """An agent that imagines, as a world model; the agent learns elsewhere and is not changed."""

    agent: Imaginer

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """Rollouts of the agent, one after another; see :class:`imagine_bench.interfaces.model.WorldModel`."""
        depth = actions.shape[1] - frames.shape[1] + 1
        rollouts = []
        begin_episode(self.agent)
        for row, seeds in enumerate(rng.integers(2**63, size=(len(frames), samples))):
            for seed in seeds:
                given = {"actions": actions[row, -depth:], "depth": depth, "rng": np.random.default_rng(seed)}
                rollouts.append(self.agent.imagine(frames[row, -1], **given).in_range())

        def stacked(name: str) -> Floats:  # [N, S, D, ...]
            found = np.array([getattr(rollout, name) for rollout in rollouts], dtype=np.float64)
            return found.reshape(len(frames), samples, *found.shape[1:])

        uncertain = {name: stacked(name).mean(axis=1) for name in UNCERTAINTIES}
        if not uncertain["aleatoric"].any():  # a rollout has to hold something; a model that has none says 0
            del uncertain["aleatoric"]
        rewards, p_ended = until_the_end(stacked("rewards"), stacked("p_terminated"))
        return Imagined(
            pictures=(stacked("frames") * 255.0).round().astype(np.uint8),
            rewards=rewards,
            p_ended=p_ended,
            accepted=stacked("accepted").mean(axis=1) >= _MOST,
            **uncertain,
        )


@dataclass(frozen=True)
class ServedModel:
    """A world model as :class:`.running.isolation.Isolated` serves it: its methods return arrays by name."""

    name: str
    model: WorldModel

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> Arrays:
        """Nothing."""
        self.model.fit(dataset, rng)
        return {}

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Arrays:
        """The fields of the model's :class:`Imagined`, by name. Raises InvalidValueError: one has wrong values."""
        found = imagined_by(self.model, self.name, frames, actions, samples, rng)
        offered = {field.name: getattr(found, field.name) for field in fields(Imagined)}
        return {name: np.ascontiguousarray(array) for name, array in offered.items() if array is not None}

    def factor_graph(self, frames: Frame) -> Arrays:
        """The fields of the model's :class:`LearnedGraph`, by name, unchecked; none where it offers none."""
        learned = graph_of(self.model, self.name, frames)
        return {} if learned is None else {name: np.asarray(array) for name, array in vars(learned).items()}

    def parameters(self) -> Arrays:
        """Their number."""
        return {"parameters": np.array(int(self.model.parameters()))}


@dataclass(frozen=True)
class IsolatedModel:
    """A world model in a process of its own."""

    process: Isolated

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """As of the model."""
        self.process.call("fit", dataset, rng)

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """As of the model; how far ``rng`` was drawn from there is not known here."""
        return Imagined(**self.process.call("imagine", frames, actions, samples, rng))

    def factor_graph(self, frames: Frame) -> LearnedGraph | None:
        """As of the model."""
        found = self.process.call("factor_graph", frames)
        return LearnedGraph(**found) if found else None

    def parameters(self) -> int:
        """As of the model."""
        return int(self.process.call("parameters")["parameters"])


def graph_of(model: WorldModel, name: str, frames: Frame) -> LearnedGraph | None:
    """The factor graph of a model, whose arrays are not checked; None where it offers none.

    Raises:
        InvalidValueError: It fails, or gives something else.
    """
    if not isinstance(model, GraphLearner):
        return None
    learned: object = call(name, "factor_graph", model.factor_graph, frames)
    if learned is not None and not isinstance(learned, LearnedGraph):
        given = type(learned).__name__
        raise InvalidValueError(f"World model {name}: factor_graph() gave {given}; give a LearnedGraph or None.")
    return learned


@dataclass(frozen=True, kw_only=True)
class ModelSource:
    """Where a model comes from: the registry, or a run, whose agent is one."""

    name: str
    make: str  #: ``"module:attr"`` of the registered factory
    given: tuple[AgentContext] | tuple[TaskSpec, RenderedFrameIndex] | None = None  #: arguments of it
    kept: KeptAgent | None = None  #: the agent of a run
    privileged: bool
    encoder: Path | None = None

    def model(self) -> WorldModel:
        """The model, in this process. Raises InvalidValueError: an agent that does not imagine."""
        if self.kept is not None:
            return AgentModel(imaginer_of(agent_of(self.kept), self.kept))
        return registry.made(f"World model {self.name}", self.make, *self.given or ())

    @property
    def cost(self) -> dict[str, str | float]:
        """The cost beforehand: the encoder's name, and the frames that it was trained on.

        If few new frames are read right from the encoder, that share is here too.
        """
        if self.encoder is None:
            return {"encoder": "", "encoder_frames": 0}
        card = encoders.card_of(self.encoder)
        frames = card.get("recipe", {}).get("frames", 0)
        share = encoders.low_share(card)
        low = {} if share is None else {"encoder_reads": share}
        return {"encoder": self.encoder.stem, "encoder_frames": frames, **low}


def serve(source: ModelSource) -> ServedModel:
    """The model of a source, for another process."""
    return ServedModel(source.name, source.model())


def source_of(
    name: str, spec: TaskSpec, index: RenderedFrameIndex, appearance: str, seeds: SeedTree, encoder: str | None = None
) -> ModelSource:
    """The source of a registered model, or of the agent of the run in a folder.

    Args:
        name: The model's name, or the folder.
        spec: The task.
        index: Given to privileged models.
        appearance: How frames vary.
        seeds: The model's node of the seed tree.
        encoder: A bundled name or a file, for models that read its latents or codes; the others see through the task's
            own, or that of their run.

    Raises:
        UnknownNameError: No such model.
        InvalidValueError: The agent of the run learned another task, or a teacher's feedback.
        ArtefactError: The run, or the encoder, cannot be read.
    """
    entry = model_entry(name)
    if Path(name) in runs_of(name).values():
        try:
            kept = read_agent(Path(name))
        except ArtefactError:
            if encoder is None:
                raise
            kept = read_agent(Path(name), encoder=encoder)
        learned = kept.spec.protocol.task
        if registry.task(learned).id != spec.id:
            raise InvalidValueError(f"{name} learned {learned}, not {spec.id}; give a run of {spec.id}.")
        if kept.spec.protocol.feedback:
            raise InvalidValueError(
                f"{name} learned rewards with a teacher's feedback in them, which the rules do not know; give a run "
                "without --feedback."
            )
        seen_through = kept.spec.encoder
        return ModelSource(name=name, make=entry.make, kept=kept, privileged=entry.privileged, encoder=seen_through)
    if entry.privileged:
        return ModelSource(name=name, make=entry.make, given=(spec, index), privileged=True)
    path = None if entry.encoder_kind is None else encoder_for(spec, appearance, entry.encoder_kind, encoder)
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=path,
        seeds=seeds,
        config_group=spec.config_group,
        overrides=parse_configuration(name).settings,
        argument=parse_configuration(name).argument,
    )
    return ModelSource(name=name, make=entry.make, given=(context,), privileged=False, encoder=path)


@dataclass(frozen=True)
class JudgedModel:
    """A world model, ready to be fitted and asked."""

    model: WorldModel
    cost: dict[str, str | float]  # spent beforehand: the encoder's name and frames, and how well it is read if badly
    learns: bool  # whether it is fitted here; an agent has learned in its run
    visited: set[tuple[State, int]] | None  # tried in an agent's training; None where that is not known
    cpu_s: Callable[[], float]  # CPU seconds so far of the process that it is in


@contextmanager
def opened(source: ModelSource, task: str, *, folder: Path, log: Path) -> Iterator[JudgedModel]:
    """A new model, or a trained agent, in a process of its own; a privileged one in this process.

    The output of that process is added to ``log``. ``folder`` is the judgement's, which is hidden from models as its
    neighbours are.

    Raises:
        ImagineBenchError: It cannot be made.
    """
    learns = source.kept is None
    visited = None if source.kept is None else _visited(source.kept)
    if source.privileged:
        yield JudgedModel(source.model(), source.cost, learns, visited, time.process_time)
        return
    hidden = [place.parent for place in folder.parent.glob("*/.lock")]
    tasks = find_spec(_TASKS)
    if tasks is not None:
        hidden += map(Path, tasks.submodule_search_locations or ())
    served = replace(source, make=importable(source.make))
    closed = closed_modules(task, source.make)
    with Isolated(f"{__name__}:{serve.__name__}", served, log=log, forbidden=closed, hidden=hidden) as process:
        yield JudgedModel(IsolatedModel(process), source.cost, learns, visited, lambda: process.cpu_s)


def closed_modules(task: str, make: str) -> list[str]:
    """Modules that tell the truth about a task and that its models cannot import, this suite's tasks first.

    A model of the package that also offers the task, ``make`` its ``"module:attr"``, can import that package.
    """
    entry = registry.task_entry(task)
    others = {target.partition(":")[0] for target in (entry.spec, entry.env)}
    package = make.partition(":")[0].partition(".")[0]
    return [_TASKS, *sorted(module for module in others if module.partition(".")[0] != package)]


def runs_of(model: str) -> dict[int, Path]:
    """The runs that a name stands for, by seed; none where it is a world model's.

    A name is a run's folder, such as ``runs/arrow_puzzle/quick-<hash>/imagination/seed_0``, or the folder above it,
    which stands for every run of that agent.
    """
    folder = Path(model)
    configs = [folder / _CONFIG] if (folder / _CONFIG).is_file() else folder.glob(f"seed_*/{_CONFIG}")
    found = {read_sealed(config, "a run's configuration")["seed"]: config.parent for config in configs}
    return dict(sorted(found.items()))


def model_entry(model: str) -> WorldModelEntry:
    """The registry line of a world model, or one for the agent of the runs of a folder.

    Raises:
        UnknownNameError: No such world model.
        ArtefactError: This process does not know the agent, or a path of no run.
    """
    runs = runs_of(model)
    if not runs:
        try:
            return registry.world_model_entry(model)
        except UnknownNameError:
            if len(Path(parse_configuration(model).agent).parts) == 1:
                raise
            raise ArtefactError(
                f"There is no run of an agent in {model}, seen from {Path.cwd()}. A judgement of runs is read from the "
                "folder in which it was made, while the runs are there."
            ) from None
    seed, folder = next(iter(runs.items()))
    config = read_sealed(folder / _CONFIG, "a run's configuration")
    agent = agent_label(config["agent"], config["protocol"])
    entry = kept_entry(agent, folder)
    title = entry.title or agent
    if folder == Path(model):
        title = f"{title}, seed {seed}"
    kind = entry.encoder_kind if entry.needs_encoder else None
    return WorldModelEntry(make=str(entry.make), title=title, privileged=entry.privileged, encoder_kind=kind)


def code_of(model: str, seed: int) -> str:
    """A digest of the package that offers a world model, empty for one of this suite; or of the run of a seed."""
    runs = runs_of(model)
    return mark_digest(runs[seed]) if seed in runs else registry.package_code(model_entry(model).make)


def one_name(model: str) -> str:
    """The same text for the same model, however its settings or the path of its runs were written."""
    return str(Path(model).resolve()) if runs_of(model) else str(parse_configuration(model))


def _visited(kept: KeptAgent) -> set[tuple[State, int]] | None:
    """Every macrostate and macro-action of a run's training; None where a dataset or earlier tasks had more of them."""
    tried = load_run(kept.folder).tried
    if tried is None:
        raise ArtefactError(f"{kept.folder} was written by a version that kept no experience; run it anew.")
    if kept.spec.protocol.dataset or kept.spec.protocol.after:
        return None
    return {(tuple(row[:-2]), row[-2]) for row in tried.tolist()}


def encoder_for(spec: TaskSpec, appearance: str, kind: str, given: str | None) -> Path:
    """The given encoder, where it gives latents or codes as the model reads them; else the task's own."""
    if given is not None:
        path = encoders.resolve(spec, appearance, given)
        if encoders.kind(path) == kind:
            return path
    return encoders.own(spec, appearance, kind)
