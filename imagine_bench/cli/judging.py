"""The commands that judge world models and verify results."""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from imagine_bench import registry
from imagine_bench.cli.benches import write_report
from imagine_bench.cli.observers import Observed
from imagine_bench.cli.options import (
    Count,
    EncoderWord,
    File,
    OfBench,
    TaskWord,
    Word,
    Words,
    demonstrations,
    one_of,
    require_with,
)
from imagine_bench.data.folder import read_card
from imagine_bench.data.motion import read_demonstrations
from imagine_bench.errors import ArtefactError, CheckFailedError, InvalidValueError, RunFailedError
from imagine_bench.interfaces import APPEARANCES
from imagine_bench.judge.judgement import SAMPLES, SIZES, Judgement, judge, kept
from imagine_bench.judge.verify import cost
from imagine_bench.running.collect import POLICIES
from imagine_bench.running.launchers.jobs import at_a_time, launcher
from imagine_bench.running.retraining import Retraining

_PLUGGED_IN = ("structured",)
"""World models of this suite's guests that are judged by default, too."""


def _usual_models() -> tuple[str, ...]:
    """The world models that are judged where none are named, privileged ones last; says which are not installed."""
    own = [name for name, entry in registry.WORLD_MODELS.items() if entry.by_default]
    installed, note = registry.installed_of((*own, *_PLUGGED_IN), registry.WORLD_MODEL_GROUP)
    if note:
        print(note)
    return tuple(sorted(installed, key=lambda name: registry.world_model_entry(name).privileged))


@dataclass(frozen=True, kw_only=True)
class Judge:
    """Judge world models, of this suite and of other packages, against the exact truth of a task's rules."""

    task: TaskWord = "arrow_puzzle"
    """Task whose world is imagined, also as --task TASK."""
    models: Words = None
    """World models, as 'imagine-bench list' names them, or folders of a finished run or of all of an agent's; by
    default all of this suite but slow ones."""
    sizes: tuple[int, ...] = SIZES
    """Transitions of the same data after which models are compared, ascending."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds, each of data and of models."""
    samples: int = SAMPLES
    """Futures imagined of each question."""
    appearance: str = APPEARANCES[0]
    """How much frames vary: a level, or factors such as light=0.5,camera=0.2."""
    policy: Annotated[str, one_of(*POLICIES)] = "random"
    """The policy that collects the data."""
    order: int = 0
    """Seed of the order in which models are asked."""
    encoder: EncoderWord = None
    """The encoder of models that read latents or codes; by default the task's own."""
    workers: Count = None
    """Processes at a time; one a core by default."""
    out: Path = Path("runs/judge")
    """Folder in which judgements are kept; the same command again goes on."""

    def __call__(self) -> None:
        """Judge and report."""
        if registry.task_of_motion(self.task) is not None:
            registry.require_guest(registry.MOTION, "Judging models of motions")
            line = f"python -m imagine_bench_motion judge {self.task}"
            raise InvalidValueError(f"The plug-in {registry.MOTION} judges models of motions; type: {line}")
        from imagine_bench.recording.judgement import record_judgement  # noqa: PLC0415 - as below
        from imagine_bench.report.judge import judged, judgement_page  # noqa: PLC0415 - as below

        workers = at_a_time(self.workers)
        models = self.models or _usual_models()
        judgement = Judgement(
            task=self.task,
            models=tuple(registry.spelled(name, registry.WORLD_MODEL_GROUP) for name in models),
            sizes=self.sizes,
            seeds=self.seeds,
            samples=self.samples,
            appearance=self.appearance,
            policy=self.policy,
            order=self.order,
            encoder=self.encoder,
        )
        folder, failed = judge(judgement, self.out, workers=workers)
        if kept(folder, judgement):  # a report without a model would replace one of other models
            write_report(judgement_page(judged(folder, judgement)), folder / "report")
            print(f"Recording: {record_judgement(folder, judgement)}")
        if failed:
            raise RunFailedError("\n".join(failed))


@dataclass(frozen=True, kw_only=True)
class Verify(OfBench):
    """Play every episode of a bench again, and say in a line a run whether its tables follow from them.

    Of a folder of demonstrations, play each from its seed and its commands, and say in one line whether they agree.

    With --train, runs are trained again, too. With --causes, every failed test episode gets the one cause that it has
    instead; the report then shows them.
    """

    train: Count = None
    """Runs of each agent, drawn at random, that are trained again; their results are compared to the bit."""
    nonce: Word = None
    """With --train: the word that decides which runs are drawn; give one only to repeat a draw."""
    workers: Count = None
    """With --train: processes at a time; one a core by default."""
    dataset: File = None
    """With --train: the folder of the dataset that the runs learned from, if they did."""
    causes: bool = False
    """Find the causes of failures: play, swap truth in for each part of the agent, report."""
    encoder: EncoderWord = None
    """With --train or --causes: the encoder the runs saw through, where it is not bundled."""

    def __call__(self) -> None:
        """Play and compare."""
        from imagine_bench.tools import audits  # noqa: PLC0415 - matplotlib loads slowly

        given, task = self.meant()
        self._require_fitting()
        if given is not None and "control" in (read_card(given) or {}):
            self._verify_demonstrations(given)
            return
        if self.causes:
            print(audits.why_report(given, root=self.out, task=task, encoder=self.encoder))
            return
        folder = audits.chosen(given, self.out, task)
        again = None
        if self.train is not None:
            again = Retraining(
                runs=self.train,
                nonce=self.nonce or secrets.token_hex(8),
                launcher=Observed(launcher("local", self.workers)),
                encoder=self.encoder,
                dataset=self.dataset,
            )
        begun_s = time.process_time()
        found = audits.verify(folder, again)
        error = audits.conclusion(found)
        print(error or "Holds.", *found, audits.what_is_shown(folder, found, again), sep="\n")
        print(cost(found, time.process_time() - begun_s))
        if error is not None:
            raise error

    def _verify_demonstrations(self, folder: Path) -> None:
        require_with("a bench", self, "train", "causes", "encoder")
        module = demonstrations()
        kept = read_demonstrations(folder)
        try:
            print(module.verify(kept))
        except ArtefactError as error:
            print(f"Does not hold. {error}")
            raise CheckFailedError("Something in it is wrong; see above.") from error

    def _require_fitting(self) -> None:
        """Raise InvalidValueError for options that do not go together."""
        if self.train is None:
            require_with("--train", self, "nonce", "workers", "dataset")
            if not self.causes:
                require_with("--causes or --train", self, "encoder")
        if self.train is not None and (self.causes or self.train < 1):
            raise InvalidValueError(f"--train {self.train} needs at least 1, and goes without --causes.")
