"""Frames to latents for any Gymnasium learner: those of the suite's own DQN, for a library's."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np

from imagine_bench.arrays import Action, Floats32, Frame
from imagine_bench.errors import InvalidValueError, require_known
from imagine_bench.interfaces import FRAME_PX

from .encoder import Encoder, bundled_encoder


class LatentObservation(gymnasium.ObservationWrapper[Floats32, Action, Frame]):
    """Replace each camera frame by the mean of its latents, float32 of shape (Z,).

    Args:
        env: An environment that gives frames (64, 64, 3), uint8.
        encoder: An encoder, its file, or the name of a bundled one, such as ``"arrow_puzzle-clean"``.

    Raises:
        UnknownNameError: No encoder of this name is bundled; the message lists those that are.
        ArtefactError: There is no such file, or it is damaged.
        InvalidValueError: The environment gives other observations, or the encoder reads frames otherwise than its task
            declares.
    """

    def __init__(self, env: gymnasium.Env[Frame, Action], encoder: Encoder | Path | str) -> None:
        super().__init__(env)
        if env.observation_space.shape != (FRAME_PX, FRAME_PX, 3):
            raise InvalidValueError(
                f"The environment gives {env.observation_space}; an encoder takes frames of {FRAME_PX} x {FRAME_PX} "
                "pixels. Leave observation and size as they are by default."
            )
        self.encoder = encoder if isinstance(encoder, Encoder) else Encoder.load(_path(encoder))
        reads = self.encoder.card.preprocessing
        declared = getattr(env.unwrapped, "preprocessing", None)
        if declared not in (None, reads):
            raise InvalidValueError(
                f"The encoder of {self.encoder.card.task} reads frames as {reads!r}, this environment's task declares "
                f"{declared!r}; choose an encoder of its own."
            )
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.encoder.latent_size,), np.float32)

    def observation(self, observation: Frame) -> Floats32:
        """Latents (Z,) of one frame (64, 64, 3)."""
        return self.encoder.latents(observation)


def _path(encoder: Path | str) -> Path:
    if isinstance(encoder, Path):
        return encoder
    path = bundled_encoder(encoder)
    require_known("encoder", encoder, sorted(file.stem for file in path.parent.glob("*.safetensors")))
    return path
