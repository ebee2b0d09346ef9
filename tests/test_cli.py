"""The command line: its answers to wrong words, and that a bench ends in a table, a report and an honest exit code."""

from __future__ import annotations

import dataclasses
import os
import pickle
import re
import shlex
import signal
import subprocess
import sys
import unicodedata
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bench_fakes  # noqa: F401 - registers the fakes
import pytest
import torch
from imagine_bench.agents.encoders.perception import prepare_torch
from small_runs import Inline

import imagine_bench
from imagine_bench import cli, errors, registry
from imagine_bench.cli import exit_code as main
from imagine_bench.cli import tools
from imagine_bench.errors import ImagineBenchError, UnknownNameError
from imagine_bench.protocols.presets import PRESETS
from imagine_bench.recording import stream
from imagine_bench.registry import AGENTS, TASKS, WORLD_MODELS
from imagine_bench.registry.entries import AgentConfiguration, parse_configuration
from imagine_bench.store.bench_folder import newest_bench
from imagine_bench.tools.describe import describe
from imagine_bench.values import dotted
from imagine_bench.version import __version__

DRAWING = {"MUJOCO_GL", "LP_NUM_THREADS", "PYOPENGL_PLATFORM", "SDL_FRAMEBUFFER_ACCELERATION"}
"""Variables that MuJoCo, PyOpenGL, Mesa and SDL read as long as the process draws (docs/reference/api.md)."""


def bench_words(out: Path, *more: str, preset: str = "smoke") -> list[str]:
    words = f"bench --task arrow_puzzle --preset {preset} --execution kinematic --out"
    return [*words.split(), str(out), *more]


@pytest.mark.parametrize(
    ("words", "now", "sentence"),
    [
        (["study", "--task", "arrow_puzzle", "--file", "x.toml"], "sweep --task arrow_puzzle --file x.toml", "x.toml"),
        (["film", "--task", "arrow_puzzle", "--out", "x"], "play --film --task arrow_puzzle --out x", "end in .gif"),
    ],
)
def test_a_former_command_runs_the_new_one(
    words: list[str], now: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    first, *others = capsys.readouterr().err.splitlines()
    assert first == f"imagine-bench: '{words[0]}' is now: imagine-bench {now}"
    assert sentence in others[0]


@pytest.mark.parametrize("words", ["--seeds 0-2 7 --out 2026-11", "--seeds=0-2 --out=2026-11"])
@pytest.mark.parametrize("home", ["", "~/"])
def test_a_range_stands_for_its_seeds_and_for_nothing_else(words: str, home: str) -> None:
    """And a home folder for its path."""
    command = cli.parsed(["bench", "arrow_puzzle", *words.replace("2026", f"{home}2026").split()])
    assert isinstance(command, cli.Bench)
    assert command.budget.seeds is not None and command.budget.seeds[:3] == (0, 1, 2)
    assert command.launch.out == Path(Path.home() if home else "") / "2026-11"


def test_a_command_called_from_python_leaves_the_process_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MPLBACKEND", "module://a_notebooks_own")

    def process() -> tuple[object, ...]:
        denormal = torch.tensor(1e-323, dtype=torch.float64).item()
        handlers = [signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)]
        settings = [torch.get_num_threads(), torch.backends.cudnn.deterministic, denormal, torch.get_default_dtype()]
        environment = {name: value for name, value in os.environ.items() if name not in DRAWING}
        return environment, list(sys.path), handlers, settings

    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    before = process()
    with pytest.raises(SystemExit, match="2"):  # once the agent is made, and torch prepared for it
        cli.main(bench_words(tmp_path, *"--agents dqn --encoder pick_place-clean".split()))
    assert "reads frames as 'small_rgb'" in capsys.readouterr().err
    after = process()
    prepare_torch("cpu")
    assert process() != after == before
    torch.set_num_threads(threads)


