"""Installed packages: the objects that they offer by entry points, and why some of these cannot be used.

Nothing of a package is imported before one of its objects is asked for.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Container, Iterable, Mapping, Sequence
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from imagine_bench.errors import InvalidValueError, SetupError, brief, require_known, unprintable
from imagine_bench.interfaces.regression import RegressionSpec
from imagine_bench.registry.builtin import (
    AGENTS,
    PLAYERS,
    REGRESSIONS,
    REGRESSORS,
    TASKS,
    WORLD_MODELS,
    Guest,
    guests,
)
from imagine_bench.registry.by_value import CodeByValue
from imagine_bench.registry.entries import (
    LABEL_OF_OLD_AGENT,
    AgentEntry,
    EncoderEntry,
    RegressorEntry,
    TaskEntry,
    WorldModelEntry,
    parse_configuration,
)
from imagine_bench.registry.loading import fault, load

MOTION = "imagine-bench-motion"
"""The plug-in of continuous control."""
TASK_GROUP = "imagine_bench.tasks"
AGENT_GROUP = "imagine_bench.agents"
ENCODER_GROUP = "imagine_bench.encoders"
REGRESSION_GROUP = "imagine_bench.regressions"
REGRESSOR_GROUP = "imagine_bench.regressors"
COMMAND_GROUP = "imagine_bench.commands"
STUDY_GROUP = "imagine_bench.studies"
WORLD_MODEL_GROUP = "imagine_bench.world_models"
"""Entry points in which installed packages make their offers: each the ``"module:attr"`` of a TaskEntry, AgentEntry,
EncoderEntry, RegressionSpec, RegressorEntry, Study or WorldModelEntry; of a plug-in of this suite, the function that
carries out a command."""


class _Group(NamedTuple):
    """A group of entry points."""

    what: str  #: one of it, in words
    kind: type  #: the class of its objects
    own: Sequence[Container[str]]  #: where the names are that are this suite's


_GROUPS = {
    TASK_GROUP: _Group("task", TaskEntry, (TASKS, REGRESSIONS)),
    AGENT_GROUP: _Group("agent", AgentEntry, (AGENTS, REGRESSORS, PLAYERS)),
    ENCODER_GROUP: _Group("encoder", EncoderEntry, ()),
    REGRESSION_GROUP: _Group("regression task", RegressionSpec, (TASKS, REGRESSIONS)),
    REGRESSOR_GROUP: _Group("regressor", RegressorEntry, (AGENTS, REGRESSORS)),
    WORLD_MODEL_GROUP: _Group("world model", WorldModelEntry, (WORLD_MODELS,)),
}


def describe_group(group: str, *, what: str, kind: type, own: Container[str]) -> None:
    """Describe the offers in a group; a room above the registry describes its own group when it is imported.

    Args:
        group: Name of the group of entry points.
        what: One of its objects, in a word.
        kind: The class of its objects.
        own: The names that are this suite's.
    """
    _GROUPS[group] = _Group(what, kind, (own,))


def usable(group: str) -> dict[str, Any]:
    """The usable offers of installed packages in a group of entry points, by name."""
    return {name: entry for name, entry in offers(group).items() if not isinstance(entry, SetupError)}


def refused_offers() -> list[SetupError]:
    """The reasons why some offers of installed packages cannot be used."""
    return [entry for group in _GROUPS for entry in offers(group).values() if isinstance(entry, SetupError)]


@functools.cache
def offers(group: str) -> Mapping[str, Any]:
    """The offers of installed packages in a group of entry points, by name: an object, or the error why it is none.

    A name of this suite's own stays this suite's.
    """
    found: dict[str, Any] = {}
    for point in entry_points(group=group):
        what, kind, own = _GROUPS[group]
        package = point.dist.name if point.dist else point.module
        offer = f"The package {package} offers {point.value} as {what} {point.name}"
        guest = guest_with(group, point.name)
        is_guests = guest is not None and guest.package != package
        if point.name in found or is_guests or any(point.name in names for names in own):
            found.setdefault(f"{package}:{point.name}", SetupError(f"{offer}, a name that is taken; give it another."))
            continue
        try:
            entry = load(f"{point.module}:{point.attr or ''}")
        except Exception as error:  # whatever a package does wrong, it is one sentence and costs nobody else anything
            entry = SetupError(f"{offer}, which cannot be loaded ({fault(error)}); mend or uninstall the package.")
        if not isinstance(entry, kind | SetupError):
            entry = SetupError(
                f"{offer}, which is {brief(entry)} and no {kind.__name__}; mend or uninstall the package."
            )
        if any(map(unprintable, vars(entry).values())):
            entry = SetupError(f"{offer}, whose texts have control characters; mend or uninstall the package.")
        found[point.name] = entry
    return found


def offered(name: str, own: Mapping[str, Any], group: str) -> Any:
    """The object of a name in a group: this suite's own, or a package's. Raises as :func:`task_entry`."""
    if isinstance(name, str) and name in own:
        return own[name]
    what = _GROUPS[group].what
    there = offers(group)
    guest = guest_with(group, name)
    if guest is not None and name not in there:
        raise SetupError(
            f"The {what} {name} is in the package {guest.package}, which is not installed. "
            f"Install it with: {guest.install}"
        )
    if group == AGENT_GROUP and name in LABEL_OF_OLD_AGENT and name not in there:
        raise InvalidValueError(f"Agent {name!r} is now called {LABEL_OF_OLD_AGENT[name]!r}; give that name.")
    entry = there[require_known(what, name, {**own, **there})]
    if isinstance(entry, SetupError):
        raise entry
    return entry


def installed_of(names: Sequence[str], group: str = AGENT_GROUP) -> tuple[tuple[str, ...], str]:
    """The names of a default, without those of this suite's guests that are not installed, and a sentence about these.

    Of a configuration, its agent counts. The sentence is empty where nothing is left out.
    """
    absent = {}
    for name in names:
        guest = guest_with(group, parse_configuration(name).agent)
        if guest is not None and parse_configuration(name).agent not in offers(group):
            absent[name] = guest
    installs = "; ".join(dict.fromkeys(guest.install for guest in absent.values()))
    note = f"Left out, as not installed: {', '.join(absent)}. To install: {installs}" if absent else ""
    return tuple(name for name in names if name not in absent), note


def guest_with(group: str, name: str) -> Guest | None:
    """The guest of this suite that offers a name in a group, installed or not; None where none does."""
    return next((guest for guest in guests() if name in guest.names.get(group, ())), None)


def is_ours(target: str | CodeByValue) -> bool:
    """Whether code is this suite's: the core's, or that of a guest of its own that needs no library of others."""
    return _top(str(target)) in {"imagine_bench", *(guest.module for guest in guests() if guest.is_ours_alone)}


def package_code(target: str) -> str:
    """Twelve hex digits of the files of the package, or of the single module, in which a ``"module:attr"`` lies.

    All of its files count, since nobody knows which of them decide: a world's XML does as code does. Hidden files and
    bytecode do not. None is imported. Empty for code of this suite, all of its guests included, of which benches keep
    the commit, and for code of a notebook.
    """
    top = _top(target)
    if top in {"__main__", "imagine_bench", *(guest.module for guest in guests())}:
        return ""
    found = find_spec(top)
    folders = (found.submodule_search_locations or ()) if found else ()
    files = sorted((file.relative_to(folder), file) for folder in map(Path, folders) for file in folder.rglob("*"))
    kept = [(name, file) for name, file in files if file.is_file() and not _is_hidden_or_bytecode(name)]
    code = [file for _, file in kept if file.suffix == ".py"]
    if found and found.has_location and not code:
        code = [Path(str(found.origin))]
    whole = hashlib.sha256(b"".join(map(Path.read_bytes, code)))
    for name, file in kept:
        if file.suffix != ".py":
            state = file.stat()
            whole.update(name.as_posix().encode() + _file_digest(file, state.st_mtime_ns, state.st_size))
    return whole.hexdigest()[:12] if code else ""


@functools.cache
def _file_digest(file: Path, mtime_ns: int, size: int) -> bytes:
    """The SHA-256 of a file, computed once while its time and size stay: a package's weights may be large."""
    del mtime_ns, size
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").digest()


