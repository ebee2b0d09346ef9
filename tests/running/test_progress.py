"""The progress of a bench on the screen: the finished part, the time left, and the latest news of a run."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
from typing import Any

import pytest
from bench_fakes import FakeRunSpec
from small_runs import small

from imagine_bench.protocols.data import Phase, Progress, RunSpec
from imagine_bench.registry import AGENTS
from imagine_bench.running.bench import ProgressBar, counted, plan

WORK = 9 + 2 * 5
"""Of a learner: training episodes, and tests at two budgets."""
PROTOCOL = small(agents=("table", "random"), seeds=(0, 1))
BENCHES = (PROTOCOL, small(agents=("table", "random"), seeds=(0,), appearance="mild"))
"""As of a study: runs of one agent and seed."""
SPECS = [FakeRunSpec(protocol=each, agent=agent, seed=seed) for each in BENCHES for agent, seed in each.runs]


def far(seed: int, done: int, phase: Phase = "training", **more: Any) -> Progress:
    known = {"agent": "table", "episode": 4, **more}
    return Progress(seed=seed, bench=PROTOCOL.hash, phase=phase, done=done, work=WORK, **known)


@pytest.fixture
def now_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The one value is the time that the screen reads, in seconds."""
    clock = [0.0]
    monkeypatch.setattr("imagine_bench.running.bench.time.monotonic", lambda: clock[0])
    return clock


@pytest.mark.parametrize(
    ("gone_s", "cost", "times"),
    [
        (36_000.0, 1.0, "10:00:00 elapsed, about 34 h left"),
        (1_500.0, 1.0, "25:00 elapsed, about 85 min left"),
        (20.0, 1.0, "00:20 elapsed, about 68 s left"),
        (20.0, 2.0, "00:20 elapsed, about 53 s left"),
    ],
)
@pytest.mark.parametrize("is_terminal", [False, True])
def test_time_left_counts_no_earlier_or_failed_work(
    gone_s: float, cost: float, times: str, is_terminal: bool, now_s: list[float], own_names: None
) -> None:
    """Of 72 parts, 9 were done before and 10 take this time; 34 are left, for a run that failed has 19.

    A run of twice the cost has parts that take twice as long. A terminal is shown the share of all work too.
    """
    AGENTS["table"] = dataclasses.replace(AGENTS["table"], relative_cost=cost)
    screen = io.StringIO()
    screen.isatty = lambda: is_terminal  # type: ignore[method-assign]
    with contextlib.redirect_stderr(screen), ProgressBar(SPECS) as show:
        show(far(0, 9))
        show(far(1, 0, "failed", detail="RuntimeError: it broke"))
        now_s[0] = gone_s
        show(far(0, WORK, "done"))
        *_, said, line = re.split(r"[\r\n]+", screen.getvalue().rstrip())
    assert "table seed 1 failed: RuntimeError: it broke" in screen.getvalue()
    assert f"1/6 runs · {times}" in line
    share = 100 * WORK * cost / (2 * WORK * cost + 3 * 5)
    assert line.startswith(f"{share:3.0f} % |" if is_terminal else "1/6 runs"), said


def test_a_minute_shows_each_run_and_its_curve(now_s: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBar(SPECS) as show:
        for block, success in enumerate((0.0, 0.5)):
            show(far(0, 1, episode=50 * block, success=success))
        now_s[0] = 61.0
        show(far(0, 4, episode=6, success=1.0))
    line, curve = capsys.readouterr().err.splitlines()
    assert line.endswith("left · table seed 0: episode 6 of 9, last 50 solved 100 %")
    assert curve == "  █▅ table seed 0: training, each 50 episodes"


@pytest.mark.parametrize(
    ("phase", "words"),
    [("testing", "testing at episode 6 of 9, solved 40 %"), ("recording", "recording at episode 6 of 9")],
)
def test_a_share_that_is_solved_is_of_tests_alone(
    phase: Phase, words: str, now_s: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    """While a run is recorded, the share of its last training episodes would look like one of tests."""
    with ProgressBar(SPECS) as show:
        now_s[0] = 20.0
        show(far(0, 4, phase, episode=6, success=0.4))
    assert capsys.readouterr().err.splitlines()[-1].endswith(words)


def test_a_run_without_episodes_says_the_share_of_its_work(
    now_s: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    spec = RunSpec(protocol=plan("toy_regression", "smoke")[0], agent="mc_dropout", seed=0)
    at = {"agent": "mc_dropout", "seed": 0, "bench": spec.protocol.hash, "work": spec.work}
    with ProgressBar([spec]) as show:
        for part, detail in ((0.25, None), (0.5, "network 2")):
            now_s[0] += 20.0
            show(Progress(**at, phase="training", done=round(part * spec.work), detail=detail))
    assert [line.partition(" · mc_dropout seed 0: ")[2] for line in capsys.readouterr().err.splitlines()] == [
        f"{words}, {100 * round(part * spec.work) / spec.work:.0f} % of its work"
        for part, words in ((0.25, "training"), (0.5, "network 2"))
    ]


def test_time_left_of_things_is_that_of_those_done(now_s: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    for number in counted(range(4), "things", total=4):
        now_s[0] += 10.0 + 10.0 * number
    said = capsys.readouterr().err.splitlines()
    assert said == ["things: 2 of 4, 00:30 gone, 00:30 left", *(f"things: {line}" for line in (
        "3 of 4, 01:00 gone, 00:20 left", "4 of 4, 01:40 gone, 00:00 left",
    ))]  # fmt: skip
