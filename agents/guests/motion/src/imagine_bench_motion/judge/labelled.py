"""A world model of macro-actions as a model of motions: it is told the goal of each motion, and sees no command.

Where a motion fails it still imagines the macro-action: a model at the coarser level cannot know the failure.
"""

from __future__ import annotations

import numpy as np
from imagine_bench.agents.world_models.latent import make_ensemble

from imagine_bench.arrays import Floats32, Frame, Ints
from imagine_bench.interfaces import AgentContext
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import WorldModel

from .interface import Motions


class Labelled:
    """Any world model, asked about the label of each motion; see :class:`.interface.MotionModel`.

    Args:
        model: The world model.
        n_actions: Macro-actions of the task.
    """

    def __init__(self, model: WorldModel, n_actions: int) -> None:
        self._model = model
        self._n_actions = n_actions
        self._seed = 0

    def fit(self, dataset: Motions, rng: np.random.Generator) -> None:
        """Learn each motion as an episode of one macro-action."""
        n = len(dataset)
        episodes = Episodes(
            lengths=np.ones(n, dtype=np.int64),
            frames=np.stack([dataset.before, dataset.after], axis=1).reshape(2 * n, *dataset.before.shape[1:]),
            action_masks=np.ones((2 * n, self._n_actions), dtype=np.int8),
            actions=dataset.labels.astype(np.int64),
            rewards=np.zeros(n),
            terminated=np.zeros(n, dtype=np.bool_),
            truncated=np.ones(n, dtype=np.bool_),
            success=np.zeros(n, dtype=np.bool_),
        )
        self._model.fit(episodes, rng)
        self._seed = int(rng.integers(2**31))

    def imagine_motion(self, frames: Frame, actions: Floats32, lengths: Ints, labels: Ints) -> Frame:
        """One future of each macro-action."""
        del actions, lengths
        rng = np.random.default_rng(self._seed)
        imagined = self._model.imagine(frames[:, None], labels[:, None], 1, rng)
        pictures = imagined.pictures[:, 0, 0]
        scale = 1 if pictures.dtype == np.uint8 else 255
        drawn: Frame = (scale * pictures).round().astype(np.uint8)
        colored = drawn if drawn.ndim == 4 else np.repeat(drawn[..., None], 3, axis=-1)
        times = frames.shape[1] // drawn.shape[1]  # an encoder may see smaller images than the scene's
        return colored.repeat(times, axis=1).repeat(times, axis=2)

    def parameters(self) -> int:
        """Those of the world model."""
        return self._model.parameters()


def make(context: AgentContext) -> Labelled:
    """The thesis' model, an ensemble of mixture density networks between latents."""
    return Labelled(make_ensemble(context), context.n_actions)
