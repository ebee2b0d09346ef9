"""A storm: deaths, damages and hostile inputs by the thousand; nothing is silent, nothing raw. ``make storm`` runs it.

Each test prints what it counted. What is drawn is drawn from a generator with a fixed seed.
"""

from __future__ import annotations

import builtins
import io
import itertools
import json
import os
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from small_runs import Inline, do, final_arrays, same_but_for_time, small

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ImagineBenchError
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.bench import bench, load_bench, plan
from imagine_bench.store.loading import load_so_far

pytestmark = pytest.mark.slow
_FEW: dict[str, Any] = {"budgets": (2, 4), "evaluation_episodes": 2}
_REGIONS = 40
"""Places in each file that are damaged, each in three ways."""


class _DeathError(BaseException):
    """The end of a process: nothing that catches errors catches it."""


def one_sentence(error: BaseException) -> str:
    text = str(error)
    assert isinstance(error, ImagineBenchError), f"raw {type(error).__name__}: {text[:300]}"
    assert len(text) < 3000 and "\n" not in text and text.isprintable(), text[:300]
    return text


# --- deaths ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["death", "full disk"])
def test_every_file_operation_may_be_the_last(  # noqa: C901
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], how: str
) -> None:
    whole = do(tmp_path / "whole", every_s=0.0, **_FEW)
    weights = final_arrays(tmp_path / "whole")["table"].tobytes()
    count, deaths = itertools.count(), 0
    at: int | None = None

    def guarded(real: Callable[..., Any], arms: Callable[..., bool] = lambda *_, **__: True) -> Callable[..., Any]:
        def call(*args: Any, **named: Any) -> Any:
            if arms(*args, **named) and next(count) == at:
                raise _DeathError if how == "death" else OSError(28, "No space left on device")
            return real(*args, **named)

        return call

    def writes(*args: Any, **named: Any) -> bool:
        mode = args[1] if len(args) > 1 else named.get("mode", "r")
        return any(mark in str(mode) for mark in "wax+") and str(tmp_path) in str(args[0])

    for name in ("mkdir", "replace", "rename", "unlink", "fsync", "rmdir"):
        monkeypatch.setattr(os, name, guarded(getattr(os, name)))
    for module in (builtins, io):
        monkeypatch.setattr(module, "open", guarded(open, writes))
    for at in itertools.count():
        count = itertools.count()
        folder = tmp_path / f"run_{at}"
        try:
            do(folder, every_s=0.0, **_FEW)
        except (_DeathError, ImagineBenchError) as error:
            deaths += 1
            if isinstance(error, ImagineBenchError):
                one_sentence(error)
        ended = next(count) <= at
        count = itertools.count(10**9)
        assert same_but_for_time(whole, do(folder, every_s=0.0, **_FEW)), at
        assert final_arrays(folder)["table"].tobytes() == weights, at
        litter = [path.name for path in folder.rglob("*partial*")]
        assert not litter, (at, litter)
        shutil.rmtree(folder)
        if ended:
            break
    with capsys.disabled():
        print(f"\nstorm: {deaths} of {at} file operations ended by {how}, 0 differing bits")
    assert deaths > 50


# --- damages -----------------------------------------------------------------------------------------------------


def damages(content: bytes, rng: np.random.Generator) -> Iterator[bytes]:
    """A bit flipped, a byte replaced by a digit and an end cut off, in each of many regions."""
    yield b""
    edges = np.unique(np.linspace(0, len(content), min(_REGIONS, len(content)) + 1).astype(int))
    for low, high in itertools.pairwise(edges.tolist()):
        place = int(rng.integers(low, high))
        for byte in (content[place] ^ (1 << int(rng.integers(8))), 48 + int(rng.integers(10))):
            yield content[:place] + bytes([byte]) + content[place + 1 :]
        yield content[:place]


def facts(result: Any) -> str:
    """All that a report could say, as text."""
    rows = [(run.agent, run.seed, run.settings, run.checkpoints, run.training_success.tolist()) for run in result.runs]
    return f"{result.protocol}{result.environment}{rows}"


@pytest.mark.parametrize("finished", [True, False])
def test_every_region_of_every_file_may_be_damaged(  # noqa: C901, PLR0912
    tmp_path: Path, capsys: pytest.CaptureFixture[str], finished: bool
) -> None:
    wanted = small(**_FEW, recorded_episodes=1)
    folder = bench(wanted, {}, root=tmp_path / "whole", launcher=Inline()).folder
    run = folder / "table" / "seed_0"
    if not finished:
        (run / "DONE").unlink()
        for name in ("imagined.npz", "recording.rrd"):
            (run / name).unlink()
    load = load_bench if finished else load_so_far
    before, counts, rng = facts(load(folder)), Counter[str](), np.random.default_rng(0)
    weights = final_arrays(run)["table"].tobytes()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        for damaged in damages(content, rng):
            if damaged == content:
                continue
            path.write_bytes(damaged)
            try:
                after = facts(load(folder))
            except ImagineBenchError as error:
                assert path.name in one_sentence(error) or path.parent.name in str(error), (path, error)
                counts["refused"] += 1
            else:
                assert after == before, (path, "silent")
                counts["the same"] += 1
            finally:
                path.write_bytes(content)
    if not finished:  # and what goes on from there
        for path in sorted(path for path in run.rglob("*") if path.is_file() and not path.name.startswith(".lock")):
            content = path.read_bytes()
            for damaged in list(damages(content, rng))[::7]:
                copy = tmp_path / "copy"
                shutil.copytree(run, copy)
                (copy / path.relative_to(run)).write_bytes(damaged)
                try:
                    do(copy, **_FEW, recorded_episodes=1)
                except ImagineBenchError as error:
                    one_sentence(error)
                    counts["refused to go on"] += 1
                else:
                    assert final_arrays(copy)["table"].tobytes() == weights, path
                    counts["went on to the same"] += 1
                shutil.rmtree(copy)
    with capsys.disabled():
        print(f"\nstorm: damages of a {'' if finished else 'un'}finished bench: {dict(counts)}, 0 silent, 0 raw")
    assert counts["refused"] > 100


