"""The commands that make datasets and encoders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from imagine_bench import registry
from imagine_bench.cli.options import MaybeEncoder, MaybeTaskWord, TaskWord, shown
from imagine_bench.data.folder import read_dataset, require_format, require_new, write_dataset
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import APPEARANCES, DEVICES
from imagine_bench.registry.entries import file_name
from imagine_bench.running.collect import collect, describe, policy_of
from imagine_bench.store.files import require_writable
from imagine_bench.tools.standard_data import standard_sets

_RECIPES_OWN = shown("INT", "(default: the recipe's)")


@dataclass(frozen=True, kw_only=True)
class DatasetCommand:
    """Collect episodes of a task as a dataset, or say what one holds."""

    task: MaybeTaskWord = None
    """Task that is played, also as --task TASK; none with --describe and --standard."""
    policy: str = "random"
    """Who plays: random; uniform (one random macro-action from any macrostate); oracle; mixed (random and oracle in
    turn); or a run's folder, whose trained agent acts greedily."""
    episodes: int = 200
    """Episodes."""
    format: str = "npz"
    """Format of the files: npz, lerobot, or minari (both of the extra 'data')."""
    out: Annotated[Path | None, shown("PATH", "(default: datasets/TASK-POLICY)")] = None
    """Folder of the dataset; never overwritten."""
    seed: int = 0
    """Seed of starts and of chance."""
    execution: Annotated[str | None, shown("STR", "(default: the task's)")] = None
    """How macro-actions happen: physics, or kinematic (their outcome is set)."""
    appearance: str = APPEARANCES[0]
    """How much frames vary: clean, mild, strong, photo, or factors such as light=0.5,camera=0.2."""
    motion_hz: float = 0.0
    """Samples a second of the arm's motion and commands, kept in a file apart; 0 keeps none."""
    encoder: MaybeEncoder = None
    """The encoder the agent of a run saw through, where it is not bundled."""
    describe: Annotated[Path | None, shown("PATH", "(default: none)")] = None
    """Folder of a dataset to check and describe, instead of collecting one."""
    standard: bool = False
    """Make random, medium and optimal sets of three control tasks, kinematic, below --out (default: datasets)."""

    def __call__(self) -> None:
        """Collect, or describe."""
        if (self.task is None) == (self.describe is None and not self.standard):
            raise InvalidValueError("Give a task to collect episodes of, or one of --describe and --standard.")
        if self.describe is not None:
            print(describe(read_dataset(self.describe)))
            return
        require_format(self.format)
        if self.task is None:
            for folder in standard_sets(self.out or Path("datasets"), self.format, self.episodes):
                print(f"{folder}\n{describe(read_dataset(folder))}\n")
            return
        spec = registry.task(self.task)
        policy = policy_of(self.policy, spec, self.seed, self.encoder)
        folder = self.out or Path("datasets") / f"{file_name(spec.id)}-{policy.name}"
        require_new(folder)
        require_writable(folder.parent)
        episodes, files, card = collect(
            spec, policy, episodes=self.episodes, seed=self.seed, execution=spec.execution(self.execution),
            appearance=self.appearance, motion_hz=self.motion_hz,
        )  # fmt: skip
        print(f"{folder}\n{describe(write_dataset(folder, episodes, files, card, self.format))}")


@dataclass(frozen=True, kw_only=True)
class EncoderCommand:
    """Train an encoder anew and say how it compares to the bundled one."""

    task: TaskWord
    """Task whose frames it learns, also as --task TASK."""
    appearance: str = APPEARANCES[0]
    """Appearance of the frames: a level, or factors such as light=0.5,camera=0.2."""
    recipe: str = "default"
    """How it is trained: default, thesis, joint (the arrow puzzles: eight latents of the whole image), or codes,
    for agents that read factors and their values."""
    seed: int = 0
    """Seed of data and training."""
    steps: Annotated[int | None, _RECIPES_OWN] = None
    """Gradient steps, at least 1."""
    batch: Annotated[int | None, _RECIPES_OWN] = None
    """Images a gradient step, at least 1."""
    latents: Annotated[int | None, _RECIPES_OWN] = None
    """Latents of the image, or of each strip, at least 1."""
    device: str = DEVICES[0]
    """Where gradient steps are made: cpu, or cuda (an NVIDIA GPU)."""
    out: Path = Path("encoders")
    """Folder for artefact, card and figure; never overwritten."""

    def __call__(self) -> None:
        """Train."""
        retrain = registry.load("imagine_bench.agents.encoders.cli:retrain")
        spec = registry.task(self.task)
        require_writable(self.out)
        names = ("recipe", "appearance", "steps", "batch", "latents", "device")
        choices = {name: getattr(self, name) for name in names}
        print(retrain(spec, **choices, seed=self.seed, out=self.out))
