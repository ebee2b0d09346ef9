"""The one writer of reports, for benches, judgements, sweeps and chapter 4: data, tables, figures, page."""

from __future__ import annotations

from pathlib import Path

from imagine_bench.report.bench import bench_page
from imagine_bench.report.page import write_page
from imagine_bench.store.results import BenchResult

__all__ = ["bench_page", "summary_table", "write_page", "write_report"]


def write_report(result: BenchResult) -> Path:
    """Write ``result.folder / "report"``: index.html, whose path is returned, CSV files and images.

    Raises:
        SetupError: The folder cannot be written.
    """
    return write_page(result.folder / "report", bench_page(result))


def summary_table(result: BenchResult) -> str:
    """Success (%) of every agent at every budget, and the verdict, as plain text."""
    return bench_page(result).summary
