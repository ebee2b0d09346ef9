"""Errors that users cause, wherever they are raised."""

from __future__ import annotations

import pickle

import pytest

from imagine_bench import errors
from imagine_bench.errors import ImagineBenchError, UnknownNameError

FAMILY = [value for value in vars(errors).values() if isinstance(value, type) and issubclass(value, ImagineBenchError)]


@pytest.mark.parametrize("kind", FAMILY)
def test_every_error_comes_back_from_a_worker_process(kind: type[ImagineBenchError]) -> None:
    """One that cannot be unpickled breaks a whole pool of processes."""
    error = UnknownNameError("task", "arow", ["arrow"]) if kind is UnknownNameError else kind("what went wrong")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind and str(again) == str(error) and vars(again) == vars(error)
