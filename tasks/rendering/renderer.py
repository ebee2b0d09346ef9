"""The only owner of OpenGL: images of a MuJoCo scene, from contexts that are made late and closed with care.

- A context is made at the first image, in the process that draws it; one inherited through a fork is dropped.
- Every call makes its own context current first, closing included: MuJoCo frees whatever context is current.
- Any thread may draw, one at a time. A context stays current in the thread that made it. Another thread makes a
  context of its own; where the work changes threads again, contexts are released after each frame.
- What is still open when the interpreter exits is closed before MuJoCo closes the display.
- Renderers of the main thread share the context of one scene and one view, which costs as much as 700 frames to make.
  The last of a few contexts that nobody uses any more are kept for the next renderer.
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
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import InvalidValueError, SetupError, brief, require_known

MAX_IMAGE_PX = 4096
_OFFSCREEN = mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value
_ALL_OBJECTS = mujoco.mjtCatBit.mjCAT_ALL.value
_EXTRA_GEOMS = 32
_MISSING_GL = (
    "No OpenGL for headless rendering ({reason}): on Debian or Ubuntu install it with "
    "'apt-get install libegl1 libgl1-mesa-dri', elsewhere set MUJOCO_GL to a platform that works.{chosen}"
)
_CHOICES = ("MUJOCO_GL", "MUJOCO_EGL_DEVICE_ID", "PYOPENGL_PLATFORM")
"""Variables by which a user, or a cluster's profile, decides how to draw."""


@dataclass(frozen=True, kw_only=True)
class View:
    """What an image shows and how well: a camera of the model, the size in pixels, and the geom groups to draw."""

    camera: str
    width: int = 64
    height: int = 64
    groups: tuple[int, ...] = (0,)
    shadow_px: int = 0  # edge of the shadow map; 0 draws no shadows
    samples: int = 0  # multisampling; 0 draws hard edges
    slices: int = 12  # corners of a drawn cylinder
    sky: bool = False  # whether to draw the skybox


def image_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of an image in pixels as numbers. Raises InvalidValueError: one out of range."""
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, (int, np.integer)) or not 1 <= value <= MAX_IMAGE_PX:
            raise InvalidValueError(f"Image {name} {brief(value)} must be an integer from 1 to {MAX_IMAGE_PX} pixels.")
    return int(width), int(height)


def _new_gl_context(width: int, height: int) -> Any:
    """A current OpenGL context of the platform that MUJOCO_GL names, or a headless one."""
    try:
        if sys.platform == "linux" and os.environ.get("MUJOCO_GL") == "egl":
            from mujoco.egl import GLContext  # noqa: PLC0415  (also where MuJoCo was imported before we chose)
        else:
            from mujoco.gl_context import GLContext  # noqa: PLC0415
        context = GLContext(width, height)
        context.make_current()
    except Exception as error:  # each platform fails in its own way: missing library, no device, no display
        raise _missing_gl(error) from error
    return context


def _missing_gl(error: Exception) -> SetupError:
    reason = str(error).strip().splitlines()
    set_now = [f"{name}={os.environ[name]}" for name in _CHOICES if os.environ.get(name)]
    chosen = f" Set now, and perhaps the cause: {', '.join(set_now)}." if set_now else ""
    return SetupError(_MISSING_GL.format(reason=reason[0] if reason else type(error).__name__, chosen=chosen))


def gl_renderer() -> str:
    """Vendor, renderer and version of the OpenGL that draws the frames.

    Raises:
        SetupError: The machine has no OpenGL.
    """
    context = _new_gl_context(64, 64)
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


def _release() -> None:
    """Let no context of EGL be current in this thread, so that another thread may use it."""
    from mujoco import egl  # noqa: PLC0415  (after the platform is chosen)

    nothing = egl.EGL.EGL_NO_SURFACE
    egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, nothing, nothing, egl.EGL.EGL_NO_CONTEXT)


def _empty_scene(model: mujoco.MjModel, view: View) -> mujoco.MjvScene:
    """An empty scene of a model, to be filled and drawn as a view says."""
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + _EXTRA_GEOMS)
    flags = mujoco.mjtRndFlag
    scene.flags[flags.mjRND_SHADOW.value] = view.shadow_px > 0
    scene.flags[flags.mjRND_SKYBOX.value] = view.sky
    scene.flags[flags.mjRND_REFLECTION.value] = False
    scene.flags[flags.mjRND_HAZE.value] = False
    return scene


def _drawn_groups(view: View) -> mujoco.MjvOption:
    """The geom groups that a view draws."""
    option = mujoco.MjvOption()
    option.geomgroup[:] = np.isin(np.arange(mujoco.mjNGROUP), view.groups)
    option.sitegroup[:] = 0
    return option


def _fixed_camera(model: mujoco.MjModel, view: View) -> mujoco.MjvCamera:
    """The camera of the model that a view names."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
    camera.fixedcamid = model.camera(view.camera).id
    return camera


