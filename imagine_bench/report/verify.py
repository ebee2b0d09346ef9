"""Verification of a bench: its runs are played again, and the tables of its report are computed anew."""

from __future__ import annotations

import dataclasses
import re
from itertools import zip_longest
from pathlib import Path

from imagine_bench.errors import brief
from imagine_bench.judge.verify import Verdict, verify_runs
from imagine_bench.report.bench import bench_page
from imagine_bench.report.page import texts
from imagine_bench.store.loading import load_so_far

_LINES = {"report.md": r"^\|.*$", "index.html": r"<t[dh][^>]*>(.*?)</t[dh]>"}
"""What is compared of a report's pages: the cells of their tables; of other files it is every line."""


def verify(folder: Path) -> list[Verdict]:
    """One verdict a run of the bench in ``folder`` and, where all runs hold, one on its report.

    Raises:
        ArtefactError: It is no bench of agents with folders of their own, or its protocol is damaged.
    """
    return with_report(folder, verify_runs(folder))


def with_report(folder: Path, runs: list[Verdict]) -> list[Verdict]:
    """The verdicts on the runs of a bench and, where all hold, one on its report."""
    if any(each.complaint for each in runs) or not (folder / "report").is_dir():
        return runs
    return [*runs, Verdict(what="report", complaint=_report_complaint(folder))]


def _report_complaint(folder: Path) -> str:
    """The first line of the report's tables that does not follow from the runs; empty if all do."""
    page = bench_page(load_so_far(folder))
    bare = dataclasses.replace(page, sections=[dataclasses.replace(each, images=()) for each in page.sections])
    for name, text in texts(bare).items():
        path = folder / "report" / name
        pattern = re.compile(_LINES.get(name, "^.*$"), re.MULTILINE)
        there = pattern.findall(path.read_text()) if path.is_file() else []
        for has, wanted in zip_longest(there, pattern.findall(text), fillvalue="nothing"):
            if has != wanted:
                return f"{name} has {brief(has)} where the runs give {brief(wanted)}."
    return ""
