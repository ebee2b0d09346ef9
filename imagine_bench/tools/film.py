"""``imagine-bench play --film``: a GIF of the oracle at work, the whole scene beside the frame that agents see."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import gymnasium
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, SetupError
from imagine_bench.interfaces import SceneReader
from imagine_bench.seeding import episode_seed
from imagine_bench.store.files import make_folder, write_bytes

WIDTH_PX, HEIGHT_PX = 560, 420
"""Size of the view of the whole scene; the agent's frame stands to its right, half as high."""
_FRAME_PX = 210
_FPS = 10
_HOLD = 8
"""Images for which the scene stands still between two macro-actions."""


def film(task: str, out: Path, *, seed: int = 0, appearance: str = "clean") -> Path:
    """Film one episode of optimal macro-actions in contact physics.

    Args:
        task: Registered task.
        out: The GIF; an existing file is not overwritten.
        seed: Chooses the episode.
        appearance: Appearance level.

    Raises:
        UnknownNameError: No such task or appearance.
        InvalidValueError: ``out`` is no GIF.
        SetupError: ``out`` exists or cannot be written, or there is no GL.
    """
    if out.suffix.lower() != ".gif":
        raise InvalidValueError(f"{out} does not end in .gif, the only format of films; give such an --out.")
    if out.exists():
        raise SetupError(f"{out} exists and is not overwritten; delete it or give another --out.")
    make_folder(out.parent)
    images = [Image.fromarray(image) for image in _episode(task, seed, appearance)]
    colors = images[0].quantize(128)
    frames = [image.quantize(palette=colors, dither=Image.Dither.NONE) for image in images]
    whole = io.BytesIO()
    frames[0].save(whole, "GIF", save_all=True, append_images=frames[1:], duration=1000 // _FPS, loop=0, optimize=True)
    write_bytes(out, whole.getvalue())
    return out


def _episode(task: str, seed: int, appearance: str) -> Iterator[NDArray[np.uint8]]:
    spec = registry.task(task)
    env = gymnasium.make(spec.env_id, appearance=appearance, disable_env_checker=True)
    scene = env.unwrapped
    assert isinstance(scene, SceneReader)
    scene.capture_motion_hz = float(_FPS)
    with closing(env):
        frame, info = env.reset(seed=episode_seed("recording", seed, 0))
        over = False
        while not over:
            yield from [_side_by_side(scene.human_view(WIDTH_PX, HEIGHT_PX), frame)] * _HOLD
            action = spec.rules.optimal_action(tuple(int(value) for value in info["macrostate"]))
            after, _, terminated, truncated, info = env.step(action)
            yield from (_side_by_side(image, frame) for image in scene.film(WIDTH_PX, HEIGHT_PX))
            frame, over = after, terminated or truncated
        yield from [_side_by_side(scene.human_view(WIDTH_PX, HEIGHT_PX), frame)] * (2 * _HOLD)


def _side_by_side(scene: NDArray[np.uint8], frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The scene, and to its right the agent's frame of the moment before, enlarged without smoothing."""
    canvas = np.full((HEIGHT_PX, WIDTH_PX + _FRAME_PX + 10, 3), 255, dtype=np.uint8)
    canvas[:, :WIDTH_PX] = scene
    small = np.asarray(Image.fromarray(frame).resize((_FRAME_PX, _FRAME_PX), Image.Resampling.NEAREST))
    top = (HEIGHT_PX - _FRAME_PX) // 2
    canvas[top : top + _FRAME_PX, WIDTH_PX + 10 :] = small
    return canvas
