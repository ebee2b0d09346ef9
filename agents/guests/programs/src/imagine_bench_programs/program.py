"""A program in a file as rules between symbols, carried out in a process apart."""

from __future__ import annotations

import hashlib
import math
import os
import re
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Arrays, State
from imagine_bench.rules import Outcome
from imagine_bench.running.isolation import GuestError, Isolated, Limits

from .symbol_rules import SymbolRules

LIMITS = Limits(call_s=30.0, memory=1 << 30)
"""Thirty seconds for the start, and for all macro-actions from one macrostate; one gibibyte."""
_SUM = 1e-6
"""By how much probabilities may miss a sum of 1."""
_DIGITS = "@0123456789ab"
_SPELLED = re.compile(r"(.*)@([0-9a-f]{12})", re.DOTALL)
"""A file and digits of its digest; a path may hold an @ of its own."""
_MOST = 100_000
"""Symbols, with memories, that a program may lead to."""


def spelled(argument: str) -> str:
    """``FILE@<12 hex digits of its content>`` of a file, for the names of agents and world models.

    Raises:
        InvalidValueError: It cannot be read, or the digits that follow it are not those of its content.
    """
    given = _SPELLED.fullmatch(argument)
    name, digits = given.groups() if given else (argument, "")
    found = hashlib.sha256(_source(name).encode()).hexdigest()[:12]
    if digits not in ("", found):
        raise InvalidValueError(
            f"{name} was changed: its digest is {found}, not {digits}. Give {name} alone to begin anew with it."
        )
    return f"{name}@{found}"


def _source(name: str) -> str:
    try:
        return Path(name).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InvalidValueError(f"The program {name} cannot be read ({error}); give a file of Python.") from error


class Program(SymbolRules):
    """A program as rules between symbols. A state is the symbols and, last, the number of the program's memory.

    Args:
        argument: The file, also with its digest as :func:`spelled` writes it.
        sizes: How many values each factor has.
        n_actions: Macro-actions.
        limits: Time and memory of its process.

    Raises:
        InvalidValueError: The file is another than its digest says, or the program does something that is refused.
    """

    def __init__(self, argument: str, sizes: Sequence[int], n_actions: int, limits: Limits = LIMITS) -> None:
        super().__init__(n_actions)
        self.name = spelled(argument)[: -len(_DIGITS)]
        self.sizes = tuple(sizes)
        self._known: dict[State, list[tuple[Outcome, ...]]] = {}
        make = f"{__package__}.guest:ServedProgram"
        try:
            self._process = Isolated(make, _source(self.name), log=Path(os.devnull), limits=limits)
        except InvalidValueError as error:
            raise self._fault(error) from error
        weakref.finalize(self, self._process.close)
        self.remembers = bool(self._call("facts")["remembers"])

    def start(self, symbols: State) -> State:
        """The state of symbols at the beginning of an episode."""
        return (*symbols, 0)

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        """The outcomes of a macro-action. None is called a success; a reward that the program leaves out is NaN.

        Raises:
            InvalidValueError: The program fails, or gives something that is no distribution of outcomes.
        """
        if macrostate not in self._known:
            if len(self._known) >= _MOST:
                raise InvalidValueError(f"Program {self.name}: it leads to more than {_MOST:,} states.")
            self._known[macrostate] = self._asked(macrostate)
        return self._known[macrostate][action]

    def follow(self, state: State, action: int, symbols: State) -> State:
        """The state after a macro-action that led to these symbols; with no memory if it was not expected to."""
        for outcome in self.outcomes(state, action):
            if outcome.macrostate[:-1] == symbols:
                return outcome.macrostate
        return self.start(symbols)

    def _asked(self, state: State) -> list[tuple[Outcome, ...]]:
        found = self._call("ask", state[:-1], state[-1], self.n_actions)
        for action in range(self.n_actions):
            rows = found["action"] == action
            self._check(found["probability"][rows], found["symbols"][rows], state, action)
        outcomes: list[list[Outcome]] = [[] for _ in range(self.n_actions)]
        columns = (found[name].tolist() for name in ("action", "symbols", "memory", "probability", "reward", "ended"))
        for action, symbols, memory, share, reward, ended in zip(*columns, strict=True):
            if share > 0.0:
                outcomes[action].append(Outcome(share, (*symbols, memory), reward, ended, success=False))
        return [tuple(each) for each in outcomes]

    def _check(self, shares: np.ndarray, symbols: np.ndarray, state: State, action: int) -> None:
        where = f"Program {self.name}: {state[:-1]} and action {action} have"
        total = math.fsum(shares.tolist())
        if not np.isfinite(shares).all() or (shares < 0.0).any() or abs(total - 1.0) > _SUM:
            given = ", ".join(f"{share:.6g}" for share in shares.tolist())
            raise InvalidValueError(f"{where} the probabilities {given}; give numbers of at least 0 that sum to 1.")
        if (symbols < 0).any() or (symbols >= np.array(self.sizes)).any():
            raise InvalidValueError(f"{where} outcomes {symbols.tolist()}; symbols lie below {self.sizes}.")

    def _call(self, method: str, *given: object) -> Arrays:
        try:
            return self._process.call(method, *given)
        except InvalidValueError as error:
            raise self._fault(error) from error

    def _fault(self, error: InvalidValueError) -> InvalidValueError:
        said = f"it raises {error}" if isinstance(error, GuestError) else str(error)
        return InvalidValueError(f"Program {self.name}: {said}")
