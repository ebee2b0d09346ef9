"""The Python API: agents by value, results as tables, and the same results from folders."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import functools
import io
import shlex
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import numpy as np
import pytest
import torch
from imagine_bench.agents.baselines import RandomAgent
from kept import RESULTS, table
from small_runs import TWO_EPISODES

import imagine_bench
from imagine_bench import api, cli, registry, values
from imagine_bench.errors import (
    ArtefactError,
    ImagineBenchError,
    InvalidValueError,
    RunFailedError,
    UnknownNameError,
)
from imagine_bench.interfaces import AgentContext
from imagine_bench.judge.models import model_entry
from imagine_bench.registry.by_value import CodeByValue, code_digest
from imagine_bench.running.trained import learners, load_trained
from imagine_bench.store import encoders
from imagine_bench.store.files import read_sealed

_LOCK = threading.Lock()
_TIMES = ("train_cpu_s", "eval_cpu_s")
_SOURCE = """
import functools
import numpy as np
from pathlib import Path
from imagine_bench.agents.baselines import RandomAgent

FIRST = 1
TABLE = {"left": [0, 2], "right": (1, 3)}
OTHERS = (range(3), Path("weights"), np.float32(0.5), np.array([None, "a"]))

@functools.cache
def shifted(number, by=FIRST, *, twice=0):
    return number + by + 2 * twice

class Base(RandomAgent):
    names = {"one", "two", "three", "four"}

class MyAgent(Base):
    '''Acts by the sum of pixels.'''

    def __init__(self, context):
        super().__init__(context.n_actions, context.seeds.child("act").generator())

    @property
    def table(self):
        return TABLE, OTHERS

    @functools.lru_cache(maxsize=9)
    def size(self):
        return len(TABLE)

    @staticmethod
    def wrapped(number):
        return (lambda: shifted(number) % 6)()

    def act(self, observation, *, explore):
        return self.wrapped(int(observation.frame.sum()))

def make(context):
    return MyAgent(context)

