"""``render_mode="human"``: a window that shows every motion, without a desktop by SDL's dummy driver."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from worlds import draw_quickly

from imagine_bench import registry
from imagine_bench.errors import SetupError

pygame = pytest.importorskip("pygame")  # of the extra play


@pytest.fixture(autouse=True)
def without_shadows(monkeypatch):
    draw_quickly(monkeypatch)


def make(**options):
    return gymnasium.make(registry.TASKS["arrow_puzzle"].env_id, disable_env_checker=True, **options)


@pytest.fixture
def shown(monkeypatch):
    """What windows show, image by image, without waiting between them."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    images, flip = [], pygame.display.flip

    def keep():
        images.append(pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1))
        flip()

    class Clock:
        def tick(self, per_s):
            assert per_s > 0

    monkeypatch.setattr(pygame.display, "flip", keep)
    monkeypatch.setattr(pygame.time, "Clock", Clock)
    yield images
    pygame.quit()


def test_a_window_shows_the_motion_and_changes_no_bit(shown):
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
    assert len(motion) == pytest.approx(5 * step[4]["sim_time_s"], abs=3)
    assert len({image.tobytes() for image in motion}) > 0.8 * len(motion)
    np.testing.assert_array_equal(motion[0], shown[before - 1])
    assert env.render() is None
    twin = pickle.loads(pickle.dumps(env))
    for each in (env, plain, twin):
        each.close()
    assert not pygame.display.get_init()


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


def test_without_pygame_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = make(render_mode="human", execution="kinematic")
    with pytest.raises(SetupError, match=r"pip install 'imagine-bench\[play\]'"):
        env.reset(seed=0)
    env.close()
