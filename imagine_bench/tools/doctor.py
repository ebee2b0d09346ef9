"""The state of this machine and installation, and in words each fault of them."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import numpy as np
from packaging.requirements import Requirement

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError
from imagine_bench.registry.machine import commit, gl_renderer, installed, machine, versions
from imagine_bench.version import PACKAGE_FOLDER

_SOFTWARE_GL = ("llvmpipe", "softpipe", "swrast")
_NEEDED_DISK_GIB = 1.0
EXTRAS_OF_A_BENCH = ("agents", "report", "rerun")
"""Extras that make an installation of environments one of benches."""
_DM_CONTROL = "dm-control"
"""The extra of an interface and a viewer, and the package that it brings."""
_LOCK = PACKAGE_FOLDER.parent / ".ci" / "requirements.lock"
_REASONS = {
    "mujoco": " MuJoCo 4.0 breaks dm-control 1.0.50: 'MjModel' has no 'flex_vertedge'.",
    "torch": " Results repeat bit for bit only on one version.",
}


def examine() -> tuple[str, bool]:
    """Look at versions, GL, threads, GPU and disk; draws a frame of the first task.

    Returns:
        The findings, as text, and whether everything works.
    """
    here = machine()
    complaints = unmet_requirements()
    try:
        gl = gl_renderer()
        task = registry.task(next(iter(registry.TASKS)))
        task.render_macrostates(np.array(task.rules.start_states[:1]), "clean", np.random.default_rng(0))
    except ImagineBenchError as error:
        gl = "none"
        complaints.append(str(error))
    except Exception as error:  # a broken installation fails anywhere, and this looks for it
        gl = "none"
        complaints.append(f"Drawing a frame failed with {type(error).__name__}: {error}. Run 'make setup' anew.")
    free_gib = 0.0
    try:
        free_gib = shutil.disk_usage(Path.cwd()).free / 2**30
        if free_gib < _NEEDED_DISK_GIB:
            complaints.append(f"Only {free_gib:.1f} GiB are free in {Path.cwd()}; a bench needs about 1 GiB.")
    except FileNotFoundError:
        complaints.append("The current folder was removed; change to one that exists.")
    facts = {
        "command": sys.executable,
        "commit": commit() or "not in a checkout",
        **versions(),
        "system": here["system"],
        "processor": f"{here['cpu']}, {here['cores']} cores usable, {here['memory_gib']} GiB",
        "NVIDIA GPU": here["gpu"] or "none",
        "threads a run": "1",
        "GL renderer": gl,
        "free disk": f"{free_gib:.1f} GiB",
    }
    notes = _notes(here["gpu"], gl) + unlocked_versions() + missing_extras()
    width = max(map(len, facts)) + 2
    lines = [f"{name:{width}}{value}" for name, value in facts.items()]
    lines += [f"Note: {note}" for note in notes]
    lines += [f"Wrong: {complaint}" for complaint in complaints] or ["Everything works."]
    return "\n".join(lines), not complaints


def unmet_requirements(version_of: Callable[[str], str] = installed) -> list[str]:
    """A sentence for each package that is missing or not of a version that works; an extra's may be missing.

    Args:
        version_of: The installed version of a package, ``"missing"`` where there is none.
    """
    complaints = []
    for wanted, extra in _requirements():
        version = version_of(wanted.name)
        missing = version == "missing"
        unwanted = version_of(_DM_CONTROL) == "missing" if extra == _DM_CONTROL else missing and extra
        if unwanted or (not missing and wanted.specifier.contains(version, prereleases=True)):
            continue
        state = "is missing" if missing else f"{version} is installed"
        reason = _REASONS.get(wanted.name, "")
        repair = "Run 'make setup' in a fresh .venv" if _LOCK.exists() else "Run pip install --upgrade imagine-bench"
        complaints.append(f"{wanted.name} {state}, but {wanted.specifier} is needed.{reason} {repair}.")
    return complaints


def _requirements() -> Iterator[tuple[Requirement, str]]:
    """The needed packages but for those of development, each with the extra that brings it, ``""`` where it always
    comes.
    """
    for wanted in map(Requirement, metadata.requires("imagine-bench") or []):
        for extra in ("", *EXTRAS_OF_A_BENCH, _DM_CONTROL):
            if wanted.marker is None or wanted.marker.evaluate({"extra": extra}):
                yield wanted, extra
                break


def missing_extras(version_of: Callable[[str], str] = installed) -> list[str]:
    """A sentence that names the extras of a bench that are not installed, or none; ``version_of`` as above."""
    lacks = {extra for each, extra in _requirements() if version_of(each.name) == "missing"} - {"", _DM_CONTROL}
    if not lacks:
        return []
    names = ",".join(sorted(lacks))
    return [f"Environments work. A bench needs more: pip install 'imagine-bench[{names}]'."]


def unlocked_versions(lock: Path = _LOCK, version_of: Callable[[str], str] = installed) -> list[str]:
    """A sentence that names the packages whose versions are not the lock's, on whose bits results depend; or none.

    Args:
        lock: The lock of a checkout. Where there is none, versions are the user's own.
        version_of: As of :func:`unmet_requirements`.
    """
    if not lock.exists():
        return []
    lines = [Requirement(line.rstrip(" \\")) for line in lock.read_text().splitlines() if "==" in line]
    here = [line for line in lines if line.marker is None or line.marker.evaluate()]
    pins = {line.name: str(line.specifier).removeprefix("==") for line in here}
    others = [f"{name} {version_of(name)} (not {pin})" for name, pin in pins.items() if version_of(name) != pin]
    if not others:
        return []
    return [
        f"Versions differ from .ci/requirements.lock, and so may the last bits of results: {', '.join(others)}. "
        "'rm .venv/.ready && make setup' brings them back."
    ]


def _notes(gpu: str | None, gl: str) -> list[str]:
    if gpu is None or not any(name in gl.lower() for name in _SOFTWARE_GL):
        return []
    return [f"Frames are drawn in software ({gl}) although there is a GPU; its driver's EGL is not installed."]
