"""Agents that packages beside this one offer: found by name, run by worker processes, and refused in one sentence."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from imagine_bench import registry
from imagine_bench.cli import main
from imagine_bench.errors import SetupError
from imagine_bench.registry.machine import versions
from imagine_bench.store.bench_folder import newest_bench

_MODULE = '''
from imagine_bench.interfaces import AgentState
from imagine_bench.registry import AgentEntry


class Constant:
    """Always the same action."""

    settings = None

    def __init__(self, context):
        self.seen = 0

    def act(self, observation, *, explore):
        return 2

    def observe(self, transition, *, episode):
        self.seen += 1

    def diagnostics(self):
        return {"real_transitions": self.seen}

    def state(self):
        return AgentState(arrays={}, values={"seen": self.seen})

    def restore(self, state):
        self.seen = state.values["seen"]


ENTRY = AgentEntry(make="their_package:Constant", needs_encoder=False, title="Theirs", description="One action.")
'''

Install = Callable[[str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Puts a package on the path that offers what it is told: ``"their_agent = their_package:ENTRY"``, line by line."""
    site = tmp_path / "site"
    facts = site / "their_package-1.2.dist-info"
    facts.mkdir(parents=True)
    (site / "their_package.py").write_text(_MODULE)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.2\n")
    monkeypatch.syspath_prepend(site)
    monkeypatch.delitem(sys.modules, "their_package", raising=False)  # that of another test

    def write(point: str) -> None:
        (facts / "entry_points.txt").write_text(f"[{registry.AGENT_GROUP}]\n{point}\n")
        registry.offers.cache_clear()

    yield write
    registry.offers.cache_clear()


def test_a_packages_agent_is_compared_like_one_of_ours(
    install: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "their_agent" not in registry.agents()
    install("their_agent = their_package:ENTRY")
    assert main(["list"]) == 0
    assert "their_agent" in capsys.readouterr().out
    words = ["bench", "--task", "arrow_puzzle", "--preset", "smoke", "--execution", "kinematic", "--workers", "1"]
    size = ["--agents", "their_agent", "--budgets", "2", "--evaluation-episodes", "2"]
    assert main([*words, *size, "--out", str(tmp_path / "runs")]) == 0
    folder = newest_bench(tmp_path / "runs")
    noted = json.loads((folder / "environment.json").read_text())["versions"]["their-package"]
    assert re.fullmatch(r"1\.2\+[0-9a-f]{8}", noted) and versions()["their-package"] == noted
    assert "Theirs" in (folder / "report" / "index.html").read_text()
    metrics = (folder / "their_agent/seed_0/metrics.csv").read_text().splitlines()
    row = dict(zip(metrics[0].split(","), metrics[-1].split(","), strict=True))
    assert float(row["diagnostics/real_transitions"]) == float(row["env_steps"]) > 0
    install("other = their_package:ENTRY")
    assert main(["report", str(folder)]) == 0, "what was measured can be read without the package"
    said = capsys.readouterr().out
    assert "Not installed here: agent their_agent. What follows from their code is not shown." in said
    assert re.search(r"^their agent +\d", said, re.MULTILINE)
    assert main([*words, *size, "--out", str(tmp_path / "runs")]) == 2
    assert "No agent 'their_agent'" in capsys.readouterr().err


def test_sources_that_changed_are_another_version(install: Install, tmp_path: Path) -> None:
    install("their_agent = their_package:ENTRY")
    before, module = versions()["their-package"], tmp_path / "site" / "their_package.py"
    module.write_text(_MODULE.replace("return 2", "return 3"))
    assert versions()["their-package"] != before
    module.write_text(_MODULE)
    assert versions()["their-package"] == before


@pytest.mark.parametrize(
    ("point", "name", "sentence"),
    [
        ("dqn = their_package:ENTRY", "their-package:dqn", "as agent dqn, a name that is taken; give it another"),
        ("ensemble = their_package:ENTRY", "their-package:ensemble", "as agent ensemble, a name that is taken"),
        ("mine = their_package:NONE", "mine", "offers their_package:NONE as agent mine, which cannot be loaded (Attri"),
        ("mine = no_package:ENTRY", "mine", "which cannot be loaded (ModuleNotFoundError: No module named 'no_package"),
        ("mine = their_broken:ENTRY", "mine", "which cannot be loaded (ZeroDivisionError: division by zero)"),
        ("mine = their_package:Constant", "mine", "which is <class 'their_package.Constant'> and no AgentEntry"),
    ],
)
def test_an_offer_that_is_no_agent_costs_nobody_anything(
    install: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str], point: str, name: str, sentence: str
) -> None:
    (tmp_path / "site" / "their_broken.py").write_text("1 / 0")
    install(f"{point}\nfine = their_package:ENTRY")
    assert versions()["their-package"].startswith("1.2+"), "what is broken can still be named"
    assert registry.agent_entry("dqn") is registry.AGENTS["dqn"] and registry.agent_entry("fine").title == "Theirs"
    with pytest.raises(SetupError, match=r"^The package their-package offers ") as caught:
        registry.agent_entry(name)
    assert sentence in str(caught.value)
    assert main(["list"]) == 0
    said = capsys.readouterr().out
    assert sentence in said and "fine" in said
