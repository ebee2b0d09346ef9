"""The one owner of OpenGL: the traps of software GL, each shown to be closed."""

from __future__ import annotations

import importlib.util
import os
import pickle
import shutil
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.arrows.world import ArrowWorld
from imagine_bench.tasks.graphics import choose_platform
from imagine_bench.tasks.pick_place.world import PickWorld
from imagine_bench.tasks.rendering import Renderer, View
from imagine_bench.tasks.rendering import renderer as rendering
from imagine_bench.tasks.rendering.cameras import DRAWN_GROUPS, agent_camera_view, human_camera_view
from imagine_bench.tasks.scenes.appearance import appearance

from imagine_bench.errors import SetupError


@pytest.fixture(autouse=True)
def no_idle_context():
    rendering.close_contexts()


@pytest.fixture
def world():
    world = ArrowWorld(appearance("clean"))
    world.place((0, 1, 2, 1), np.random.default_rng(0))
    return world


@pytest.fixture
def made(monkeypatch):
    """The sizes of the contexts that are made."""
    made = []
    make = rendering.new_gl_context
    monkeypatch.setattr(rendering, "new_gl_context", lambda *size: made.append(size) or make(*size))
    return made


def own_camera(model):
    """Of a size that nothing else in this process draws, so that it shares no context."""
    return Renderer(model, agent_camera_view(62))


needs_xvfb = pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="needs Xvfb")


def run_script(script: str, *before: str, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")}
    return subprocess.run(
        [*before, sys.executable, "-W", "error::ResourceWarning", "-c", textwrap.dedent(script)],
        capture_output=True, text=True, timeout=120, env=kept | environment, check=False,
    )  # fmt: skip


def assert_silent(script: str, *before: str, **environment: str) -> None:
    """A script that prints True says nothing else, however it ends."""
    done = run_script(script, *before, **environment)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "True", "")


def test_the_table_stands_on_the_floor(world):
    model = world.model
    legs = [geom for geom in map(model.geom, range(model.ngeom)) if geom.name.startswith("table_leg")]
    table = model.geom("table_wood")
    heights = [world.data.geom(leg.name).xpos[2] + leg.size[2] * np.array([-1.0, 1.0]) for leg in legs]
    underside = world.data.geom(table.name).xpos[2] - table.size[2]
    np.testing.assert_allclose(heights, [[world.data.geom("floor").xpos[2], underside]] * 4)


def test_renderers_share_a_context_if_scene_and_quality_are_the_same(world, made):
    """Whatever the camera; sharing, an end and a new context change no frame."""
    twin, other = ArrowWorld(appearance("clean")), PickWorld(appearance("clean"))
    twin.place((3, 3, 0, 2), np.random.default_rng(0))
    wrist = agent_camera_view(62)
    shared = [(world, wrist), (twin, wrist), (world, replace(wrist, camera="human", groups=DRAWN_GROUPS))]
    better = [replace(wrist, width=63), replace(wrist, shadow_px=256), replace(wrist, samples=4)]
    several = [*shared, (other, wrist), *((world, view) for view in better)]  # pick-and-place has other meshes
    alone = []
    for scene, view in several:
        alone.append(Renderer(scene.model, view).frame(scene.data))
        rendering.close_contexts()
    made.clear()
    cameras = [Renderer(scene.model, view) for scene, view in several]
    for count in (5, 10):
        for camera, (scene, _), frame in zip(cameras, several, alone, strict=True):
            assert np.array_equal(camera.frame(scene.data), frame)
        assert len(made) == count
        cameras[0].close()
        assert np.array_equal(cameras[1].frame(twin.data), alone[1])
        rendering.close_contexts()


@pytest.fixture
def foreign(world, monkeypatch):
    """Another renderer of the same scene in the same process, whose context is not current."""
    if sys.platform != "linux":
        return mujoco.Renderer(world.model, 64, 64)
    from mujoco.rendering.classic import gl_context

    egl = pytest.importorskip("mujoco.egl")
    monkeypatch.setattr(gl_context, "GLContext", egl.GLContext)
    renderer = mujoco.Renderer(world.model, 64, 64)
    egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_CONTEXT)
    return renderer


def test_frames_survive_a_foreign_renderer_in_the_same_process(world, foreign):
    camera = Renderer(world.model, agent_camera_view())
    before = camera.frame(world.data)
    foreign.update_scene(world.data)
    foreign.render()
    assert np.array_equal(camera.frame(world.data), before)
    foreign._gl_context.make_current()
    foreign.close()
    assert np.array_equal(camera.frame(world.data), before)


