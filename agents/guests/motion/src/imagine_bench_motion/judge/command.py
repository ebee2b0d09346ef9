"""The command ``python -m imagine_bench_motion judge``."""

from __future__ import annotations

import argparse
from pathlib import Path

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, RunFailedError
from imagine_bench.running.launchers.jobs import at_a_time
from imagine_bench.store.files import table_text, write_bytes

from .interface import motion_models
from .judgement import CHAINS, PAIRS, SEEDS, SIZES, MotionJudgement, judge, judged
from .report import motion_rows, motion_tables


def add_judge(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("task", help="a task of continuous control, such as ArrowPuzzleMotion")
    parser.add_argument("--models", nargs="+", default=list(motion_models()), help="by default all that are installed")
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES), help="motions to learn from, ascending")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS), help="each of data and of models")
    parser.add_argument("--pairs", type=int, default=PAIRS, help="counterfactual pairs to ask about")
    parser.add_argument("--chains", type=int, default=CHAINS, help="chains of motions to ask about")
    parser.add_argument("--workers", type=int, help="processes at a time; one a core by default")
    parser.add_argument("--out", type=Path, default=Path("runs/judge"), help="the same command again goes on there")
    parser.set_defaults(run=_judge)


def _judge(given: argparse.Namespace) -> None:
    task = registry.task_of_motion(given.task)
    if task is None:
        raise InvalidValueError(
            f"{given.task} is no task of continuous control; give one such as ArrowPuzzleMotion or PickPlaceMotion."
        )
    judgement = MotionJudgement(
        task=task,
        models=tuple(given.models),
        sizes=tuple(given.sizes),
        seeds=tuple(given.seeds),
        pairs=given.pairs,
        chains=given.chains,
    )
    folder, failed = judge(judgement, given.out, workers=at_a_time(given.workers))
    cells = judged(judgement, folder)
    if cells:
        write_bytes(folder / "motions.csv", table_text(motion_rows(cells)).encode())
        for table in motion_tables(judgement, cells):
            print(f"{table.text}\n\n{table.remark}\n")
        print(f"Each row: {folder / 'motions.csv'}")
    if failed:
        raise RunFailedError("\n".join(failed))