# --- hostile inputs ----------------------------------------------------------------------------------------------


_TEXTS = [
    "", " ", "x" * 5000, "\x1b[31mred", "\udcff", "a\nb", "../..", "~nobody/x", "NaN", "null", "quick\x00", "[" * 900,
]  # fmt: skip
_NUMBERS = [-1, 0, 10**9, 10**30, -(10**400), 0.5, 1e308, float("nan"), float("inf"), -float("inf"), True, None]
_OTHERS: list[Any] = [
    [], {}, (), [[]], {"a": {}}, b"\xff", np.ma.masked, np.array(["clean", "mild"]), np.zeros((3, 3)), object(),
    Ellipsis, np.array([]), range(3), {1, 2}, [1.5, None], np.float64("nan"), np.datetime64("NaT"), 1j, len,
]  # fmt: skip


def hostile(rng: np.random.Generator) -> Any:
    """A value that nobody means."""
    everything = [*_TEXTS, *_NUMBERS, *_OTHERS]
    return everything[int(rng.integers(len(everything)))]


_BEGINS = 77
"""The exit code of a command that would begin a bench: what it was given has been accepted."""


def as_word(value: Any) -> str:
    return value if isinstance(value, str) else str(value)[:4000]


def command(rng: np.random.Generator, root: Path) -> str:
    """A command line; it must say no in one sentence, or in tyro's own box, or come as far as to begin a bench."""
    flags = [
        "preset", "agents", "seeds", "budgets", "evaluation-episodes", "execution", "appearance", "encoder", "after",
        "demonstrations", "queries", "dataset", "set", "device", "launcher", "test-appearance", "physics",
    ]  # fmt: skip
    word = as_word(hostile(rng))
    words = ["bench", "--task", "arrow_puzzle", "--out", str(root), f"--{rng.choice(flags)}", word]
    if rng.random() < 0.3:
        words = [str(rng.choice(["report", "plan", "view", "why", "--help-me"])), word]
    err, sys.stderr = sys.stderr, io.StringIO()
    out, sys.stdout = sys.stdout, io.StringIO()
    try:
        code = main(words)
        said = sys.stderr.getvalue()
    except SystemExit as ended:
        code, said = int(ended.code or 0), sys.stderr.getvalue() + sys.stdout.getvalue()
    finally:
        sys.stderr, sys.stdout = err, out
    if code == _BEGINS:
        return "passed"
    assert code in (1, 2), f"silent: {words}"
    assert said and "Traceback" not in said and "\x1b[31mred" not in said and len(said.splitlines()) < 60, said[:500]
    return "refused"


def setting(rng: np.random.Generator) -> None:
    agents = ("imagination", "factored:given", "sb3_dqn")
    names = sorted(set().union(*map(registry.setting_names, agents)))
    plan("arrow_puzzle", "smoke", overrides=((str(rng.choice(names)), hostile(rng)),), agents=agents)


def protocol_field(rng: np.random.Generator) -> None:
    values = small(**_FEW).as_dict()
    name = str(rng.choice(sorted(values)))
    Protocol.from_dict({**values, name: hostile(rng)})


def of_folder(rng: np.random.Generator, root: Path) -> None:
    folder = root / "arrow_puzzle" / "smoke"
    folder.mkdir(parents=True, exist_ok=True)
    values = small(**_FEW).as_dict()
    name = str(rng.choice(sorted(values)))
    text = json.dumps({**values, name: hostile(rng)}, default=str)
    (folder / "protocol.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    load_bench(folder)


def _begin(*_: Any, **__: Any) -> None:
    raise SystemExit(_BEGINS)


def test_hostile_inputs_are_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("imagine_bench.cli.benches.bench", _begin)
    rng, counts = np.random.default_rng(0), Counter[str]()
    env = gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic").unwrapped

    def reset(rng: np.random.Generator) -> None:
        given = itertools.repeat(0) if rng.random() < 0.05 else hostile(rng)
        env.reset(seed=0, options=given if rng.random() < 0.3 else {"macrostate": given})

    def step(rng: np.random.Generator) -> None:
        env.reset(seed=0)
        env.step(hostile(rng))

    storms: dict[Callable[..., str | None], int] = {
        command: 500, setting: 500, reset: 250, step: 150, protocol_field: 250, of_folder: 100,
    }  # fmt: skip
    for storm, times in storms.items():
        for _ in range(times):
            try:
                how = storm(*((rng, tmp_path) if storm in (command, of_folder) else (rng,))) or "passed"
            except ImagineBenchError as error:
                one_sentence(error)
                how = "refused"
            counts[f"{storm.__name__} {how}"] += 1
    with capsys.disabled():
        print(f"\nstorm: {sum(storms.values())} hostile inputs: {dict(counts)}, 0 raw")
