"""Imports between folders go one way, heavy libraries stay in their folders, and nobody draws from a global generator.

An import counts wherever it stands: at the top of a file, inside a function, under ``TYPE_CHECKING``, or as a string
that names a module, such as those of the registry and of ``import_module``.
"""

from __future__ import annotations

import ast
import functools
import importlib
import pkgutil
import re
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import imagine_bench
from imagine_bench import MOVED, api

_TOP = Path(__file__).parent.parent
LOOSE = "loose modules"
"""The modules that lie in ``imagine_bench/`` itself count as one folder."""
PACKAGE = "the package itself"
"""``__init__.py``, ``api.py`` and ``__main__.py`` of ``imagine_bench``: the names that its import and ``python -m``
offer.
"""
FOLDERS = (
    LOOSE,
    "imagine_bench/reference",
    "imagine_bench/interfaces",
    "imagine_bench/exact",
    "tasks/scenes",
    "tasks/rendering",
    "tasks/parameters",
    "tasks/motion",
    "tasks",
    "tasks/arrows",
    "tasks/pick_place",
    "tasks/continuous",
    "agents/networks",
    "agents/encoders",
    "agents",
    "agents/imagination",
    "agents/world_models",
    "imagine_bench/registry",
    "imagine_bench/protocols",
    "imagine_bench/store",
    "imagine_bench/regression",
    "imagine_bench/data",
    "imagine_bench/running",
    "imagine_bench/running/launchers",
    "imagine_bench/judge/policies",
    "imagine_bench/judge/worlds",
    "imagine_bench/judge",
    "imagine_bench/sweep",
    "imagine_bench/recording",
    "imagine_bench/report",
    "imagine_bench/adapters",
    "imagine_bench/testing",
    "imagine_bench/tools",
    "imagine_bench/cli",
    PACKAGE,
)
"""Every folder, from the ground up: a file may import from its own folder and from those that stand before it."""
GROUND = {
    "arrays",
    "assets",
    "appearance",
    "cores",
    "environments",
    "errors",
    "interfaces",
    "values",
    "preprocessing",
    "rules",
    "seeding",
}
"""The parts of imagine_bench that tasks and agents may import; they never import each other."""
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
"""The one folder that imports each heavy library."""
_GUESTS = sorted((_TOP / "agents" / "guests").glob("*/src/**/*.py"))
_STABLE = frozenset(re.findall(r"`(imagine_bench\w*\.[\w.]+)`", (_TOP / "docs/reference/api.md").read_text()))
"""The modules that docs/reference/api.md lists: those that other packages may import."""
SETTINGS = "settings.py"
"""Settings are read without torch: a file whose name ends so imports neither it nor a network."""
_TORCH_DRAWS = {"rand", "randn", "randint", "randperm", "bernoulli", "multinomial", "normal", "rand_like", "randn_like"}
_TENSOR_DRAWS = {"normal_", "uniform_", "bernoulli_", "exponential_", "random_", "multinomial"}


parsed = functools.cache(ast.parse)


def sources() -> list[Path]:
    """The Python files of the core."""
    files = (path for room in ("imagine_bench", "tasks", "agents") for path in (_TOP / room).rglob("*.py"))
    return sorted(path for path in files if not path.is_relative_to(_TOP / "agents" / "guests"))


def module_name(path: Path) -> str:
    """The dotted name by which a file is installed."""
    parts = list(path.relative_to(_TOP).with_suffix("").parts)
    if parts[-1] == "__init__":
        parts.pop()
    return ".".join(parts if parts[0] == "imagine_bench" else ["imagine_bench", *parts])


_MODULES = {module_name(path): path for path in sources()}


def imports(path: Path, source: str) -> Iterator[str]:
    """Dotted names that a file imports anywhere, relative ones made absolute, and those that a string names."""
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package.pop()
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            prefix = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{prefix}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            named = node.value.partition(":")[0]
            if "." in named and named in _MODULES:
                yield named


def folder_of(path: Path) -> str:
    """The folder that a file counts to."""
    folder = path.relative_to(_TOP).parent.as_posix()
    if folder != "imagine_bench":
        return folder
    return PACKAGE if path.name in ("__init__.py", "__main__.py", "api.py") else LOOSE


def arrows(path: Path, source: str) -> dict[str, str]:
    """The other folders that a file imports from, each with one of the names."""
    found = {}
    for name in imports(path, source):
        module = name
        while module and module not in _MODULES:
            module = module.rpartition(".")[0]
        if module and (module != "imagine_bench" or name == "imagine_bench" or name.startswith("imagine_bench.__")):
            found[folder_of(_MODULES[module])] = name
    found.pop(folder_of(path), None)
    return found


