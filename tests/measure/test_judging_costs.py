"""What a judgement costs: each registered world model, after its fit, a minute of CPU time at most."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from kept import ROOT

from imagine_bench import registry
from imagine_bench.judge.judgement import Judgement, ModelFit, data_of, judge_cell, prepare

_PROGRAM = ROOT / "agents" / "guests" / "programs" / "examples" / "arrows.py"
_NAMES = [*registry.world_models(), f"program:{_PROGRAM}"]
_MOST_S = 60.0


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Judgement, Path]:
    """A judgement whose questions and data are made, and its folder."""
    judgement = Judgement(task="arrow_puzzle", models=tuple(_NAMES), sizes=(300,), seeds=(706,))
    folder = tmp_path_factory.mktemp("judge") / "judgement"
    folder.mkdir()
    prepare(judgement, folder)
    data_of(judgement, folder, 706)
    return judgement, folder


def _cpu_s() -> float:
    """CPU seconds of this process and of those that it has ended."""
    return sum(os.times()[:4])


@pytest.mark.slow  # some models take a minute to fit
@pytest.mark.parametrize("name", _NAMES)
def test_a_model_is_judged_within_a_minute_after_its_fit(name: str, judged: tuple[Judgement, Path]) -> None:
    judgement, folder = judged
    begun_s = _cpu_s()
    found, _ = judge_cell(judgement, folder, ModelFit(name, 706, 300))
    spent_s = _cpu_s() - begun_s
    print(f"{name}: fit {found['fit_s']:.1f} CPU s, after it {spent_s - found['fit_s']:.1f}")
    assert 0.0 < spent_s - found["fit_s"] < _MOST_S
