"""Judged code in a process of its own: it is given its questions and can look at nothing else of its caller.

Calls go over a pipe. An answer is arrays as a safetensors file, or a sentence; never a pickle, which would carry out
the guest's code here. The process has limits of time and memory, some modules cannot be imported in it, and it ends
with its caller, by whatever death.

On Linux, where user namespaces are allowed, it also has no network, sees no process but its own, finds the folders
empty that are hidden from it, and nothing that it starts outlives it. Where :func:`why_open` says that the system has
no such means, as macOS has none, it has all rights of its user, and a process that it detaches may outlive it.
"""

from __future__ import annotations

import ctypes
import functools
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.abc import MetaPathFinder
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Self

import numpy as np
from safetensors.numpy import load, save

from imagine_bench import registry
from imagine_bench.arrays import Arrays
from imagine_bench.cores import ONE_THREAD, usable_memory
from imagine_bench.errors import ImagineBenchError, InvalidValueError, plain, writing
from imagine_bench.registry.loading import fault

_PATIENCE_S = 5.0
_POLL_S = 0.05
_KILLED = 128 + signal.SIGKILL
_LONGEST = 1_000  # characters of a guest's own words that are handed on
_ANSWER, _SENTENCE, _RAISED = b"answer", b"sentence", b"raised"
# From Linux' sched.h, mount.h and prctl.h
_NEW_NAMESPACES = 0x20000 | 0x10000000 | 0x20000000 | 0x40000000  # of mounts, users, processes and networks
_PRIVATE_MOUNTS = 0x4000 | 0x40000  # MS_REC, MS_PRIVATE
_DIE_WITH_PARENT = 1
_NO_NEW_PRIVILEGES = 38
_CAPABILITIES_VERSION = 0x20080522


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a guest."""

    call_s: float = 3_600.0  #: Wall seconds of a call
    memory: int = field(default_factory=lambda: usable_memory() * 3 // 4)  #: Bytes of its data (on Linux)


class GuestError(InvalidValueError):
    """An error of a guest, in its own words."""


class Isolated:
    """An object that judged code makes, in a process of its own.

    Args:
        make: ``"module:attr"`` of the factory. Each method of the object that it makes returns arrays by name.
        given: Arguments of the factory.
        log: File to which the output of the process is added.
        forbidden: Modules that cannot be imported there, nor any below them.
        hidden: Folders that are empty there, if it is closed off.
        limits: Time and memory.
        closed: Whether it is closed off as :func:`close_off` says; None for wherever the system allows it.

    Raises:
        InvalidValueError, GuestError: As :meth:`call`, for making the object.
    """

    def __init__(
        self,
        make: str,
        *given: object,
        log: Path,
        forbidden: Iterable[str] = (),
        hidden: Iterable[Path] = (),
        limits: Limits = Limits(),
        closed: bool | None = None,
    ) -> None:
        self._limits = limits
        self.cpu_s = 0.0
        """CPU seconds of all calls, as that process says."""
        with writing(log):
            opened = log.open("ab")
        ours, theirs = socket.socketpair()
        with theirs, opened as printed:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", f"from {__name__} import serve; serve({theirs.fileno()})"],
                stdin=subprocess.PIPE,  # nothing is written: its end tells that this process has ended
                stdout=printed,
                stderr=printed,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **ONE_THREAD},
                start_new_session=True,  # Ctrl-C is for this process
            )
        self._pipe = Connection(ours.detach())
        folders = [str(folder.resolve()) for folder in hidden if folder.is_dir()]
        closes = not why_open() if closed is None else closed
        try:
            self._pipe.send((sys.path, folders if closes else None, tuple(forbidden), limits.memory))
            self.call("", make, *given)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process, and on Linux all that it started."""
        self._pipe.close()
        self._kill()
        try:
            self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _kill(self) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()

    def call(self, method: str, *given: object) -> Arrays:
        """Call a method of the object, and return its arrays.

        Raises:
            InvalidValueError: The guest raised an error that is written for users, its process ended or was stopped, or
                it sent bytes that are no answer.
            GuestError: It raised anything else.
        """
        begun_s = time.monotonic()
        watch = threading.Timer(self._limits.call_s, self._kill)
        watch.start()
        try:
            self._pipe.send((method, given))
            kind = self._pipe.recv_bytes(len(_SENTENCE))
            content = self._pipe.recv_bytes(self._limits.memory)
            if kind == _ANSWER:
                answer: Arrays = load(content)
                self.cpu_s += float(answer.pop("cpu_s"))
                return answer
        except Exception as error:
            raise InvalidValueError(self._end(time.monotonic() - begun_s)) from error
        finally:
            watch.cancel()
        words = plain(content[:_LONGEST].decode(errors="replace"))
        raise InvalidValueError(words) if kind == _SENTENCE else GuestError(words)

    def _end(self, gone_s: float) -> str:
        """Why there is no answer after so many seconds."""
        if gone_s >= self._limits.call_s:
            return f"it was stopped after {self._limits.call_s:,.0f} s, the limit of a call."
        try:
            code = self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            return "it sent something that is no answer."
        how = "was killed, such as for lack of memory" if code == _KILLED else f"ended itself with exit code {code}"
        return f"its process {how}."