def test_a_context_that_other_code_damaged_is_not_shared(world, foreign):
    first, second = Renderer(world.model, agent_camera_view()), Renderer(world.model, agent_camera_view())
    before = first.frame(world.data)
    foreign._mjr_context.free()  # while ours is current: OpenGL deletes objects of the same numbers in ours
    assert not np.array_equal(first.frame(world.data), before), "nothing was damaged"
    assert np.array_equal(second.frame(world.data), before)
    assert np.array_equal(first.frame(world.data), before), "an environment that shared it takes another one, too"
    first.close()
    second.close()
    assert np.array_equal(first.frame(world.data), before)
    first.close()
    foreign._gl_context.free()


def test_no_context_is_made_before_the_first_frame(world, made):
    rendering.close_contexts()  # those of other tests
    camera = own_camera(world.model)
    twin = pickle.loads(pickle.dumps(camera))  # as a pickled environment's
    assert made == []
    twin.frame(world.data)
    assert len(made) == 1
    twin.close()


@pytest.mark.parametrize(
    ("owner", "name", "failure"),
    [
        ("mujoco.egl", "GLContext", ImportError("Cannot initialize a EGL device display")),
        ("mujoco.egl", "GLContext", AttributeError()),
        ("mujoco", "MjrContext", mujoco.FatalError("an OpenGL platform library has not been loaded")),
    ],
)
def test_missing_gl_says_what_to_install(world, monkeypatch, owner, name, failure):
    def broken(*_):
        raise failure

    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(pytest.importorskip(owner), name, broken)
    with pytest.raises(SetupError, match="apt-get install libegl1 libgl1-mesa-dri") as caught:
        own_camera(world.model).frame(world.data)
    assert (str(failure) or "AttributeError") in str(caught.value)
    assert "\n" not in str(caught.value)


