"""The comparison with kept files itself: it fails with the difference, and forgives rounding alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from whole_outputs import Expected, matches, short


@pytest.mark.parametrize(
    ("found", "kept", "same"),
    [
        ("solved 0.124 of 10", "solved 0.123 of 10", True),
        ("solved 0.125 of 10", "solved 0.123 of 10", False),
        ("solved 0.12 of 10", "solved 0.121 of 10", True),
        ("solved 0.12 of 10", "solved 0.123 of 10", False),
        ("solved 0.123 of 11", "solved 0.123 of 10", False),
        ("solved -0.000", "solved 0.000", True),
        ("lost 0.123 of 10", "solved 0.123 of 10", False),
    ],
)
def test_only_the_last_digit_of_a_decimal_number_may_differ(found: str, kept: str, same: bool) -> None:
    assert matches(found, kept) == same


def test_another_output_fails_with_the_difference_until_it_is_kept(tmp_path: Path) -> None:
    compare = Expected(write=False, folder=tmp_path)
    keep = Expected(write=True, folder=tmp_path)
    with pytest.raises(pytest.fail.Exception, match=r"area\.txt; if it is right: --write-expected\nmissing"):
        compare("area", "one\n")
    keep("area", "one\ntwo 0.1\n")
    compare("area", "one  \ntwo 0.1")
    compare("area", "one\ntwo 0.2", exactly=False)
    with pytest.raises(pytest.fail.Exception, match=r"(?s)--write-expected\n.*\n-two 0\.1\n\+two 0\.2$"):
        compare("area", "one\ntwo 0.2")
    with pytest.raises(pytest.fail.Exception, match=r"\+three"):
        compare("area", "one\ntwo 0.1\nthree", exactly=False)
    keep("area", "one\ntwo 0.2", exactly=False)
    assert (tmp_path / "area.txt").read_text() == "one\ntwo 0.1\n", "a difference of rounding alone is not kept"
    for section in ("b", "a"):
        keep("parts", f"of {section}\n", section=section)
    assert (tmp_path / "parts.txt").read_text() == "==== a\nof a\n==== b\nof b\n"
    compare("parts", "of b", section="b")
    with pytest.raises(pytest.fail.Exception, match=r"(?s)parts\.txt b; .*-of b\n\+of a"):
        compare("parts", "of a", section="b")


def test_long_decimals_are_shortened_and_nothing_else() -> None:
    assert short("0.123456789 of 1234567, -2.5e-3, 1.234567e-9") == "0.12346 of 1234567, -2.5e-3, 1.2346e-09"