class _Canvas:
    """An OpenGL context with one model's meshes and textures in it."""

    def __init__(self, model: mujoco.MjModel, view: View) -> None:
        self.users = 0  # renderers that share it
        self.damaged = False  # whether other code was found to have freed a part of it
        self.pid = os.getpid()
        self.thread: int | None = threading.get_ident()  # in which it may be current; None once it is released
        self.gl = _new_gl_context(view.width, view.height)
        self._is_egl = type(self.gl).__module__.endswith("egl")
        self._address = ctypes.cast(self.gl._context, ctypes.c_void_p).value if self._is_egl else None
        try:
            with _quality(model, view):
                self.mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except mujoco.FatalError as error:  # GLFW makes a context object without a display, but nothing can be drawn
            raise _missing_gl(error) from error
        mujoco.mjr_setBuffer(_OFFSCREEN, self.mjr)
        self._model = model  # its scene below points into it
        self._rect = mujoco.MjrRect(0, 0, view.width, view.height)
        self._probe = _empty_scene(model, view)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        option = _drawn_groups(view)
        mujoco.mjv_updateScene(model, data, option, None, _fixed_camera(model, view), _ALL_OBJECTS, self._probe)
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

    def make_current(self) -> None:
        """Make this context current, unless it is: asking costs 1 us, telling makes the driver check everything."""
        if not self._is_egl or _current()() != self._address:
            self.gl.make_current()

    @property
    def usable(self) -> bool:
        """Whether this thread of this process may make it current."""
        return self.pid == os.getpid() and self.thread in (None, threading.get_ident())

    def release(self) -> None:
        """Leave it to any thread; EGL alone can."""
        if self._is_egl:
            _release()
            self.thread = None

    def close(self) -> None:
        """Free everything; nothing if that was done before or belongs to a parent process or another thread."""
        gl = self.gl
        mjr = self.mjr
        self.gl = None
        self.mjr = None
        if gl is None:
            return
        if not self.usable:
            _inherited.append((gl, gl._context, mjr))
            gl._context = None  # its destructor would free it from here, or after the display was closed
            return
        gl.make_current()
        mjr.free()
        gl.free()