def _is_hidden_or_bytecode(name: Path) -> bool:
    """Whether a file of a package comes and goes by itself."""
    return any(part.startswith(".") or part == "__pycache__" for part in name.parts)


def packages_of(targets: Iterable[str]) -> set[str]:
    """The installed packages that offer anything of the top modules in which some ``"module:attr"`` lie."""
    tops = set(map(_top, targets))
    return {name for name, modules in guest_packages().items() if modules & tops}


def _top(target: str) -> str:
    return target.partition(":")[0].partition(".")[0]


def absent_guests() -> list[Guest]:
    """The guests of this suite that are not installed here."""
    installed = guest_packages()
    return [guest for guest in guests() if guest.package not in installed]


def require_guest(package: str, doing: str) -> None:
    """Raise SetupError, with the line that installs it, where a plug-in of this suite is missing that does something.

    Args:
        package: The plug-in, as pip knows it.
        doing: The work that needs it, as the beginning of a sentence.
    """
    for guest in absent_guests():
        if guest.package == package:
            raise SetupError(
                f"{doing} needs the package {package}, which is not installed. Install it with: {guest.install}"
            )


def command(name: str) -> str:
    """The place of the function that carries out a command of a plug-in, as :func:`.loading.load` takes it.

    Raises SetupError, with the line that installs it, where the plug-in is missing.
    """
    (guest,) = (each for each in guests() if name in each.names.get(COMMAND_GROUP, {}))
    require_guest(guest.package, f"'imagine-bench {name}'")
    return guest.names[COMMAND_GROUP][name]


def guest_packages() -> dict[str, set[str]]:
    """The installed packages that offer anything, by name, and where their entries lie: names of top modules."""
    found: dict[str, set[str]] = {}
    everything = entry_points()
    for group in (each for each in everything.groups if each.startswith("imagine_bench.")):
        for point in everything.select(group=group):
            if point.dist:
                found.setdefault(point.dist.name, set()).add(point.module.partition(".")[0])
    return dict(sorted(found.items()))
