"""Programs in a file: their limits, their exactness, their names, and benches and judgements of them."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
from imagine_bench_programs import __main__ as commands
from imagine_bench_programs.experience import macro_actions_of, play, write_experience
from imagine_bench_programs.model import make_program
from imagine_bench_programs.program import Program, spelled
from imagine_bench_programs.scores import efficiency, score
from imagine_bench_programs.symbol_rules import SymbolRules
from imagine_bench_programs.symbols import Symbols
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench import bench, registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ImagineBenchError, InvalidValueError
from imagine_bench.interfaces import AgentContext, Outcome, State, TaskSpec
from imagine_bench.protocols.control import context_of, protocol
from imagine_bench.protocols.data import RunSpec
from imagine_bench.rules import states_of_play
from imagine_bench.running.isolation import Limits
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders

ARROWS = Path(__file__).parents[1] / "examples" / "arrows.py"
SIZES = (4, 4, 4, 3)
STATE = (0, 1, 2, 0, 0)
REACHES = "import collections\ncollections._sys.modules"
"""Loaded modules, past the checked import: the audit hook refuses their calls."""
HOSTILE = {
    "hangs": ("while True: pass", "it was stopped after 6 s, the limit of a call."),
    "hangs when it is asked": ("def outcomes(s, a):\n while True: pass", "it was stopped after 6 s"),
    "forks": (f"{REACHES}['os'].fork()", "it calls os.fork; a program only computes."),
    "starts a command": (f"{REACHES}['subprocess'].run(['ls'])", "it calls subprocess.Popen"),
    "calls the C library": (f"{REACHES}['ctypes'].CDLL(None).fork()", "it calls ctypes.dlopen"),
    "opens a socket": (f"{REACHES}['socket'].socket()", "it calls socket.__new__"),
    "imports a module that is loaded": ("import os", "it imports os; a program may import bisect, "),
    "imports a part that no program needs": ("import numpy.lib", "it imports numpy.lib; a program may"),
    "imports a part of one": ("from os import path", "it imports os; a program may"),
    "imports when it is asked": ("def outcomes(s, a):\n from time import time", "it imports time; a program may"),
    "imports by a function": ("__import__('random')", "it imports random; a program may"),
    "imports from its own package": ("from . import guest", "it imports .; a program may"),
    "reads a file": ("open('/etc/passwd')", "it opens '/etc/passwd'; a program reads and writes no files."),
    "imports the rules": ("import imagine_bench.tasks.arrows.rules", "it imports imagine_bench.tasks"),
    "prints": ("def outcomes(s, a):\n print('hello')\n return {s: 1.0}", "it prints 'hello"),
    "exits": ("raise SystemExit(3)", "it raises SystemExit: 3"),
    "ends its process": (f"{REACHES}['os']._exit(4)", "its process ended itself with exit code 4."),
    "fills the memory": ("x = bytearray(3 << 30)", "it raises MemoryError"),
    "raises": ("def outcomes(s, a): raise KeyError('x')", "it raises KeyError: 'x'"),
    "is no Python": ("def outcomes(:", "it raises SyntaxError"),
    "has no function": ("x = 1", "it has no function outcomes(symbols, action)."),
    "gives a list": ("def outcomes(s, a): return [s]", "give a dictionary of outcomes."),
    "gives NaN": ("def outcomes(s, a): return {s: float('nan')}", "the probabilities nan; give numbers"),
    "gives a half": ("def outcomes(s, a): return {s: 0.5}", "the probabilities 0.5; give numbers of at least 0"),
    "gives less than 0": ("def outcomes(s, a): return {s: 1.5, (0, 0, 0, 0): -0.5}", "probabilities 1.5, -0.5"),
    "gives other values": ("def outcomes(s, a): return {(9, 9, 9, 9): 1.0}", "symbols lie below (4, 4, 4, 3)."),
    "gives half a symbol": ("def outcomes(s, a): return {(0, 1, 2, 0.5): 1.0}", "(0, 1, 2, 0.5); give whole numbers."),
    "gives fewer symbols": ("def outcomes(s, a): return {(0,): 1.0}", "give 4 symbols, or (symbols, reward"),
}


_FAST = {"imports a part that no program needs", "imports a part of one", "gives fewer symbols", "gives half a symbol"}


@pytest.mark.parametrize(
    ("source", "said"),
    [
        pytest.param(*case, id=name, marks=[pytest.mark.slow] * (name not in _FAST))  # half a CPU second each
        for name, case in HOSTILE.items()
    ],
)
def test_a_hostile_program_gets_one_sentence(source: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "hostile.py"
    file.write_text(source)
    limits = Limits(call_s=6.0 if "while" in source else 60.0, memory=1 << 30)
    with pytest.raises(InvalidValueError) as raised:
        Program(str(file), SIZES, 6, limits).outcomes(STATE, 0)
    sentence = str(raised.value)
    assert sentence.startswith(f"Program {file}: ") and said in sentence and "\n" not in sentence


def test_each_factor_has_its_own_symbols_from_0_to_its_size(tmp_path: Path) -> None:
    """The program changes the factor that the first symbol names to the value that the second one names."""
    file = tmp_path / "changes.py"
    file.write_text(
        "def outcomes(symbols, action):\n"
        "    place, value = symbols[:2]\n"
        "    return {(*symbols[:place], (-1, 0, 2, 3, 4)[value], *symbols[place + 1 :]): 1.0}\n"
    )
    sizes = (4, 5, 3, 4)
    changes = Program(str(file), sizes, 1)
    for place, size in enumerate(sizes):
        for number, value in enumerate((-1, 0, 2, 3, 4)):
            state = (place, number, 0, 0, 0)
            if 0 <= value < size:
                (outcome,) = changes.outcomes(state, 0)
                assert outcome.macrostate[place] == value
            else:
                with pytest.raises(InvalidValueError, match=re.escape(f"symbols lie below {sizes}.")):
                    changes.outcomes(state, 0)


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A copy of the example."""
    return shutil.copy(ARROWS, tmp_path / "mine.py")


