"""The one import of ``dm_control.mjcf``: PyMJCF only composes here, and must not open a display of its own.

dm_control initialises EGL while it is imported, which would leave a process with a display that neither survives a fork
nor shuts down quietly. MuJoCo itself is imported first, with the platform that this package chose.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco  # noqa: F401


@contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


with _environment("MUJOCO_GL", "off"):
    from dm_control import mjcf

__all__ = ["mjcf"]