partial = functools.partial(MyAgent)
"""


@pytest.fixture(autouse=True)
def agents() -> Iterator[None]:
    """The agents as they are, whatever a test registers."""
    before = dict(registry.AGENTS)
    yield
    registry.AGENTS.clear()
    registry.AGENTS.update(before)


class Shifting(RandomAgent):
    """Acts by the sum of pixels."""

    shift = 0

    def __init__(self, context: AgentContext) -> None:
        super().__init__(context.n_actions, context.seeds.child("act").generator())

    def act(self, observation: Any, *, explore: bool) -> int:
        return int(observation.frame.sum() + self.shift) % 6


def code(source: str = _SOURCE) -> dict[str, Any]:
    """The names that the source of a script or a cell defines."""
    variables: dict[str, Any] = {"__name__": "__main__"}
    exec(source, variables)
    return variables


@pytest.mark.parametrize(
    ("was", "now", "changes"),
    [
        ("% 6", "% 5", True),
        ("FIRST = 1", "FIRST = 2", True),
        ("twice=0", "twice=1", True),
        ("number + by", "number - by", True),
        ('"left": [0, 2]', '"left": [0, 4]', True),
        ('"three", "four"', '"three"', True),
        ("class MyAgent(Base)", "class MyAgent(RandomAgent)", True),
        ("@staticmethod", "@functools.cache\n    @staticmethod", True),
        ("FIRST = 1", "SECOND = 7\n\n# A comment.\nFIRST = 1", False),
        ("Acts by the sum of pixels.", "Acts.", False),
    ],
)
def test_a_digest_changes_with_the_code_s_behavior_alone(was: str, now: str, changes: bool) -> None:
    before, after = code(), code(_SOURCE.replace(was, now))
    assert _SOURCE.count(was) == 1
    for name in ("MyAgent", "make", "partial"):
        assert (code_digest(before[name]) != code_digest(after[name])) == changes, name


@pytest.mark.parametrize(
    ("was", "now"),
    [
        ("range(3)", "range(5)"),
        ("pathlib.Path('a')", "pathlib.Path('b')"),
        ("np.float32(0.1)", "np.float32(0.2)"),
        ("np.array(['a', 1], dtype=object)", "np.array(['b', 1], dtype=object)"),
        ("torch.tensor([1.0])", "torch.tensor([2.0])"),
        ("re.compile('a')", "re.compile('b')"),
        ("min", "max"),
        ("np.minimum", "np.maximum"),
        ("functools.cache(lambda: 1)", "functools.cache(lambda: 2)"),
        ("functools.cached_property(lambda self: 1)", "functools.cached_property(lambda self: 2)"),
        ("Slotted(1)", "Slotted(2)"),
    ],
)
def test_a_digest_changes_with_a_constant_of_any_type(was: str, now: str) -> None:
    head = "import dataclasses, functools, pathlib, re, numpy as np, torch\n"
    head += "@dataclasses.dataclass(slots=True)\nclass Slotted:\n    size: int\n"
    (before, again, after) = (
        code_digest(code(f"{head}CONSTANT = {value}\ndef use():\n    return CONSTANT\n")["use"])
        for value in (was, was, now)
    )
    assert before == again != after


def test_a_digest_changes_with_the_parts_of_own_modules_that_code_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of a module in a module, and with those of a package none."""
    outer, inner = ModuleType("outer"), ModuleType("inner")
    monkeypatch.setitem(sys.modules, "outer", outer)
    monkeypatch.setitem(sys.modules, "inner", inner)
    vars(outer).update(inner=inner, RATE=1, other=0)
    exec("import outer\ndef twice():\n    return 2", vars(inner))
    act = code("import outer, numpy\ndef act():\n    return outer.inner.twice() + outer.RATE + numpy.pi")["act"]
    first = code_digest(act)
    vars(outer).update(other=1)
    assert code_digest(act) == first, "it is not named"
    vars(outer).update(RATE=2)
    second = code_digest(act)
    exec("def twice():\n    return 3", vars(inner))
    assert len({first, second, code_digest(act)}) == 3


