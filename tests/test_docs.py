"""Documents: links lead somewhere, and the commands that pages name could be carried out."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
import tyro

from imagine_bench.cli import Bench, Command
from imagine_bench.registry import REGRESSIONS, TASKS

ROOT = Path(__file__).parents[1]
WRITTEN = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
KEPT = sorted((ROOT / "docs" / "results").rglob("*.md"))
COMMAND = re.compile(r"(?:^|`)imagine-bench ([a-z]+ [^`\n#]+)", re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Those that a page's headings have in the usual viewers."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*WRITTEN, *KEPT], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]+))?\)", page.read_text()):
        there = page.parent / target if target else page
        assert there.exists(), f"{page} links to {target}"
        assert not anchor or anchor in anchors(there), f"{page} links to {target}#{anchor}"


def test_commands_could_be_carried_out() -> None:
    """Options, tasks, agents and settings that pages name exist, and every bench could be begun."""
    named = [(page.name, words) for page in WRITTEN for words in COMMAND.findall(page.read_text())]
    benches = 0
    for page, words in named:
        try:
            command = tyro.cli(Command, args=shlex.split(words), config=(tyro.conf.OmitArgPrefixes,))
        except SystemExit:
            pytest.fail(f"{page} names a command that is not understood: imagine-bench {words}")
        assert getattr(command, "task", None) in (None, "my_task", *TASKS, *REGRESSIONS), f"{page}: {words}"
        if isinstance(command, Bench) and not str(command.encoder).endswith(".safetensors"):
            command.planned()
            benches += 1
    assert benches > 20


def test_kept_numbers_are_what_every_json_reader_can_read() -> None:
    files = sorted((ROOT / "docs" / "results").rglob("*.json"))
    assert len(files) > 100
    for file in files:
        json.loads(file.read_text(), parse_constant=lambda word, file=file: pytest.fail(f"{file} holds {word}"))
