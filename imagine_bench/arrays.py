"""The arrays that every part of the project exchanges."""

from __future__ import annotations

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
