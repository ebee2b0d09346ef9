"""The arrays that every part of the project exchanges."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]
"""An image as the agent sees it. Shape (64, 64, 3), upright, RGB."""
Macrostate = NDArray[np.int64]
"""The discrete state of a task, one integer a coordinate. Shape (M,)."""
State = tuple[int, ...]
"""A macrostate that can be a key. Length M."""
Floats = NDArray[np.float64]
"""Numbers of double precision, of any shape."""
Floats32 = NDArray[np.float32]
"""Numbers of single precision, of any shape."""
Ints = NDArray[np.int64]
"""Whole numbers, of any shape."""
Bools = NDArray[np.bool_]
"""True or False, of any shape."""
Pixels = NDArray[np.uint8]
"""Images as bytes, of any shape, RGB or gray."""
Images = NDArray[np.uint8] | NDArray[np.floating]
"""Images of any shape: uint8, or floats in [0, 1]."""
Array = NDArray[np.generic]
"""An array of any dtype and shape that is only passed on."""
Arrays = dict[str, NDArray[Any]]
"""Arrays by name, as a file or a state holds them: each has a dtype and a shape of its own."""
D = TypeVar("D", bound=np.generic)
Observed = NDArray[Any] | Arrays
"""An observation of one moment: one part, an image or a vector, or several by name."""
Action = np.int64 | int
"""The number of a macro-action."""
Info = dict[str, Any]
"""Gymnasium's ``info``: numpy scalars and arrays, and sentences."""


def read_only(array: NDArray[D]) -> NDArray[D]:
    """A view of an array that cannot be written to: whoever is handed it changes nothing that others are handed."""
    view = array.view()
    view.flags.writeable = False
    return view


def content_hash(arrays: Mapping[str, Array]) -> str:
    """64 hex digits of the names, types, shapes and bytes of arrays."""
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        sha.update(array.data)
    return sha.hexdigest()
