"""A plug-in of pytest: ``pytest --imagine-bench-task NAME`` adds the contract's checks to whatever tests there are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from imagine_bench.errors import ImagineBenchError

_GUESTS = ("task", "agent", "model")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options as those of ``imagine-bench check``."""
    group = parser.getgroup("imagine-bench", "the contract of imagine_bench's guests")
    for guest in _GUESTS:
        group.addoption(f"--imagine-bench-{guest}", metavar="NAME", help=f"check this {guest}")


def pytest_collection_modifyitems(session: pytest.Session, config: pytest.Config, items: list[pytest.Item]) -> None:
    """Add a test for each check."""
    chosen = {guest: config.getoption(f"imagine_bench_{guest}") for guest in _GUESTS}
    if not any(chosen.values()):
        return
    from imagine_bench.testing import checks, contract  # noqa: PLC0415 - nothing where no option is given

    try:
        found = contract.checks(**chosen)
    except ImagineBenchError as error:
        raise pytest.UsageError(str(error)) from error
    name = chosen["agent"] or chosen["model"] or chosen["task"]
    for words, check in ((f"{name}: {what}", check) for what, check in found.items()):
        nodeid = f"imagine-bench::{words}"
        item = Check.from_parent(session, name=words, nodeid=nodeid, check=check, excuse=checks.NotOffered)
        items.append(item)


class Check(pytest.Item):
    """One sentence of the contract."""

    def __init__(self, *, check: Callable[[], None], excuse: type[Exception], **given: Any) -> None:
        super().__init__(**given)
        self._check = check
        self._excuse = excuse

    def runtest(self) -> None:
        """Pass, fail, or be skipped where the guest may do without the checked ability."""
        try:
            self._check()
        except self._excuse as why:
            pytest.skip(str(why))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """The sentence that names the fault; of an error that is not ours, where it happened."""
        if isinstance(excinfo.value, ImagineBenchError):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[str, None, str]:
        """The sentence itself."""
        return "imagine_bench", None, self.name
