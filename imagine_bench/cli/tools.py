"""The commands beside benches: data and encoders, viewing, playing, describing, checking, and the state of this
machine.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from imagine_bench import registry
from imagine_bench.cli.options import (
    Count,
    DeviceWord,
    EncoderWord,
    ExecutionWord,
    File,
    MaybeTaskWord,
    OfBench,
    TaskWord,
    Word,
    demonstrations,
    one_of,
    require_with,
    shown,
)
from imagine_bench.data.folder import CARD, FORMATS, read_card, read_dataset, require_format, require_new, write_dataset
from imagine_bench.data.motion import read_demonstrations
from imagine_bench.errors import CheckFailedError, InvalidValueError
from imagine_bench.interfaces import APPEARANCES, DEVICES
from imagine_bench.interfaces.episodes import FRAME_SHAPE
from imagine_bench.registry.entries import file_name
from imagine_bench.running.collect import POLICIES, collect, policy_of
from imagine_bench.running.collect import describe as describe_episodes
from imagine_bench.running.player import protocol_of_player
from imagine_bench.store.bench_folder import newest_recording
from imagine_bench.store.files import require_writable
from imagine_bench.tools.describe import describe, names
from imagine_bench.tools.doctor import examine
from imagine_bench.tools.standard_data import standard_sets


@dataclass(frozen=True, kw_only=True)
class DatasetCommand:
    """Collect episodes of a task as a dataset, or describe one.

    TASK is a task of macro-actions, or one of continuous control, such as ArrowPuzzleMotion.
    """

    task: MaybeTaskWord = None
    """Task that is played, also as --task TASK; none with --describe and --standard."""
    policy: str = "random"
    """The player: random; uniform (one random macro-action from any macrostate); oracle; mixed (random and oracle in
    turn); or a run's folder, whose trained agent acts greedily. Of continuous control: expert; noisy (with errors, and
    planned again after a failure); random; mixed (all three in turn)."""
    episodes: int = 200
    """Episodes."""
    format: Annotated[str, one_of(*FORMATS)] = "npz"
    """Format of the files; lerobot and minari need the extra 'data'."""
    out: File = None
    """Folder of the dataset, by default datasets/TASK-POLICY; never overwritten."""
    seed: int = 0
    """Seed of starts and of chance."""
    execution: ExecutionWord = None
    """How macro-actions happen: physics, or kinematic (their outcome is set)."""
    appearance: str = APPEARANCES[0]
    """How much frames vary: clean, mild, strong, patched, or factors such as light=0.5,camera=0.2."""
    motion_hz: float = 0.0
    """Samples a second of the arm's motion and commands, kept in a file apart; 0 keeps none."""
    size: Count = None
    """Edge of images in pixels, of continuous control; by default 64."""
    workers: Count = None
    """Processes at a time, of continuous control; one a core by default. The episodes do not depend on it."""
    encoder: EncoderWord = None
    """The encoder the agent of a run saw through, where it is not bundled."""
    describe: File = None
    """Folder of a dataset to describe, instead of collecting one. 'verify' checks one of continuous control."""
    standard: bool = False
    """Make random, medium and optimal sets of three control tasks, kinematic, below --out (default: datasets)."""

    def __call__(self) -> None:
        """Collect, or describe."""
        if [self.task is None, self.describe is None, not self.standard].count(False) != 1:
            raise InvalidValueError("Give exactly one of a task to collect episodes of, --describe and --standard.")
        if self.task is None:
            how = ("policy", "seed", "execution", "appearance", "motion_hz", "size", "workers", "encoder")
            require_with("a task", self, *how, *(() if self.standard else ("episodes", "format", "out")))
        if self.describe is not None:
            if "control" in (read_card(self.describe) or {}):
                print(demonstrations().describe(read_demonstrations(self.describe)))
            else:
                print(describe_episodes(read_dataset(self.describe)))
            return
        require_format(self.format)
        motion = None if self.task is None else registry.task_of_motion(self.task)
        if motion is not None:
            self._demonstrate(motion)
            return
        require_with("a task of continuous control", self, "size", "workers")
        if self.task is None:
            for folder in standard_sets(self.out or Path("datasets"), self.format, self.episodes):
                print(f"{folder}\n{describe_episodes(read_dataset(folder))}\n")
            return
        if self.policy in POLICIES:
            require_with("--policy FOLDER", self, "encoder")
        spec = registry.task(self.task)
        policy = policy_of(self.policy, spec, self.seed, self.encoder)
        folder = self.out or Path("datasets") / f"{file_name(spec.id)}-{policy.name}"
        require_new(folder)
        require_writable(folder.parent)
        episodes, files, card = collect(
            spec,
            policy,
            episodes=self.episodes,
            seed=self.seed,
            execution=spec.execution(self.execution),
            appearance=self.appearance,
            motion_hz=self.motion_hz,
        )
        print(f"{folder}\n{describe_episodes(write_dataset(folder, episodes, files, card, self.format))}")

    def _demonstrate(self, task: str) -> None:
        require_with("a task of macro-actions", self, "execution", "motion_hz", "encoder")
        folder = self.out or Path("datasets") / f"{file_name(str(self.task))}-{self.policy}"
        require_new(folder)
        require_writable(folder.parent)
        module = demonstrations()
        made = module.collect(
            task,
            policy=self.policy,
            episodes=self.episodes,
            seed=self.seed,
            appearance=self.appearance,
            size=self.size or FRAME_SHAPE[0],
            format=self.format,
            folder=folder,
            workers=self.workers,
        )
        print(f"{folder}\n{module.describe(made)}")


