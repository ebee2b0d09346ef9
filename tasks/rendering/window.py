"""A window on the desktop that shows images, by pygame: the only module that imports it, and only when one opens."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from types import ModuleType
from typing import Any, cast

from imagine_bench.arrays import Frame
from imagine_bench.errors import SetupError

HAS_PYGAME = importlib.util.find_spec("pygame") is not None


def open_display(*, seen: bool) -> ModuleType:
    """Open pygame's display; where there is no desktop, one that nobody sees, unless it must be ``seen``.

    SDL's driver "offscreen", its own choice there, would end MuJoCo's OpenGL too when the window closes.

    Raises:
        SetupError: There is no pygame, or no desktop. ``SDL_VIDEODRIVER=dummy`` does without one, for tests.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame  # noqa: PLC0415  (an extra)
    except ImportError as error:
        raise SetupError("Windows need pygame: pip install 'imagine-bench[play]'.") from error
    chosen = os.environ.get("SDL_VIDEODRIVER")
    linux = sys.platform == "linux"
    needs = {"x11": "DISPLAY", "wayland": "XDG_RUNTIME_DIR"}  # where they are not set, SDL itself complains
    drivers = [*(driver for driver, variable in needs.items() if variable in os.environ), "dummy"]
    for driver in () if chosen or not linux else drivers:
        os.environ["SDL_VIDEODRIVER"] = driver
        with contextlib.suppress(pygame.error):
            pygame.display.init()
        del os.environ["SDL_VIDEODRIVER"]
    pygame.display.init()
    if seen and not chosen and pygame.display.get_driver() == "dummy":
        pygame.display.quit()
        raise SetupError(
            "There is no desktop to open a window on; run this on one. SDL_VIDEODRIVER=dummy opens one unseen."
        )
    return pygame


class Window:
    """One window with a title, opened by its first image, of whose size it is."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._pygame = cast(Any, None)
        self._clock = cast(Any, None)

    def show(self, image: Frame, per_s: float) -> None:
        """Show an image (H, W, 3) and wait until the next one is due, so many a second; SetupError without pygame."""
        if self._pygame is None:
            self._pygame = open_display(seen=False)
            self._clock = self._pygame.time.Clock()
        pygame = self._pygame
        height, width, _ = image.shape
        screen = pygame.display.get_surface()
        if screen is None or screen.get_size() != (width, height):
            screen = pygame.display.set_mode((width, height))
            pygame.display.set_caption(self._title)
        screen.blit(pygame.surfarray.make_surface(image.swapaxes(0, 1)), (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(per_s)

    def close(self) -> None:
        """Close it; may be called again, and a later image opens it anew."""
        if self._pygame is not None:
            self._pygame.display.quit()
            self._pygame = None

    def __reduce__(self) -> tuple[type[Window], tuple[str]]:
        return type(self), (self._title,)
