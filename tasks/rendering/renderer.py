"""The only owner of OpenGL: images of a MuJoCo scene, from contexts that are made late and closed with care.

- A context is made at the first image, in the process that draws it; one inherited through a fork is left alone.
- Every call makes its own context current first, closing included: MuJoCo frees whatever context is current.
- Renderers that draw the same scene in the same size and quality share one context, whichever camera they draw from. A
  context costs as much as 700 frames to make, and about 30 us to change to.
  The few that were used last are kept for the next renderer.
- Any thread may draw, one at a time. The contexts of the main thread stay current there. Other threads share contexts
  that are released after each image; without EGL, which alone can release one, each thread has its own.
- Contexts that are still open when the interpreter exits are closed before MuJoCo closes the display.
"""

from __future__ import annotations

import atexit
import contextlib
import copy
import ctypes
import functools
import hashlib
import os
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import State
from imagine_bench.errors import SetupError, require_known

_OFFSCREEN = mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value
_ALL_OBJECTS = mujoco.mjtCatBit.mjCAT_ALL.value
_EXTRA_GEOMS = 32
_MESHES = ("mesh_vert", "mesh_normal", "mesh_texcoord", "mesh_face", "mesh_graph", "hfield_data", "skin_vert")
_IN_CONTEXT = (*_MESHES, "tex_data", "tex_height", "tex_width", "tex_type")
_MISSING_GL = (
    "No OpenGL for headless rendering ({reason}): on Debian or Ubuntu install it with "
    "'apt-get install libegl1 libgl1-mesa-dri', elsewhere set MUJOCO_GL to a platform that works.{chosen}"
)


@dataclass(frozen=True, kw_only=True)
class View:
    """The content and the quality of an image: a camera of the model, the size in pixels, and the geom groups to
    draw.
    """

    camera: str
    width: int = 64
    height: int = 64
    groups: State = (0,)
    shadow_px: int = 0  # edge of the shadow map; 0 draws no shadows
    samples: int = 0  # multisampling; 0 draws hard edges
    slices: int = 12  # corners of a drawn cylinder
    for_people: bool = False  # whether to draw the sky, by all lights of the model

    @property
    def canvas(self) -> tuple[int, ...]:
        """Size and quality: views of one scene that differ only in camera and groups share a context."""
        return self.width, self.height, self.shadow_px, self.samples, self.slices


def _is_egl() -> bool:
    return sys.platform == "linux" and os.environ.get("MUJOCO_GL") == "egl"


def new_gl_context(width: int, height: int) -> Any:
    """A current OpenGL context of the platform that MUJOCO_GL names, or a headless one."""
    try:
        if _is_egl():
            from mujoco.egl import GLContext  # noqa: PLC0415  (also where MuJoCo was imported before we chose)
        else:
            from mujoco.gl_context import GLContext  # noqa: PLC0415
        context = GLContext(width, height)
        context.make_current()
    except Exception as error:  # each platform fails in its own way: missing library, no device, no display
        raise _missing_gl(error) from error
    return context


def _missing_gl(error: Exception) -> SetupError:
    reason, *_ = str(error).strip().splitlines() or [type(error).__name__]
    pyopengl = os.environ.get("PYOPENGL_PLATFORM") or "egl"
    if _is_egl() and pyopengl.lower() != "egl":
        return SetupError(f"PYOPENGL_PLATFORM is {pyopengl!r}, but frames are drawn by EGL; unset it.")
    device = os.environ.get("MUJOCO_EGL_DEVICE_ID")
    if device is not None and "mujoco.egl" in sys.modules:  # EGL is there, for that module loads it
        words = "unset it, or give the number of a device that works"
        return SetupError(f"MUJOCO_EGL_DEVICE_ID is {device!r}, a device that draws nothing ({reason}); {words}.")
    platform = os.environ.get("MUJOCO_GL", "egl")
    chosen = "" if platform == "egl" else f" MUJOCO_GL is {platform!r} now, which may be the cause."
    return SetupError(_MISSING_GL.format(reason=reason, chosen=chosen))


def gl_renderer() -> str:
    """Vendor, renderer and version of the OpenGL that draws the frames.

    Raises:
        SetupError: The machine has no OpenGL.
    """
    context = new_gl_context(64, 64)
    try:
        from OpenGL import GL  # noqa: PLC0415  (after the platform is chosen)

        parts = [GL.glGetString(name) for name in (GL.GL_VENDOR, GL.GL_RENDERER, GL.GL_VERSION)]
    finally:
        context.free()
    return ", ".join(part.decode() for part in parts if part)


@functools.cache
def _current() -> Callable[[], int | None]:
    """EGL's question for the address of the current context; PyOpenGL's own takes ten times as long."""
    from OpenGL.platform import PLATFORM  # noqa: PLC0415  (after the platform is chosen)

    return ctypes.CFUNCTYPE(ctypes.c_void_p)(("eglGetCurrentContext", PLATFORM.EGL))