def offences(path: Path, source: str) -> list[str]:
    """Every import and draw of a file that is forbidden."""
    return [*_upward(path, source), *_foreign(path, source), *_global_draws(parsed(source))]


def guest_offences(path: Path, source: str) -> list[str]:
    """Every import of a plug-in that the documentation does not list, or that is of a package which it does not name as
    a dependency, and every draw from a global generator.
    """
    folder = _TOP / "agents" / "guests" / path.relative_to(_TOP / "agents" / "guests").parts[0]
    needed = tomllib.loads((folder / "pyproject.toml").read_text())["project"]["dependencies"]
    packages = {Requirement(text).name.replace("-", "_") for text in needed}
    found = []
    for name in imports(path, source):
        top = name.partition(".")[0]
        is_own = name.startswith("imagine_bench.agents.guests.")  # a relative import
        if is_own or not top.startswith("imagine_bench"):
            continue
        if not {name, name.rpartition(".")[0]} & _STABLE:
            found.append(f"{name} is not listed in docs/reference/api.md")
        if top not in packages:
            found.append(f"{top} is no dependency of {folder.name}")
    return [*found, *_global_draws(parsed(source))]


def _upward(path: Path, source: str) -> Iterator[str]:
    """Imports from a folder that stands above the file's own."""
    here = folder_of(path)
    if here not in FOLDERS:
        yield f"{here} is a new folder; say in FOLDERS where it stands"
        return
    for there, name in arrows(path, source).items():
        if there in FOLDERS and FOLDERS.index(there) > FOLDERS.index(here):
            yield f"{name}: {there} stands above {here}"


def _foreign(path: Path, source: str) -> Iterator[str]:
    """Heavy libraries outside of their folder, and rooms that tasks and agents may not know."""
    room = path.relative_to(_TOP).parts[0]
    for name in imports(path, source):
        top, *rest = name.split(".")
        owner = _HEAVY.get(top)
        if owner is not None and not path.is_relative_to(_TOP / owner):
            yield f"{top} is imported outside of {owner}"
        if top == "torch" and path.name.endswith(SETTINGS):
            yield "settings import torch"
        if top in ("tasks", "agents"):
            yield f"{name}: the folders are installed inside imagine_bench"
        if top == "imagine_bench" and rest and room != "imagine_bench" and rest[0] not in {room, *GROUND}:
            yield f"{name}: {room} may import only {sorted(GROUND)}"


def _global_draws(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom) and (
            getattr(node, "module", None) == "random" or any(alias.name == "random" for alias in node.names)
        ):
            yield "the global module random"
        if isinstance(node, ast.Attribute):
            text = ast.unparse(node)
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


def test_every_folder_stands_in_the_order_once() -> None:
    assert sorted(FOLDERS) == sorted({folder_of(path) for path in _MODULES.values()})


def test_every_import_goes_down_and_every_draw_has_a_generator() -> None:
    found = {str(path.relative_to(_TOP)): offences(path, path.read_text()) for path in _MODULES.values()}
    assert {file: said for file, said in found.items() if said} == {}


def test_no_class_name_is_defined_twice() -> None:
    """Neither in the core nor in its guests, private ones included."""
    where: dict[str, list[str]] = {}
    for path in [*_MODULES.values(), *_GUESTS]:
        for node in ast.walk(parsed(path.read_text())):
            if isinstance(node, ast.ClassDef):
                where.setdefault(node.name, []).append(str(path.relative_to(_TOP)))
    assert {name: files for name, files in where.items() if len(files) > 1} == {}


@pytest.mark.parametrize("path", _GUESTS, ids=lambda path: path.name)
def test_guests_import_documented_modules_only(path: Path) -> None:
    assert guest_offences(path, path.read_text()) == []


@pytest.mark.parametrize(
    ("line", "offence"),
    [
        (
            "from imagine_bench.agents.attic import x",
            "imagine_bench.agents.attic.x is not listed in docs/reference/api.md",
        ),
        (
            "from imagine_bench_factored.planner import Planner",
            "imagine_bench_factored.planner.Planner is not listed in docs/reference/api.md",
        ),
        ("from imagine_bench_peers.sb3 import x", "imagine_bench_peers is no dependency of controls"),
    ],
)
def test_an_undocumented_import_of_a_guest_would_be_seen(line: str, offence: str) -> None:
    fine = "from imagine_bench.agents.dqn import DQN\nfrom imagine_bench_factored.factors import Code\n"
    path = _TOP / "agents/guests/controls/src/imagine_bench_controls/new.py"
    assert offence in guest_offences(path, fine + line) and guest_offences(path, fine) == []


