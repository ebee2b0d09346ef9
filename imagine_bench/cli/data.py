"""The command that collects datasets and says what they hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from imagine_bench import registry
from imagine_bench.cli.options import shown
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import APPEARANCES
from imagine_bench.registry.entries import file_name
from imagine_bench.store.files import require_writable


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Collect episodes of a task as a dataset, or say what one holds."""

    task: Annotated[str | None, tyro.conf.Positional, shown("[TASK]", "(none with --describe, --standard)")] = None
    """Task that is played."""
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
    encoder: Annotated[str | None, shown("NAME|FILE", "(default: the run's, if bundled)")] = None
    """The encoder the agent of a run saw through, where it is not bundled."""
    describe: Annotated[Path | None, shown("PATH", "(default: none)")] = None
    """Folder of a dataset to check and describe, instead of collecting one."""
    standard: bool = False
    """Make random, medium and optimal sets of three control tasks, kinematic, below --out (default: datasets)."""

    def __call__(self) -> None:
        """Collect, or describe."""
        from imagine_bench.data.folder import read_dataset, require_format, require_new, write_dataset  # noqa: PLC0415
        from imagine_bench.running.collect import collect, describe, policy_of  # noqa: PLC0415 - slow, and only for this
        from imagine_bench.tools.standard_data import standard_sets  # noqa: PLC0415 - as above

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
