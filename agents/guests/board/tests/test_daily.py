"""A world a day: its date decides it, its facts are exact, and no two days share one."""

from __future__ import annotations

import hashlib
import os
import time
from datetime import UTC, date, datetime, timedelta
from unittest import mock

import pytest
from board_forging import on
from imagine_bench_board.daily import world_of_day
from imagine_bench_board.rounds import today

from imagine_bench import registry
from imagine_bench.cli import exit_code

DAYS = [str(date(2026, 12, 1) + timedelta(days=number)) for number in range(3)]


def test_a_day_has_one_world_and_other_days_have_others() -> None:
    worlds = [world_of_day(day) for day in DAYS]
    assert worlds[0] == world_of_day(DAYS[0])
    assert len({world.task for world in worlds}) == len(DAYS)
    for world in worlds:
        assert world.facts.chance_level <= 0.15 and world.facts.optimum >= 0.9
        assert registry.task(world.task).facts() == world.facts


def test_a_secret_hides_the_world_and_the_digest_binds_it() -> None:
    open_world = world_of_day(DAYS[0])
    hidden = world_of_day(DAYS[0], "a word")
    assert hidden.task != open_world.task
    assert hidden.digest == hashlib.sha256(f"{DAYS[0]}:{hidden.task}:a word".encode()).hexdigest()


def test_today_is_the_day_by_default() -> None:
    with on(date(2026, 12, 3)):
        assert world_of_day() == world_of_day("2026-12-03")
    for zone in ("XXX+14", "XXX-14"):  # it is another day there, for some hours of each
        with mock.patch.dict(os.environ, TZ=zone):
            time.tzset()
            assert today() == datetime.now(UTC).date()
    time.tzset()


def test_the_command_says_the_world_and_takes_options_of_runs_with_agents(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["daily", "--date", DAYS[0]]) == 0
    assert capsys.readouterr().out == f"{world_of_day(DAYS[0])}\n"
    assert exit_code("daily --date 2026-12-01 --budgets 3".split()) == 2
    assert "--budgets goes with --agents; leave it out" in capsys.readouterr().err
