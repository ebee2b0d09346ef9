"""What a bench shows on a terminal: the total, and one line for each run that is going on."""

from __future__ import annotations

import io
import re
import sys

import pytest
from bench_fakes import FakeRunSpec
from small_runs import small

from imagine_bench.protocols.runs import Phase, Progress
from imagine_bench.running.progress import ProgressBars, RunKey, counted

WORK = 9 + 2 * 5
"""Of a learner: training episodes, and tests at two budgets."""
AGENTS, SEEDS = ("table", "random"), (0, 1, 2)
BENCH = small(agents=AGENTS, seeds=SEEDS).hash


class Terminal(io.StringIO):
    """Somewhere to write that says a person watches."""

    def isatty(self) -> bool:
        """Always."""
        return True


def specs() -> list[FakeRunSpec]:
    protocol = small(agents=AGENTS, seeds=SEEDS)
    return [FakeRunSpec(protocol=protocol, agent=agent, seed=seed) for agent in AGENTS for seed in SEEDS]


def far(agent: str, seed: int, phase: Phase = "training") -> Progress:
    done = WORK if phase == "done" else 5
    return Progress(agent=agent, seed=seed, bench=BENCH, phase=phase, done=done, work=WORK, episode=5)


def rows(terminal: Terminal) -> dict[int, str]:
    """What stands in each row below the first: tqdm goes down, writes over the row, and comes up again."""
    written = re.findall(r"(\n*)\r([^\r\n\x1b]*)", terminal.getvalue())
    return {len(down): text.rstrip() for down, text in written if down}


def test_every_running_run_has_a_row_of_the_display(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with ProgressBars(specs()) as show:
        for seed in SEEDS:
            show(far("table", seed))
        at_first = rows(terminal)
        show(far("table", 1, "done"))
        after_one = rows(terminal)
        show(far("random", 0))
        show(far("random", 1))
        at_last = rows(terminal)
    assert [at_first[row].split(":")[0] for row in (1, 2, 3)] == ["table seed 0", "table seed 1", "table seed 2"]
    assert after_one[2] == "" and after_one[1] and after_one[3]
    assert [at_last[row].split(":")[0] for row in (2, 4)] == ["random seed 0", "random seed 1"]
    assert len(at_last) == 4
    assert not any(rows(terminal).values()), "nothing stays behind"


def test_a_run_that_waits_for_others_at_a_budget_is_not_done(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBars(specs()) as show:
        show(Progress(agent="table", seed=0, bench=BENCH, phase="done", done=9, work=9, episode=4))
        show(far("table", 0, "done"))
        show(far("table", 0, "done"))
    waiting, done, again = capsys.readouterr().err.splitlines()
    assert waiting.startswith("0 of 6 runs done") and "table seed 0: waiting, training episode 4, 47 % of" in waiting
    assert done.startswith("1 of 6 runs done") and "table seed 0: done" in done
    assert again.startswith("1 of 6 runs done")


def after_ten_hours(monkeypatch: pytest.MonkeyPatch, *told: Progress, done: dict[RunKey, int]) -> None:
    """Show all but the last at the beginning, the last one ten hours later."""
    now_s = [0.0]
    monkeypatch.setattr("imagine_bench.running.progress.time.monotonic", lambda: now_s[0])
    with ProgressBars(specs(), done) as show:
        for progress in told[:-1]:
            show(progress)
        now_s[0] = 36_000.0
        show(told[-1])


def test_time_left_is_of_what_no_session_has_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three runs of 19 parts have done 9 each before, three of 5 nothing; 10 more take ten hours, 35 are left."""
    before = {(BENCH, "table", seed): 9 for seed in SEEDS}
    begins = Progress(agent="table", seed=0, bench=BENCH, phase="training", done=9, work=WORK)
    after_ten_hours(monkeypatch, begins, far("table", 0, "done"), done=before)
    assert "10:00:00 gone, 35:00:00 left" in capsys.readouterr().err


def test_a_failed_run_is_named_at_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    begins = Progress(agent="table", seed=0, bench=BENCH, phase="training", done=9, work=WORK)
    failed = Progress(
        agent="table", seed=1, bench=BENCH, phase="failed", done=0, work=WORK, detail="RuntimeError: it broke"
    )
    after_ten_hours(monkeypatch, begins, failed, far("table", 0, "done"), done={})
    said, line = capsys.readouterr().err.splitlines()
    assert said == "table seed 1 failed: RuntimeError: it broke"
    assert line.startswith("1 of 6 runs done") and "34:00:00 left" in line  # of 72 parts 19 are done, 19 will not be


def test_a_run_that_fails_leaves_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    failed = Progress(
        agent="table", seed=1, bench=BENCH, phase="failed", done=0, work=WORK, detail="RuntimeError: it broke"
    )
    with ProgressBars(specs()) as show:
        show(far("table", 0))
        show(far("table", 1))
        show(failed)
        show(far("random", 0))
        at_last = rows(terminal)
    assert "table seed 1 failed: RuntimeError: it broke\n" in terminal.getvalue()
    assert [at_last[row].split(":")[0] for row in (1, 2)] == ["table seed 0", "random seed 0"]


def test_items_are_counted_when_they_are_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = iter(range(0, 1000, 10))
    monkeypatch.setattr("imagine_bench.running.progress.time.monotonic", lambda: float(next(now_s)))
    assert list(counted(iter("abcd"), "plans", total=4)) == list("abcd")
    assert capsys.readouterr().err.splitlines() == ["2 of 4 plans", "4 of 4 plans"]
    terminal = Terminal()
    monkeypatch.undo()
    monkeypatch.setattr(sys, "stderr", terminal)
    assert list(counted("abcd", "plans", total=4)) == list("abcd")
    assert "plans" in terminal.getvalue() and "of 4 plans" not in terminal.getvalue()


def test_without_a_terminal_the_end_of_each_run_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBars(specs()) as show:
        show(far("table", 0))
        show(far("table", 0, "done"))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("1 of 6 runs done") and "table seed 0" in line
