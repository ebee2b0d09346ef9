"""How numbers and facts are printed."""

from __future__ import annotations

from imagine_bench.report.page import flat


def test_lists_of_sessions_are_rows_not_python() -> None:
    facts = {"seeds": [0, 1], "sessions": [{"wall_s": 1.0, "changed": {}}, {"wall_s": 2.0, "changed": {"commit": "a"}}]}
    assert flat("", facts) == [
        ("seeds", "0; 1"), ("sessions.1.wall_s", "1.0"),
        ("sessions.2.wall_s", "2.0"), ("sessions.2.changed.commit", "a"),
    ]  # fmt: skip
