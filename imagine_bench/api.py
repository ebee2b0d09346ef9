"""The Python API, which ``import imagine_bench`` offers: :func:`bench`, :func:`load` and :func:`register_agent`.

It is loaded when one of them is first used.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import re
import shlex
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, get_args, get_origin, get_type_hints

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Array, Arrays
from imagine_bench.cli import torch_as_it_was
from imagine_bench.cli.benches import Budget, Learner, Tests, WorldOptions, carry_out, page_of
from imagine_bench.cli.observers import Observed
from imagine_bench.errors import ArtefactError, InvalidValueError, UnknownKeywordError, brief, require_known
from imagine_bench.interfaces import Agent, AgentContext
from imagine_bench.judge.judgement import Judgement
from imagine_bench.protocols.data import Result
from imagine_bench.registry.builtin import OUR_AGENTS
from imagine_bench.registry.by_value import CodeByValue
from imagine_bench.registry.entries import AgentEntry, agent_label, parse_settings
from imagine_bench.registry.machine import CALL
from imagine_bench.running import bench as benches
from imagine_bench.running.launchers.jobs import launcher as launcher_named
from imagine_bench.seeding import SEEDS
from imagine_bench.store.bench_folder import is_archive, read_protocol_values
from imagine_bench.store.files import expanded, read_json, reading
from imagine_bench.values import KINDS, Setting, unpack

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from imagine_bench.report.page import Page

MakeAgent = Callable[[AgentContext], Agent]
"""A class or a function that makes an agent from its context."""
_MAIN_TABLES = ("results", "scores", "seeds")
_NOTEBOOK = "ipykernel"
"""The module that carries out the cells of a notebook."""
_SETTINGS = ("set", "physics")
"""Options that are mappings."""
_OWN = ("preset", "workers", "launcher", "track", "out")
"""Keywords of :func:`bench` that are no part of a protocol."""
_TEXT = ("agent", "model", "solved", "protocol")
"""Columns of texts, also where they could be read as numbers: an agent may be called ``inf``."""


@dataclass(frozen=True, repr=False)
class Comparison:
    """The results of a comparison: a bench, a merged report, a judgement, or the tables that were kept of one.

    Printed, it shows the table and the verdict of the report.
    """

    folder: Path  #: where they lie
    make_page: Callable[[], Page] | None  #: makes the report; None where tables alone were kept
    #: today's name of an agent in the table ``results``, whose file has the name of its time
    label: Callable[[str], str] = str

    def __repr__(self) -> str:
        return f"{', '.join(self.tables)} in {self.folder}" if self.make_page is None else self.page.summary

    @cached_property
    def page(self) -> Page:
        """The report, as :class:`imagine_bench.report.page.Page`.

        Raises:
            InvalidValueError: Only tables were kept.
        """
        if self.make_page is None:
            raise InvalidValueError(
                f"{self.folder} holds tables alone ({', '.join(self.tables)}); frame() gives them. Verdict and figures "
                "are made by the command that ran the comparison."
            )
        return self.make_page()

    @cached_property
    def tables(self) -> Mapping[str, str]:
        """The CSV files of the report by name, the main one first: ``results``, ``scores`` or of a study ``seeds``."""
        if self.make_page is None:
            found = {path.stem: path.read_text() for path in sorted(self.folder.glob("*.csv"))}
        else:
            found = {Path(name).stem: text for name, text in self.page.files.items() if name.endswith(".csv")}
        return dict(sorted(found.items(), key=lambda item: item[0] not in _MAIN_TABLES))

    def frame(self, table: str = "") -> pandas.DataFrame | Arrays:
        """A table: a pandas DataFrame, or a dict of numpy arrays by column where pandas is not installed.

        ``table`` is a name in :attr:`tables`, by default the first. A column of numbers has int64 or, with empty cells
        as NaN, float64; any other has text. Agents of a bench have today's names, also where the file has former ones.

        Raises:
            UnknownNameError: No such table.
        """
        text = self.tables[require_known("table", table or next(iter(self.tables)), self.tables)]
        header, *rows = csv.reader(io.StringIO(text))
        cells = zip(*rows, strict=True) if rows else [()] * len(header)
        columns = {name: _column(name, column) for name, column in zip(header, cells, strict=True)}
        if table in ("", "results") and "agent" in columns:
            columns["agent"] = np.array([self.label(agent) for agent in columns["agent"].tolist()])
        try:
            import pandas  # noqa: PLC0415 - no dependency
        except ImportError:
            return columns
        return pandas.DataFrame(columns)

    def plot(self, figure: str = "") -> Figure:
        """A figure of the report as a matplotlib Figure, by default the first: success by real episodes.

        Raises:
            UnknownNameError: No such figure.
            InvalidValueError: Only tables were kept.
        """
        images = [image for section in self.page.sections for image in section.images]
        drawn = {image.name: image.draw for image in images if image.draw is not None}
        draw = drawn[require_known("figure", figure or next(iter(drawn), figure), drawn)]
        if _NOTEBOOK in sys.modules:  # with its backend loaded, a notebook shows figures as images
            pyplot = registry.load("matplotlib.pyplot")
            pyplot.switch_backend(pyplot.get_backend())
        return draw()

    def verdict(self) -> str:
        """The findings of the report, a sentence or two a line. Raises InvalidValueError: only tables were kept."""
        return "\n".join(self.page.answers)

    def report(self) -> Path:
        """Write the report to ``folder / "report"`` and return the path of its page.

        Raises:
            SetupError: The folder cannot be written.
            InvalidValueError: Only tables were kept.
        """
        write = registry.load("imagine_bench.report.page:write_page")
        path: Path = write(self.folder / "report", self.page)
        return path

    def show_recording(self, run: str = "") -> None:
        """Show a recording in the Rerun viewer: in the cell of a notebook, elsewhere in a window of its own.

        ``run`` names whole parts of its path below :attr:`folder`, such as ``"dqn/seed_0"`` or ``"dqn"``. Of several
        that fit the last one is shown.

        Raises:
            ArtefactError: There is no such recording.
            SetupError: There is no display, or the extra ``rerun``, or in a notebook ``notebook``, is not installed.
        """
        found = {path.relative_to(self.folder).as_posix(): path for path in sorted(self.folder.rglob("*.rrd"))}
        parts = f"/{run.strip('/')}/" if run else "/"
        fits = [name for name in found if parts in f"/{name}/"]
        if not fits:
            raise ArtefactError(f"{self.folder} has no recording {run!r}; it has {', '.join(found) or 'none'}.")
        show = "show_in_notebook" if _NOTEBOOK in sys.modules else "open_in_viewer"
        registry.load(f"imagine_bench.recording.stream:{show}")(found[fits[-1]])


def _column(name: str, cells: Sequence[str]) -> Array:
    """The cells of a column as numbers, or as texts where one is no number."""
    if name not in _TEXT:
        for kind in (np.int64, np.float64):
            try:
                return np.array([cell or "nan" for cell in cells]).astype(kind)
            except ValueError:
                continue
    return np.array(cells)


def bench(
    task: str,
    agents: Sequence[str | MakeAgent] | str | MakeAgent | None = None,
    *,
    preset: str = "quick",
    seeds: int | Sequence[int] | None = None,
    workers: int | None = None,
    launcher: str = "local",
    track: str | None = None,
    out: Path | str = "runs",
    **options: Any,
) -> Comparison:
    """Train and compare agents on a task, as the command ``imagine-bench bench`` does; the same call again goes on.

    Args:
        task: A task's name, such as ``"arrow_puzzle"`` or ``"arrows:cubes=4"``.
        agents: Names, and classes or functions, which are registered by their name; or one alone. By default the
            preset's agents.
        preset: The size of the comparison.
        seeds: Seeds, or their number; by default the preset's. Each agent is trained once a seed; where no
            agents are named, some of the preset ``quick`` have fewer seeds.
        workers: Processes at a time; by default one a core.
        launcher: ``"local"``, ``"this_process"`` (for a debugger), ``"ray"`` or ``"slurm"``.
        track: ``"tensorboard"`` or ``"wandb"`` (offline): metrics are also written for it, as the runs go, into a
            folder of its name in the bench's.
        out: The folder of all benches.
        **options: Other options of the command, by their names there, such as ``budgets=(100, 250)``,
            ``evaluation_episodes=50``, ``execution="kinematic"``, ``set={"controller.discount": 0.9}``.

    Returns:
        The results, with ``until_decided=True`` those of all stages. Their method :meth:`~Comparison.report` writes
        the report.

    Raises:
        UnknownKeywordError: An option that the command has not.
        RunFailedError: Some runs failed; the message names their logs, the others are kept.
        ImagineBenchError: As :func:`imagine_bench.running.bench.plan` and :func:`imagine_bench.running.bench.bench`.
    """
    registry.refuse_while_loading()
    task = _fitting("task", _plain(task), str)
    root = expanded(Path(_fitting("out", _plain(out), str))).absolute()  # the process may go elsewhere afterwards
    processes = None if workers is None else _fitting("workers", _plain(workers), int)
    several: list[Any] = list(agents) if isinstance(agents, list | tuple | np.ndarray | Iterator) else [agents]
    if agents is not None and not all(isinstance(agent, str) or callable(agent) for agent in several):
        raise InvalidValueError(f"agents is {brief(agents)}; give a name, a class or a function, or a list of them.")
    named = None if agents is None else [_name(agent) for agent in several]
    given = {"agents": named, "seeds": seeds, **options}
    given = {name: _plain(value) for name, value in given.items() if value is not None}
    words = [f"{name}={value!r}" for name, value in {"preset": preset, **given}.items()]
    python = f"import imagine_bench; imagine_bench.bench({', '.join([repr(task), *words])})"
    call = CALL.set(shlex.join(["python", "-c", python]))
    try:
        with torch_as_it_was():
            changes = protocol_changes(given)
            until, most = changes.pop("until_decided", False), changes.pop("most_seeds", None)
            launch = Observed(launcher_named(launcher, processes))
            *_, whole = carry_out(
                task, preset, changes, root=root, launcher=launch, until=until, most=most, track=track
            )
            return _of_bench(whole)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted; the same call goes on from the last checkpoints") from None
    finally:
        CALL.reset(call)


def protocol_changes(given: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a bench as fields of its protocol."""
    known: dict[str, Any] = {}
    for part in (WorldOptions, Learner, Budget, Tests):
        known |= get_type_hints(part)
    changes: dict[str, Any] = {}
    for name, value in given.items():
        if name not in known:
            raise UnknownKeywordError.of(name, [*known, *_OWN])
        fitting = _texts(value) if name == "variants" else _plain(value)
        changes[name] = value if name in _SETTINGS else _fitting(name, fitting, known[name])
    if isinstance(_plain(given.get("seeds")), int):
        changes["seeds"] = _first_seeds(*changes["seeds"])
    if "set" in changes:
        changes["overrides"] = _pairs("set", changes.pop("set"))
    if "physics" in changes:
        changes["physics"] = _pairs("physics", changes["physics"])
    return changes