@functools.cache
def why_open() -> str:
    """Why this system lets no process close itself off, as its words; empty where it does."""
    if sys.platform != "linux":
        return f"{sys.platform} has no namespaces"
    words = [sys.executable, "-P", "-c", f"from {__name__} import close_off; close_off(())"]
    alone = {**os.environ, **ONE_THREAD}  # only a process of one thread can be closed off
    tried = subprocess.run(words, capture_output=True, text=True, check=False, env=alone)
    return "" if tried.returncode == 0 else tried.stderr.strip().rpartition("\n")[2] or "it cannot be tried"


def close_off(hidden: Iterable[str]) -> None:
    """Take the network and these folders from this process; its later children see no other processes.

    Raises OSError: the system does not allow it.
    """
    user, group = os.getuid(), os.getgid()
    _system("unshare", _NEW_NAMESPACES)
    for name, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
        Path("/proc/self", name).write_text(text)
    _system("mount", None, b"/", None, _PRIVATE_MOUNTS, None)
    for folder in hidden:
        _system("mount", b"none", folder.encode(), b"tmpfs", 0, None)


def _system(name: str, *given: int | bytes | None) -> None:
    """Call a function of the C library. Raises OSError."""
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*given) != 0:
        raise OSError(ctypes.get_errno(), f"{name}: {os.strerror(ctypes.get_errno())}")


class _Closed(MetaPathFinder):
    """Lets some modules, and those below them, not be imported."""

    def __init__(self, names: Iterable[str]) -> None:
        self._names = tuple(names)

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
        if any(f"{name}.".startswith(f"{each}.") for each in self._names):
            raise ModuleNotFoundError(f"{name} is closed to code that is judged", name=name)


def serve(pipe_number: int) -> None:
    """The life of the process: a child of its own answers calls until the caller's process or the child ends."""
    pipe = Connection(pipe_number)
    sys.path[:], hidden, forbidden, memory = pipe.recv()
    if hidden is not None:
        close_off(hidden)
    guest = os.fork()
    if guest == 0:
        _answer(pipe, closed=hidden is not None, forbidden=forbidden, memory=memory)
    pipe.close()
    while not (ended := os.waitpid(guest, os.WNOHANG))[0]:
        if select.select([0], [], [], _POLL_S)[0]:  # the caller's process has ended, or wants an end
            os.kill(guest, signal.SIGKILL)
            time.sleep(_POLL_S)
    code = os.waitstatus_to_exitcode(ended[1])
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(guest, signal.SIGKILL)  # processes that it started and left
    os._exit(code if code >= 0 else 128 - code)


def _answer(pipe: Connection, *, closed: bool, forbidden: Sequence[str], memory: int) -> None:
    """Answer calls until there are no more; never returns."""
    os.setpgid(0, 0)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    if sys.platform == "linux":
        _system("prctl", _DIE_WITH_PARENT, signal.SIGKILL, 0, 0, 0)
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    if closed:
        with suppress(OSError):  # in some containers; it sees other processes then, and may do nothing to them
            _system("mount", b"none", b"/proc", b"proc", 0, None)
        _system("prctl", _NO_NEW_PRIVILEGES, 1, 0, 0, 0)
        _system("capset", np.array([_CAPABILITIES_VERSION, 0], np.uint32).tobytes(), bytes(24))  # none: no unmounting
    sys.meta_path.insert(0, _Closed(forbidden))
    held = None
    with suppress(EOFError, BrokenPipeError):
        while True:
            method, given = pipe.recv()
            begun_s = time.process_time()
            kind = _ANSWER
            found: Arrays = {}
            try:
                if held is None:
                    make, *given = given
                    held = registry.load(make)(*given)
                else:
                    found = getattr(held, method)(*given)
                content = save({**found, "cpu_s": np.array(time.process_time() - begun_s)})
            except ImagineBenchError as error:
                kind, content = _SENTENCE, str(error).encode()
            except BaseException as error:  # sys.exit too
                kind, content = _RAISED, fault(error).encode()
            sys.stdout.flush()
            pipe.send_bytes(kind)
            pipe.send_bytes(content)
    os._exit(0)
