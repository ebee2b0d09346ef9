"""A bench's metrics for TensorBoard and, offline, for Weights & Biases; extra ``tracking``.

Read from the ``metrics.csv`` of each run, which has a row for every budget tested so far: also while the bench runs.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from imagine_bench.errors import InvalidValueError, lacking, require_known
from imagine_bench.store.codec import table_rows
from imagine_bench.store.files import make_folder

_METRICS = "metrics.csv"
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
        SetupError: The tool is not installed.
    """
    write = TOOLS[require_known("tracking tool", tool, TOOLS)]
    runs = {path.parent.relative_to(folder): path for path in sorted(folder.glob(f"*/seed_*/{_METRICS}"))}
    if not runs:
        raise InvalidValueError(f"No run in {folder} has been tested yet; give the folder of a bench.")
    if not all(path.read_text().startswith("episodes,") for path in runs.values()):
        raise InvalidValueError(f"{folder} compares no agents by training episodes; give the folder of such a bench.")
    out = folder / tool
    shutil.rmtree(out, ignore_errors=True)
    for run, path in runs.items():
        write(make_folder(out), run, [_scalars(row) for row in table_rows(path.read_text(), ("solved",))])
    return out


def _scalars(row: dict[str, float]) -> dict[str, float]:
    """The numbers of a row and the success rate in [0, 1]."""
    rate = row["successes"] / row["test_episodes"]
    return {"success_rate": rate, **{name: float(value) for name, value in row.items() if name != "solved"}}


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
        written.log({name: value for name, value in row.items() if name != "episodes"}, step=int(row["episodes"]))
    written.finish()
    wandb.teardown()  # ends its service, which writes the files


TOOLS: dict[str, Callable[[Path, Path, Rows], None]] = {"tensorboard": _tensorboard, "wandb": _wandb}
