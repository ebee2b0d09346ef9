"""Plain calls that the learners still make by these names; this file goes when they no longer do."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")

cpu_time_s = time.process_time


def together(
    function: Callable[[Sequence[Item]], Sequence[Answer | Exception]], item: Item, *, kind: Hashable = None
) -> Answer:
    """The answer of ``function`` to this item; an exception among its answers is raised."""
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
