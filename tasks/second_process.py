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
_Scene = tuple[mujoco.MjModel, mujoco.MjData]


def _inputs(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[NDArray[np.float64], ...]:
    """All that changes and shows in a scene's images: views."""
    return data.qpos, data.mocap_pos, data.mocap_quat, *looks_of(model)


class _Shared:
    """What both processes see of each scene: the number that is wanted, its inputs, its frame."""

    def __init__(self, memory: mmap.mmap, offset: int, slots: int, width: int, view: View) -> None:
        self.wanted = np.frombuffer(memory, np.int64, slots, offset)
        self.inputs = np.frombuffer(memory, np.float64, slots * width, offset + 8 * slots).reshape(slots, width)
        shape, start = (slots, view.height, view.width, 3), offset + 8 * slots * (1 + width)
        self.frames = np.frombuffer(memory, np.uint8, -1, start).reshape(shape)


class _Process:
    """Draws the scenes that it is asked for, one after another.

    Raises:
        OSError: It cannot start; from the methods: it has died.
    """

    def __init__(self, model: mujoco.MjModel, view: View, slots: int, width: int) -> None:
        head = pickle.dumps((model, view, slots, width))
        offset = -(-len(head) // 8) * 8
        size = offset + slots * (8 + 8 * width + 3 * view.height * view.width)
        with tempfile.TemporaryFile(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as file:
            file.truncate(size)
            memory = mmap.mmap(file.fileno(), size)
            memory[: len(head)] = head
            code = f"from {__name__} import serve; serve({file.fileno()}, {offset})"
            self._child = subprocess.Popen(
                [sys.executable, "-P", "-c", code], bufsize=0, pass_fds=[file.fileno()], start_new_session=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        assert self._child.stdin is not None and self._child.stdout is not None
        self._asks, self._answers = self._child.stdin, self._child.stdout
        os.set_blocking(self._answers.fileno(), False)
        self.shared, self.asked, self._done = _Shared(memory, offset, slots, width, view), 0, -1

    def done(self) -> int:
        """The number of the last scene that is drawn, or was no longer wanted; -1 before the process is ready."""
        heard = self._answers.read(4096)  # a byte when it is ready, and one for each scene
        if heard == b"":
            raise BrokenPipeError
        self._done += len(heard or b"")
        return self._done

    def ask(self, slot: int) -> int:
        """Ask for a scene, whose inputs are written; returns its number."""
        self.asked += 1
        self.shared.wanted[slot] = self.asked
        self._asks.write(slot.to_bytes(2, "little"))
        return self.asked

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
    model, view, slots, width = pickle.loads(memory)
    data, renderer, shared = mujoco.MjData(model), Renderer(model, view), _Shared(memory, offset, slots, width, view)
    inputs = _inputs(model, data)
    ends = np.cumsum([each.size for each in inputs])[:-1]
    renderer.frame(data)
    os.write(1, b"!")
    number = 0
    while asked := sys.stdin.buffer.read(2):
        number, slot = number + 1, int.from_bytes(asked, "little")
        if shared.wanted[slot] == number:
            for mine, given in zip(inputs, np.split(shared.inputs[slot], ends), strict=True):
                mine[...] = given.reshape(mine.shape)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            shared.frames[slot] = renderer.frame(data)
        os.write(1, b".")


class SharedRenderer:
    """A renderer's frames, some of which a second process has drawn by the time they are wanted.

    Args:
        renderer: Draws the others; it is closed with this.
        scenes: All that will be drawn; their model and data stay where they are in memory.
    """

    def __init__(self, renderer: Renderer, scenes: Sequence[_Scene]) -> None:
        self._renderer, self._model, self._inputs = renderer, scenes[0][0], [_inputs(*scene) for scene in scenes]
        self._slots = {id(data): slot for slot, (_, data) in enumerate(scenes)}
        self._process: _Process | None = None
        self._reset()

    def _reset(self) -> None:
        self._patience, self._pid = PATIENCE, os.getpid()
        self._numbers = [0] * len(self._inputs)  # of what was begun and not fetched; 0 where nothing was

    def begin(self, data: mujoco.MjData) -> None:
        """Begin to draw a scene, which stands as it is until :meth:`frames` is asked for it, or it is begun anew."""
        if self._pid != os.getpid():
            self._end()
        self._patience -= 1
        if self._patience >= 0:
            return
        slot = self._slots[id(data)]
        try:
            process = self._process or self._start()
            if 0 <= process.done() > process.asked - _BACKLOG * len(self._slots):
                np.concatenate([each.ravel() for each in self._inputs[slot]], out=process.shared.inputs[slot])
                self._numbers[slot] = process.ask(slot)
        except OSError:
            self._alone()

    def frames(self, scenes: Sequence[_Scene]) -> list[NDArray[np.uint8]]:
        """As :meth:`.Renderer.frames`; the last are drawn here while the first, if begun, are drawn there."""
        return [self._frame(*scene) for scene in reversed(scenes)][::-1]

    def _frame(self, model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.uint8]:
        slot, process = self._slots[id(data)], self._process
        number, self._numbers[slot] = self._numbers[slot], 0
        if number and process is not None and self._pid == os.getpid():
            try:
                if process.done() >= number:
                    return process.shared.frames[slot].copy()
                process.shared.wanted[slot] = 0
            except OSError:
                self._alone()
        return self._renderer.frame(data, model)

    def close(self) -> None:
        """End the process and free the OpenGL context; may be called again."""
        self._end()
        self._renderer.close()

    def _start(self) -> _Process:
        width = sum(each.size for each in self._inputs[0])
        self._process = process = _Process(self._model, self._renderer.view, len(self._inputs), width)
        self._finalizer = weakref.finalize(self, process.end, self._pid)
        return process

    def _end(self) -> None:
        if self._process is not None:
            self._finalizer()
        self._process = None
        self._reset()

    def _alone(self) -> None:
        """Go on without the process."""
        self._end()
        self._patience = sys.maxsize
        words = "The process that draws lanes beside this one could not start or has died; this one draws all of them."
        warnings.warn(words, RuntimeWarning, stacklevel=2)