@pytest.fixture(scope="module")
def program() -> Program:
    return Program(str(ARROWS), SIZES, 6)


def test_the_example_is_exact(program: Program) -> None:
    found = score(program, registry.task("arrow_puzzle"))
    assert (found.total_variation, found.found, found.facts) == (0.0, 39, 39)
    assert (found.ranking, found.fidelity) == (1.0, 1.0)
    assert len(ARROWS.read_text().splitlines()) <= 25


class Elsewhere(SymbolRules):
    """The rules, but with some probability the next symbols are others."""

    def __init__(self, spec: TaskSpec, elsewhere: State, share: float = 0.8) -> None:
        super().__init__(spec.n_actions)
        self._rules = spec.rules
        self._elsewhere = elsewhere
        self._share = share

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        right = [replace(each, probability=1.0 - self._share) for each in self._rules.outcomes(macrostate, action)]
        return (*right, Outcome(self._share, self._elsewhere, -1.0, terminated=False, success=False))


def test_only_macrostates_of_the_world_are_distractors() -> None:
    """Nothing else can be drawn, however probable it is. Of 164 others, five are drawn and one is no less probable."""
    spec = registry.task("arrow_puzzle")
    for outside in ((-1, -1, -1, -1), (0, 0, 0, 0)):
        assert score(Elsewhere(spec, outside), spec).ranking == 1.0
    start = spec.rules.start_states[0]
    reached = sum(each.macrostate == start for pair in pairs_of_play(spec) for each in spec.rules.outcomes(*pair))
    unreached = 1.0 - reached / len(pairs_of_play(spec))
    expected = unreached * (1.0 - 5 / 164) + (1.0 - unreached)
    for share, ranking in ((0.8, expected), (0.5, expected), (0.4, 1.0)):
        assert score(Elsewhere(spec, start, share), spec).ranking == pytest.approx(ranking, abs=1e-12)


def pairs_of_play(spec: TaskSpec) -> list[tuple[State, int]]:
    """Every macro-action in every macrostate in which an episode goes on."""
    return list(itertools.product(states_of_play(spec.rules), range(spec.n_actions)))


def test_experience_of_another_task_gives_no_efficiency(tmp_path: Path) -> None:
    for task in ("arrow_puzzle", "arrows:slip=0.5", "pick_place", "arrows:gesture=first,horizon=2"):
        folder = tmp_path / task
        write_experience(task, folder, macro_actions=30, seed=0)
        assert macro_actions_of(folder, registry.task(task)) == 30
        rows, step = json.loads((folder / "experience.json").read_text())["transitions"], 0
        for row, following in itertools.pairwise(rows):
            step += 1
            assert row[5] == (row[4] or step == registry.task(task).horizon), "the last of its episode"
            assert row[5] or row[2] == following[0]
            step *= not row[5]
    for task in ("arrows:slip=0.5", "pick_place"):
        with pytest.raises(InvalidValueError, match=r"holds experience that arrow_puzzle cannot give"):
            macro_actions_of(tmp_path / task, registry.task("arrow_puzzle"))


