"""Whether two environments gave the same."""

from __future__ import annotations

import numpy as np


def assert_same(one, other, where=""):
    """Nested dicts, lists, tuples and arrays, equal to the bit and of the same types."""
    assert type(one) is type(other), where
    if isinstance(one, dict):
        assert set(one) == set(other), where
        for key in one:
            assert_same(one[key], other[key], f"{where}/{key}")
        return
    if isinstance(one, list | tuple) or (isinstance(one, np.ndarray) and one.dtype.hasobject):
        for each, its in zip(one, other, strict=True):
            assert_same(each, its, where)
        return
    one, other = np.asarray(one), np.asarray(other)
    assert (one.dtype, one.shape) == (other.dtype, other.shape), where
    assert np.array_equal(one, other), where
