"""The report of a bench: one self-contained page, the same as Markdown, CSV and PNG, and a table for the terminal."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from imagine_bench.report import figures, text
from imagine_bench.report.data import ReportData, collect, open_loop_csv, summary_csv
from imagine_bench.report.sections import causes, certificate, imagination, policy, success
from imagine_bench.report.tables import Page, Section
from imagine_bench.report.text import agent_words, percent, score_text
from imagine_bench.store.archive import archive_files
from imagine_bench.store.files import make_folder, sweep, write_bytes
from imagine_bench.store.results import BenchResult


def write_report(result: BenchResult) -> Path:
    """Write ``result.folder / "report"``: index.html, report.md, the CSV files and the images.

    Returns the path of index.html.

    Raises:
        SetupError: The folder cannot be written.
    """
    return write_page(result.folder / "report", report_page(result))


def report_page(result: BenchResult) -> Page:
    """The report. Everything comes from ``result`` (and the bundled encoder's card), so it is the same every time."""
    data = collect(result)
    files = {**archive_files(result), "summary.csv": summary_csv(data)}
    if data.open_loop:
        files["open_loop.csv"] = open_loop_csv(result)
    protocol, agents = result.protocol, result.protocol.agents
    return Page(
        title=f"{data.spec.title}: does imagination save real experience?",
        subtitle=f"Preset {protocol.preset} · {protocol.execution} execution · appearance “{protocol.looks}” · "
        f"{f'trained first on dataset {protocol.dataset} · ' if protocol.dataset else ''}"
        f"{f'tests start where training never does, {protocol.split} · ' if protocol.split else ''}"
        f"protocol {result.protocol_hash}",
        question=text.question(data),
        answers=text.answers(data),
        sections=_sections(data),
        files=files,
        colors={agent_words(agent).title: figures.color(agent) for agent in agents},
        **made(result, {agent: agent_words(agent).title for agent in agents}),
    )


def _sections(data: ReportData) -> list[Section]:
    parts = [success.compared(data), success.success(data, _interval_words(data))]
    parts += [certificate.world(data.result.certificate)] if data.result.certificate is not None else []
    parts += [success.area(data)] if data.areas else []
    parts += [success.gain(data)] if data.comparisons else []
    parts += [policy.policies(data, led)] if (led := policy.followed(data)) else []
    parts += [causes.causes(found)] if (found := causes.read_failures(data.result.folder)) else []
    parts += imagination.sections(data)
    parts += [success.threshold(data)] if data.reached else []
    return [*parts, success.cost(data)]


def write_page(folder: Path, page: Page) -> Path:
    """Write a report: index.html, whose path is returned, report.md, the page's CSV files and images.

    Raises:
        SetupError: The folder cannot be written.
    """
    files = {name: content.encode() for name, content in texts(page).items()}
    files |= {f"{image.name}.png": image.png for section in page.sections for image in section.images}
    sweep(make_folder(folder), older_than_s=3600.0)  # another may write the same report
    for name, content in files.items():
        write_bytes(folder / name, content)
    return folder / "index.html"


def texts(page: Page) -> dict[str, str]:
    """The files of a report, by name, but for its images."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("imagine_bench.report"), autoescape=lambda name: str(name).endswith(".html.j2"),
        trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    environment.filters |= {"md": markdown_text, "code": markdown_code}
    pages = {"report.md": "page.md.j2", "index.html": "page.html.j2"}
    rendered = {name: environment.get_template(template).render(page=page) for name, template in pages.items()}
    return {**page.files, **rendered}


def markdown_text(value: object) -> str:
    """A text as Markdown shows it unchanged: in a line, its special characters escaped."""
    return re.sub(r"([\\`*_<>|&~]|^#|(?<=\])(?=\())", r"\\\1", " ".join(str(value).split()))


def markdown_code(value: object) -> str:
    """A text as code in a line of Markdown, unchanged, whatever backticks it has."""
    text = " ".join(str(value).split())
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence} {text} {fence}" if len(fence) > 1 else f"{fence}{text}{fence}"


def summary_table(result: BenchResult) -> str:
    """Success (%) of every agent at every budget as plain text, chance level, optimum and thesis beside them."""
    data = collect(result)
    protocol = result.protocol
    rows = [["real episodes", "chance", *(agent_words(agent).title for agent in protocol.agents), "optimum"]]
    for budget in data.budgets:
        cells = [score_text(data.scores[agent][budget]) for agent in protocol.agents]
        rows.append([f"{budget:,}", percent(data.facts.chance_level), *cells, percent(data.facts.optimum)])
        if any(budget in printed for printed in data.thesis.values()):
            rows.append(_thesis_row(data, budget, "  thesis"))
    beyond = [budget for budget in success.thesis_only(data) if budget > data.budgets[-1]]
    if beyond:
        rows.append(_thesis_row(data, beyond[0], f"thesis at {beyond[0]:,}"))
    title = (
        f"{data.spec.title}: test episodes solved, % [{_interval_words(data)}]; preset {protocol.preset}, "
        f"{protocol.execution}, {protocol.looks}, {len(protocol.seeds)} seed(s) x "
        f"{protocol.evaluation_episodes} test episodes"
        f"{f'; trained first on dataset {protocol.dataset}' if protocol.dataset else ''}"
    )
    return "\n".join([title, "", *aligned(rows), "", *text.paired_answers(data), "", *text.answers(data)])


def _thesis_row(data: ReportData, budget: int, name: str) -> list[str]:
    printed = [data.thesis.get(agent, {}).get(budget) for agent in data.result.protocol.agents]
    return [name, "", *(success.thesis_text(each) if each else "" for each in printed), ""]


def aligned(rows: list[list[str]]) -> list[str]:
    """Columns padded to the width of their widest cell, the first to the left and the others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip())
    return [lines[0], "-" * max(len(line) for line in lines), *lines[1:]]