def _drawn_as(model: mujoco.MjModel) -> bytes:
    """A digest of all that a context keeps of a model: equal for models that one context may draw."""
    vis = model.vis
    settings = [getattr(vis.map, name) for name in ("shadowclip", "shadowscale", "fogstart", "fogend")]
    numbers = [*settings, *vis.rgba.fog, vis.global_.linewidth, model.stat.extent]
    arrays = [model.mesh_vert, model.mesh_normal, model.mesh_texcoord, model.mesh_face, model.mesh_graph]
    arrays += [model.tex_data, model.tex_height, model.tex_width, model.tex_type, model.hfield_data, model.skin_vert]
    digest = hashlib.sha256(np.array(numbers).tobytes())
    for array in arrays:
        digest.update(f"{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()


class _Canvases:
    """The shared contexts of the main thread of one process, by what they draw."""

    def __init__(self) -> None:
        self._pid = os.getpid()
        self._canvases: dict[tuple[bytes, View], _Canvas] = {}  # in the order of their last use

    def borrow(self, scene: bytes, model: mujoco.MjModel, view: View) -> _Canvas:
        """The context of a scene and a view, made if there is none."""
        if self._pid != os.getpid():
            self.close()
            self._pid = os.getpid()
        canvas = self._canvases.pop((scene, view), None)
        if canvas is not None and not canvas.is_whole():
            canvas.damaged = True  # renderers that use it take a new one for their next frame
            if not canvas.users:
                canvas.close()
            canvas = None
        if canvas is None:
            canvas = _Canvas(model, view)
        self._canvases[scene, view] = canvas
        canvas.users += 1
        return canvas

    def give_back(self, canvas: _Canvas) -> None:
        """One renderer less uses it; of those without a user the few that were used last are kept."""
        canvas.users -= 1
        if not canvas.users and canvas not in self._canvases.values():  # another one took its place
            canvas.close()
        self.free_idle(_KEPT)

    def free_idle(self, keep: int = 0) -> None:
        """Free the contexts that nobody uses, but for the last ones."""
        idle = [key for key, each in list(self._canvases.items()) if not each.users]
        for key in idle[: max(0, len(idle) - keep)]:
            self._canvases.pop(key).close()

    def close(self) -> None:
        """Free every context."""
        canvases = list(self._canvases.values())
        self._canvases.clear()
        for canvas in canvases:
            canvas.close()


@contextlib.contextmanager
def _quality(model: mujoco.MjModel, view: View) -> Iterator[None]:
    """Lend ``model`` the quality of ``view``: a context reads it once, when it is made."""
    quality = model.vis.quality
    size = model.vis.global_
    before = copy.copy(quality)
    size_before = copy.copy(size)
    quality.shadowsize = view.shadow_px
    quality.offsamples = view.samples
    quality.numslices = view.slices
    quality.numstacks = max(view.slices // 2, 3)
    size.offwidth = view.width
    size.offheight = view.height
    try:
        yield
    finally:
        model.vis.quality = before
        model.vis.global_ = size_before


_KEPT = 4
"""Contexts that are kept although nobody uses them."""
_shared = _Canvases()
_open: weakref.WeakSet[Renderer] = weakref.WeakSet()
_inherited: list[Any] = []
"""Contexts of a parent process or another thread: never used here and never freed, since they belong there."""


def close_idle_contexts() -> None:
    """Free the OpenGL contexts that are kept for the next renderer."""
    _shared.free_idle()


def _close_all() -> None:
    for renderer in list(_open):
        renderer.close()
    _shared.close()


@functools.cache
def _close_all_at_exit(pid: int) -> None:
    """Register, once in each process, after MuJoCo registered its own clean-up, so that ours runs first."""
    del pid
    atexit.register(_close_all)


class Renderer:
    """Images of one model from one view; changes of the model's colors, lights and cameras show in the next image.

    Raises:
        UnknownNameError: The model has no such camera.
    """

    def __init__(self, model: mujoco.MjModel, view: View) -> None:
        self._canvas: _Canvas | None = None
        self._takeovers = 0
        self._lock = threading.RLock()
        self._pid = os.getpid()
        require_known("camera", view.camera, [model.camera(index).name for index in range(model.ncam)])
        self.view = view
        self._model = model
        self._scene = _empty_scene(model, view)
        self._option = _drawn_groups(view)
        self._camera = _fixed_camera(model, view)

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
        with self._one_at_a_time():
            canvas = self._ready_canvas()
            canvas.make_current()
            for scene in scenes:
                mujoco.mjv_updateScene(*scene, self._option, None, self._camera, _ALL_OBJECTS, self._scene)
                drawn.append(canvas.draw(self._scene)[::-1].copy())
            if self._takeovers > 1:
                canvas.release()
        return drawn

    def _one_at_a_time(self) -> AbstractContextManager[bool]:
        """The lock of this process: a thread of the parent's that held it when this was forked lives there alone."""
        if self._pid != os.getpid():
            self._lock = threading.RLock()
            self._pid = os.getpid()
        return self._lock

    def _ready_canvas(self) -> _Canvas:
        canvas = self._canvas
        if canvas is not None and canvas.usable and not canvas.damaged:
            return canvas
        self._takeovers += canvas is not None and canvas.pid == os.getpid() and not canvas.damaged
        self.close()
        if threading.current_thread() is threading.main_thread() and not self._takeovers:
            canvas = _shared.borrow(self._drawn_as, self._model, self.view)
            give_back: Callable[[], None] = functools.partial(_shared.give_back, canvas)
        else:
            canvas = _Canvas(self._model, self.view)
            give_back = canvas.close
        self._canvas = canvas
        # A renderer that is merely forgotten must free its context with it current, too.
        self._finalizer = weakref.finalize(self, give_back)
        self._finalizer.atexit = False
        _open.add(self)
        _close_all_at_exit(os.getpid())
        return canvas

    def close(self) -> None:
        """Free the OpenGL context, if this process has one. Safe to call again; a later frame makes a new one."""
        with self._one_at_a_time():
            canvas = self._canvas
            self._canvas = None
            _open.discard(self)
            if canvas is not None:
                self._finalizer()

    def __reduce__(self) -> tuple[type[Renderer], tuple[mujoco.MjModel, View]]:
        return type(self), (self._model, self.view)