@dataclass(frozen=True, kw_only=True)
class EncoderCommand:
    """Train an encoder anew and say how it compares to the bundled one."""

    task: TaskWord
    """Task whose frames it learns, also as --task TASK."""
    appearance: str = APPEARANCES[0]
    """Appearance of the frames: a level, or factors such as light=0.5,camera=0.2."""
    recipe: Annotated[str, one_of("default", "thesis", "joint", "codes")] = "default"
    """How it is trained: default, thesis, joint (the arrow puzzles: eight latents of the whole image), or codes,
    for agents that read factors and their values."""
    seed: int = 0
    """Seed of data and training."""
    steps: Count = None
    """Gradient steps, at least 1; by default the recipe's."""
    batch: Count = None
    """Images a gradient step, at least 1; by default the recipe's."""
    latents: Count = None
    """Latents of the image, or of each strip, at least 1; by default the recipe's."""
    device: DeviceWord = DEVICES[0]
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


@dataclass(frozen=True, kw_only=True)
class ViewCommand(OfBench):
    """Open a recording in the Rerun viewer: the .rrd file of the first word, or the newest of a folder, task or all.

    Of a folder of demonstrations, an episode is played again and recorded beside it.
    """

    episode: Count = None
    """Of demonstrations: the number of the episode, from 0."""

    def __call__(self) -> None:
        """Find and open."""
        from imagine_bench.recording.stream import open_in_viewer  # noqa: PLC0415 - Rerun loads slowly

        path, task = self.meant()
        if path is not None and (path / CARD).exists():
            index = self.episode or 0
            whole = Path(os.path.abspath(path))  # "." has no name of its own
            file = whole.with_name(f"{whole.name}-episode_{index}.rrd")
            demonstrations().record(read_demonstrations(path), index, file)
            path = file
        else:
            require_with("a folder of demonstrations", self, "episode")
        if path is not None and path.is_dir():
            of_run = path / "recording.rrd"
            path = of_run if of_run.is_file() else newest_recording(path)
        open_in_viewer(path or newest_recording(self.out, task))


@dataclass(frozen=True, kw_only=True)
class Describe:
    """Describe a task exactly (macro-actions, chance, optimum, plan lengths), or an agent with its settings.

    Without a name, name everything.
    """

    task: Annotated[str | None, tyro.conf.Positional, shown("[NAME]")] = None
    """Task, agent, regressor or world model; a task also as --task TASK."""

    def __call__(self) -> None:
        """Describe, or list."""
        print(names() if self.task is None else describe(self.task))


