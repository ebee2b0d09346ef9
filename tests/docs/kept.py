"""Files of docs/results, each read once."""

from __future__ import annotations

import csv
import functools
import json
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.exact.certificate import Certificate, certificate

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"


@functools.cache
def table(path: str) -> list[dict[str, str]]:
    """The rows of a kept CSV file."""
    with (RESULTS / path).open() as file:
        return list(csv.DictReader(file))


@functools.cache
def facts(path: str) -> Any:
    """The content of a kept JSON file."""
    return json.loads((RESULTS / path).read_text())


@functools.cache
def certificate_of(task: str) -> Certificate:
    return certificate(registry.task(task))
