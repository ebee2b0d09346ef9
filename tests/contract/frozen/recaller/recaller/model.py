"""The world model: frames are told apart by small gray images of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.data.episodes import Episodes
from imagine_bench.interfaces import AgentContext, Frame
from imagine_bench.world_models import Imagined
from recaller.memory import Memory


class Recall:
    """Each imagined future draws one of the outcomes that were seen."""

    def __init__(self, context: AgentContext) -> None:
        self.n_actions = context.n_actions
        self.memory = Memory()
        self.images: dict[str, Frame] = {}

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        keys = [key(frame) for frame in dataset.frames]
        self.images = dict(zip(keys, dataset.frames, strict=True))
        for step, row in enumerate(dataset.rows[0]):
            followed = (keys[row + 1], float(dataset.rewards[step]), bool(dataset.terminated[step]))
            self.memory.add(keys[row], int(dataset.actions[step]), followed)

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        asked = actions[:, frames.shape[1] - 1 :]  # [N, D]
        shape = (len(frames), samples, asked.shape[1])
        pictures = np.empty((*shape, *frames.shape[2:]), dtype=np.uint8)
        rewards = np.zeros(shape)
        p_ended = np.zeros(shape)
        unknown = np.zeros(shape)
        for row, sample in np.ndindex(shape[:2]):
            state = key(frames[row, -1])
            image = frames[row, -1]
            over = False
            for step, action in enumerate(asked[row].tolist()):
                unknown[row, sample, step] = float(self.memory.count(state, action) == 0)
                state, reward, terminated = self.memory.draw(state, action, rng)
                image = self.images.get(state, image)
                pictures[row, sample, step] = image
                rewards[row, sample, step] = 0.0 if over else reward
                over = over or terminated
                p_ended[row, sample, step] = float(over)
        epistemic = unknown.mean(axis=1)
        return Imagined(
            pictures=pictures,
            probabilities=np.full(shape, 1.0 / samples),
            rewards=rewards,
            p_ended=p_ended,
            epistemic=epistemic,
            aleatoric=rewards.std(axis=1),
            modal=np.zeros(epistemic.shape),
            accepted=epistemic < 0.5,
        )

    def parameters(self) -> int:
        return len(self.memory.rows())


def key(frame: Frame) -> str:
    """A frame as 8 x 8 gray values in 32 shades."""
    gray = frame.astype(np.float64).mean(axis=2).reshape(8, 8, 8, 8).mean(axis=(1, 3))
    shades: Any = (gray // 8).astype(np.uint8)
    return str(shades.tobytes().hex())


def make(context: AgentContext) -> Recall:
    return Recall(context)