def test_code_is_the_same_in_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a script, and of a module that is in no file; whatever order the hashes of texts give its sets there."""
    unwritten = ModuleType("unwritten")
    exec(_SOURCE, vars(unwritten))
    monkeypatch.setitem(sys.modules, "unwritten", unwritten)
    makers = [variables[name] for variables in (code(), vars(unwritten)) for name in ("MyAgent", "make", "partial")]
    found = [CodeByValue.of(make) for make in makers]
    probe = (
        "import sys, pickle, cloudpickle\n"
        "from imagine_bench.registry.by_value import code_digest\n"
        "print([code_digest(cloudpickle.loads(each.pickled)) for each in pickle.load(sys.stdin.buffer)])"
    )
    words = [sys.executable, "-c", probe]
    done = subprocess.run(words, input=cloudpickle.dumps(found), capture_output=True, check=True)
    assert done.stdout.decode().strip() == str([each.digest for each in found])


def numbers(results: api.Comparison, table: str = "") -> dict[str, list[Any]]:
    """A table without its times; NaN as text, so that it equals itself."""
    frame = results.frame(table)
    names = [name for name in frame if name not in _TIMES and not name.startswith("time/")]
    return {name: list(map(repr, np.asarray(frame[name]).tolist())) for name in names}


@pytest.mark.slow
def test_a_worker_process_gives_the_bits_of_this_process(tmp_path: Path) -> None:
    given = {**TWO_EPISODES, "agents": ["dqn", code()["MyAgent"]], "execution": "physics"}
    here, there = (
        imagine_bench.bench("arrow_puzzle", **{**given, "launcher": launcher}, out=tmp_path / launcher)
        for launcher in ("this_process", "local")
    )
    assert here.folder.name == there.folder.name
    assert numbers(here) == numbers(there) and numbers(here)["agent"].count("'MyAgent'") == 2
    assert here.verdict() == there.verdict()
    runs = [each.folder / "MyAgent/seed_0/checkpoints" for each in (here, there)]
    states = [next(run.glob("*/runner.safetensors")).read_bytes() for run in runs]
    assert states[0] == states[1]


@pytest.mark.slow
@pytest.mark.parametrize("from_stdin", [True, False])
def test_a_script_needs_no_guard(from_stdin: bool, tmp_path: Path) -> None:
    call = {**TWO_EPISODES, "launcher": "local", "workers": 1, "agents": ["MyAgent"]}
    text = _SOURCE + (
        "import imagine_bench\n"
        "imagine_bench.register_agent('MyAgent', MyAgent)\n"
        f"print(imagine_bench.bench('arrow_puzzle', **{call!r}).frame()['agent'])\n"
    )
    (tmp_path / "script.py").write_text(text)
    words = [sys.executable, "-" if from_stdin else "script.py"]
    done = subprocess.run(words, cwd=tmp_path, input=text, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "MyAgent" in done.stdout, done.stderr


@pytest.fixture
def results(tmp_path: Path) -> api.Comparison:
    """A small bench of a class."""
    return imagine_bench.bench("arrow_puzzle", agents=["random", Shifting], out=tmp_path, **TWO_EPISODES)


def test_a_class_of_an_equal_name_elsewhere_is_not_the_registered_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = ModuleType("first"), ModuleType("second")
    for module, action in ((first, 1), (second, 2)):
        monkeypatch.setitem(sys.modules, module.__name__, module)
        exec(_SOURCE.replace("return self.wrapped(int(observation.frame.sum()))", f"return {action}"), vars(module))
    imagine_bench.register_agent("named", first.MyAgent, title="Named")
    ran = [imagine_bench.bench("arrow_puzzle", agents=[each.MyAgent], out=tmp_path, **TWO_EPISODES)
           for each in (first, second)]  # fmt: skip
    assert [set(each.frame()["agent"]) for each in ran] == [{"named"}, {"MyAgent"}]


def test_a_changed_class_resumes_no_run(results: api.Comparison, capsys: pytest.CaptureFixture[str]) -> None:
    run = results.folder / "Shifting/seed_0"
    content = {path: path.read_bytes() for path in results.folder.rglob("*") if path.is_file()}
    again = {**TWO_EPISODES, "agents": ["random", Shifting], "out": results.folder.parents[1]}
    assert imagine_bench.bench("arrow_puzzle", **again, track="tensorboard").folder == results.folder
    said = capsys.readouterr().out
    assert "All runs lie in" in said and "Note: 2 of 2 runs were finished before and are not tracked" in said
    changed = type("Shifting", (Shifting,), {"shift": 1})
    with pytest.raises(ArtefactError, match=r"code of agent Shifting is not that of this bench"):
        imagine_bench.register_agent("Shifting", changed)
        load_trained(run)
    other = imagine_bench.bench("arrow_puzzle", **{**again, "agents": ["random", changed]})
    assert other.folder != results.folder
    assert f"the code of an agent or of the task was changed since {results.folder}" in capsys.readouterr().out
    kept = {path: path.read_bytes() for path in content}
    assert kept == content, "the former bench stays as it is"
    imagine_bench.register_agent("Shifting", Shifting)
    assert load_trained(run).episodes == 2, "the former class, again"
    assert learners(results.folder) == (run,)
    del registry.AGENTS["Shifting"]
    for read in (lambda: learners(results.folder), lambda: load_trained(run), lambda: model_entry(str(run))):
        with pytest.raises(ArtefactError, match="of a script"):
            read()


def test_a_frame_is_the_table_of_the_report(results: api.Comparison, monkeypatch: pytest.MonkeyPatch) -> None:
    page = results.report()
    assert {path.stem for path in page.parent.glob("*.csv")} == set(results.tables)
    for name, text in results.tables.items():
        assert (page.parent / f"{name}.csv").read_text() == text
        header, *rows = csv.reader(io.StringIO(text))
        frame = results.frame(name)
        assert list(frame) == header
        for column, cells in zip(header, zip(*rows, strict=True), strict=True):
            for value, cell in zip(frame[column], cells, strict=True):
                if cell in ("", "nan"):
                    assert value == "" or np.isnan(value), (name, column)
                else:
                    assert type(value)(cell) == value, (name, column)
    assert all(isinstance(value, str) for value in results.frame()["solved"]), "digits that are a text"
    told = shlex.split(read_sealed(results.folder / "sessions.json", "sessions")["environment"]["command"])
    given = "preset='smoke', agents=['random', 'Shifting'], seeds=1, budgets=[1, 2], evaluation_episodes=2, "
    call = f"imagine_bench.bench('arrow_puzzle', {given}execution='kinematic')"
    assert told == ["python", "-c", f"import imagine_bench; {call}"]
    pandas = ModuleType("pandas")
    vars(pandas)["DataFrame"] = lambda columns: ("pandas", columns)
    monkeypatch.setitem(sys.modules, "pandas", pandas)
    kind, columns = results.frame()
    assert kind == "pandas" and list(columns)[:3] == ["agent", "seed", "episodes"]


def test_diagnostics_of_any_kind_of_number_are_read_again_from_a_report(tmp_path: Path) -> None:
    class Measured(Shifting):
        def diagnostics(self) -> dict[str, Any]:
            return {"done": True, "small": np.float32(0.5), "tensor": torch.tensor(2.0), "steps": 3}

    imagine_bench.register_agent("inf", Measured)
    page = imagine_bench.bench("arrow_puzzle", agents=["inf"], out=tmp_path, **TWO_EPISODES).report()
    frame = imagine_bench.load(page.parent).frame()
    assert set(frame["agent"]) == {"inf"}, "a name, and no number"
    assert [float(frame[name][0]) for name in ("done", "small", "tensor", "steps")] == [1.0, 0.5, 2.0, 3.0]
    with pytest.raises(InvalidValueError, match=r"diagnostic 'many' is array\(\[1, 2\]\); give a number"):
        values.numbers({"many": np.array([1, 2])})
    with pytest.raises(InvalidValueError, match=r"diagnostic 'text' is '3'; give a number"):
        values.numbers({"text": "3"})


@pytest.mark.parametrize(
    ("asked", "shown"),
    [("dqn/seed_1", "dqn/seed_1"), ("dqn", "dqn/seed_12"), ("seed_1", "sb3_dqn/seed_1"), ("", "sb3_dqn/seed_1")],
)
def test_a_recording_is_chosen_by_whole_parts_of_its_path(
    asked: str, shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for run in ("dqn/seed_1", "dqn/seed_12", "sb3_dqn/seed_1"):
        (tmp_path / run).mkdir(parents=True)
        (tmp_path / run / "recording.rrd").touch()
    opened: list[Path] = []
    monkeypatch.setattr("imagine_bench.recording.stream.open_in_viewer", opened.append)
    api.Comparison(tmp_path, None).show_recording(asked)
    assert opened == [tmp_path / shown / "recording.rrd"]


def test_results_stay_where_they_are_if_the_process_goes_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = imagine_bench.bench("arrow_puzzle", agents=["random"], out="runs", **TWO_EPISODES)
    found = imagine_bench.load(made.folder.relative_to(tmp_path))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for results in (made, found):
        assert results.report() == made.folder / "report/index.html"
    assert made.folder.is_relative_to(tmp_path / "runs") and not list(Path.cwd().iterdir())


def test_a_home_folder_is_meant_by_its_sign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where results are written, where they are read, and the file of an encoder."""
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = imagine_bench.bench("arrow_puzzle", agents=["random"], out="~/runs", **TWO_EPISODES).folder
    assert folder.is_relative_to(tmp_path / "runs")
    assert imagine_bench.load(f"~/{folder.relative_to(tmp_path)}").folder == folder
    shutil.copy(encoders.bundled()["arrow_puzzle-clean"], tmp_path / "mine.safetensors")
    spec = registry.task("arrow_puzzle")
    assert encoders.resolve(spec, "clean", "~/mine.safetensors") == (tmp_path / "mine.safetensors").resolve()


