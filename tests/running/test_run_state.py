"""A run's encoder, what is told of how far it is, and how often it is saved."""

from __future__ import annotations

import time
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
from small_runs import small

from imagine_bench import registry
from imagine_bench.errors import ArtefactError
from imagine_bench.protocols.runs import Progress, RunSpec
from imagine_bench.running.evaluation import EvaluationCounts
from imagine_bench.running.run_state import Counters, Run
from imagine_bench.store import encoders


@pytest.mark.parametrize(("wanted", "given"), [("clean", "mild"), ("mild", "clean"), ("clean", "clean")])
def test_another_encoder_than_the_bench_s_is_refused(wanted: str, given: str) -> None:
    paths = {name: encoders.bundled()[f"arrow_puzzle-{name}"] for name in (wanted, given)}
    protocol = small(encoder=encoders.identity(paths[wanted]))
    entry, spec = registry.agent_entry("imagination"), SimpleNamespace(encoder=paths[given])
    run: Any = SimpleNamespace(protocol=protocol, entry=entry, spec=spec)
    with nullcontext() if wanted == given else pytest.raises(ArtefactError, match=f"-{given}@.*of .*-{wanted}@"):
        Run._require_its_encoder(run)


def test_progress_counts_all_that_was_played() -> None:
    """Three episodes on an earlier task and 110 here, two tests of five; of the last hundred episodes 40 succeeded."""
    told: list[Progress] = []
    counters = Counters(before=3, episode=110, success=[True] * 10 + [False] * 60 + [True] * 40)
    counters.rows = ["a row"] * 2  # type: ignore[list-item]
    run: Any = object.__new__(Run)
    run.counters, run.entry, run.protocol = counters, SimpleNamespace(learns=True), small()
    run.spec, run._reported_s, run._on_progress = RunSpec(protocol=small(), agent="table", seed=0), 0.0, told.append

    def tell(*, at_once: bool = True) -> tuple[int, float | None]:
        run.tell("training", at_once=True) if at_once else run.tell("training")
        return told[-1].done, told[-1].success

    assert tell(at_once=False) == (123, 0.4) and told[0].episode == 110
    counters.test = EvaluationCounts()
    assert tell(at_once=False) == (123, 0.4) and len(told) == 1, "not so soon again"
    assert tell() == (123, 0.4) and len(told) == 2
    counters.test = EvaluationCounts(solved="0100")
    assert tell() == (127, 0.25)
    counters.test, counters.success, run.entry.learns = None, [], False
    assert tell() == (118, None), "one that does not learn is tested once"


def test_a_run_is_saved_as_often_as_it_is_asked_to_be() -> None:
    run: Any = object.__new__(Run)
    saved: list[str] = []
    run.tell, run.save, run.spec = str, lambda: saved.append("now"), SimpleNamespace(checkpoint_every_s=20.0)
    for since_s, count in ((0.0, 0), (15.0, 0), (20.5, 1)):
        run._saved_s = time.monotonic() - since_s
        run.made_progress("training")
        assert len(saved) == count
