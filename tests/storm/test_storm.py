"""A storm: deaths, damages and hostile inputs by the thousand; nothing is silent, nothing raw. ``make storm`` runs it.

Each test prints its counts. Random numbers come from a generator with a fixed seed.
"""

from __future__ import annotations

import io
import itertools
import json
import shutil
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from small_runs import Inline, do, final_arrays, same_but_for_time, small
from storms import as_word, damages, facts, hostile, interrupted, one_sentence

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ImagineBenchError
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.bench import bench, load_bench, plan
from imagine_bench.store.loading import load_so_far
from imagine_bench.store.results import RunResult

pytestmark = pytest.mark.slow
_FEW: dict[str, Any] = {"budgets": (2, 4), "evaluation_episodes": 2}


# --- deaths ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["death", "full disk"])
def test_every_file_operation_may_be_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], how: str
) -> None:
    def act(folder: Path) -> RunResult:
        return do(folder, every_s=0.0, **_FEW)

    whole = act(tmp_path / "whole")
    weights = final_arrays(tmp_path / "whole")["table"].tobytes()
    deaths = 0
    for folder in interrupted(tmp_path, monkeypatch, how, act):
        deaths += 1
        assert same_but_for_time(whole, act(folder)), folder
        assert final_arrays(folder)["table"].tobytes() == weights, folder
        litter = [path.name for path in folder.rglob("*partial*")]
        assert not litter, (folder, litter)
    with capsys.disabled():
        print(f"\nstorm: {deaths} file operations ended by {how}, 0 differing bits")
    assert deaths > 50


# --- damages -----------------------------------------------------------------------------------------------------


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
    if not finished:  # and the runs that go on from there
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


_BEGINS = 77
"""The exit code of a command that would begin a bench: its options have been accepted."""


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