def _release(theirs: tuple[Any, ...] | None) -> None:
    """Let a context of other code be current in this thread, or none, so that another thread may use ours."""
    from mujoco import egl  # noqa: PLC0415  (after the platform is chosen)

    nothing = egl.EGL.EGL_NO_SURFACE
    egl.EGL.eglMakeCurrent(*(theirs or (egl.EGL_DISPLAY, nothing, nothing, egl.EGL.EGL_NO_CONTEXT)))


def _drawing(model: mujoco.MjModel, view: View) -> tuple[mujoco.MjvOption, mujoco.MjvCamera, mujoco.MjvScene]:
    """The options and the camera of a view, and an empty scene to be filled."""
    option = mujoco.MjvOption()
    option.geomgroup[:] = np.isin(np.arange(mujoco.mjNGROUP), view.groups)
    option.sitegroup[:] = 0
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
    camera.fixedcamid = model.camera(view.camera).id
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + _EXTRA_GEOMS)
    flags = mujoco.mjtRndFlag
    scene.flags[flags.mjRND_SHADOW.value] = view.shadow_px > 0
    scene.flags[flags.mjRND_SKYBOX.value] = view.for_people
    scene.flags[flags.mjRND_REFLECTION.value] = False
    scene.flags[flags.mjRND_HAZE.value] = False
    return option, camera, scene


