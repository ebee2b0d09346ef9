"""The facts of a machine and an installation that stand beside every result."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable
from contextvars import ContextVar
from importlib import metadata
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.cores import usable_cores
from imagine_bench.errors import SetupError
from imagine_bench.values import Json
from imagine_bench.version import PACKAGE_FOLDER, __version__

PACKAGES = ("daqp", "gymnasium", "mink", "mujoco", "numpy", "rerun-sdk", "safetensors", "scipy", "torch")
OPTIONAL_PACKAGES = ("dm-control", "sb3-contrib", "sheeprl", "stable-baselines3", "torch-world")
"""Of adapters and of the extra ``peers``; named where they are installed."""
GL_RENDERER = "imagine_bench.tasks.rendering:gl_renderer"
CALL: ContextVar[str | None] = ContextVar("CALL", default=None)
"""The command line of the call of the Python API that is carried out."""
_CODE = ("imagine_bench", "agents", "tasks", "assets", "pyproject.toml")
"""The folders that decide results, in a checkout."""


def describe_environment() -> dict[str, Json]:
    """Command, commit, versions, machine, GL renderer (or why there is none), threads; JSON-like."""
    try:
        gl = gl_renderer()
    except SetupError as error:
        gl = f"none: {error}"
    return {
        "command": command(),
        "commit": commit(),
        "versions": versions(),
        "machine": machine(),
        "gl_renderer": gl,
        "threads_a_run": 1,
    }


def command() -> str:
    """The command line of this process, with the program's bare name, or that of the call that runs."""
    call = CALL.get()
    if call is not None:
        return call
    path = Path(sys.argv[0])
    program = ["python", "-m", path.parent.name] if path.name == "__main__.py" else [path.name]
    return shlex.join([*program, *sys.argv[1:]])


def commit(top: Path = PACKAGE_FOLDER.parent) -> str | None:
    """A checkout's commit, None outside one; code that differs, new files too, adds ``+changes.`` and its digest."""
    if not (top / ".git").exists():
        return None
    head = _output("git", "-C", str(top), "rev-parse", "--short=12", "HEAD")
    changes = _changes(top)
    return f"{head}+changes.{changes}" if head and changes else head


def _changes(top: Path) -> str:
    """Beginning of a digest of all files of code that differ from the commit or are new; empty if none do.

    ``unknown`` where git does not say, as on a machine that is too busy.
    """
    options = ("--porcelain", "-z", "--no-renames", "--untracked-files=all")
    found = _output("git", "-C", str(top), "status", *options, "--", *_CODE)
    if found is None:
        return "unknown"
    names = sorted(entry.split(maxsplit=1)[1] for entry in found.split("\0") if entry)
    digest = hashlib.sha256()
    for name in names:
        digest.update(name.encode())
        if (top / name).is_file():
            digest.update((top / name).read_bytes())
    return digest.hexdigest()[:8] if names else ""


def versions() -> dict[str, str]:
    """Versions of Python, this package, those that decide its numbers and those that offer agents; imports none.

    One that offers agents is likely still being written: the beginning of its sources' digest follows its version.
    """
    found = {"python": platform.python_version(), "imagine-bench": __version__}
    found |= {package: installed(package) for package in PACKAGES}
    optional = {package: installed(package) for package in OPTIONAL_PACKAGES}
    found |= {name: version for name, version in optional.items() if version != "missing"}
    return found | {name: f"{installed(name)}+{_sources(top)}" for name, top in registry.guest_packages().items()}


def _sources(modules: Iterable[str]) -> str:
    """Beginning of a digest of the Python files of top modules, none of which is imported; those that lack add none."""
    digest = hashlib.sha256()
    for spec in filter(None, map(importlib.util.find_spec, sorted(modules))):
        files = [Path(spec.origin)] if spec.origin else []
        if spec.submodule_search_locations:
            files = sorted(path for folder in spec.submodule_search_locations for path in Path(folder).rglob("*.py"))
        for path in files:
            digest.update(path.name.encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def installed(package: str) -> str:
    """The version of a package, read without importing it; ``"missing"`` where there is none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "missing"


def machine() -> dict[str, Any]:
    """Operating system, processor, cores this process may use, memory, NVIDIA GPU."""
    gpus = _output("nvidia-smi", "--query-gpu=name", "--format=csv,noheader")
    return {
        "system": platform.platform(),
        "cpu": _cpu_model(),
        "cores": usable_cores(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "gpu": gpus.splitlines()[0] if gpus else None,
    }


def _cpu_model() -> str:
    """The processor's name as the system gives it."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text().splitlines() if known.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else _output("sysctl", "-n", "machdep.cpu.brand_string") or platform.machine()


def gl_renderer() -> str:
    """Vendor and renderer of the OpenGL that draws the frames. Raises SetupError: there is none."""
    return registry.load(GL_RENDERER)()


def _output(*words: str) -> str | None:
    """The output of a command, stripped; None if it fails."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