def test_a_folder_gives_the_same_results_again(results: api.Comparison) -> None:
    results.report()
    for folder in (results.folder, results.folder / "report"):
        again = imagine_bench.load(folder)
        assert dict(again.tables) == dict(results.tables) and again.verdict() == results.verdict()
        assert repr(again) == repr(results)
    assert results.plot().get_axes()[0].get_ylabel() == "test episodes solved (%)"
    with pytest.raises(UnknownNameError, match="success"):
        results.plot("sucess")
    with pytest.raises(ArtefactError, match=r"no recording 'dqn'; it has Shifting/seed_0/recording.rrd, random/seed"):
        results.show_recording("dqn")
    refused = {"random/seed_0": "the folder of one run", "random": "holds no results; give the folder of a bench"}
    for place, words in refused.items():
        with pytest.raises(ArtefactError, match=words):
            imagine_bench.load(results.folder / place)


@pytest.mark.parametrize(
    "kept", ["arrow_puzzle-quick", "arrow_puzzle-study", "suite", "arrow_puzzle-judge", "robot_ik-quick"]
)
def test_kept_results_are_loaded_as_they_were_written(kept: str) -> None:
    results = imagine_bench.load(RESULTS / kept)
    frame = results.frame()
    main = next(iter(results.tables))
    assert main in ("results", "scores")
    rows = table(f"{kept}/{main}.csv")
    assert set(frame) == set(rows[0]) and len(rows) > 5
    if "summary" in results.tables:
        assert set(frame["agent"]) == set(results.frame("summary")["agent"]), "today's names"
    for column in set(frame) - {"agent"}:
        for value, row in zip(frame[column], rows, strict=True):
            text = row[column]
            assert str(value) == text or float(text or "nan") == value or not text, (column, value, text)
    if kept == "arrow_puzzle-quick":
        assert results.plot()
        assert "--budgets 100 250 500 --seeds" in results.verdict(), "the bench that is kept, not today's preset"
    else:
        for method in (results.verdict, results.plot, results.report):
            with pytest.raises(InvalidValueError, match="holds tables alone"):
                method()


