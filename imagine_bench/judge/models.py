"""Where world models come from: those of the registry, and agents that imagine, which are world models too.

What an agent says its own images show counts for nothing when it is judged: they are read as those of any model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Ints
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import AgentContext, Floats, Frame, State, TaskSpec
from imagine_bench.interfaces.capabilities import Imaginer, begin_episode
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import UNCERTAINTIES, Imagined, WorldModel
from imagine_bench.judge.predictions import RenderedFrameIndex
from imagine_bench.registry.entries import WorldModelEntry, entrant
from imagine_bench.running.trained import Trained, load_trained
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders
from imagine_bench.store.files import read_json, read_sealed
from imagine_bench.store.run_folder import load_run

__path__: list[str] = []  # the old path imagine_bench.judge.models.outcomes is looked for below this module
_CONFIG = "config.json"
_MOST = 0.5  # share of its futures that a filter keeps of a step that counts as kept


class AgentModel:
    """An agent that imagines, as a world model; the agent learns elsewhere and is not changed."""

    def __init__(self, agent: Imaginer) -> None:
        self.agent = agent

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Learn nothing more."""
        del dataset, rng

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """Rollouts of the agent, one after another; see :class:`imagine_bench.interfaces.model.WorldModel`."""
        depth = actions.shape[1] - frames.shape[1] + 1
        rollouts = []
        begin_episode(self.agent)
        for row, seeds in enumerate(rng.integers(2**63, size=(len(frames), samples))):
            for seed in seeds:
                given = {"actions": actions[row, -depth:], "depth": depth, "rng": np.random.default_rng(seed)}
                rollouts.append(self.agent.imagine(frames[row, -1], **given))

        def stacked(name: str) -> Floats:  # [N, S, D, ...]
            found = np.array([getattr(rollout, name) for rollout in rollouts], dtype=np.float64)
            return found.reshape(len(frames), samples, *found.shape[1:])

        uncertain = {name: stacked(name).mean(axis=1) for name in UNCERTAINTIES}
        if not uncertain["aleatoric"].any():  # a rollout has to hold something; a model that has none says 0
            del uncertain["aleatoric"]
        survived = np.cumprod(1.0 - stacked("p_terminated"), axis=2)
        before = np.pad(survived[:, :, :-1], ((0, 0), (0, 0), (1, 0)), constant_values=1.0)
        return Imagined(
            pictures=(stacked("frames").clip(0.0, 1.0) * 255.0).round().astype(np.uint8),
            rewards=before * stacked("rewards"),
            p_ended=1.0 - survived,
            accepted=stacked("accepted").mean(axis=1) >= _MOST,
            **uncertain,
        )

    def parameters(self) -> int:
        """Not known."""
        return 0


class TrainedModel(AgentModel):
    """An agent that imagines, as its run left it."""

    def __init__(self, trained: Trained) -> None:
        super().__init__(trained.imaginer)
        tried = load_run(trained.folder).tried
        if tried is None:
            raise ArtefactError(f"{trained.folder} was written by a version that kept no experience; run it anew.")
        self.visited: set[tuple[State, int]] = {(tuple(row[:-2]), row[-2]) for row in tried.tolist()}
        """Every macrostate and macro-action of its training."""
        self.cost = _encoder_cost(trained.spec.encoder)


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
    """The registry line of a world model, or one for the agent of the runs of a folder. Raises UnknownNameError."""
    runs = runs_of(model)
    if not runs:
        return registry.world_model_entry(model)
    seed, folder = next(iter(runs.items()))
    agent = read_sealed(folder / _CONFIG, "a run's configuration")["agent"]
    title = registry.agent_entry(agent).title or agent
    if folder == Path(model):
        title = f"{title}, seed {seed}"
    return WorldModelEntry(make=f"{__name__}:load_model", title=title)


def one_name(model: str) -> str:
    """The same text for the same model, however its settings or the path of its runs were written."""
    return str(Path(model).resolve()) if runs_of(model) else str(entrant(model))


def load_model(folder: Path, task: str) -> TrainedModel:
    """The agent of a run's folder.

    Raises:
        InvalidValueError: It does not imagine, or learned another task.
        ArtefactError: It cannot be taken up again.
    """
    trained = load_trained(folder)
    if trained.task.id != task:
        raise InvalidValueError(f"{folder} learned {trained.task.id}, not {task}; give a run of {task}.")
    return TrainedModel(trained)


def make(
    name: str, spec: TaskSpec, index: RenderedFrameIndex, appearance: str, seeds: SeedTree, encoder: str | None = None
) -> tuple[WorldModel, dict[str, str | int]]:
    """A new model, or a trained agent, and what was spent on it beforehand: the encoder's name and frames."""
    if Path(name) in runs_of(name).values():
        trained = load_model(Path(name), spec.id)
        return trained, trained.cost
    entry = registry.world_model_entry(name)
    if entry.privileged:
        return registry.make_world_model(name, spec, index), _encoder_cost(None)
    path = None if entry.encoder_kind is None else _encoder(spec, appearance, entry.encoder_kind, encoder)
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=path,
        seeds=seeds,
        config_group=spec.config_group,
        overrides=entrant(name).settings,
    )
    return registry.make_world_model(name, context), _encoder_cost(path)


def _encoder(spec: TaskSpec, appearance: str, kind: str, given: str | None) -> Path:
    """The given encoder, where it gives latents or codes as the model reads them; else the task's own."""
    if given is not None:
        path = encoders.resolve(spec, appearance, given)
        if encoders.kind(path) == kind:
            return path
    return encoders.own(spec, appearance, kind)


def _encoder_cost(path: Path | None) -> dict[str, str | int]:
    """The encoder's name, and the frames that it was trained on."""
    if path is None:
        return {"encoder": "", "encoder_frames": 0}
    card = read_json(path.with_suffix(".json"), "an encoder's card")
    return {"encoder": path.stem, "encoder_frames": card.get("recipe", {}).get("frames", 0)}
