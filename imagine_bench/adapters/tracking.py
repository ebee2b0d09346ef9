"""A bench's metrics for TensorBoard and, offline, for Weights & Biases; extra ``tracking``.

Read from the ``metrics.csv`` of each run, which has a row for every budget tested so far: also while the bench runs.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from imagine_bench.errors import InvalidValueError, lacking, require_known
from imagine_bench.store import run_folder
from imagine_bench.store.files import make_folder, reading, table_rows

Rows = list[dict[str, float]]


def track(folder: Path, tool: str) -> Path:
    """Write the metrics of every run of a bench anew, by real training episodes.

    Args:
        folder: The bench's.
        tool: A name in :data:`TOOLS`.

    Returns:
        The folder inside it to open: ``tensorboard --logdir`` it, or ``wandb sync`` the runs in it.

    Raises:
        UnknownNameError: Another tool.
        InvalidValueError: No run there has been tested, or it is a bench of regressors.
        ArtefactError: A table is damaged, or a part of a finished run is missing.
        SetupError: The tool is not installed.
    """
    write = TOOLS[require_known("tracking tool", tool, TOOLS)]
    for run in sorted(folder.glob("*/seed_*")):
        if run_folder.is_done(run):
            run_folder.require_done(run)
    runs = {path: path.read_bytes().decode(errors="replace") for path in sorted(folder.glob("*/seed_*/metrics.csv"))}
    if not runs:
        raise InvalidValueError(f"No run in {folder} has been tested yet; give the folder of a bench.")
    if not all(table.startswith("episodes,") for table in runs.values()):
        raise InvalidValueError(f"{folder} compares no agents by training episodes; give the folder of such a bench.")
    out = folder / tool
    shutil.rmtree(out, ignore_errors=True)
    for path, table in runs.items():
        with reading(path, "the table of a run of an agent"):
            rows = table_rows(table, ("solved",))
            for row in rows:
                del row["solved"]
                row["success_rate"] = row["successes"] / row["test_episodes"]
        write(make_folder(out), path.parent.relative_to(folder), rows)
    return out


def _tensorboard(out: Path, run: Path, rows: Rows) -> None:
    try:
        from tensorboard.summary import Writer  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise lacking("tensorboard") from error
    writer = Writer(str(out / run))
    for row in rows:
        for name, value in row.items():
            writer.add_scalar(name, value, int(row["episodes"]))
    writer.close()


def _wandb(out: Path, run: Path, rows: Rows) -> None:
    try:
        import wandb  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise lacking("wandb") from error
    quiet = wandb.Settings(
        console="off", silent=True, x_disable_stats=True, x_disable_meta=True, disable_git=True, save_code=False
    )
    written = wandb.init(
        project=out.parent.name, group=run.parent.name, name=str(run), dir=out, mode="offline", settings=quiet
    )
    for row in rows:
        episodes = row.pop("episodes")
        written.log(row, step=int(episodes))
    written.finish()
    wandb.teardown()  # ends its service, which writes the files


TOOLS: dict[str, Callable[[Path, Path, Rows], None]] = {"tensorboard": _tensorboard, "wandb": _wandb}
