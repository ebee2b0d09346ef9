"""A window on the desktop that shows images, by pygame: the only module that imports it, and only when one opens."""

from __future__ import annotations

import os
from types import ModuleType
from typing import Any

from imagine_bench.errors import SetupError
from imagine_bench.interfaces import Frame

_NOWHERE = ("offscreen", "dummy")
"""What SDL chooses by itself where there is no desktop."""


def open_display() -> ModuleType:
    """Pygame with its display open.

    Raises:
        SetupError: There is no pygame or no desktop; ``SDL_VIDEODRIVER=dummy`` does without one.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame  # noqa: PLC0415  (an extra)
    except ImportError as error:
        raise SetupError("Windows need pygame: pip install 'imagine-bench[play]'.") from error
    try:
        pygame.display.init()
        driver = pygame.display.get_driver()
    except pygame.error as error:
        raise _no_desktop(str(error)) from error
    if driver in _NOWHERE and "SDL_VIDEODRIVER" not in os.environ:
        pygame.display.quit()
        raise _no_desktop("DISPLAY and WAYLAND_DISPLAY name none")
    return pygame


def _no_desktop(reason: str) -> SetupError:
    return SetupError(
        f"No desktop to open a window on ({reason}). Use one, or render_mode='rgb_array'; SDL_VIDEODRIVER=dummy opens "
        "windows that nobody sees."
    )


class Window:
    """One window with a title; it opens with the first image and takes its size."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._pygame: Any = None
        self._clock: Any = None

    def show(self, image: Frame, per_s: float) -> None:
        """Show an image (H, W, 3) and wait until it is time for the next one, so many a second.

        Raises:
            SetupError: As :func:`open_display`.
        """
        if self._pygame is None:
            self._pygame = open_display()
            self._clock = self._pygame.time.Clock()
        pygame, (height, width, _) = self._pygame, image.shape
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

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._title,)