@pytest.mark.parametrize("word", ["--help", "describe"])
def test_help_and_lists_load_nothing_heavy(word: str) -> None:
    probe = (
        f"import sys, runpy; sys.argv = ['imagine-bench', {word!r}]\n"
        "try: runpy.run_module('imagine_bench', run_name='__main__')\n"
        "except SystemExit: pass\n"
        "heavy = ('torch', 'mujoco', 'rerun', 'matplotlib', 'dm_control', 'scipy.stats', 'PIL')\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert "bench" in done.stdout or "arrow_puzzle" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> Inline:
    """Runs of the command in this process, in the order in which the fixture notes them."""
    launcher = Inline()
    monkeypatch.setattr("imagine_bench.cli.options.launcher", lambda *_: launcher)
    return launcher


def test_a_failing_seed_fails_the_command_and_names_its_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], inline: Inline
) -> None:
    assert main(bench_words(tmp_path, "--agents", "failing", "--seeds", "0", "1", "--budgets", "5")) == 1
    folder = newest_bench(tmp_path)
    assert capsys.readouterr().err.splitlines()[-2:] == [
        "imagine-bench: 1 of 2 runs failed; the same command tries them again and keeps the others.",
        f"  failing seed 1 in arrow_puzzle: this agent breaks on purpose. Log: {folder}/failing/seed_1/log.txt",
    ]
    assert len(inline.order) == 2
    assert (folder / "failing/seed_0/DONE").exists() and not (folder / "failing/seed_1/DONE").exists()
    assert main(["report", str(folder)]) == 0
    assert "Missing are failing seed 1: 0 of 5" in capsys.readouterr().out, "a missing run is never left out"


def test_a_bench_ends_with_a_table_a_report_and_recordings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], inline: Inline
) -> None:
    few = "--agents random oracle --seeds 3 5 --budgets 10 20 --evaluation-episodes 10"
    words = bench_words(tmp_path, *few.split(), preset="quick")
    assert main(words) == 0
    said = capsys.readouterr().out
    folder = newest_bench(tmp_path)
    assert re.search(r"^oracle +100", said, re.MULTILINE)
    assert f"Report:     {folder}/report/index.html" in said
    assert (folder / "report" / "index.html").stat().st_size > 10_000
    assert len(list(folder.glob("*/seed_3/recording.rrd"))) == 2
    assert "Recordings: 2, such as" in said, "those of the first seed"
    assert main(words) == 0
    assert len(inline.order) == 4, "a finished bench is not run again"
    assert capsys.readouterr().out.splitlines()[-4:] == said.splitlines()[-4:]


_SUITE = """
agents = ["oracle"]
evaluation_episodes = 4
hyperparameters = "minimal"
[[experiments]]
name = "size"
dial = "cubes"
question = "?"
levels = [{name = "1", task = "arrows:cubes=1", episodes = 5}, {name = "2", task = "arrows:cubes=2", episodes = 5}]
[[experiments]]
name = "other"
dial = "cubes"
question = "?"
levels = [{name = "1", task = "arrows:cubes=1", episodes = 5}]
"""
_STUDY = """
question = "?"
budgets = [2]
evaluation_episodes = 2
seeds = [1000]
variants = [
    {name = "table", factor = "", agent = "table"},
    {name = "mild", factor = "appearance", agent = "table", against = "table", world = {appearance = "mild"}},
    {name = "imaginer", factor = "agent", agent = "imaginer", against = "table"},
]
"""


def test_a_sweep_of_a_file_runs_what_is_wanted_and_reports(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], inline: Inline
) -> None:
    grids = {"mine.toml": _SUITE, "factor.toml": _STUDY}
    for name, text in grids.items():
        (tmp_path / name).write_text(text)
    suite, study = (["sweep", "--out", str(tmp_path / "runs"), "--name", str(tmp_path / name)] for name in grids)
    assert main([*suite, *"--experiment size --agents oracle random --seeds 4 3".split()]) == 0
    assert sorted(inline.order) == sorted((agent, seed) for agent in ("oracle", "random") for seed in (3, 4) * 2)
    said = capsys.readouterr().out
    assert re.search(r"^size: cubes +1\.00 ", said, re.MULTILINE)
    (page,) = (tmp_path / "runs" / "suite").glob("mine-*/report/index.html")
    assert f"Report:     {page}" in said
    inline.jobs.clear()
    assert main([*suite, *"--experiment other --seeds 4 1".split()]) == 0
    assert inline.order == [("oracle", 1)], "the agent of the file; the run that there was is kept"
    assert main([*suite, *"--experiment other --agents random --seeds 4 1".split()]) == 0
    pages = [page.read_text() for page in (tmp_path / "runs" / "suite").glob("mine-*/report/scores.csv")]
    assert len(pages) == 3 and len(set(pages)) == 3, "no report replaces that of other agents"
    capsys.readouterr()
    assert main([*suite, *"--experiment other --agents failing --seeds 1".split()]) == 1
    assert capsys.readouterr().err.splitlines()[-1].endswith("1 runs failed; the same command tries them again.")
    inline.jobs.clear()
    assert main([*study, "arrow_puzzle", "--variants", "mild"]) == 0
    assert [job.spec.protocol.appearance for job in inline.jobs] == ["clean", "mild"], "with what it is compared with"
    (page,) = (tmp_path / "runs" / "arrow_puzzle").glob("study-factor-*/index.html")
    assert f"Report:     {page}" in capsys.readouterr().out


