"""The storm of hostile inputs: values that nobody means are refused in one sentence, or accepted; nothing is raw."""

from __future__ import annotations

import itertools
import json
import sys
from collections import Counter
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from small_runs import collected, small
from storms import as_word, hostile, one_sentence

from imagine_bench import registry
from imagine_bench.cli import exit_code
from imagine_bench.errors import ImagineBenchError
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.bench import load_bench, plan
from imagine_bench.store.files import make_folder, write_json
from imagine_bench.sweep.grid import read_grid

pytestmark = pytest.mark.slow
_BEGINS = 77
"""The exit code of a command that would begin its work: its options have been accepted."""
_WORK = (
    "imagine_bench.cli.benches.bench",
    "imagine_bench.cli.tools.collect",
    "imagine_bench_motion.control.datasets.collect",
    "imagine_bench.testing.physics._segments",
    "imagine_bench.cli.judging.judge",
    "imagine_bench.cli.benches.run_study",
    "imagine_bench.cli.benches.run_suite",
    "imagine_bench.agents.encoders.cli.train_encoder",
)
_FLAGS = {
    "bench arrow_puzzle": "preset agents seeds budgets evaluation-episodes execution appearance encoder after queries "
    "demonstrations dataset set device launcher test-appearance physics",
    "dataset arrow_puzzle": "policy format seed execution appearance motion-hz episodes describe",
    "dataset ArrowPuzzleMotion": "policy format seed size appearance episodes workers describe",
    "check ArrowPuzzleMotion --physics": "turns trials random appearances out",
    "judge arrow_puzzle": "models sizes seeds samples appearance policy encoder workers order",
    "sweep arrow_puzzle": "file variants experiment agents seeds workers launcher",
    "encoder arrow_puzzle": "appearance recipe seed steps batch latents device",
}
_BARE = ("report", "plan", "view", "why", "--help-me")


def commands(rng: np.random.Generator, root: Path) -> str:
    """A command line; it must say no in a sentence, or in tyro's own box, or come as far as to begin its work."""
    line = str(rng.choice([*_FLAGS, "bench arrow_puzzle"]))
    word = as_word(hostile(rng))
    words = [*line.split(), "--out", str(root / "out"), f"--{rng.choice(_FLAGS[line].split())}", word]
    if rng.random() < 0.15:
        words = [str(rng.choice(_BARE)), word]
    said = StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stderr", said)
        patch.setattr(sys, "stdout", said)
        try:
            code = exit_code(words)
        except SystemExit as ended:
            code = int(ended.code or 0)
    if code == _BEGINS:
        return "passed"
    text = said.getvalue()
    assert code in (1, 2), f"silent: {words}"
    assert text and "Traceback" not in text and "\x1b[31mred" not in text, (words, text[:500])
    return "refused"


def settings(rng: np.random.Generator, _: Path) -> None:
    agents = ("imagination", "factored:given", "sb3_dqn")
    names = sorted(set().union(*map(registry.setting_names, agents)))
    plan("arrow_puzzle", "smoke", overrides=((str(rng.choice(names)), hostile(rng)),), agents=agents)


def _hostile_protocol(rng: np.random.Generator) -> dict[str, Any]:
    values = small(budgets=(2, 4)).as_dict()
    return {**values, str(rng.choice(sorted(values))): hostile(rng)}


def protocols(rng: np.random.Generator, _: Path) -> None:
    Protocol.from_dict(_hostile_protocol(rng))


def folders(rng: np.random.Generator, root: Path) -> None:
    folder = make_folder(root / "arrow_puzzle" / "smoke")
    text = json.dumps(_hostile_protocol(rng), default=str)
    (folder / "protocol.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    load_bench(folder)


def played(env: Any) -> Callable[[np.random.Generator, Path], None]:
    """Resets and steps of an environment, or of lanes, with values that nobody means."""

    def play(rng: np.random.Generator, _: Path) -> None:
        given = itertools.repeat(0) if rng.random() < 0.05 else hostile(rng)
        asked: dict[str, Any] = {"seed": given} if rng.random() < 0.2 else {"options": given}
        if rng.random() < 0.4:
            asked = {"options": {"macrostate": given}}
        if rng.random() < 0.6:
            env.reset(**{"seed": 0, **asked})
        else:
            env.reset(seed=0)
            env.step(hostile(rng))

    return play


def worlds(rng: np.random.Generator, _: Path) -> None:
    options = ["cubes", "slip", "goal", "forbid", "lag", "gesture", "coupling", "shuffle", "horizon", "none"]
    registry.task(f"arrows:{rng.choice(options)}={as_word(hostile(rng))}")


def grids(rng: np.random.Generator, folder: Path) -> None:
    """A study in a file, whose world is one in a file, too."""
    variant: dict[str, Any] = {"name": "a", "agent": "random", "world": {"appearance": "mild", "queries": 1}}
    study: dict[str, Any] = {"question": "?", "budgets": [2], "variants": [variant]}
    _read(folder, study)
    where = [study, variant, variant["world"]][int(rng.integers(3))]
    where[str(rng.choice([*where, "more"]))] = hostile(rng)
    _read(folder, study)


def _read(folder: Path, study: dict[str, Any]) -> None:
    write_json(folder / "mine.json", json.loads(json.dumps(study, default=str)))
    read_grid(folder / "mine.json")


def _begin(*_: Any, **__: Any) -> Any:
    raise SystemExit(_BEGINS)


@pytest.mark.parametrize("share", ["few", "all"])
def test_hostile_inputs_are_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, share: str
) -> None:
    collected()
    for work in _WORK:
        monkeypatch.setattr(work, _begin)
    env = gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic").unwrapped
    lanes = gymnasium.make_vec("imagine_bench/ArrowPuzzle-vector-v0", 3, execution="kinematic")
    storms: dict[str, tuple[Callable[[np.random.Generator, Path], str | None], int]] = {
        "commands": (commands, 800),
        "settings": (settings, 500),
        "protocols": (protocols, 250),
        "folders": (folders, 100),
        "episodes": (played(env), 400),
        "lanes": (played(lanes), 300),
        "worlds": (worlds, 300),
        "grids": (grids, 300),
    }
    rng, counts = np.random.default_rng(0), Counter[str]()
    for name, (storm, times) in storms.items():
        for _ in range(10 if share == "few" else times):
            try:
                how = storm(rng, tmp_path) or "passed"
            except ImagineBenchError as error:
                one_sentence(error)
                how = "refused"
            counts[f"{name} {how}"] += 1
    lanes.close()
    with capsys.disabled():
        print(f"\nstorm: {counts.total()} hostile inputs: {dict(counts)}, 0 raw")
