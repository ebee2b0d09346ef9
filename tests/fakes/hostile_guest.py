"""Code that would look at, change or outlive the process that calls it."""

from __future__ import annotations

import ctypes
import gc
import importlib
import os
import pickle
import signal
import socket
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[np.generic]]


class _Opened:
    """Makes a file where it is unpickled."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str, str]]:
        return open, (self.path, "w")


class Hostile:
    def count_of(self, secret: bytes) -> Arrays:
        """How often a text, given backwards, is in anything that this process holds: variables, objects, memory."""
        text = secret[::-1]
        frame = sys._getframe()
        found = 0
        while frame is not None:
            found += sum(text in str(value).encode() for name, value in frame.f_locals.items() if name != "text")
            frame = frame.f_back
        found += sum(isinstance(each, dict) and text.decode() in each for each in gc.get_objects())
        return {"found": np.array(found)}

    def imported(self, name: str) -> Arrays:
        importlib.import_module(name)
        return {}

    def listed(self, folder: str) -> Arrays:
        return {"names": np.array([len(name) for name in os.listdir(folder)])}

    def others(self) -> Arrays:
        return {"processes": np.array([int(name) for name in os.listdir("/proc") if name.isdigit()])}

    def unmounted(self, folder: str) -> Arrays:
        libc = ctypes.CDLL(None)
        libc.unshare(0x10000000 | 0x20000)  # a namespace in which it may do more
        return {"failed": np.array(libc.umount2(folder.encode(), 0) != 0), **self.listed(folder)}

    def connected(self, port: int) -> Arrays:
        socket.create_connection(("127.0.0.1", port), timeout=5).close()
        return {}

    def exits(self, code: int) -> Arrays:
        sys.exit(code)

    def dies(self, code: int) -> Arrays:
        os._exit(code)

    def killed(self) -> Arrays:
        os.kill(os.getpid(), signal.SIGKILL)
        return {}

    def hangs(self) -> Arrays:
        time.sleep(600)
        return {}

    def grows(self) -> Arrays:
        return {"large": np.ones(2**28)}

    def sends_a_pickle(self, path: str) -> Arrays:
        """Behind the back of its server."""
        for number in map(int, os.listdir("/proc/self/fd")):
            end = Path(f"/proc/self/fd/{number}")
            if end.exists() and str(end.readlink()).startswith("socket"):
                pipe = Connection(number)
                pipe.send_bytes(b"answer")
                pipe.send_bytes(pickle.dumps(_Opened(path)))
        time.sleep(60)
        return {}

    def leaves(self, beat: str) -> Arrays:
        """A process of a session of its own, which writes to a file as long as it is alive."""
        if os.fork() == 0:
            os.setsid()
            while True:
                Path(beat).open("a").write("alive")
                time.sleep(0.05)
        return {}

    def raises(self) -> Arrays:
        raise ValueError("depth\x1b[31m\nsecond line")

    def gives_text(self) -> Arrays:
        return {"text": "text"}  # type: ignore[dict-item]
