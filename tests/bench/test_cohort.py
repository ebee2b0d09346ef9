"""Runs side by side: they meet, share, differ in length, fail alone, and pay only for themselves."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

import pytest

from imagine_bench.bench.cohort import answer_each, cpu_time_s, side_by_side, together


class Shared:
    """Doubles items, and remembers which ones it was given at once."""

    def __init__(self) -> None:
        self.calls: list[list[int]] = []

    def double(self, items: Sequence[int]) -> list[int | Exception]:
        self.calls.append(list(items))
        return answer_each(self._double, [(item,) for item in items])

    def _double(self, item: int) -> int:
        if item == 13:
            raise ValueError("13 is not doubled here")
        return 2 * item


def test_alone_it_is_an_ordinary_call() -> None:
    shared = Shared()
    assert together(shared.double, 4) == 8
    with pytest.raises(ValueError, match="13 is not doubled"):
        together(shared.double, 13)
    assert shared.calls == [[4], [13]]


def test_works_of_different_length_meet_as_long_as_they_last() -> None:
    shared = Shared()

    def work(name: int, steps: int) -> list[int]:
        return [together(shared.double, 10 * name + step) for step in range(steps)]

    results = side_by_side([partial(work, 1, 3), partial(work, 2, 1), partial(work, 3, 2)])
    assert results == [[20, 22, 24], [40], [60, 62]]
    assert shared.calls == [[10, 20, 30], [11, 31], [12]]


def test_what_one_is_answered_or_raises_is_no_matter_of_the_others() -> None:
    shared = Shared()

    def work(first: int) -> int:
        value = together(shared.double, first)
        if value == 4:
            raise RuntimeError("broke later")
        return together(shared.double, value)

    refused, broken, fine = side_by_side([partial(work, first) for first in (13, 2, 3)])
    assert isinstance(refused, ValueError) and isinstance(broken, RuntimeError) and fine == 12


def test_what_fails_for_all_together_is_raised_in_each() -> None:
    def broken(items: Sequence[int]) -> list[int | Exception]:
        raise MemoryError(f"no room for {len(items)}")

    def work(name: int) -> str:
        try:
            together(broken, name)
        except MemoryError as error:
            return f"{name}: {error}"
        return "never"

    assert side_by_side([partial(work, 1), partial(work, 2)]) == ["1: no room for 2", "2: no room for 2"]


def test_works_that_drift_apart_meet_again_at_the_first_thing_of_a_step() -> None:
    model, controller = Shared(), Shared()

    def work(practises_from: int) -> None:
        for step in range(3):
            together(model.double, step)
            if step >= practises_from:
                together(controller.double, step)

    side_by_side([partial(work, 2), partial(work, 0)])
    assert model.calls == [[0, 0], [1, 1], [2, 2]]
    assert controller.calls == [[0], [1], [2, 2]]


def test_only_items_of_one_kind_meet() -> None:
    shared = Shared()
    side_by_side([partial(together, shared.double, item, kind=item % 2) for item in range(4)])
    assert sorted(shared.calls) == [[0, 2], [1, 3]]


def test_each_pays_for_itself_and_its_share() -> None:
    """A shared second costs two works half of one each, and what one does alone costs the other nothing."""

    def burn(seconds: float) -> None:
        end_s = time.process_time() + seconds
        while time.process_time() < end_s:
            pass

    def shared(items: Sequence[None]) -> Sequence[None]:
        burn(0.2)
        return items

    def work(own_s: float) -> float:
        start_s = cpu_time_s()
        burn(own_s)
        together(shared, None)
        burn(own_s)
        return cpu_time_s() - start_s

    begin_s = time.process_time()
    costs = side_by_side([partial(work, 0.1), partial(work, 0.0)])
    assert costs == [pytest.approx(0.3, abs=0.04), pytest.approx(0.1, abs=0.04)]
    assert sum(costs) == pytest.approx(time.process_time() - begin_s, abs=0.02)


def test_an_interrupt_ends_all_and_lets_them_tidy_up() -> None:
    tidied = []

    def resting() -> None:
        try:
            together(Shared().double, 1)
        finally:
            tidied.append("resting")

    def interrupted() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        side_by_side([resting, interrupted])
    assert tidied == ["resting"]
