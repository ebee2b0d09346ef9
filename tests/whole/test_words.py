"""The words of the command line: what it lists, how it describes things, and its answers to wrong words.

The figures of described worlds are computed otherwise in ``tests/exact`` and by hand below; the numbers of settings
beside the thesis' own in ``tests/agents/test_settings.py``.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from imagine_bench.agents.baselines import RandomAgent
from storms import one_sentence
from whole_outputs import Expected, questions

import imagine_bench
from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ImagineBenchError
from imagine_bench.interfaces import APPEARANCES, EXECUTIONS
from imagine_bench.running.bench import task_types
from imagine_bench.running.launchers.jobs import LAUNCHERS
from imagine_bench.store.encoders import bundled
from imagine_bench.sweep.grid import GRIDS
from imagine_bench.tools.describe import describe

WORLDS = {"arrow_puzzle_hard": 180, "arrow_puzzle_easy": 4, "arrows:slip=0.1,lag=1": 165, "ArrowPuzzleMotion": 165}
"""Described worlds, and the macrostates that come up: 3 x (4 x 3 x 2) legal ones and those with which episodes end."""
SEVERAL = {**WORLDS, "toy_regression": 0, "robot_ik": 0}


@pytest.fixture(autouse=True)
def _ours_alone(own_names: None) -> None:
    """Agents that other tests have registered in this process are not listed."""
    for entries in (registry.AGENTS, registry.WORLD_MODELS):
        for name in [name for name, entry in entries.items() if not entry.make.startswith("imagine_bench")]:
            del entries[name]


def test_list(expected: Expected, capsys: pytest.CaptureFixture[str]) -> None:
    """Everything has a line of its own."""
    assert main(["list"]) == 0
    listed = capsys.readouterr().out
    names = {line.split()[0] for line in listed.splitlines() if line.startswith("  ")}
    for kind in task_types().values():
        assert names >= {*kind.tasks(), *kind.learners(), *kind.presets}
    assert names >= {*GRIDS, *EXECUTIONS, *LAUNCHERS, *APPEARANCES, *registry.WORLD_MODELS, *bundled()}
    assert main(["describe"]) == 0
    assert capsys.readouterr().out == listed
    expected("list", listed)


@pytest.mark.parametrize("name", SEVERAL)
def test_described_worlds(name: str, expected: Expected) -> None:
    page = describe(name)
    assert not WORLDS.get(name) or f"\nmacrostates     {WORLDS[name]} can come up" in page
    expected(f"describe_{re.sub('[^a-zA-Z]+', '_', name)}", page)


def learners() -> dict[str, object]:
    return {**registry.agents(), **registry.world_models(), **registry.regressors()}


def test_described_learners(expected: Expected) -> None:
    """Each with its settings in all presets, but for those lines that the one before it has too."""
    before: set[str] = set()
    pages = []
    for name in learners():
        if ":ARGUMENT" in name:
            continue
        head, _, settings = describe(name).partition("\nSettings of")
        each = re.split(r"\n(?=  \S)", settings)
        new = [text for text in each[1:] if text not in before]
        before |= set(each)
        pages.append("\n".join([f"$ describe {name}", head.rstrip(), each[0], *new, f"({len(each) - 1} settings)"]))
    expected("describe_learners", "\n\n".join(pages))


@pytest.mark.parametrize("which", ["wrong_words", "wrong_benches"])
def test_answers_to_wrong_words(
    which: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], expected: Expected
) -> None:
    """One line each, exit code 2, and nothing is written; the words stand in the kept file, HERE is an empty folder."""
    answers = []
    for words in questions(which):
        code = main([word.replace("HERE", str(tmp_path)) for word in words.split()])
        said = capsys.readouterr()
        assert (code, said.out, len(said.err.splitlines())) == (2, "", 1), words
        answers += [f"$ {words}", said.err.replace(str(tmp_path), "HERE")]
    assert not list(tmp_path.iterdir())
    expected(which, "\n".join(answers))


def test_answers_to_wrong_keywords(tmp_path: Path, expected: Expected) -> None:
    """Of the Python API; a line of the kept file is a function with its keywords as JSON."""
    usual: dict[str, dict[str, Any]] = {
        "bench": {"task": "arrow_puzzle", "out": tmp_path},
        "register_agent": {"name": "mine", "make": RandomAgent},
    }
    answers = []
    for call in questions("wrong_keywords"):
        name, _, given = call.partition(" ")
        with pytest.raises(ImagineBenchError) as caught:
            getattr(imagine_bench, name)(**{**usual[name], **json.loads(given)})
        answers += [f"$ {call}", one_sentence(caught.value), ""]
    assert not list(tmp_path.iterdir())
    expected("wrong_keywords", "\n".join(answers))
