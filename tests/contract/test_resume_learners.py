"""The real learners, killed in the midst of a run and resumed, end in the bits of an uninterrupted one."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_runner import final_arrays, small

from imagine_bench import registry
from imagine_bench.bench import runner
from imagine_bench.bench.runs import RunSpec
from imagine_bench.store import encoders
from imagine_bench.store.checkpoints import load_newest
from imagine_bench.store.results import RunResult

LEARNERS = [
    name
    for name, entry in registry.AGENTS.items()
    if entry.learns and not entry.external_training_loop and entry.make.startswith("imagine_bench.agents.")
]
"""All of the suite but those that a library trains, which begin anew; fakes of other tests are registered too."""


class KilledError(Exception):
    pass


def do(folder: Path, agent: str, every_s: float) -> RunResult:
    overrides = {"imagination.rehearsal_episodes": 5, "imagination.start_episode": 3}
    own = tuple(registry.own_settings(agent, overrides).items())
    protocol = small(agents=(agent,), budgets=(6, 12), evaluation_episodes=4, open_loop_starts=3, overrides=own)
    encoder = encoders.resolve(registry.task("arrow_puzzle"), "clean", kind=registry.AGENTS[agent].encoder_kind)
    spec = RunSpec(protocol=protocol, agent=agent, seed=1, encoder=encoder, checkpoint_every_s=every_s)
    return runner.run(spec, folder, lambda progress: None)


def measured(result: RunResult) -> list[dict[str, Any]]:
    """Every number of every row but the times; a NaN equals itself as text."""
    rows = []
    for row in result.checkpoints:
        values = dataclasses.asdict(row)
        values["diagnostics"] = {k: v for k, v in values["diagnostics"].items() if not k.startswith("time/")}
        rows.append({name: exact(value) for name, value in values.items() if not name.endswith("_cpu_s")})
    return rows


def exact(value: Any) -> Any:
    """A value to compare to the bit; the text of an array would round its numbers and leave most of them out."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, dict):
        return {name: exact(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [exact(part) for part in value]
    assert value is None or isinstance(value, int | float | str | np.generic), type(value)
    return repr(value)


def own_values(folder: Path) -> str:
    """What an agent keeps beside its arrays, but for times."""
    snapshot = load_newest(folder / "checkpoints")
    assert snapshot is not None
    meters = {name: value for name, value in snapshot.agent.values["meters"].items() if not name.startswith("time/")}
    return repr(sorted({**snapshot.agent.values, "meters": meters}.items()))


@pytest.mark.parametrize("agent", LEARNERS)
def test_a_killed_learner_ends_in_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agent: str) -> None:
    whole = do(tmp_path / "whole", agent, 1e9)
    real, saves = runner.save_snapshot, []

    def killing(folder: Path, snapshot: Any) -> Path:
        saves.append(real(folder, snapshot))
        if len(saves) in (5, 9, 15):  # training before and after the first test, and within a test
            raise KilledError
        return saves[-1]

    monkeypatch.setattr(runner, "save_snapshot", killing)
    for _ in range(3):
        with pytest.raises(KilledError):
            do(tmp_path / "run", agent, 0.0)
    resumed = do(tmp_path / "run", agent, 0.0)
    assert measured(whole) == measured(resumed)
    assert agent == "factored" or "loss/bellman" in whole.checkpoints[-1].diagnostics
    assert own_values(tmp_path / "whole") == own_values(tmp_path / "run")
    before, after = final_arrays(tmp_path / "whole"), final_arrays(tmp_path / "run")
    assert set(before) == set(after)
    assert [name for name in before if before[name].tobytes() != after[name].tobytes()] == []
    for one, other in zip(whole.imagined, resumed.imagined, strict=True):
        assert np.array_equal(one.rollout.frames, other.rollout.frames)