def test_seeds_are_added_until_it_is_decided_or_there_are_enough(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], inline: Inline, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {"agents": ("table", "imaginer", "random"), "headlines": (("imaginer", "table"),), "seeds": (0, 1)}
    monkeypatch.setitem(PRESETS, "smoke", {**PRESETS["smoke"], **few, "recorded_episodes": 0, "open_loop_starts": 0})
    words = bench_words(tmp_path, *"--budgets 2 --evaluation-episodes 2 --until-decided --most-seeds 3".split())
    assert main(words) == 0
    assert sorted(inline.order) == sorted(
        [*((agent, seed) for agent in few["agents"] for seed in (0, 1)), ("table", 2), ("imaginer", 2)]
    )
    protocols = [job.spec.protocol for job in inline.jobs]
    assert {(one.budgets, one.evaluation_episodes, one.execution) for one in protocols} == {((2,), 2, "kinematic")}
    printed = capsys.readouterr().out
    (report,) = re.findall(r"Report: +(\S+)", printed)
    assert "merged-" in report
    (parts,) = re.findall(r"Parts: +(.+)", printed)
    assert all((Path(part) / "report" / "index.html").is_file() for part in parts.split(", "))
    assert [Path(part).parts[-3] == "added" for part in parts.split(", ")] == [False, True]
    again: dict[str, Any] = {"budgets": 2, "evaluation_episodes": 2, "until_decided": True, "most_seeds": 3}
    read = imagine_bench.bench("arrow_puzzle", preset="smoke", execution="kinematic", out=tmp_path, **again)
    assert main(words) == 0 and len(inline.order) == 8, "a finished search is only read"
    assert read.folder / "report/index.html" == Path(report), "from Python as well"


@pytest.mark.parametrize("group", [registry.TASK_GROUP, registry.AGENT_GROUP, registry.WORLD_MODEL_GROUP])
def test_a_misspelt_name_is_answered_by_the_nearest(group: str) -> None:
    """By its own right spelling first, of all names that there are; those that are few are all named."""
    own = {registry.TASK_GROUP: TASKS, registry.AGENT_GROUP: AGENTS, registry.WORLD_MODEL_GROUP: WORLD_MODELS}[group]
    for name in own:
        with pytest.raises(UnknownNameError) as found:
            registry.offered(f"{name[:-1]}{name[-1] * 2}", own, group)
        said = str(found.value)
        known = found.value.args[2]
        assert f"Did you mean {name!r}?" in said
        assert f"The five nearest: {name}, " in said if len(known) > 8 else f"Known: {', '.join(known)}." in said


@pytest.mark.parametrize("given", [[], ["list", "more"]])
def test_words_of_a_caller_are_read_instead_of_those_of_the_process(given: list[str]) -> None:
    caller = f"from imagine_bench.cli import main; main({given})"
    done = subprocess.run([sys.executable, "-c", caller, "list"], capture_output=True, check=False)
    assert done.returncode == 2


@pytest.mark.parametrize("offered", [registry.agents, registry.world_models, registry.regressors])
def test_a_described_setting_can_be_typed_and_has_a_meaning(
    offered: Callable[[], Mapping[str, Any]],
) -> None:
    for name, entry in offered().items():
        found = describe(name).partition("\nSettings of the preset quick")[2]
        heads = dict(re.findall(r"\n  (\S+) = (\S+)", found))
        assert len(re.findall(r"\n {6}(?!must|may|one of| )", found)) >= len(heads), name
        if target := getattr(entry, "settings", ""):
            settings = registry.load(target)
            group = name if name in settings.groups else "chapter_5"
            default = dotted(dataclasses.asdict(settings.resolve("fast", {}, group)))
            inert = registry.inert_settings(name) if offered is registry.agents else frozenset()
            assert heads.keys() == settings.names() - inert
            for head, value in heads.items():
                typed = f"{name}{',' if ':' in name else ':'}{head}={value}"
                assert str(parse_configuration(typed)) == str(AgentConfiguration(name, {head: default[head]})), typed


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_can_complete_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--tyro-print-completion", shell])
    said = capsys.readouterr().out
    assert all(name in said for name in ("bench", "describe", "--evaluation-episodes", "sample_efficiency"))


