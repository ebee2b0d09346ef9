"""Registry lines of a script or a notebook reach the processes that carry out its runs and do not run it again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from bench_fakes import FakeRunSpec
from guest_packages import Guests
from small_runs import small

from imagine_bench.errors import SetupError
from imagine_bench.protocols.data import Job
from imagine_bench.registry import AGENTS, load
from imagine_bench.running.launchers.jobs import LocalPool
from imagine_bench.store import run_folder

_AGENT = """
from imagine_bench.agents.baselines import RandomAgent
from imagine_bench.cli import main
from imagine_bench.registry import AGENTS, AgentEntry

class Agent(RandomAgent):
    def act(self, observation, *, explore):
        {act}

def make(context):
    return Agent(context.n_actions, context.seeds.child("act").generator())

AGENTS["mine"] = AgentEntry(make="{module}:make", needs_encoder=False)
"""
_BENCH = """main("bench arrow_puzzle --preset smoke --agents {agent} --execution kinematic --budgets 1 --seeds 0 "
     "--evaluation-episodes 1 --workers 1".split())
"""
_JUDGE = """main("judge arrow_puzzle_easy --models copy --sizes 30 --seeds 0 1 --samples 2 --workers 2".split())
"""
_GUARD = 'if __name__ == "__main__":\n    '


def script(module: str, act: str = "return 0", *, guard: bool = True) -> str:
    call = _BENCH.format(agent="mine")
    return _AGENT.format(module=module, act=act) + (_GUARD + call if guard else call)


def test_a_worker_needs_no_script_and_knows_what_it_registers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of standard input: the main module has a file that is none. No file beside it stands for one of Python's."""
    (tmp_path / "pickle.py").write_text("raise RuntimeError('not the one of Python')")
    monkeypatch.chdir(tmp_path)
    main = sys.modules["__main__"]
    monkeypatch.setattr(main, "__file__", "<stdin>", raising=False)
    monkeypatch.setattr(main, "__spec__", None)
    monkeypatch.setitem(AGENTS, "mine", AGENTS["table"])
    spec = FakeRunSpec(protocol=small(agents=("mine",), budgets=(1,), evaluation_episodes=1), agent="mine", seed=0)
    job = Job(spec=spec, folder=tmp_path / "run")
    assert LocalPool(1).launch([job], lambda _: None) == ()
    assert run_folder.is_done(job.folder) and sys.modules["__main__"] is main


_REGISTERS = """
from dataclasses import replace
from imagine_bench.registry import AGENTS, REGRESSIONS, REGRESSORS, TASKS, WORLD_MODELS, RegressorEntry
from imagine_bench.registry.loading import register, registered
AGENTS["mine"] = replace(AGENTS["random"], make="__main__:make", settings="__main__:SETTINGS")
REGRESSIONS["mine"] = "__main__:DATA"
REGRESSORS["mine"] = RegressorEntry(make="__main__:learn", title="", description="")
TASKS["mine"] = replace(TASKS["arrow_puzzle"], spec="__main__:SPEC", env="__main__:Env")
WORLD_MODELS["mine"] = replace(WORLD_MODELS["copy"], make="__main__:model")
there = registered()
for table in (AGENTS, REGRESSIONS, REGRESSORS, TASKS, WORLD_MODELS):
    del table["mine"]
register(there)
print(AGENTS["mine"].make, AGENTS["mine"].settings, REGRESSIONS["mine"], REGRESSORS["mine"].make, TASKS["mine"].spec)
print(TASKS["mine"].env, WORLD_MODELS["mine"].make, AGENTS["random"].make)
"""


@pytest.mark.parametrize(
    ("words", "name"), [(["-"], "__main__"), (["my_agent.py"], "my_agent"), (["-m", "a.b"], "a.b")]
)
def test_main_gets_the_name_that_others_import(words: list[str], name: str, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    for file in ("my_agent.py", "a/b.py"):
        (tmp_path / file).write_text(_REGISTERS)
    given = f"__file__ = '<stdin>'\n{_REGISTERS}"
    done = subprocess.run(
        [sys.executable, *words], cwd=tmp_path, input=given, capture_output=True, text=True, check=True
    )
    mine = ("make", "SETTINGS", "DATA", "learn", "SPEC", "Env", "model")
    assert done.stdout.split() == [*(f"{name}:{each}" for each in mine), AGENTS["random"].make]


def test_a_module_that_runs_a_command_when_imported_is_named(guests: Guests) -> None:
    guests.write("unguarded", "from imagine_bench.cli import main\nmain(['describe'])\n", {})
    with pytest.raises(SetupError, match=r"unguarded runs a command when it is imported.*Write the line 'if __name__"):
        load("unguarded:make")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "from_stdin", "code", "said"),
    [
        (script("__main__"), False, 0, "Report:"),
        (script("mine", "raise RuntimeError('boom')"), False, 1, "mine seed 0 in arrow_puzzle: RuntimeError: boom"),
        (script("__main__", guard=False), False, 1, "mine runs a command when it is imported"),
        (script("__main__", guard=False), True, 1, "write the code to a file"),
        ("from imagine_bench.cli import main\n" + _BENCH.format(agent="random"), True, 0, "Report:"),
        ("from imagine_bench.cli import main\n" + _JUDGE, True, 0, "Recording:"),
        ("from imagine_bench.cli import main\nmain(['bench', 'nowhere'])\n", False, 2, "No task 'nowhere'"),
    ],
)
def test_a_script_ends_as_its_command_does(text: str, from_stdin: bool, code: int, said: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(text)
    words = [sys.executable, "-"] if from_stdin else [sys.executable, "mine.py"]
    done = subprocess.run(
        words, cwd=tmp_path, input=text if from_stdin else "", capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stderr
    assert said in done.stdout + done.stderr and "Traceback" not in done.stderr
