"""A trained agent of a bench as a world model: asked what any other is asked, and read by the same reader.

What it says its own pictures show counts for nothing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import Frame, State
from imagine_bench.interfaces.capabilities import Imaginer, begin_episode
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import UNCERTAINTIES, Imagined
from imagine_bench.registry.entries import WorldModelEntry
from imagine_bench.running.trained import Trained, load_trained
from imagine_bench.store.files import read_json, read_sealed
from imagine_bench.store.run_folder import load_run

_CONFIG = "config.json"
_MOST = 0.5  # share of its futures that a filter keeps of a step that counts as kept


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
    return WorldModelEntry(
        make=f"{__name__}:load_model", title=f"{title}, seed {seed}" if folder == Path(model) else title
    )


class TrainedModel:
    """An agent that imagines, as its run left it; it learned elsewhere."""

    def __init__(self, trained: Trained) -> None:
        self.agent: Imaginer = trained.imaginer
        tried = load_run(trained.folder).tried
        if tried is None:
            raise ArtefactError(f"{trained.folder} was written by a version that kept no experience; run it anew.")
        self.visited: set[tuple[State, int]] = {(tuple(row[:-2]), row[-2]) for row in tried.tolist()}
        """Every macrostate and macro-action of its training."""
        path = trained.spec.encoder
        card = {} if path is None else read_json(path.with_suffix(".json"), "an encoder's card")
        self.price = {
            "encoder": "" if path is None else path.stem, "encoder_frames": card.get("recipe", {}).get("frames", 0)
        }  # fmt: skip

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Learn nothing more."""
        del dataset, rng

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        """Rollouts of the agent, one after another; see :class:`imagine_bench.world_models.WorldModel`."""
        asked = actions[:, frames.shape[1] - 1 :]
        seeds = rng.integers(2**63, size=(len(frames), samples))
        begin_episode(self.agent)
        found = [
            [
                self.agent.imagine(frame, actions=row, depth=len(row), rng=np.random.default_rng(seed))
                for seed in seeds[index]
            ]
            for index, (frame, row) in enumerate(zip(frames[:, -1], asked, strict=True))
        ]

        def stacked(name: str) -> NDArray[np.float64]:  # [N, S, D, ...]
            return np.array([[getattr(one, name) for one in futures] for futures in found], dtype=np.float64)

        uncertain = {name: stacked(name).mean(axis=1) for name in UNCERTAINTIES}
        if not uncertain["aleatoric"].any():  # a rollout has to hold something; a model that has none says 0
            del uncertain["aleatoric"]
        survived = np.cumprod(1.0 - stacked("p_terminated"), axis=2)
        before = np.concatenate([np.ones_like(survived[:, :, :1]), survived[:, :, :-1]], axis=2)
        return Imagined(
            pictures=(stacked("frames").clip(0.0, 1.0) * 255.0).round().astype(np.uint8),
            rewards=before * stacked("rewards"), p_ended=1.0 - survived,
            accepted=stacked("accepted").mean(axis=1) >= _MOST, **uncertain,
        )  # fmt: skip

    def parameters(self) -> int:
        """Not known."""
        return 0


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