def test_the_program_says_which_version_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"imagine-bench {__version__}\n"


def test_who_stops_reading_gets_no_traceback_and_no_verdict() -> None:
    command = [sys.executable, "-m", "imagine_bench", "describe"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["report", "x" * 5000], "give at most 1,000 characters"),
        (["report", "\x1b[31mred"], r"The word '\x1b[31mred' cannot be meant"),
        (["report", "\udcff"], "outside Unicode"),
        (["report", "x" * 900], "File name too long"),
        (["bench", "arrow_puzzle", "--encoder", "~nobody_at_all/x.safetensors"], "knows no such home folder"),
        (["new", "agent", "mine", "--out", "~nobody_at_all/x"], "knows no such home folder"),
        (["bench", "--task", "arrow_puzzle", "--set", "memory.real=" + "[" * 900], "it takes a whole number"),
    ],
)
def test_a_word_nobody_means_is_one_line(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "\x1b" not in said
    assert sentence in said or "name is too long" in said


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a disk that is always full")
@pytest.mark.parametrize(
    ("redirection", "sentence"),
    [(">/dev/full", "standard output cannot be read or written: the disk is full"), (">&-", "output is closed")],
)
def test_output_that_cannot_be_written_is_one_line(redirection: str, sentence: str) -> None:
    line = f"{sys.executable} -m imagine_bench describe {redirection}"
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and sentence in done.stderr and len(done.stderr.splitlines()) == 1


def test_a_removed_folder_and_a_strange_backend_are_no_tracebacks(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    folder = shlex.quote(str(gone))
    python = shlex.quote(sys.executable)
    line = f"cd {folder} && rmdir {folder} && MPLBACKEND=nonsense {python} -m imagine_bench doctor"
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
    assert "The current folder was removed" in done.stdout and done.returncode == 1
    assert done.stderr == "imagine-bench: Something is wrong with this installation; see above.\n"


FAMILY = [value for value in vars(errors).values() if isinstance(value, type) and issubclass(value, ImagineBenchError)]


@pytest.mark.parametrize("kind", FAMILY)
def test_every_error_comes_back_from_a_worker_process(kind: type[ImagineBenchError]) -> None:
    """One that cannot be unpickled breaks a whole pool of processes."""
    error = UnknownNameError("task", "arow", ["arrow"]) if kind is UnknownNameError else kind("the fault")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind and str(again) == str(error) and vars(again) == vars(error)


def test_demonstrations_are_recorded_anew_each_time_they_are_viewed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others may lie in the folder by then."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / tools.CARD).write_text("{}")
    collected, opened = ["old"], []

    def record(episodes: str, index: int, file: Path) -> None:
        file.write_text(f"{episodes}, episode {index}")

    monkeypatch.setattr(tools, "read_demonstrations", lambda folder: collected[-1])
    monkeypatch.setattr(tools, "demonstrations", lambda: SimpleNamespace(record=record))
    monkeypatch.setattr(stream, "open_in_viewer", lambda file: opened.append((file, file.read_text())))
    monkeypatch.chdir(tmp_path / "mine")
    for content, folder in (("old", tmp_path / "mine"), ("new", "."), ("newest", "../mine/")):
        collected.append(content)
        assert main(["view", str(folder), "--episode", "2"]) == 0
    assert [text for _, text in opened] == [f"{content}, episode 2" for content in ("old", "new", "newest")]
    assert {file.resolve() for file, _ in opened} == {tmp_path / "mine-episode_2.rrd"}, "beside the folder"


def test_a_terminal_is_sent_no_control_character_but_line_ends() -> None:
    others = [mark for mark in map(chr, range(0x2100)) if unicodedata.category(mark)[0] in "CZ" and mark not in "\n "]
    assert {"\r", "\t", "\f", "\x1b", "\x85", "\xa0", "\u2028"} <= {*others}
    assert [mark for mark in others if mark in errors.plain(f"a{mark}b")] == []
    assert errors.plain("Größe 5 µm,\nline 2") == "Größe 5 µm,\nline 2" and errors.plain("50 %\r99 %") == r"50 %\r99 %"