def _fitting(name: str, value: Any, kind: Any) -> Any:
    """The value as an option of a kind takes it: a list, or one value where a list is taken, as a tuple.

    Raises InvalidValueError: it is of another kind.
    """
    one = next((part for part in get_args(kind) if types.NoneType in get_args(kind)), kind)
    several = get_origin(one) is tuple
    element = get_args(one)[0] if several else one
    is_list = several and isinstance(value, list | tuple | range)
    plain = tuple(_plain(each) for each in (value if is_list else (value,)))
    element = str if element not in KINDS else element  # a path, or the repeated words of a command
    if not all(type(each) is element or (element is float and type(each) is int) for each in plain):
        raise InvalidValueError(f"{name} is {brief(value)}; give {KINDS[element]}{' or a list of them' * several}.")
    return plain if several else plain[0]


def _plain(value: Any) -> Any:
    """Numbers of numpy as Python's, the items of a generator as a list, and a path as text."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Iterator):
        return list(value)
    return str(value) if isinstance(value, PurePath) else value


def _texts(value: Any) -> Any:
    """A variant, or a list of them, with numbers of samples as texts."""
    plain = _plain(value)
    if isinstance(plain, list | tuple | range):
        return [_texts(each) for each in plain]
    return str(plain) if type(plain) is int else plain


def _first_seeds(number: int) -> tuple[int, ...]:
    """So many seeds, from 0 on. Raises InvalidValueError: so many there are not."""
    if not 1 <= number <= SEEDS:
        raise InvalidValueError(f"seeds is {number}; give their number, 1 to {SEEDS}, or a list of seeds.")
    return tuple(range(number))


def _pairs(name: str, given: Mapping[str, Setting] | Sequence[str]) -> tuple[tuple[str, Setting], ...]:
    """Settings, given as a mapping or as the words of the command."""
    if isinstance(given, Mapping):
        return tuple(sorted((str(key), _plain(value)) for key, value in given.items()))
    if isinstance(given, list | tuple) and all(isinstance(each, str) for each in given):
        return parse_settings(given, name)
    raise InvalidValueError(f"{name} is {brief(given)}; give a mapping of names to values.")


def register_agent(name: str, make: MakeAgent | str, **options: Any) -> None:
    """Register an agent under a name, for benches of this session; a second call replaces it.

    Args:
        name: Letters, digits and underscores; the name of no other agent.
        make: A class or a function that is called with an :class:`~imagine_bench.interfaces.AgentContext` and gives
            an :class:`~imagine_bench.interfaces.Agent`; or its ``"module:attr"``. A class or function is taken as it is
            now, with the helpers and constants that it names, and reaches the processes of runs by value; a digest of
            its code is in the protocol.
        **options: Other fields of :class:`~imagine_bench.registry.AgentEntry`, such as ``title``. Unlike there, an
            agent needs no encoder by default; its description is the first line of the docstring.

    Raises:
        InvalidValueError: The name is no name or taken, the class cannot be sent to another process, or an
            option has a value of another kind.
        UnknownNameError: No such kind of encoder, or no such part of an observation.
        UnknownKeywordError: An option that agents do not have.
    """
    known = get_type_hints(AgentEntry)
    del known["make"]
    for option, value in options.items():
        if option not in known:
            raise UnknownKeywordError.of(option, list(known))
        options[option] = _fitting(option, _plain(value), known[option])
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name):
        raise InvalidValueError(
            f"An agent cannot be called {brief(name)}; give a name of letters, digits and underscores that begins with "
            "one of a to z or A to Z. register_agent gives a class another name than its own."
        )
    taken = name in OUR_AGENTS or registry.guest_with(registry.AGENT_GROUP, name) is not None
    if taken or name in registry.usable(registry.AGENT_GROUP):
        raise InvalidValueError(f"There is an agent {name!r} already; give yours another name.")
    text = (getattr(make, "__doc__", None) or "").strip().partition("\n")[0]
    described = {"description": text} if text and not isinstance(make, str) else {}
    code = make if isinstance(make, str) else CodeByValue.of(make)
    registry.AGENTS[name] = AgentEntry(**{"make": code, "needs_encoder": False, **described, **options})


def _name(agent: str | MakeAgent) -> str:
    """The name of an agent; a class or function that is not registered yet is registered by its own.

    One that was registered and has been changed since keeps its name and its other fields, of several names the last.
    """
    if isinstance(agent, str):
        return agent
    code = CodeByValue.of(agent)
    made_by = {name: entry.make for name, entry in registry.AGENTS.items() if isinstance(entry.make, CodeByValue)}
    same = [name for name, make in made_by.items() if make == code]
    former = [name for name, make in made_by.items() if (make.home, make.name) == (code.home, code.name)]
    for name in (same or former)[-1:]:
        registry.AGENTS[name] = dataclasses.replace(registry.AGENTS[name], make=code)
        return name
    name = code.name.rpartition(".")[2]
    register_agent(name, agent)
    return name


def load(path: Path | str) -> Comparison:
    """Read the results that lie in a folder.

    A bench, finished or not, a merged report and a judgement give everything. A kept bench has no recordings. Of a
    study, a suite, a kept judgement and a kept regression bench only tables are kept: ``frame`` gives them, and
    the other methods say so.

    Raises:
        ArtefactError: There are no results in the folder, or a file is damaged.
    """
    folder = expanded(Path(_fitting("path", _plain(path), str))).absolute()
    places = [place for place in (folder, folder / "report") if place.is_dir()]
    for place in places:
        if (place / "protocol.json").exists() or (is_archive(place) and "variants" not in read_protocol_values(place)):
            return _of_bench(benches.load_so_far(place))
    if (folder / "judgement.json").exists() and any(folder.glob("*-seed*-*.json")):
        return Comparison(folder, lambda: _page_of_judgement(folder))
    if (folder / "config.json").exists():
        raise ArtefactError(f"{folder} is the folder of one run; give that of its bench, {folder.parent.parent}.")
    for place in places:
        if any((place / f"{name}.csv").is_file() for name in _MAIN_TABLES):
            return Comparison(place, None)
    raise ArtefactError(
        f"{folder} holds no results; give the folder of a bench (runs/<task>/<preset>-<hash>), of a judgement, a "
        "study, a suite, or of results that were kept."
    )


def _of_bench(result: Result) -> Comparison:
    edition: dict[str, object] = {"agent_names": result.protocol.agent_names}
    return Comparison(result.folder, lambda: page_of(result), lambda agent: agent_label(agent, edition))


def _page_of_judgement(folder: Path) -> Page:
    """The report of a judgement in a folder."""
    path = folder / "judgement.json"
    with reading(path, "a judgement"):
        judgement = unpack(Judgement, read_json(path, "a judgement"), {})
    report = registry.load("imagine_bench.report.judge")
    page: Page = report.judgement_page(report.judged(folder, judgement))
    return page