def test_every_option_of_the_command_is_a_keyword(tmp_path: Path) -> None:
    """With the same protocol; a mapping stands for its words."""
    pairs: list[tuple[str, Mapping[str, Any]]] = [
        ("--physics pad_friction=0.5", {"physics": {"pad_friction": 0.5}}),
        ("--set controller.discount=0.9", {"set": ["controller.discount=0.9"]}),
        ("--seeds 0 1 2", {"seeds": 3}),
        ("--seeds 4 7", {"seeds": np.array([4, 7])}),
        ("--budgets 1 2 3", {"budgets": range(1, 4)}),
        ("--seeds 0 1", {"seeds": (seed for seed in range(2))}),
        ("--seeds 3", {"seeds": (np.int64(3),), "appearance": Path("clean")}),
        ("--set controller.discount=0.5", {"set": {"controller.discount": np.float32(0.5)}}),
        ("--appearance mild --demonstrations 2", {"appearance": "mild", "demonstrations": 2}),
    ]
    for words, options in pairs:
        command = cli.parsed(["bench", "arrow_puzzle", "--agents", "dqn", *words.split()])
        assert isinstance(command, cli.Bench)
        given = api.protocol_changes({"agents": ["dqn"], **options})
        wanted, _ = api.benches.plan("arrow_puzzle", "quick", **given)
        assert wanted == command.planned()[0], words
    variants = {"variants": [np.int64(50), "100"]}
    assert api.protocol_changes(variants) == {"variants": ("50", "100")}
    for wrong in ({"seeds": {0, 1}}, {"agents": {"dqn", "random"}}):
        with pytest.raises(InvalidValueError, match="or a list of them"):
            imagine_bench.bench("arrow_puzzle", out=tmp_path, **wrong)
    with pytest.raises(InvalidValueError, match="cannot be sent to worker processes"):
        imagine_bench.register_agent("mine", functools.partial(Shifting, _LOCK))


