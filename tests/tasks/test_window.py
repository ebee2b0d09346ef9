"""``render_mode="human"``: a window that shows every motion, without a desktop by SDL's dummy driver."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

from imagine_bench import registry

pygame = pytest.importorskip("pygame")  # of the extra play


pytestmark = pytest.mark.usefixtures("without_shadows")


def make(**options):
    return gymnasium.make(registry.TASKS["arrow_puzzle"].env_id, disable_env_checker=True, **options)


@pytest.fixture
def shown(monkeypatch):
    """The images of windows, one by one, and how many are due a second, without waiting between them."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    images, rates, flip = [], [], pygame.display.flip

    def keep():
        images.append(pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1))
        flip()

    class Clock:
        def tick(self, per_s):
            rates.append(per_s)

    monkeypatch.setattr(pygame.display, "flip", keep)
    monkeypatch.setattr(pygame.time, "Clock", Clock)
    yield images, rates
    pygame.quit()


def test_a_window_shows_the_motion_and_changes_no_bit(shown):
    shown, rates = shown
    assert make(render_mode="human").unwrapped.capture_motion_hz == 25
    small = {"width": 64, "height": 48}
    env, plain = make(render_mode="human", motion_hz=5, **small), make(render_mode="rgb_array", **small)
    for each in (env, plain):
        each.reset(seed=0)
    np.testing.assert_array_equal(shown[-1], plain.render())
    assert pygame.display.get_caption()[0] == "Arrow puzzle"
    before = len(shown)
    step, step_too = env.step(2), plain.step(2)
    np.testing.assert_equal(step, step_too)
    np.testing.assert_array_equal(shown[-1], plain.render())
    motion = shown[before:]
    assert rates == [5, 25, *[5] * (len(motion) - 1), 25], "how the scene stands is shown for a moment"
    assert len(motion) == pytest.approx(5 * step[4]["sim_time_s"], abs=3)
    assert len({image.tobytes() for image in motion}) > 0.8 * len(motion)
    np.testing.assert_array_equal(motion[0], shown[before - 1])
    assert env.render() is None
    twin = pickle.loads(pickle.dumps(env))
    for each in (env, plain, twin):
        each.close()
    assert not pygame.display.get_init()


def test_a_window_of_continuous_control_shows_an_image_a_command(shown):
    images, rates = shown
    options = {"render_mode": "human", "rate_hz": 12.5, "observation": "proprio", "width": 64, "height": 48}
    env = gymnasium.make("imagine_bench/ArrowPuzzleEasyMotion-v0", disable_env_checker=True, **options)
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(7))
    env.close()
    assert len(images) == 4 and rates == pytest.approx([12.5] * 4)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a desktop")
def test_who_must_be_seen_needs_a_desktop():
    words = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    quiet = {name: value for name, value in os.environ.items() if name not in words}
    code = (
        "from imagine_bench.tasks.rendering.window import open_display; pygame = open_display(seen=False)\n"
        "print(pygame.display.get_driver()); pygame.quit(); open_display(seen=True)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=quiet, capture_output=True, text=True, check=False)
    assert done.stdout == "dummy\n"
    assert "SetupError: There is no desktop to open a window on" in done.stderr


_PRESS_ESCAPE = """
import threading, time, pygame
def press():
    while True:
        time.sleep(0.3)
        if pygame.display.get_init() and pygame.display.get_surface():
            assert pygame.display.get_driver() == "x11", pygame.display.get_driver()
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, {"key": pygame.K_ESCAPE}))
threading.Thread(target=press, daemon=True).start()
"""
_WINDOWS = {
    "play": _PRESS_ESCAPE + "from imagine_bench.tools.play import play; print(play('arrow_puzzle', seed=0))",
    "human": "import gymnasium, pygame, imagine_bench\n"
    "env = gymnasium.make('imagine_bench/ArrowPuzzle-v0', render_mode='human', execution='kinematic')\n"
    "env.reset(seed=0); env.step(0); print(pygame.display.get_driver()); env.close()",
}


@pytest.fixture(scope="module")
def desktop():
    """The name of an X11 display of its own."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb, a desktop without a screen, is not installed")
    ready, told = os.pipe()
    with subprocess.Popen(["Xvfb", "-displayfd", str(told)], pass_fds=[told], stderr=subprocess.DEVNULL) as server:
        yield f":{os.read(ready, 16).decode().strip()}"
        server.terminate()
    os.close(ready)
    os.close(told)


@pytest.mark.slow
@pytest.mark.parametrize("code", _WINDOWS.values(), ids=_WINDOWS)
def test_windows_open_on_x11_where_mesa_draws_and_escape_ends_a_game(desktop, code):
    """X11 ends a process that draws by GLX where EGL draws, too: the window must not be drawn by OpenGL."""
    words = ("WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "SDL_FRAMEBUFFER_ACCELERATION")
    there = {name: value for name, value in os.environ.items() if name not in words} | {"DISPLAY": desktop}
    done = subprocess.run(
        [sys.executable, "-c", code], env=there, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "x11" in done.stdout or "No episode was finished" in done.stdout