@dataclass(frozen=True, kw_only=True)
class Play:
    """Solve a task by keyboard; says at the end how often, beside chance and optimum. Or film the oracle.

    Keys are macro-actions; of a task of continuous control, such as ArrowPuzzleMotion, they move the hand.
    """

    task: MaybeTaskWord = None
    """Task to play, also as --task TASK; by default that of --model."""
    model: File = None
    """A run's folder, whose agent imagines the same keys beside the real scene."""
    execution: ExecutionWord = None
    """physics or kinematic; by default the model's, else the task's."""
    appearance: Word = None
    """Appearance: a level, or factors; by default likewise."""
    encoder: EncoderWord = None
    """Name or file of the encoder that the model used."""
    camera: Annotated[str, one_of("human", "far")] = "human"
    """Camera of the scene: human looks at the table from nearby, far at the whole arm."""
    seed: int = 0
    """Chooses the episodes."""
    quiz: int = 0
    """Answer so many questions about the task's whole world instead, as world models are asked; with --appearance and
    --seed. Their images are written into runs/quiz."""
    keep: Word = None
    """Your name, such as anna: keep your episodes as a run of a bench. Each begins where everybody's tests begin, all
    count, and the same command goes on after a pause."""
    tests: Count = None
    """With --keep: tests to play, 20 by default."""
    training: Count = None
    """With --keep: training episodes before the tests, 0 by default."""
    like: File = None
    """With --keep: folder of a bench whose world and tests are taken, so that one report can show both."""
    film: bool = False
    """Film an episode of optimal macro-actions in contact physics instead, as a GIF."""
    out: File = None
    """With --film: the GIF to write, film.gif by default; never overwritten. With --keep: folder of all benches, runs
    by default."""

    def __call__(self) -> None:
        """Play, or film."""
        from imagine_bench.tools import play  # noqa: PLC0415 - pillow loads slowly

        motion = None if self.task is None else registry.task_of_motion(self.task)
        if motion is not None:
            self._play_motion(motion)
            return
        if self.quiz:
            self._quiz()
            return
        if self.keep is not None:
            self._keep(self.keep)
            return
        require_with("--keep", self, "tests", "training", "like")
        if not self.film:
            require_with("--film or --keep", self, "out")
            options = {"execution": self.execution, "appearance": self.appearance, "encoder": self.encoder}
            print(play.play(self.task, model=self.model, seed=self.seed, camera=self.camera, **options))
            return
        if self.task is None or self.model or self.execution or self.encoder:
            raise InvalidValueError(
                "A film is of the oracle in a task, in contact physics; give a task, and no --model, --execution or "
                "--encoder."
            )
        look = self.appearance or APPEARANCES[0]
        print(play.film(self.task, self.out or Path("film.gif"), seed=self.seed, appearance=look, camera=self.camera))

    def _play_motion(self, task: str) -> None:
        others = ("quiz", "keep", "tests", "training", "like", "film", "out", "model", "execution", "encoder")
        require_with("a task of macro-actions", self, *others)
        registry.require_guest(registry.MOTION, "Playing continuous control by keys")
        play_motion = registry.load("imagine_bench_motion.control.keyboard:play_motion")
        look = self.appearance or APPEARANCES[0]
        print(play_motion(task, seed=self.seed, appearance=look, camera=self.camera))

    def _keep(self, name: str) -> None:
        from imagine_bench.tools import play  # noqa: PLC0415 - as above

        require_with("a game without --keep", self, "model", "encoder", "film")
        names = ("tests", "training", "seed", "like", "execution", "appearance")
        chosen = {each: getattr(self, each) for each in names}
        wanted = protocol_of_player(self.task, "person", name, **chosen)
        print(play.keep_playing(wanted, self.out or Path("runs"), camera=self.camera))

    def _quiz(self) -> None:
        from imagine_bench.tools.quiz import quiz  # noqa: PLC0415 - as above

        require_with("a game", self, "model", "execution", "encoder", "camera", "film", "out", "keep")
        require_with("--keep", self, "tests", "training", "like")
        if self.task is None:
            raise InvalidValueError("There is nothing to ask about; give a task, such as play arrow_puzzle --quiz 16.")
        print(quiz(self.task, self.quiz, seed=self.seed, appearance=self.appearance or APPEARANCES[0]))


