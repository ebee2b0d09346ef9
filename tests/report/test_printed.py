"""How numbers and facts are printed."""

from __future__ import annotations

import math

import pytest

from imagine_bench.report.page import flat, number


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (9.999, 3, "10.0"), (1234.5, 3, "1234"), (0.004, 2, "4.0e\u221203"), (0.0, 3, "0.000"),
        (-3.14159, 3, "\u22123.14"), (123456.0, 3, "1.23e+05"), (math.nan, 3, "–"),
    ],
)  # fmt: skip
def test_numbers_show_what_there_is(value: float, digits: int, text: str) -> None:
    assert number(value, digits) == text


def test_lists_of_sessions_are_rows_not_python() -> None:
    facts = {"seeds": [0, 1], "sessions": [{"wall_s": 1.0, "changed": {}}, {"wall_s": 2.0, "changed": {"commit": "a"}}]}
    assert flat("", facts) == [
        ("seeds", "0; 1"), ("sessions.1.wall_s", "1.0"),
        ("sessions.2.wall_s", "2.0"), ("sessions.2.changed.commit", "a"),
    ]  # fmt: skip