@pytest.mark.parametrize(
    ("file", "line", "offence"),
    [
        ("tasks/new.py", "import torch", "torch is imported outside of agents"),
        ("imagine_bench/report/new.py", "import rerun as rr", "rerun is imported outside of imagine_bench/recording"),
        (
            "tasks/new.py",
            "from imagine_bench.seeding import x\nfrom imagine_bench import statistics",
            "may import only",
        ),
        ("imagine_bench/registry/new.py", "import agents", "installed inside imagine_bench"),
        ("imagine_bench/store/new.py", "from ..running import runner", "imagine_bench/running stands above"),
        ("imagine_bench/store/new.py", "def f():\n    from imagine_bench.cli import main", "imagine_bench/cli stands"),
        ("imagine_bench/registry/new.py", "load('imagine_bench.running.runner:run')", "imagine_bench/running stands"),
        ("imagine_bench/attic/new.py", "import imagine_bench.errors", "attic is a new folder"),
        ("agents/dqn_settings.py", "import torch", "settings import torch"),
        ("agents/new.py", "x = np.random.default_rng()", "without a seed"),
        ("agents/new.py", "x = torch.randn(3)", "torch.randn without a generator"),
        ("agents/new.py", "x.normal_(0, 1)", "x.normal_ without a generator"),
        ("agents/new.py", "x = F.dropout(x)", "uses a global generator"),
        ("tasks/new.py", "import random", "the global module random"),
    ],
)
def test_each_offence_would_be_seen(file: str, line: str, offence: str) -> None:
    (found,) = offences(_TOP / file, line)
    assert offence in found


@pytest.mark.parametrize("old", MOVED)
def test_an_old_path_gives_the_objects_of_the_new_one_and_warns_once(old: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a package around it may have another old path, and a warning of its own
        importlib.import_module(old)
    sys.modules.pop(old)
    with pytest.warns(DeprecationWarning, match=f"{old} is now {MOVED[old]}; import it from there"):
        module = importlib.import_module(old)
    new = vars(importlib.import_module(MOVED[old]))
    public = [name for name in new if not name.startswith("__")]
    assert public or "__path__" in new, "a package may have no names of its own"
    assert all(getattr(module, name) is new[name] for name in public)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert importlib.import_module(old) is module


def test_a_path_that_never_was_is_not_found() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"imagine_bench\.never_was"):
        importlib.import_module("imagine_bench.never_was")


@pytest.mark.parametrize("again", [False, True])
def test_an_old_path_hides_no_function_of_the_package(again: bool) -> None:
    """``imagine_bench.bench`` was a package: the import of a module by its old path leaves the function."""
    for old in ("imagine_bench.bench", "imagine_bench.bench.bench"):
        sys.modules.pop(old, None)
    if not again:
        vars(imagine_bench).pop("bench", None)
    with pytest.warns(DeprecationWarning):
        module = importlib.import_module("imagine_bench.bench.bench")
    assert imagine_bench.bench is api.bench and module.plan is importlib.import_module(MOVED[module.__name__]).plan
    names = [module.name for module in pkgutil.iter_modules(imagine_bench.__path__)]
    assert "bench" not in names and not set(names) & {old.split(".")[1] for old in MOVED if old.count(".") == 1}


def test_the_package_loads_its_functions_when_they_are_used() -> None:
    probe = """
import sys
import imagine_bench
assert not {"imagine_bench.api", "imagine_bench.cli", "scipy", "torch", "mujoco"} & set(sys.modules)
assert set(dir(imagine_bench)) >= {"bench", "load", "register_agent", "registry"}
from imagine_bench import bench, load
assert bench is imagine_bench.api.bench and load is imagine_bench.load
assert not {"torch", "mujoco", "matplotlib", "rerun"} & set(sys.modules)
import gymnasium
for level in ("ArrowPuzzle", "ArrowPuzzleMotion"):
    gymnasium.make(f"imagine_bench/{level}-v0")
assert not {"torch", "mink"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", probe], check=True)


@pytest.mark.slow
def test_functions_of_the_package_outlive_imports_of_modules() -> None:
    rooms = ("imagine_bench.agents", "imagine_bench.tasks", "imagine_bench.__main__")
    modules = [name for name in _MODULES if not name.startswith(rooms)]
    probe = f"""
import contextlib, importlib
import imagine_bench
for _ in range(2):
    for name in {modules}:
        with contextlib.suppress(ModuleNotFoundError):  # of a library that is not installed
            importlib.import_module(name)
    for call in (imagine_bench.bench, imagine_bench.load):
        try:
            call("nowhere")
        except imagine_bench.errors.ImagineBenchError as error:
            print(error)
"""
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=False)
    assert done.stdout.count("No task 'nowhere'") == done.stdout.count("nowhere holds no results") == 2, done.stderr
