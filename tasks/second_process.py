"""A second process draws lanes while the first goes on: software OpenGL is most of a kinematic macro-action's time.

Within one process it draws one scene after another. The second draws the same bits, and nobody waits for it: what it
has not drawn when it is wanted, the first draws itself. So one that is slow, has died or cannot start costs only time.
"""

from __future__ import annotations

import mmap
import os
import pickle
import subprocess
import sys
import tempfile
import warnings
import weakref
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from .rendering import Renderer, View
from .scenes.appearance import looks_of

PATIENCE = 500
"""So many scenes are drawn alone before the other process is begun, which takes as long as drawing some thousands."""
_BACKLOG = 4
"""A process that is so many times all scenes behind is asked for no more."""
_TOLD_AT_ONCE = 4
"""Scenes: each message costs a system call."""
_SLOT_BYTES = 2
_Scene = tuple[mujoco.MjModel, mujoco.MjData]


def _inputs(model: mujoco.MjModel, data: mujoco.MjData) -> list[NDArray[np.float64]]:
    """All that changes and shows in a scene's images: views."""
    return [data.qpos, data.mocap_pos, data.mocap_quat, *looks_of(model)]


class _Shared:
    """What both processes see: of each slot the number of the scene that is wanted, its inputs, and its frame."""

    def __init__(self, memory: mmap.mmap, offset: int, slot: np.dtype[np.void]) -> None:
        slots = np.frombuffer(memory, slot, offset=offset)
        self.wanted, self.frames = slots["wanted"], slots["frame"]
        self.inputs = [[row[name] for name in (slot.names or ())[1:-1]] for row in slots]