class _Canvas:
    """An OpenGL context with one model's meshes and textures in it, for one thread or, released, for any."""

    def __init__(self, model: mujoco.MjModel, view: View, thread: int | None) -> None:
        self.thread = thread
        self.gl = new_gl_context(view.width, view.height)
        self.address = ctypes.cast(self.gl._context, ctypes.c_void_p).value if _is_egl() else None
        try:
            self.mjr = mujoco.MjrContext(_in_quality(model, view), mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except mujoco.FatalError as error:  # GLFW makes a context object without a display, but nothing can be drawn
            raise _missing_gl(error) from error
        mujoco.mjr_setBuffer(_OFFSCREEN, self.mjr)
        self._model = model  # its scene below points into it
        self._rect = mujoco.MjrRect(0, 0, view.width, view.height)
        option, camera, self._probe = _drawing(model, view)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mjv_updateScene(model, data, option, None, camera, _ALL_OBJECTS, self._probe)
        self._probe_image = self.draw(self._probe)

    def draw(self, scene: mujoco.MjvScene) -> NDArray[np.uint8]:
        """Draw a scene in this context, which is current. Shape (height, width, 3), from the bottom up."""
        image = np.empty((self._rect.height, self._rect.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._rect, scene, self.mjr)
        mujoco.mjr_readPixels(image, None, self._rect, self.mjr)
        return image

    def is_whole(self) -> bool:
        """Whether it still draws its first image.

        Other code damages a context if it frees a context of its own while this one is current: OpenGL then deletes
        the meshes and textures of this one.
        """
        self.make_current()
        return np.array_equal(self.draw(self._probe), self._probe_image)

    def is_current(self) -> bool:
        """Whether this context is known to be current in this thread, for which EGL alone can be asked."""
        return self.address is not None and _current()() == self.address

    def make_current(self) -> None:
        """Make this context current, unless it is: asking costs 1 us, telling makes the driver check everything."""
        if not self.is_current():
            self.gl.make_current()

    def close(self) -> None:
        """Free everything; nothing is left to be freed where other code has ended the display."""
        with contextlib.suppress(Exception):  # of PyOpenGL, whose class is known only after the platform is chosen
            self.make_current()
            self.mjr.free()
            self.gl.free()
        self.leave()

    def leave(self) -> None:
        """Never use this context again, nor let its destructor free it."""
        self.gl._context = None
        self.address = None


def _drawn_as(model: mujoco.MjModel) -> bytes:
    """A digest of all that a context keeps of a model: equal for models that one context may draw."""
    vis = model.vis
    settings = [vis.map.shadowclip, vis.map.shadowscale, vis.map.fogstart, vis.map.fogend]
    numbers = [*settings, *vis.rgba.fog, vis.global_.linewidth, model.stat.extent]
    digest = hashlib.sha256(np.array(numbers).tobytes())
    for name in _IN_CONTEXT:
        array = getattr(model, name)
        digest.update(f"{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.digest()


class _Canvases:
    """The contexts of this process, by scene, size and quality, and thread; the one used last comes last."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._canvases: dict[tuple[bytes, tuple[int, ...], int | None], _Canvas] = {}
        self._others: list[_Canvas] = []

    def find(self, scene: bytes, model: mujoco.MjModel, view: View, known: _Canvas | None) -> _Canvas:
        """The context for a view of a scene, made if there is none, or if one that is not the known one is damaged."""
        is_main = threading.current_thread() is threading.main_thread()
        thread = None if _is_egl() and not is_main else threading.get_ident()
        canvas = self._canvases.pop((scene, view.canvas, thread), None)
        if canvas is not None and canvas is not known and not canvas.is_whole():
            canvas.close()
            canvas = None
        if canvas is None:
            self.close(_KEPT - 1)
            canvas = _Canvas(model, view, thread)
            _close_at_exit()
        self._canvases[scene, view.canvas, thread] = canvas
        return canvas

    def of_others(self) -> tuple[Any, ...] | None:
        """Display, surfaces and context of other code, if its context is current in this thread; else None.

        They make that context current again later, as dm_control expects: it never checks whether its own still is.
        """
        current = _current()() if _is_egl() and "mujoco.egl" in sys.modules else None
        if current is None or any(current == canvas.address for canvas in reversed(self._canvases.values())):
            return None
        from mujoco.egl import EGL  # noqa: PLC0415  (after the platform is chosen)

        surfaces = EGL.eglGetCurrentSurface(EGL.EGL_DRAW), EGL.eglGetCurrentSurface(EGL.EGL_READ)
        return EGL.eglGetCurrentDisplay(), *surfaces, EGL.eglGetCurrentContext()

    def close(self, keep: int = 0) -> None:
        """Free the contexts that this thread may free, but for those that were used last."""
        usable = [key for key, each in self._canvases.items() if each.thread in (None, threading.get_ident())]
        for key in usable[: max(0, len(usable) - keep)]:
            self._canvases.pop(key).close()

    def leave(self) -> None:
        """Use no context any more, and free none, since they belong to a parent process or another thread."""
        self.lock = threading.RLock()  # a thread of the parent's may have held it
        self._others += self._canvases.values()
        self._canvases.clear()
        for canvas in self._others:
            canvas.leave()


def _in_quality(model: mujoco.MjModel, view: View) -> mujoco.MjModel:
    """A copy of a model with the quality of a view: a context reads it once, when it is made."""
    asked = copy.copy(model)
    quality = asked.vis.quality
    size = asked.vis.global_
    quality.shadowsize = view.shadow_px
    quality.offsamples = view.samples
    quality.numslices = view.slices
    quality.numstacks = max(view.slices // 2, 3)
    size.offwidth = view.width
    size.offheight = view.height
    return asked


_KEPT = 12
"""Contexts that are kept at most, of each thread."""
_canvases = _Canvases()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_canvases.leave)


def close_contexts() -> None:
    """Free the OpenGL contexts of this thread; a renderer that draws again makes a new one."""
    with _canvases.lock:
        _canvases.close()


@functools.cache
def _close_at_exit() -> None:
    """Register the end after MuJoCo registered its own, so that ours comes first."""
    atexit.register(_canvases.leave)
    atexit.register(close_contexts)


class Renderer:
    """Images of one model from one view; changes of the model's colors, lights and cameras show in the next image.

    Raises:
        UnknownNameError: The model has no such camera.
    """

    def __init__(self, model: mujoco.MjModel, view: View) -> None:
        require_known("camera", view.camera, [model.camera(index).name for index in range(model.ncam)])
        self.view = view
        self._model = model
        self.canvas: _Canvas | None = None
        self.option, self.camera, self.scene = _drawing(model, view)

    @functools.cached_property
    def _drawn_as(self) -> bytes:
        return _drawn_as(self._model)

    def frame(self, data: mujoco.MjData, model: mujoco.MjModel | None = None) -> NDArray[np.uint8]:
        """Draw ``data``, whose derived positions are up to date: a new upright RGB array. Shape (height, width, 3).

        ``model`` is a copy of this renderer's model whose colors, lights and cameras hold, or None.

        Raises:
            SetupError: The machine has no OpenGL.
        """
        return self.frames([(model or self._model, data)])[0]

    def frames(self, scenes: Sequence[tuple[mujoco.MjModel, mujoco.MjData]]) -> list[NDArray[np.uint8]]:
        """Draw several scenes, each as :meth:`frame` draws one.

        Raises:
            SetupError: As :meth:`frame`.
        """
        drawn = []
        with _canvases.lock:
            theirs = None
            canvas = self.canvas
            if canvas is None or not canvas.is_current():
                theirs = _canvases.of_others()
                canvas = _canvases.find(self._drawn_as, self._model, self.view, self.canvas)
                self.canvas = canvas
                canvas.make_current()
            for scene in scenes:
                self._fill(*scene)
                drawn.append(canvas.draw(self.scene)[::-1].copy())
            if canvas.thread is None or theirs is not None:
                _release(theirs)
        return drawn

    def _fill(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Put the geoms of the view into the scene, lit by all lights if it is for people."""
        lights = model.light_active
        as_compiled = lights.copy()
        if self.view.for_people:
            lights[:] = True
        mujoco.mjv_updateScene(model, data, self.option, None, self.camera, _ALL_OBJECTS, self.scene)
        lights[:] = as_compiled

    def close(self) -> None:
        """Leave the OpenGL context to the next renderer. Safe to call again; a later frame finds or makes one."""
        self.canvas = None

    def __reduce__(self) -> tuple[type[Renderer], tuple[mujoco.MjModel, View]]:
        return type(self), (self._model, self.view)
