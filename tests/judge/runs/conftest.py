"""A judge whose reader of images costs nothing."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fake_reader import read_nothing

from imagine_bench.judge import judgement, questions


@pytest.fixture(scope="module")
def blind() -> Iterator[None]:
    """A reader that costs nothing, and few rollouts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judgement, "reader_in", read_nothing)
        patch.setattr(questions, "ROLLOUTS", 16)
        yield
    judgement.prepare.cache_clear()
    judgement.data_of.cache_clear()