class _Process:
    """Draws the scenes that it is asked for, one after another.

    Raises:
        OSError: It cannot start; from the methods: it has died.
    """

    def __init__(self, scene: _Scene, view: View, slots: int) -> None:
        inputs = [(str(index), each.dtype, each.shape) for index, each in enumerate(_inputs(*scene))]
        slot = np.dtype([("wanted", np.int64), *inputs, ("frame", np.uint8, (view.height, view.width, 3))], align=True)
        head = pickle.dumps((scene[0], view, slot))
        offset = -(-len(head) // 64) * 64
        with tempfile.TemporaryFile(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as file:
            file.truncate(offset + slots * slot.itemsize)
            memory = mmap.mmap(file.fileno(), 0)
            memory[: len(head)] = head
            code = f"from {__name__} import serve; serve({file.fileno()}, {offset})"
            self._child = subprocess.Popen(
                [sys.executable, "-P", "-c", code], bufsize=0, pass_fds=[file.fileno()], start_new_session=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        assert self._child.stdin is not None and self._child.stdout is not None
        self._asks, self._answers, self._untold = self._child.stdin, self._child.stdout, bytearray()
        os.set_blocking(self._answers.fileno(), False)
        self.shared, self.asked, self.done = _Shared(memory, offset, slot), 0, -1

    def listen(self) -> int:
        """The number of the last scene that is drawn, or was no longer wanted; -1 before the process is ready."""
        heard = self._answers.read(4096)  # a byte when it is ready, and one for each scene
        if heard == b"":
            raise BrokenPipeError
        self.done += len(heard or b"")
        return self.done

    def ask(self, slot: int) -> int:
        """Ask for a scene, whose inputs are written; returns its number."""
        self.asked += 1
        self.shared.wanted[slot] = self.asked
        self._untold += slot.to_bytes(_SLOT_BYTES, "little")
        if len(self._untold) >= _SLOT_BYTES * _TOLD_AT_ONCE:
            self.tell()
        return self.asked

    def tell(self) -> None:
        """Ask now for what was not yet asked for."""
        if self._untold:
            self._asks.write(self._untold)
            self._untold.clear()

    def end(self, pid: int) -> None:
        """End it, unless it belongs to the process from which this one was forked."""
        if pid == os.getpid():
            self._child.kill()
            self._child.wait()
        self._child.returncode = self._child.returncode or 0
        self._asks.close()
        self._answers.close()


def serve(file: int, offset: int) -> None:
    """What the second process does, until its standard input ends."""
    memory = mmap.mmap(file, 0)
    model, view, slot_type = pickle.loads(memory)
    data, renderer, shared = mujoco.MjData(model), Renderer(model, view), _Shared(memory, offset, slot_type)
    inputs, number = _inputs(model, data), 0
    renderer.frame(data)
    os.write(1, b"!")
    while asked := sys.stdin.buffer.read(_SLOT_BYTES):
        number, slot = number + 1, int.from_bytes(asked, "little")
        if shared.wanted[slot] == number:
            _copy(shared.inputs[slot], inputs)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            shared.frames[slot] = renderer.frame(data)
        os.write(1, b".")


def _copy(values: list[NDArray[np.float64]], to: list[NDArray[np.float64]]) -> None:
    for value, place in zip(values, to, strict=True):
        place[...] = value


class SharedRenderer:
    """A renderer's frames, some of which a second process has drawn by the time they are wanted.

    Args:
        renderer: Draws the others; it is closed with this.
        scenes: All that will be drawn; their model and data stay where they are in memory.
    """

    def __init__(self, renderer: Renderer, scenes: Sequence[_Scene]) -> None:
        self._renderer, self._scene, self._inputs = renderer, scenes[0], [_inputs(*scene) for scene in scenes]
        self._slots = {id(data): slot for slot, (_, data) in enumerate(scenes)}
        self._process: _Process | None = None
        self._reset()

    def begin(self, data: mujoco.MjData) -> None:
        """Begin to draw a scene, which stands as it is until :meth:`frames` is asked for it, or it is begun anew."""
        if self._pid != os.getpid():
            self._reset()
        self._patience -= 1
        if self._patience >= 0:
            return
        slot = self._slots[id(data)]
        try:
            process = self._process or self._start()
            behind = _BACKLOG * len(self._slots)
            if process.done >= max(process.asked - behind, 0) or process.listen() >= max(process.asked - behind, 0):
                _copy(self._inputs[slot], process.shared.inputs[slot])
                self._numbers[slot] = process.ask(slot)
        except OSError:
            self._alone()

    def frames(self, scenes: Sequence[_Scene]) -> list[NDArray[np.uint8]]:
        """As :meth:`.Renderer.frames`; the last are drawn here while the first, if begun, are drawn there."""
        if self._pid != os.getpid():
            self._reset()
        try:
            if self._process is not None:
                self._process.tell()
        except OSError:
            self._alone()
        return [self._frame(*scene) for scene in reversed(scenes)][::-1]

    def _frame(self, model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.uint8]:
        slot, process = self._slots[id(data)], self._process
        number, self._numbers[slot] = self._numbers[slot], 0
        if number and process is not None:
            try:
                if process.done >= number or process.listen() >= number:
                    return process.shared.frames[slot].copy()
                process.shared.wanted[slot] = 0
            except OSError:
                self._alone()
        return self._renderer.frame(data, model)

    def close(self) -> None:
        """End the process and free the OpenGL context; may be called again."""
        self._reset()
        self._renderer.close()

    def _start(self) -> _Process:
        self._process = process = _Process(self._scene, self._renderer.view, len(self._inputs))
        self._finalizer = weakref.finalize(self, process.end, os.getpid())
        return process

    def _reset(self) -> None:
        if self._process is not None:
            self._finalizer()
        self._process, self._patience, self._pid = None, PATIENCE, os.getpid()
        self._numbers = [0] * len(self._inputs)  # of what was begun and not fetched; 0 where nothing was

    def _alone(self) -> None:
        """Go on without the process."""
        self._reset()
        self._patience = sys.maxsize
        words = "The process that draws lanes beside this one could not start or has died; this one draws all of them."
        warnings.warn(words, RuntimeWarning, stacklevel=2)