def test_a_class_that_is_changed_keeps_its_name_and_fields() -> None:
    imagine_bench.register_agent("earlier", Shifting)
    imagine_bench.register_agent("mine", Shifting, title="my own", observes=("frame", "state"))
    imagine_bench.register_agent("made", code()["make"])
    first = registry.AGENTS["mine"]
    assert first.description == "Acts by the sum of pixels." and not first.needs_encoder
    changed = type("Shifting", (Shifting,), {"shift": 1, "__doc__": Shifting.__doc__})
    with pytest.raises(UnknownNameError, match="preset"):
        imagine_bench.bench("arrow_puzzle", [changed, code()["make"], code()["MyAgent"]], preset="smke")
    now = registry.AGENTS["mine"]
    assert "Shifting" not in registry.AGENTS and "make" not in registry.AGENTS and "MyAgent" in registry.AGENTS
    assert now.make != first.make and dataclasses.replace(now, make=first.make) == first
    assert registry.AGENTS["earlier"].make == first.make, "of two names the last"
    for make in ("imagine_bench.agents:nope", changed):
        imagine_bench.register_agent("mine", make)
    assert registry.AGENTS["mine"].make == now.make, "a second call replaces it"


def test_an_interrupted_call_says_that_it_goes_on(tmp_path: Path) -> None:
    class Stopped(Shifting):
        def act(self, observation: Any, *, explore: bool) -> int:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="the same call goes on from the last checkpoints"):
        imagine_bench.bench("arrow_puzzle", agents=[Stopped], out=tmp_path, **TWO_EPISODES)


def test_a_class_without_a_method_is_named_before_anything_is_played(tmp_path: Path) -> None:
    class Half:
        def __init__(self, context: Any) -> None: ...

        def act(self, observation: Any, *, explore: bool) -> int:
            raise RuntimeError("played")

        def observe(self, transition: Any, *, episode: int) -> None: ...

        def state(self) -> None: ...

    sentence = "Half has no method diagnostics and no restore; an agent has act, observe, diagnostics, state, restore."
    with pytest.raises(ImagineBenchError, match=sentence):
        imagine_bench.bench("arrow_puzzle", agents=[Half], out=tmp_path, **TWO_EPISODES)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        *((kind, "") for kind in (np.int64, np.uint8, np.array)),
        (lambda action: np.array([1]), r"The agent gave array\(\[1\]\) as an action. An action is one integer"),
        (lambda action: None, "The agent gave None as an action. An action is one integer"),
        (float, r"The agent gave \d\.0 as an action. An action is one integer"),
        (lambda action: 1 // 0, r"Odd seed 0 in arrow_puzzle: ZeroDivisionError: .*\. Log: .*log.txt"),
    ],
)
def test_any_single_integer_is_an_action_and_nothing_else_is(
    given: Callable[[int], Any], said: str, tmp_path: Path
) -> None:
    """An array of one number or a float would go through some parts of a bench and stop others."""

    class Odd(Shifting):
        def act(self, observation: Any, *, explore: bool) -> Any:
            return given(super().act(observation, explore=explore))

        def observe(self, transition: Any, *, episode: int) -> None:
            assert type(transition.action) is int

    fails = pytest.raises(RunFailedError, match=said) if said else contextlib.nullcontext()
    with fails:
        imagine_bench.bench("arrow_puzzle", agents=[Odd], out=tmp_path, **TWO_EPISODES)
