"""Writing a report: one self-contained page, the same as Markdown, its CSV files and its images."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from imagine_bench.report.tables import Page, markdown_text
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
        loader=jinja2.PackageLoader("imagine_bench.report"),
        autoescape=lambda name: str(name).endswith(".html.j2"),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["md"] = markdown_text
    environment.filters["base64"] = lambda png: base64.b64encode(png).decode()
    pages = {"report.md": "page.md.j2", "index.html": "page.html.j2"}
    rendered = {name: environment.get_template(template).render(page=page) for name, template in pages.items()}
    return {**page.files, **rendered}


def made(result: Any, titles: Mapping[str, str]) -> dict[str, Any]:
    """How a result of any kind was made: the fields ``facts``, ``settings`` and ``protocol`` of a Page.

    ``titles`` are those of its learners. All seeds of one have the same settings.
    """
    protocol = result.protocol
    environment = result.environment
    commit = str(environment.get("commit") or "").split("+")[0]
    where = f"git checkout {commit} && " if commit else ""
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
    }


def flat(prefix: str, value: object) -> list[tuple[str, str]]:
    """Nested values as rows of dotted name and text."""
    if isinstance(value, list | tuple) and any(isinstance(each, Mapping) for each in value):
        value = dict(enumerate(value, 1))
    if isinstance(value, Mapping):
        return [row for key, each in value.items() for row in flat(f"{prefix}.{key}" if prefix else str(key), each)]
    return [(prefix, "; ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))]
