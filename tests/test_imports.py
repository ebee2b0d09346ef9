"""The arrows of the house, by syntax tree: who may import whom, and that nobody draws from a global generator."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

_TOP = Path(__file__).parent.parent
_BOTH = {"cohort", "interfaces", "capabilities", "errors", "seeding", "preprocessing", "regression"}
_SHARED = {"agents": _BOTH, "tasks": _BOTH | {"rules"}}
"""What tasks and agents may take from imagine_bench."""
_HEAVY = {
    "torch": "agents",
    "mujoco": "tasks",
    "dm_control": "imagine_bench/adapters",
    "dm_env": "imagine_bench/adapters",
    "mink": "tasks",
    "daqp": "tasks",
    "OpenGL": "tasks",
    "rerun": "imagine_bench/recording",
}
_SOURCES = sorted(path for room in ("imagine_bench", "tasks", "agents") for path in (_TOP / room).rglob("*.py"))
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
    room = path.relative_to(_TOP).parts[0]
    tree = ast.parse(source)
    found = []
    for name in imports(tree, path):
        top, *rest = name.split(".")
        owner = _HEAVY.get(top)
        if owner is not None and not path.is_relative_to(_TOP / owner):
            found.append(f"{top} is imported outside of {owner}")
        if top in ("tasks", "agents"):
            found.append(f"{name}: the rooms are installed inside imagine_bench")
        if top == "imagine_bench" and rest:
            found += _crossing(room, name, rest[0])
    return found + list(_global_draws(tree))


def _crossing(room: str, name: str, target: str) -> list[str]:
    if room == "imagine_bench":
        return (
            [f"{name}: the bench reaches tasks and agents by registry names"] if target in ("tasks", "agents") else []
        )
    shared = _SHARED[room]
    return [] if target in shared or target == room else [f"{name}: {room} may take only {sorted(shared)}"]


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


def _undirected(call: ast.Call, function: ast.Attribute) -> Iterator[str]:
    """Draws that name no generator."""
    directed = any(keyword.arg == "generator" for keyword in call.keywords)
    text = ast.unparse(function)
    if text == "np.random.default_rng" and not call.args:
        yield "default_rng() without a seed"
    from_torch = text.startswith("torch.") and function.attr in _TORCH_DRAWS
    if (from_torch or function.attr in _TENSOR_DRAWS) and not directed:
        yield f"{text} without a generator"


@pytest.mark.parametrize("path", _SOURCES, ids=lambda path: str(path.relative_to(_TOP)))
def test_the_arrows_hold(path: Path) -> None:
    assert offences(path, path.read_text()) == []


@pytest.mark.parametrize(
    ("room", "line", "offence"),
    [
        ("tasks", "import torch", "torch is imported outside of agents"),
        ("agents", "import mujoco.batch", "mujoco is imported outside of tasks"),
        ("imagine_bench", "from dm_control import mjcf", "dm_control is imported outside of imagine_bench/adapters"),
        ("imagine_bench", "import rerun as rr", "rerun is imported outside of imagine_bench/recording"),
        ("tasks", "from imagine_bench.registry import task", "may take only"),
        ("tasks", "from imagine_bench import agents", "may take only"),
        ("agents", "from ..tasks import arrow_rules", "may take only"),
        ("agents", "from imagine_bench.rules import facts", "may take only"),
        ("agents", "from ..registry import task", "may take only"),
        ("imagine_bench", "def f():\n    from imagine_bench.tasks import arrow_rules", "reaches tasks and agents by"),
        ("imagine_bench", "import agents", "installed inside imagine_bench"),
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
    ("room", "line"),
    [
        ("agents", "import torch\nx = torch.randn(3, generator=g)\nfrom .layers import MLP"),
        ("tasks", "import mujoco\nfrom imagine_bench.rules import facts\nfrom ..frames import frames_of"),
        ("imagine_bench", "from imagine_bench import registry\nrng = np.random.default_rng(7)"),
    ],
)
def test_what_is_allowed_is_allowed(room: str, line: str) -> None:
    folder = _TOP / room / ("scenes" if room == "tasks" else "")
    assert offences(folder / "new.py", line) == []
