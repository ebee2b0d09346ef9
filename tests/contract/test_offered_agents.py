"""Agents that packages beside this one offer: found by name, run by worker processes, and refused in one sentence."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_fakes import Pupil
from guest_packages import Guests
from numpy.typing import NDArray
from small_runs import benched, collected, context, do, written

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import SetupError
from imagine_bench.interfaces import Observation
from imagine_bench.registry.machine import versions
from imagine_bench.running.collect import Policy, collect
from imagine_bench.store.bench_folder import newest_bench
from imagine_bench.store.run_folder import load_run

_ONE = {registry.AGENT_GROUP: {"their_agent": "their_package:ENTRY"}}
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


@pytest.fixture
def site(guests: Guests) -> Path:
    """The folder of a package that offers one agent."""
    return guests.write("their_package", _MODULE, _ONE)


def test_a_packages_agent_is_compared_like_one_of_ours(
    guests: Guests, site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["list"]) == 0
    assert "their_agent" in capsys.readouterr().out
    few = "--preset smoke --execution kinematic --workers 1 --budgets 2 --evaluation-episodes 2"
    words = ["bench", "arrow_puzzle", "--agents", "their_agent", *few.split(), "--out", str(tmp_path / "runs")]
    assert main(words) == 0
    folder = newest_bench(tmp_path / "runs")
    noted = json.loads((folder / "sessions.json").read_text())["environment"]["versions"]["their_package"]
    assert re.fullmatch(r"1\.2\+[0-9a-f]{8}", noted) and versions()["their_package"] == noted
    assert "their_agent" in (folder / "report" / "index.html").read_text()
    row = load_run(folder / "their_agent" / "seed_0").checkpoints[-1]
    assert row.diagnostics["real_transitions"] == row.env_steps > 0
    guests.offer(site, {})
    assert main(["report", str(folder)]) == 0, "results can be read without the package"
    said = capsys.readouterr().out
    assert "Not installed here: agent their_agent. Numbers that need missing code are not shown." in said
    assert re.search(r"^their_agent +\d", said, re.MULTILINE)
    assert main(words) == 2
    assert "No agent 'their_agent'" in capsys.readouterr().err


def test_sources_that_changed_are_another_version(site: Path) -> None:
    before = versions()["their_package"]
    module = site / "their_package.py"
    module.write_text(_MODULE.replace("return 2", "return 3"))
    assert versions()["their_package"] != before
    module.write_text(_MODULE)
    assert versions()["their_package"] == before


_LOADED = "which cannot be loaded "


@pytest.mark.parametrize(
    ("point", "target", "asked", "sentence"),
    [
        ("dqn", "their_package:ENTRY", "their_package:dqn", "as agent dqn, a name that is taken; give it another"),
        ("mine", "their_package:NONE", "mine", f"offers their_package:NONE as agent mine, {_LOADED}(AttributeError"),
        ("mine", "no_package:ENTRY", "mine", f"{_LOADED}(ModuleNotFoundError: No module named 'no_package"),
        ("mine", "their_broken:ENTRY", "mine", f"{_LOADED}(ZeroDivisionError: division by zero)"),
        ("mine", "their_package:Constant", "mine", "which is <class 'their_package.Constant'> and no AgentEntry"),
    ],
)
def test_an_offer_that_is_no_agent_costs_nobody_anything(
    guests: Guests, site: Path, capsys: pytest.CaptureFixture[str], point: str, target: str, asked: str, sentence: str
) -> None:
    (site / "their_broken.py").write_text("1 / 0")
    guests.offer(site, {registry.AGENT_GROUP: {point: target, "fine": "their_package:ENTRY"}})
    assert versions()["their_package"].startswith("1.2+"), "a broken agent can still be named"
    assert registry.agent_entry("dqn") is registry.AGENTS["dqn"] and registry.agent_entry("fine").title == "Theirs"
    with pytest.raises(SetupError, match=r"^The package their_package offers ") as caught:
        registry.agent_entry(asked)
    assert sentence in str(caught.value)
    assert main(["list"]) == 0
    said = capsys.readouterr().out
    assert sentence in said and "fine" in said


def test_a_name_is_that_of_one_of_two_packages(guests: Guests) -> None:
    for package in ("their_one", "their_other"):
        module = _MODULE.replace("their_package", package)
        guests.write(package, module, {registry.AGENT_GROUP: {"mine": f"{package}:ENTRY"}})
    keeps = str(registry.agent_entry("mine").make).partition(":")[0]
    (loses,) = {"their_one", "their_other"} - {keeps}
    with pytest.raises(SetupError, match=f"The package {loses} offers .* as agent mine, a name that is taken"):
        registry.agent_entry(f"{loses}:mine")


def arrays_in(value: object) -> Iterator[NDArray[np.generic]]:
    """Every array that somebody is handed within dataclasses, mappings and sequences."""
    if isinstance(value, np.ndarray):
        yield value
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from arrays_in(getattr(value, field.name))
    elif isinstance(value, Mapping | list | tuple):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from arrays_in(part)


def a_pupil(tmp_path: Path, agent: str, **protocol: Any) -> object:
    """All that an agent was shown in a run, in training and in tests."""
    do(tmp_path / "run", agent=agent, **protocol)
    pupil = Pupil.made[-1]
    return [pupil.seen, pupil.shown]


def of_dataset(tmp_path: Path) -> object:
    written(tmp_path / "set")
    changes = {"seeds": (0,), "dataset": tmp_path / "set", "appearance": "mild", "evaluation_episodes": 1}
    benched(tmp_path / "runs", "arrow_puzzle", "pupil", **changes)
    return Pupil.made[-1].shown


def who_collects(_: Path) -> object:
    pupil = Pupil(context())
    policy = Policy(name="pupil", players=[(pupil, True)], facts={})
    collect(registry.task("arrow_puzzle"), policy, episodes=1, seed=0, execution="kinematic", appearance="clean")
    return pupil.seen


HANDED: dict[str, Callable[[Path], object]] = {
    "an agent": lambda path: a_pupil(path, "pupil", queries=2),
    "an agent that watches demonstrations": lambda path: a_pupil(path, "pupil", demonstrations=4),
    "an agent shown more than frames": lambda _: Observation(frame=np.zeros(3, np.uint8), more={"state": np.zeros(3)}),
    "a privileged agent": lambda path: a_pupil(path, "pupil_privileged"),
    "a learner of a dataset": of_dataset,
    "a policy that collects": who_collects,
    "a world model": lambda _: [collected()[0], collected()[0].first(5)],
    "a regressor": lambda _: registry.regression("toy_regression").training("base", np.random.default_rng(0)),
}


@pytest.mark.parametrize("who", HANDED)
def test_nobody_can_write_to_what_is_handed_out(tmp_path: Path, who: str) -> None:
    handed = list(arrays_in(HANDED[who](tmp_path)))
    assert len(handed) >= 2
    for array in handed:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
