"""Writing a report: one self-contained page, the same as Markdown, its CSV files and its images."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from imagine_bench import registry
from imagine_bench.registry.machine import describe_environment
from imagine_bench.report.tables import Page
from imagine_bench.running.task_types import task_type
from imagine_bench.running.trained import require_control
from imagine_bench.store.bench_folder import newest_bench, require_either
from imagine_bench.store.files import make_folder, sweep, write_bytes


def write_page(folder: Path, page: Page) -> Path:
    """Write a report: index.html, whose path is returned, report.md, the page's CSV files and images.

    Raises:
        SetupError: The folder cannot be written.
    """
    sweep(make_folder(folder), older_than_s=3600.0)  # another may write the same report
    files = {name: content.encode() for name, content in texts(page).items()}
    files |= {f"{image.name}.png": image.png for section in page.sections for image in section.images}
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


def made(result: Any, titles: Mapping[str, str]) -> dict[str, Any]:
    """How a result of any kind was made: the fields ``facts``, ``settings``, ``protocol`` and ``recordings`` of a Page.

    ``titles`` are those of its learners. All seeds of one have the same settings.
    """
    protocol = result.protocol
    environment = result.environment
    commit = str(environment.get("commit") or "").split("+")[0]
    where = f"git checkout {commit} && " if commit else ""
    paths = [run.recording for run in result.runs if run.recording]
    settings = {title: flat("", result.of(name)[0].settings) for name, title in titles.items()}
    return {
        "facts": [
            ("protocol", f"{result.protocol_hash}, preset {protocol.preset}"),
            ("seeds", ", ".join(map(str, protocol.seeds))),
            *flat("", environment),
            ("reproduce", f"{where}{environment.get('command', '')}"),
        ],
        "settings": {title: rows for title, rows in settings.items() if rows},
        "protocol": [(name, str(value)) for name, value in protocol.as_dict().items()],
        "recordings": [str(p.relative_to(result.folder) if p.is_relative_to(result.folder) else p) for p in paths],
    }


def flat(prefix: str, value: object) -> list[tuple[str, str]]:
    """Nested values as rows of dotted name and text."""
    if isinstance(value, Mapping):
        inner = {str(key): each for key, each in value.items()}
    elif isinstance(value, list | tuple) and any(isinstance(each, Mapping) for each in value):
        inner = {str(place): each for place, each in enumerate(value, 1)}
    else:
        return [(prefix, "; ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))]
    return [row for key, each in inner.items() for row in flat(f"{prefix}.{key}" if prefix else key, each)]


def chosen(given: Path | None, root: Path, task: str | None) -> Path:
    """What was given, or else the newest bench of a task in which agents act, or of all such tasks.

    Raises:
        ImagineBenchError: Both are given, or there is no such bench.
    """
    require_either(given, task)
    if task is not None:
        task_type(task)  # knows every name
        require_control(task, f"Task {task!r}")
    return given or newest_bench(root, *(registry.tasks() if task is None else (task,)))


def provenance(protocol_hash: str) -> dict[str, object]:
    """Protocol, commit and command of a figure."""
    environment = describe_environment()
    return {"protocol_hash": protocol_hash, "commit": environment.get("commit"), "command": environment.get("command")}


def origin(facts: Mapping[str, object]) -> str:
    """Where the figures of a page come from: ``protocol hash 6bf1d791349c; commit c9d5ec664788.`` and so on."""
    return "; ".join(f"{name.replace('_', ' ')} {value}" for name, value in facts.items()) + "."
