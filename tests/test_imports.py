"""The arrows of the house, by syntax tree: who may import whom, and that nobody draws from a global generator."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

_TOP = Path(__file__).parent.parent
_VOCABULARY = {
    "errors",
    "seeding",
    "appearance",
    "arrays",
    "interfaces",
    "rules",
    "preprocessing",
    "version",
}
"""What every room may import, and all that tasks and agents may take from imagine_bench."""
_DATA = {"registry", "protocols", "store"}
ARROWS: dict[str, set[str]] = {
    "statistics": set(),
    "reference": set(),
    "registry": set(),
    "exact": {"registry"},
    "protocols": {"registry", "exact"},
    "store": {"registry", "protocols", "exact", "statistics"},
    "data": {"registry", "store"},
    "running": {*_DATA, "data", "exact", "statistics"},
    "judge": {*_DATA, "running", "data", "statistics"},
    "recording": {*_DATA, "judge", "running", "report"},
    "sweep": {*_DATA, "running", "judge", "statistics"},
    "report": {*_DATA, "exact", "running", "judge", "sweep", "statistics", "reference"},
    "regression": {*_DATA, "judge", "recording", "report", "statistics", "reference"},
    "adapters": {"registry", "store"},
    "tools": {*_DATA, "exact", "statistics", "running", "data", "sweep"},
    "testing": {*_DATA, "running", "exact", "data", "judge", "statistics"},
    "cli": {
        *_DATA,
        "adapters",
        "data",
        "running",
        "judge",
        "recording",
        "sweep",
        "report",
        "testing",
        "tools",
    },
    "__init__": {"registry", "version"},
    "version": set(),
    "__main__": {"cli"},
}
"""The rooms of imagine_bench, and what each may import beside itself and the vocabulary."""
WITHIN: dict[str, tuple[str, ...]] = {
    "agents/dqn": ("agents/imagination", "agents/factored"),
    "settings": ("networks", "torch"),
}
"""Within agents: a file whose path ends so may import nothing of these."""
_HEAVY = {
    "torch": "agents",
    "mujoco": "tasks",
    "dm_control": "imagine_bench/adapters",
    "dm_env": "imagine_bench/adapters",
    "mink": "tasks",
    "daqp": "tasks",
    "OpenGL": "tasks",
    "pygame": "tasks",
    "rerun": "imagine_bench/recording",
    "pyarrow": "imagine_bench/data",
    "minari": "imagine_bench/data",
}
_EVERYTHING = sorted(path for room in ("imagine_bench", "tasks", "agents") for path in (_TOP / room).rglob("*.py"))
_SOURCES = [path for path in _EVERYTHING if "guests" not in path.relative_to(_TOP).parts]
_GUESTS = sorted((_TOP / "agents" / "guests").glob("*/src/**/*.py"))
_STABLE = frozenset(re.findall(r"`(imagine_bench\.[\w.]+)`", (_TOP / "docs/reference/api.md").read_text()))
"""The modules that docs/reference/api.md lists: those that other packages may import."""
_NUMPY_RANDOM = {"Generator", "SeedSequence", "default_rng", "PCG64", "BitGenerator"}
_TORCH_DRAWS = {"rand", "randn", "randint", "randperm", "bernoulli", "multinomial", "normal", "rand_like", "randn_like"}
_TENSOR_DRAWS = {"normal_", "uniform_", "bernoulli_", "exponential_", "random_", "multinomial"}


def imports(tree: ast.AST, path: Path) -> Iterator[str]:
    """Dotted names imported anywhere in a file, relative ones made absolute by where the file is installed."""
    package = _installed(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            prefix = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{prefix}.{alias.name}" for alias in node.names)


def _installed(path: Path) -> str:
    parts = list(path.relative_to(_TOP).with_suffix("").parts)
    parts = parts[:-1] if parts[-1] == "__init__" else parts
    return ".".join(parts if parts[0] == "imagine_bench" else ["imagine_bench", *parts])


def offences(path: Path, source: str) -> list[str]:
    """Every import and draw of a file that the house forbids."""
    top_room = path.relative_to(_TOP).parts[0]
    tree = ast.parse(source)
    found = []
    for name in imports(tree, path):
        top, *rest = name.split(".")
        owner = _HEAVY.get(top)
        if owner is not None and not path.is_relative_to(_TOP / owner):
            found.append(f"{top} is imported outside of {owner}")
        if top in ("tasks", "agents"):
            found.append(f"{name}: the rooms are installed inside imagine_bench")
        if top_room == "agents":
            found += _within(path, name)
        if top == "imagine_bench" and rest:
            found += _crossing(path, name, rest)
    return found + list(_global_draws(tree))


def _within(path: Path, name: str) -> list[str]:
    """An import of a part of agents that this file may not have."""
    here, there = path.with_suffix("").as_posix(), name.replace(".", "/")
    return [
        f"{name}: {end} may not import {part}"
        for end, parts in WITHIN.items()
        for part in parts
        if here.endswith(end) and f"/{part}/" in f"/{there}/"
    ]


def _crossing(path: Path, name: str, target: list[str]) -> list[str]:
    top_room = path.relative_to(_TOP).parts[0]
    if _is_vocabulary(target) or target[0] == top_room:
        return []
    if top_room != "imagine_bench":
        return [f"{name}: {top_room} may take only {sorted(_VOCABULARY)}"]
    if target[0] in ("tasks", "agents"):
        return [f"{name}: the bench reaches tasks and agents by registry names"]
    room = path.relative_to(_TOP / "imagine_bench").with_suffix("").parts[0]
    if target[0] not in ARROWS:  # a name of the package itself
        return []
    if room not in ARROWS:
        return [f"{room} is a new room; say in ARROWS what it may import"]
    return [] if target[0] in {room, *ARROWS[room]} else [f"{name}: {room} may import only {sorted(ARROWS[room])}"]


def _is_vocabulary(target: list[str]) -> bool:
    return target[0] in _VOCABULARY or ".".join(target[:2]) in _VOCABULARY


def _global_draws(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom) and (
            getattr(node, "module", None) == "random" or any(alias.name == "random" for alias in node.names)
        ):
            yield "the global module random"
        if isinstance(node, ast.Attribute):
            text = ast.unparse(node)
            if text.startswith(("np.random.", "numpy.random.")) and node.attr not in _NUMPY_RANDOM:
                yield f"{text} draws from a global generator"
            if text in ("torch.manual_seed", "torch.seed", "torch.nn.Dropout", "nn.Dropout", "F.dropout"):
                yield f"{text} uses a global generator"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            yield from _undirected(node, node.func)


def guest_offences(path: Path, source: str) -> list[str]:
    """Every import of a guest that the documentation does not list, and every draw from a global generator."""
    tree = ast.parse(source)
    found = [
        f"{name} is not listed in docs/reference/api.md"
        for name in imports(tree, path)
        if name.partition(".")[0] == "imagine_bench"
        and not name.startswith("imagine_bench.agents.guests.")  # of its own package
        and not {name, name.rpartition(".")[0]} & _STABLE
    ]
    return found + list(_global_draws(tree))


def _undirected(call: ast.Call, function: ast.Attribute) -> Iterator[str]:
    """Draws that name no generator."""
    directed = any(keyword.arg == "generator" for keyword in call.keywords)
    text = ast.unparse(function)
    if text == "np.random.default_rng" and not call.args:
        yield "default_rng() without a seed"
    from_torch = text.startswith("torch.") and function.attr in _TORCH_DRAWS
    if (from_torch or function.attr in _TENSOR_DRAWS) and not directed:
        yield f"{text} without a generator"


def test_the_arrows_go_one_way() -> None:
    order = list(TopologicalSorter(ARROWS).static_order())
    assert order.index("store") < order.index("running") < order.index("cli")
    house = _TOP / "imagine_bench"
    rooms = {path.relative_to(house).parts[0] for path in _SOURCES if path.is_relative_to(house)}
    assert {room.removesuffix(".py") for room in rooms} <= {*ARROWS, *_VOCABULARY}, "a room is missing in the table"


@pytest.mark.parametrize("path", _SOURCES, ids=lambda path: str(path.relative_to(_TOP)))
def test_the_arrows_hold(path: Path) -> None:
    assert offences(path, path.read_text()) == []


@pytest.mark.parametrize("path", _GUESTS, ids=lambda path: path.name)
def test_guests_import_documented_modules_only(path: Path) -> None:
    assert guest_offences(path, path.read_text()) == []


def test_an_undocumented_import_of_a_guest_would_be_seen() -> None:
    path = _GUESTS[0].parent / "new.py"
    (private,) = guest_offences(
        path, "from imagine_bench.agents.dqn import DQN\nfrom imagine_bench.agents.speed import x"
    )
    assert private.startswith("imagine_bench.agents.speed.x is not listed")
    (whole,) = guest_offences(path, "import imagine_bench.store.files")
    assert whole.startswith("imagine_bench.store.files is not listed")
    (inside,) = guest_offences(path, "def f():\n    from imagine_bench.agents import baselines")
    assert inside.startswith("imagine_bench.agents.baselines is not listed")


@pytest.mark.parametrize(
    ("room", "line", "offence"),
    [
        ("tasks", "import torch", "torch is imported outside of agents"),
        ("agents", "import mujoco.batch", "mujoco is imported outside of tasks"),
        ("imagine_bench", "from dm_control import mjcf", "dm_control is imported outside of imagine_bench/adapters"),
        ("imagine_bench/report", "import rerun as rr", "rerun is imported outside of imagine_bench/recording"),
        ("tasks", "from imagine_bench.registry import task", "may take only"),
        ("tasks", "from imagine_bench import agents", "may take only"),
        ("agents", "from ..tasks import arrow_rules", "may take only"),
        ("agents", "from ..registry import task", "may take only"),
        ("agents", "from imagine_bench.store import files", "may take only"),
        ("tasks", "from imagine_bench.regression.runner import run", "may take only"),
        (
            "imagine_bench/running",
            "def f():\n    from imagine_bench.tasks import frames",
            "reaches tasks and agents by",
        ),
        ("imagine_bench", "import agents", "installed inside imagine_bench"),
        ("imagine_bench/running", "from imagine_bench.judge import plans", "running may import only"),
        (
            "imagine_bench/running",
            "def f():\n    from imagine_bench.recording import record_run",
            "running may import only",
        ),
        ("imagine_bench/running", "from imagine_bench import report", "running may import only"),
        ("imagine_bench/store", "from ..running import runner", "store may import only"),
        ("imagine_bench/judge", "from imagine_bench.cli import main", "judge may import only"),
        ("imagine_bench/attic", "from imagine_bench.store import files", "attic is a new room"),
        ("agents", "x = np.random.rand(3)", "draws from a global generator"),
        ("agents", "x = np.random.default_rng()", "without a seed"),
        ("agents", "x = torch.randn(3)", "torch.randn without a generator"),
        ("agents", "x.normal_(0, 1)", "x.normal_ without a generator"),
        ("agents", "x = F.dropout(x)", "uses a global generator"),
        ("tasks", "import random", "the global module random"),
    ],
)
def test_each_offence_would_be_seen(room: str, line: str, offence: str) -> None:
    (found,) = offences(_TOP / room / "new.py", line)
    assert offence in found


@pytest.mark.parametrize(
    ("file", "line", "offence"),
    [
        ("dqn.py", "from .imagination.agent import make", "agents/dqn may not import agents/imagination"),
        ("factored/settings.py", "from ..networks.mlp import mlp", "settings may not import networks"),
        ("regressors/settings.py", "import torch", "settings may not import torch"),
    ],
)
def test_each_offence_within_agents_would_be_seen(file: str, line: str, offence: str) -> None:
    (found,) = offences(_TOP / "agents" / file, line)
    assert offence in found


@pytest.mark.parametrize(
    ("room", "line"),
    [
        ("agents", "import torch\nx = torch.randn(3, generator=g)\nfrom .networks import mlp"),
        ("tasks/scenes", "import mujoco\nfrom imagine_bench.rules import facts\nfrom ..frames import frames_of"),
        ("agents", "from imagine_bench.rules import facts\nfrom imagine_bench.interfaces.regression import Dataset"),
        ("imagine_bench/store", "from imagine_bench import registry\nrng = np.random.default_rng(7)"),
        ("imagine_bench/recording", "import rerun\nfrom imagine_bench.judge import plans\nfrom . import scene"),
    ],
)
def test_what_is_allowed_is_allowed(room: str, line: str) -> None:
    assert offences(_TOP / room / "new.py", line) == []
