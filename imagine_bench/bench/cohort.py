"""Runs that go on side by side in one process, and do together what costs less when it is done at once.

Each run is written as if it were alone. Where it has something that runs like it may want to share, it calls
:func:`together`, which is an ordinary call for a run that is alone. In a cohort the run rests there until all others
rest too; then those that wait for the same thing get it done in one call.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from greenlet import getcurrent, greenlet

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def together(
    function: Callable[[Sequence[Item]], Sequence[Answer | Exception]], item: Item, *, kind: Hashable = None
) -> Answer:
    """Have ``function`` called with this item, and in a cohort with those of other runs beside it.

    Args:
        function: From items to an answer to each, in order; an exception is an answer too, to one item alone.
        item: What this run brings.
        kind: Only items of one kind meet.

    Raises:
        Exception: What the function gave this item as an answer.
    """
    member = getcurrent()
    if isinstance(member, _Member):
        answer = member.rest(_Request(function, item, kind))
    else:
        (answer,) = function([item])
    if isinstance(answer, Exception):
        raise answer
    return answer


def answer_each(function: Callable[..., Answer], items: Sequence[tuple[Any, ...]]) -> list[Answer | Exception]:
    """Call ``function`` with each item's arguments; what it raises is the answer to that one."""

    def answer(arguments: tuple[Any, ...]) -> Answer | Exception:
        try:
            return function(*arguments)
        except Exception as error:
            return error

    return [answer(arguments) for arguments in items]


def cpu_time_s() -> float:
    """CPU seconds that count for whoever asks: of the process, or in a cohort the run's own and its share."""
    member = getcurrent()
    return time.process_time() - (member.of_others_s if isinstance(member, _Member) else 0.0)


def side_by_side(works: Sequence[Callable[[], Any]]) -> list[Any]:
    """Carry out all works, which meet wherever they call :func:`together`.

    Which of them go first, and who meets whom, depends on nothing but what they do. Works that drift apart meet again:
    of the things that are waited for, the one that came up last in the life of this cohort is done first, so that all
    wait for the first one together.

    Args:
        works: Each as it would be called alone.

    Returns:
        What each gave back, or the exception that ended it.
    """
    members = [_Member(work) for work in works]
    try:
        _go_on(members)
    finally:
        for member in members:
            member.throw()  # where one was interrupted, the others tidy up; those that ended do nothing
    return [member.result for member in members]


def _go_on(members: Sequence[_Member]) -> None:
    waiting = {member: request for member in members if (request := member.go_on(None, 0.0)) is not None}
    seen: list[tuple[Any, Hashable]] = []
    while waiting:
        seen += dict.fromkeys(request.what for request in waiting.values() if request.what not in seen)
        chosen = max((request.what for request in waiting.values()), key=seen.index)
        group = [member for member in members if member in waiting and waiting[member].what == chosen]
        start_s = time.process_time()
        answers = _answers(chosen[0], [waiting.pop(member).item for member in group])
        share_s = (time.process_time() - start_s) / len(group)
        for member, answer in zip(group, answers, strict=True):
            if (request := member.go_on(answer, share_s)) is not None:
                waiting[member] = request


def _answers(function: Callable[[Sequence[Any]], Sequence[Any]], items: Sequence[Any]) -> Sequence[Any]:
    """What the function answers; what it cannot do for all of them together is an answer to each."""
    try:
        return function(items)
    except Exception as error:
        return [error] * len(items)


@dataclass(frozen=True, slots=True)
class _Request:
    function: Callable[[Sequence[Any]], Sequence[Any]]
    item: Any
    kind: Hashable

    @property
    def what(self) -> tuple[Any, Hashable]:
        return self.function, self.kind


class _Member(greenlet):  # type: ignore[misc]  # untyped where its stubs are missing
    """A work, and how much CPU time of its process was spent for others while it rested."""

    def __init__(self, work: Callable[[], Any]) -> None:
        super().__init__()
        self._work = work
        self.result: Any = None
        self.of_others_s = 0.0

    def run(self) -> None:
        try:
            self.result = self._work()
        except Exception as error:
            self.result = error

    def go_on(self, answer: Any, share_s: float) -> _Request | None:
        """Answer the member's request and let it go on; its next one, or None at its end."""
        self._share_s = share_s
        request: _Request | None = self.switch() if not self else self.switch(answer)
        return request

    def rest(self, request: _Request) -> Any:
        start_s = time.process_time()
        answer = self.parent.switch(request)
        self.of_others_s += time.process_time() - start_s - self._share_s
        return answer