def test_the_command_says_each_score(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The example misses slips by their probability: each of six macro-actions turns one cube, from four directions.

    Efficiency is a square, and at most 1.
    """
    assert efficiency(100.0, 50) == 1.0
    monkeypatch.setattr(commands, "_learner", lambda spec: 100.0)
    write_experience("arrows:slip=0.2", tmp_path / "mine", macro_actions=200, seed=0)
    words = ["programs", "score", "arrows:slip=0.2", str(ARROWS), "--experience", str(tmp_path / "mine")]
    monkeypatch.setattr(sys, "argv", words)
    commands.main()
    assert re.findall(r"^(.*?) {2,}(.*)$", capsys.readouterr().out, re.MULTILINE) == [
        ("total variation", "0.2000"),
        ("facts", "15 of 39"),
        ("state ranking", "0.8000"),
        ("fidelity", "0.9500"),
        ("efficiency", "0.25: 200 macro-actions, the cautious learner 100"),
    ]


def test_a_changed_file_is_another_agent_and_resumes_nothing(mine: Path) -> None:
    name = f"program:{mine}"
    before = protocol("arrow_puzzle", "smoke", agents=(name,))
    assert before.agents == (f"program:{spelled(str(mine))}",)
    mine.write_text(ARROWS.read_text() + "# changed\n")
    assert protocol("arrow_puzzle", "smoke", agents=(name,)).hash != before.hash
    kept = RunSpec(protocol=before, agent=before.agents[0], seed=0, encoder=None)
    with pytest.raises(InvalidValueError, match="was changed: its digest is"):
        Program(context_of(kept).argument, SIZES, 6)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("program", "program alone is no name; give program:ARGUMENT"),
        ("program:nowhere.py", "The program nowhere.py cannot be read"),
        (f"program:{ARROWS},symbols=pixels", "pixels"),
        (f"program:{ARROWS},symbol=codes", "symbol"),
    ],
)
def test_a_name_that_is_none_gets_one_sentence(name: str, said: str) -> None:
    with pytest.raises(ImagineBenchError, match=said):
        registry.settings(protocol("arrow_puzzle", "smoke", agents=(name,)).agents[0], "fast", {}, "chapter_5")


def test_a_path_may_hold_an_at_sign(mine: Path) -> None:
    file = mine.rename(mine.with_name("me@home.py"))
    name = spelled(str(file))
    assert name == f"{file}@{spelled(str(ARROWS))[-12:]}" and spelled(name) == name
    assert Program(name, SIZES, 6).name == str(file)
    assert registry.agent_entry(f"program:{name}").title == f"program (symbols given) {file}"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (f"score nosuchtask {ARROWS}", "No task 'nosuchtask'."),
        ("experience arrow_puzzle_easy FILE", "Cannot write FILE"),
        ("experience arrow_puzzle_easy new --seed -1", "seed is -1; give an integer from 0 on."),
        ("write arrow_puzzle_easy nosuchtask --seeds 0", "No task 'nosuchtask'."),
        ("write arrow_puzzle_easy --seeds -1", "--seeds is -1; give an integer from 0 on."),
        ("write arrow_puzzle_easy --times 0", "--times is 0, and the cautious learner of arrow_puzzle_easy has 20"),
        ("write arrow_puzzle_easy --times nan", "--times is nan, and"),
        ("write arrow_puzzle_easy --out FILE", "FILE is not a file of 'write'"),
        ("write arrow_puzzle_easy --out FILE/written.json", "Cannot write"),
    ],
)
def test_an_error_of_a_command_ends_with_its_own_exit_code(
    words: str, sentence: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("FILE").write_text("no JSON")
    monkeypatch.setattr(commands, "_learner", lambda spec: 20.0)
    monkeypatch.setattr(sys, "argv", ["programs", *words.split()])
    with pytest.raises(SystemExit) as ended:
        commands.main()
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.err.startswith(sentence)
    assert not said.out, "it ends before any work"
    assert [path.name for path in tmp_path.iterdir()] == ["FILE"]


def test_allowed_modules_and_their_parts_are_imported(tmp_path: Path) -> None:
    file = tmp_path / "imports.py"
    file.write_text(
        "import numpy.linalg\nfrom collections import abc\nfrom numpy import random\n"
        "def outcomes(s, a):\n import math\n return {s: math.cos(0.0)}\n"
    )
    (only,) = Program(str(file), SIZES, 6).outcomes(STATE, 0)
    assert only.probability == 1.0


def test_a_program_without_rewards_is_judged_and_not_planned_in(tmp_path: Path) -> None:
    file = tmp_path / "stays.py"
    file.write_text("def outcomes(s, a):\n return {s: 1.0}\n")
    spec = registry.task("arrow_puzzle")
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=encoders.own(spec, "clean", "codes"),
        seeds=SeedTree(0),
        argument=str(file),
    )
    model = make_program(context)
    frames = spec.render_macrostates(np.array([STATE[:4]]), "clean", np.random.default_rng(0))
    imagined = model.imagine(frames[None], np.zeros((1, 1), dtype=np.int64), 1, np.random.default_rng(0))
    assert imagined.rewards is None and imagined.pictures.shape[:3] == (1, 1, 1)
    with pytest.raises(InvalidValueError, match="have no reward"):
        model.rules.optimal_action(STATE)


@pytest.mark.slow  # three processes
def test_tests_of_experience_pass_for_the_true_program_alone(tmp_path: Path) -> None:
    folder = tmp_path / "experience"
    write_experience("arrow_puzzle", folder, macro_actions=60, seed=0)
    known = json.loads((folder / "experience.json").read_text())
    assert len(known["transitions"]) == known["macro_actions"] == 60 and known["factors"] == list(SIZES)
    assert "arrow" not in "".join(path.read_text() for path in folder.iterdir()), "the world has no names"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", "/dev/null", str(folder)]
    for source, code in ((ARROWS.read_text(), 0), (ARROWS.read_text().replace("3 if", "2 if"), 1)):
        (folder / "program.py").write_text(source)
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stdout
    with pytest.raises(InvalidValueError, match="give an empty folder"):
        write_experience("arrow_puzzle", folder, macro_actions=60, seed=0)


@pytest.mark.slow  # a judgement and a bench
def test_a_program_is_judged_exact_and_benched_without_training(tmp_path: Path) -> None:
    name = f"program:{ARROWS}"
    judged = ["judge", "arrow_puzzle", "--models", name, "--sizes", "30", "--seeds", "0", "--workers", "1"]
    assert main([*judged, "--out", str(tmp_path / "judged")]) == 0
    (cell,) = (tmp_path / "judged").glob("*/program*.json")
    assert json.loads(cell.read_text())["total_variation"] < 0.005
    options = {"execution": "kinematic", "evaluation_episodes": 20, "launcher": "this_process"}
    found = bench("arrow_puzzle", name, preset="smoke", out=tmp_path, **options)
    assert {float(share) for share in found.frame()["success_rate"]} == {1.0}


def test_experience_begins_from_every_start_and_chance_decides_as_the_rules_say() -> None:
    """One of five macro-actions slips, and the gesture is seen in three of ten first frames."""
    spec = registry.task("arrows:cubes=2,slip=0.2,gesture=0.3")
    rng = np.random.default_rng(0)
    rows = [row for row, _ in itertools.islice(play(spec, lambda _: int(rng.integers(4)), rng), 3000)]
    starts = [row.now for row in rows if row.step == 0]
    assert {state for state in starts if state[-1] >= 0} == set(spec.rules.start_states)
    for found, share in (([row.then[:-1] == row.now[:-1] for row in rows], 0.2), ([s[-1] >= 0 for s in starts], 0.3)):
        assert abs(np.mean(found) - share) < 4.0 * np.sqrt(share * (1.0 - share) / len(found))


def test_experience_is_as_late_and_hidden_as_frames() -> None:
    """A symbol that is hidden is the one last seen; rewards and ends come at once."""
    spec = registry.task("arrows:cubes=2,gesture=first,lag=2")
    rng = np.random.default_rng(0)
    for row, _ in itertools.islice(play(spec, lambda _: int(rng.integers(spec.n_actions)), rng), 300):
        if row.step == 0:
            states = [row.now]
        (outcome,) = spec.rules.outcomes(states[-1], row.action)
        states.append(outcome.macrostate)
        assert (row.reward, row.ended) == (outcome.reward, outcome.terminated)
        assert row.now == states[max(0, row.step - 2)] and row.then == states[max(0, row.step - 1)]


class TwoShown:
    """An encoder of one factor of two values, which its probe reads as two of three macrostates."""

    card = SimpleNamespace(code_sizes=(2,), cardinalities=(3,))

    def read_macrostate(self, hot: Tensor) -> NDArray[np.int64]:
        return hot.argmax(dim=1, keepdim=True).numpy()

    def decode(self, hot: Tensor) -> NDArray[np.float32]:
        return (0.25 + 0.5 * hot.argmax(dim=1)[:, None, None]).numpy() * np.ones((1, 64, 64), dtype=np.float32)


@pytest.mark.parametrize(("kind", "shown"), [("macrostates", [64, 191, 0]), ("codes", [64, 191])])
def test_a_macrostate_that_no_code_shows_is_black(kind: str, shown: list[int]) -> None:
    context: Any = SimpleNamespace(device="cpu")
    with mock.patch("imagine_bench_programs.symbols.load_perception", return_value=SimpleNamespace(encoder=TwoShown())):
        symbols = Symbols(context, kind)
    images = symbols.images([(value,) for value in range(len(shown))])
    assert images[:, 0, 0].tolist() == images[:, -1, -1].tolist() == shown