def _interval_words(data: ReportData) -> str:
    if len(data.result.protocol.seeds) == 1:
        return "95 % interval over test episodes only (Wilson; one seed says nothing about the luck of training)"
    return "95 % interval over seeds (Student's, of the trimmed mean)"


def made(result: Any, titles: Mapping[str, str]) -> dict[str, Any]:
    """How a result of any kind was made: the fields ``facts``, ``settings``, ``protocol`` and ``recordings`` of a Page.

    ``titles`` are those of its learners. All seeds of one have the same settings.
    """
    protocol, environment = result.protocol, result.environment
    where = f"git checkout {str(environment['commit']).split('+')[0]} && " if environment.get("commit") else ""
    paths = [run.recording for run in result.runs if run.recording]
    return {
        "facts": [
            ("protocol", f"{result.protocol_hash}, preset {protocol.preset}"),
            ("seeds", ", ".join(str(seed) for seed in protocol.seeds)),
            *flat("", environment),
            ("reproduce", f"{where}{environment.get('command', '')}"),
        ],
        "settings": {title: rows for name, title in titles.items() if (rows := flat("", result.of(name)[0].settings))},
        "protocol": [(name, str(value)) for name, value in protocol.as_dict().items()],
        "recordings": [str(p.relative_to(result.folder) if p.is_relative_to(result.folder) else p) for p in paths],
    }


def flat(prefix: str, value: Any) -> list[tuple[str, str]]:
    """Nested values as rows of dotted name and text."""
    if hasattr(value, "items"):
        return [row for key, inner in value.items() for row in flat(f"{prefix}.{key}" if prefix else str(key), inner)]
    if isinstance(value, list | tuple) and any(hasattr(item, "items") for item in value):
        return [row for count, item in enumerate(value, 1) for row in flat(f"{prefix}.{count}", item)]
    if isinstance(value, list | tuple):
        return [(prefix, "; ".join(str(item) for item in value))]
    return [(prefix, str(value))]