_FRAME = """
    {before}
    import gymnasium, imagine_bench
    options = {{"execution": "kinematic", "render_mode": "rgb_array", "width": 64, "height": 48}}
    env = gymnasium.make("imagine_bench/ArrowPuzzle-v0", **options)
    frame, _ = env.reset(seed=0)
    image = env.render()
    {after}
    print(frame.sum() > 0 and image.sum() > 0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="headless EGL is a Linux matter")
@pytest.mark.parametrize(
    ("before", "after"),
    [("", "del env"), ("import mujoco", "kept = [env, env.unwrapped]")],
    ids=["collected", "mujoco_first_and_left_open"],
)
def test_a_headless_script_draws_and_exits_in_silence(before, after):
    """MUJOCO_GL is empty and the display is a stale one; nothing is said on stderr, however the script ends."""
    assert_silent(_FRAME.format(before=before, after=after), MUJOCO_GL="", DISPLAY=":99")


@pytest.mark.skipif(sys.platform != "linux", reason="headless EGL is a Linux matter")
@pytest.mark.parametrize("desktop", [False, pytest.param(True, marks=needs_xvfb)])
def test_a_window_of_gymnasium_s_ends_no_environment_s_drawing(desktop):
    """SDL without a desktop ends EGL where it closes; on X11 it would draw by GLX in the thread that draws by EGL."""
    pytest.importorskip("pygame")
    before = """
    import gymnasium, imagine_bench
    from gymnasium.wrappers import HumanRendering
    make = lambda **options: gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic", **options)
    other = make()
    shown = HumanRendering(make(render_mode="rgb_array", width=64, height=48))
    other.reset(seed=0)
    shown.reset(seed=0)
    """
    after = "frame = other.step(1)[0]; shown.close(); frame = other.step(0)[0]"
    command = ["xvfb-run", "-a"] if desktop else []
    folders = {"XDG_RUNTIME_DIR": "/tmp", "TMPDIR": "/tmp"}  # xvfb-run takes no folder with a space
    assert_silent(_FRAME.format(before=before, after=after), *command, **folders)


@pytest.mark.skipif(sys.platform != "linux", reason="headless EGL is a Linux matter")
@pytest.mark.parametrize(
    ("variable", "value", "sentence"),
    [
        *(("MUJOCO_EGL_DEVICE_ID", value, "a device that draws nothing") for value in ("99", "abc")),
        ("PYOPENGL_PLATFORM", "glx", "but frames are drawn by EGL; unset it"),
    ],
)
def test_a_variable_that_blocks_egl_is_named(variable, value, sentence):
    draw = "from imagine_bench.tasks.rendering import gl_renderer\ntry:\n    gl_renderer()\nexcept Exception as error:"
    done = run_script(f"{draw}\n    print(error)", **{variable: value})
    assert done.stdout.startswith(f"{variable} is {value!r}, {sentence}")
    assert "install" not in done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="triton is a Linux matter")
def test_the_llvm_of_triton_is_loaded_before_mesa_s(tmp_path):
    """In the other order an optimiser of a CUDA build of torch ends the process; triton itself is not imported."""
    (tmp_path / "triton" / "_C").mkdir(parents=True)
    (tmp_path / "triton" / "__init__.py").write_text("raise ImportError('nobody needs triton here')")
    library = tmp_path / "triton" / "_C" / "libtriton.so"
    library.write_bytes(Path(importlib.util.find_spec("_ctypes").origin).read_bytes())
    loaded = "from pathlib import Path; loaded = 'libtriton' in Path('/proc/self/maps').read_text()"
    before = f"import sys; sys.path.insert(0, {str(tmp_path)!r})"
    assert_silent(_FRAME.format(before=before, after=f"{loaded}; assert loaded; env.close()"))


@pytest.mark.parametrize(
    ("platform", "complaint"),
    [
        ("elg", "MUJOCO_GL is 'elg'; unset it, or give one of egl, glfw, osmesa"),
        ("osmesa", "MUJOCO_GL is 'osmesa', but libOSMesa is not installed; install it or uns"),
    ],
)
def test_a_platform_that_cannot_draw_is_named(monkeypatch, platform, complaint):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    monkeypatch.setenv("MUJOCO_GL", platform)
    with pytest.raises(SetupError, match=complaint):
        choose_platform()


@pytest.mark.skipif(sys.platform != "linux", reason="headless EGL is a Linux matter")
def test_scenes_of_several_threads_end_in_silence():
    script = """
        from concurrent.futures import ThreadPoolExecutor
        import numpy as np
        from imagine_bench.tasks.arrows.spec import spec_of
        from imagine_bench.tasks.rendering import Renderer, View
        from imagine_bench.tasks.rendering.cameras import agent_camera_view
        from imagine_bench.tasks.arrows.world import ArrowWorld
        from imagine_bench.tasks.scenes.appearance import appearance
        states, world = np.array([[0, 1, 2, 1]]), ArrowWorld(appearance("clean"))
        world.place((0, 1, 2, 1), np.random.default_rng(0))
        camera = Renderer(world.model, agent_camera_view())
        with ThreadPoolExecutor(3) as pool:
            draw = spec_of().render_macrostates
            drawn = [pool.submit(draw, states, "clean", np.random.default_rng(0)) for _ in range(3)]
            frames = [job.result() for job in drawn]
            pool.submit(camera.frame, world.data).result()
        camera.close()
        print(all(np.array_equal(frames[0], frame) for frame in frames))
    """
    assert_silent(script)


def test_any_thread_draws_one_at_a_time(world, made):
    camera = own_camera(world.model)
    before = camera.frame(world.data)
    with ThreadPoolExecutor(1) as first, ThreadPoolExecutor(1) as second:
        for _ in range(3):
            for pool in (first, second):
                assert np.array_equal(pool.submit(camera.frame, world.data).result(), before)
            assert np.array_equal(camera.frame(world.data), before)
        at_once = [pool.submit(camera.frame, world.data) for _ in range(10) for pool in (first, second)]
        assert all(np.array_equal(job.result(), before) for job in at_once)
        assert len(made) == 2, "one of the main thread, one of all others"
        second.submit(camera.close).result()
    assert np.array_equal(camera.frame(world.data), before)
    camera.close()


@pytest.mark.parametrize(
    ("size", "quick", "quality"),
    [((256, 256), False, (2048, 4, 28)), ((257, 1), False, (8192, 16, 64)), ((1, 257), True, (2048, 4, 28))],
)
def test_small_and_quick_views_for_people_are_coarse(size, quick, quality):
    view = human_camera_view("far", *size, quick=quick)
    assert (view.width, view.height, view.shadow_px, view.samples, view.slices) == (*size, *quality)


def test_a_view_for_people_leaves_agents_frames_as_they_were(world):
    camera = own_camera(world.model)
    before = camera.frame(world.data)
    lights = world.model.light_active.tolist()
    dim, lit = (
        Renderer(world.model, View(camera="human", groups=DRAWN_GROUPS, for_people=for_people)).frame(world.data)
        for for_people in (False, True)
    )
    table = (slice(48, 62), slice(4, 60))
    assert lit[table].mean() > dim[table].mean() + 5
    assert world.model.light_active.tolist() == lights
    np.testing.assert_array_equal(camera.frame(world.data), before)
    camera.close()