@dataclass(frozen=True, kw_only=True)
class Serve:
    """Serve a task over HTTP for language models and other programs, and keep their episodes as runs of a bench.

    Plain HTTP, MCP and OpenEnv, without a key, for this machine alone. Needs the plug-in imagine-bench-serving.
    """

    task: MaybeTaskWord = None
    """Task to serve, also as --task TASK; by default that of --like."""
    observation: Annotated[str, one_of("words", "png")] = "words"
    """How players are shown the scene: in words, or as frames."""
    player: Word = None
    """Name of the player of requests that name none."""
    tests: Count = None
    """Tests of each player, 20 by default; they begin where everybody's tests begin."""
    training: Count = None
    """Training episodes of each player before the tests, 0 by default."""
    like: File = None
    """Folder of a bench whose world and tests are taken, so that one report can show both."""
    execution: ExecutionWord = None
    """physics or kinematic; by default the task's."""
    appearance: Word = None
    """Appearance of frames: a level, or factors."""
    most_players: int = 16
    """Different players that are let in."""
    host: str = "127.0.0.1"
    """Address that is bound to; another than 127.0.0.1 lets other machines play."""
    port: int = 8765
    """Port; 0 takes any free one."""
    out: Path = Path("runs")
    """Folder of all benches."""

    def __call__(self) -> None:
        """Serve until Ctrl-C."""
        registry.load(registry.command("serve"))(**vars(self))


@dataclass(frozen=True, kw_only=True)
class CheckCommand:
    """Say whether a task, an agent or a world model, of this suite or another package, keeps the contract."""

    task: MaybeTaskWord = None
    """Task to check, also as --task TASK; with --agent or --model, the one that these are checked in."""
    agent: Word = None
    """Agent to check."""
    model: Word = None
    """World model to check."""
    physics: bool = False
    """Measure the task's contact physics instead: fidelity to the rules at random, then how far friction, force, mass
    and the planner's errors may go before macro-actions fail. Of continuous control, such as ArrowPuzzleMotion: how
    many planned macro-actions (--trials) and whole episodes (of --turns macro-actions) succeed by hand twists."""
    turns: int = 2_000
    """With --physics: macro-actions of the fidelity measurement; 0 for none."""
    trials: int = 200
    """With --physics: macro-actions of each value of each setting; 0 for none."""
    appearances: tuple[str, ...] = APPEARANCES[:1]
    """With --physics: appearance levels at which fidelity is measured."""
    random: int = 100
    """With --physics, of continuous control: episodes of random hand twists. With --trials 0 they are added to those
    that the file of --out has."""
    out: Path = Path("runs/margins.json")
    """With --physics: the file in which the figures are kept, with the machine's description."""

    def __call__(self) -> None:
        """Check."""
        from imagine_bench.testing import contract, physics  # noqa: PLC0415 - nothing else needs them

        if not self.physics:
            require_with("--physics", self, "turns", "trials", "random", "appearances", "out")
            failed = contract.report(contract.checks(self.task, self.agent, self.model)) > 0
        elif self.task is None or self.agent or self.model:
            raise InvalidValueError("Physics is measured of a task; give one, and no --agent or --model.")
        elif registry.task_of_motion(self.task):
            numbers = {"turns": self.turns, "trials": self.trials, "random_episodes": self.random}
            failed = not physics.check_motion(self.task, self.out, **numbers, appearances=self.appearances)
        else:
            require_with("a task of continuous control", self, "random")
            failed = not physics.check_physics(
                self.task, self.out, turns=self.turns, trials=self.trials, appearances=self.appearances
            )
        if failed:
            raise CheckFailedError("Not everything that was checked holds; see above.")


@dataclass(frozen=True, kw_only=True)
class New:
    """Write a package of your own with a task, an agent or a world model in it, ready to be changed."""

    kind: Annotated[str, tyro.conf.Positional, one_of("task", "agent", "model")]
    """The kind of thing that the package holds."""
    name: Annotated[str, tyro.conf.Positional]
    """Name of the package, and of the task, agent or world model in it."""
    out: Path = Path()
    """Folder in which the package's folder is made."""

    def __call__(self) -> None:
        """Write."""
        from imagine_bench.tools.new import new_package  # noqa: PLC0415 - nothing else needs it

        print(new_package(self.kind, self.name, self.out))


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Describe this machine and installation, and each fault of them in words."""

    def __call__(self) -> None:
        """Examine."""
        text, works = examine()
        print(text)
        if not works:
            raise CheckFailedError("Something is wrong with this installation; see above.")
