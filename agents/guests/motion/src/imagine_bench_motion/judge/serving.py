"""Models of motions in processes of their own, where they find their questions and nothing else of the judge."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Arrays, Floats32, Frame, Ints
from imagine_bench.interfaces import AgentContext, TaskSpec
from imagine_bench.judge.models import closed_modules
from imagine_bench.running.isolation import Isolated
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders

from .interface import MotionModel, MotionModelEntry, Motions, require_frames


class ServedMotionModel:
    """A model as :class:`imagine_bench.running.isolation.Isolated` serves it: its methods return arrays by name."""

    def __init__(self, name: str, model: MotionModel) -> None:
        self._name = name
        self._model = model

    def fit(self, dataset: Motions, rng: np.random.Generator) -> Arrays:
        """The number of parameters that were fitted."""
        self._model.fit(dataset, rng)
        return {"parameters": np.array(int(self._model.parameters()))}

    def imagine_motion(self, frames: Frame, actions: Floats32, lengths: Ints, labels: Ints) -> Arrays:
        """The frames. Raises InvalidValueError: the model hands in something else."""
        drawn = self._model.imagine_motion(frames, actions, lengths, labels)
        return {"frames": require_frames(drawn, name=self._name, rows=len(labels))}


def serve(name: str, make: str, context: AgentContext) -> ServedMotionModel:
    """A model, for another process."""
    return ServedMotionModel(name, registry.made(f"Model of motions {name}", make, context))


class IsolatedMotionModel:
    """A model in a process of its own.

    Args:
        process: That process.
    """

    def __init__(self, process: Isolated) -> None:
        self._process = process

    def fit(self, dataset: Motions, rng: np.random.Generator) -> tuple[float, int]:
        """Fit it. Returns the CPU seconds that took, and the number of parameters."""
        begun_s = self._process.cpu_s
        parameters = int(self._process.call("fit", dataset, rng)["parameters"])
        return self._process.cpu_s - begun_s, parameters

    def imagine_motion(self, frames: Frame, actions: Floats32, lengths: Ints, labels: Ints) -> Frame:
        """As of the model."""
        return self._process.call("imagine_motion", frames, actions, lengths, labels)["frames"]


@contextmanager
def opened(
    name: str, entry: MotionModelEntry, spec: TaskSpec, seeds: SeedTree, *, folder: Path, log: Path
) -> Iterator[IsolatedMotionModel]:
    """A new model of a task in a process of its own, which can import no task and finds no judgement.

    Args:
        name: Its name.
        entry: Its entry.
        spec: The task of macro-actions.
        seeds: The model's node of the seed tree.
        folder: The judgement's; it and its neighbours are hidden from the model where the system allows it.
        log: The file to which the output of the process is added.

    Raises:
        ImagineBenchError: It cannot be made.
    """
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=None if entry.encoder_kind is None else encoders.own(spec, "clean", entry.encoder_kind),
        seeds=seeds,
        config_group=spec.config_group,
    )
    hidden = [place.parent for place in folder.parent.glob("*/.lock")]
    closed = closed_modules(spec.id, entry.make)
    for package in filter(None, map(find_spec, closed)):
        hidden += map(Path, package.submodule_search_locations or ())
    given = (name, entry.make, context)
    with Isolated(f"{__name__}:serve", *given, log=log, forbidden=closed, hidden=hidden) as process:
        yield IsolatedMotionModel(process)
