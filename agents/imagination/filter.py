"""The epistemic filter: which imagined transitions a controller may learn from (thesis 5.2.2).

Weight samples of the dynamics that disagree say that the model has not learned the outcomes there. Dynamics may be
certain of a place where no reward was ever seen, so the filter can also read how much samples of the reward network
disagree there, and how certain the end is.
"""

from __future__ import annotations

import torch
from torch import Tensor

from imagine_bench.errors import InvalidValueError

from ..replay import RealMemory
from .settings import Settings
from .uncertainty import REDUCTIONS, decompose
from .world_model import EnvironmentModel

_CALIBRATION = 64
"""Real transitions whose epistemic variance a moving threshold is read from."""


def weight_samples(settings: Settings) -> int:
    """Different samples of each member's weights, 1 where nothing is dropped."""
    return settings.imagination.weight_samples if settings.model.dropout > 0.0 else 1


class EpistemicFilter:
    """Epistemic uncertainty above a threshold discards a transition, and the rest of its rollout.

    ``active`` is false for the agents that keep everything, which the filter then lets pass.

    Raises:
        InvalidValueError: It would compare weight samples, but none differs from another.
    """

    def __init__(self, settings: Settings, *, active: bool) -> None:
        self.reads_reward = active and settings.imagination.reward_threshold is not None
        samples = weight_samples(settings)
        several = samples * settings.model.members > 1
        readers = {
            "The filter": (active, several),
            "imagination.curiosity": (settings.imagination.curiosity > 0.0, several),
            "imagination.confidence_scale": (settings.imagination.confidence_scale is not None, several),
            "imagination.reward_threshold": (self.reads_reward, samples > 1),
        }
        for who, (reads, enough) in readers.items():
            if reads and not enough:
                raise InvalidValueError(
                    f"{who} compares several networks, and here is one. Set model.dropout above 0 and "
                    "imagination.weight_samples above 1, or do without it; of all but the reward, model.members above "
                    "1 is enough."
                )
        self.settings = settings.imagination
        self.active = active
        self.threshold = self.settings.threshold

    def reset(self) -> None:
        """Take the threshold of the settings again."""
        self.threshold = self.settings.threshold

    def score(self, variances: Tensor) -> Tensor:
        """Reduce variances (..., Z) to one number each; one that overflowed is infinite. Shape (...)."""
        return REDUCTIONS[self.settings.reduction](variances).nan_to_num(nan=torch.inf, posinf=torch.inf)

    def passes(self, uncertainty: Tensor, p_terminated: Tensor, reward_std: Tensor | None) -> Tensor:
        """Which of N transitions pass where the filter is active. Shape (N,), bool.

        Args:
            uncertainty: Reduced epistemic variance of the next state. Shape (N,).
            p_terminated: Predicted probability of the end. Shape (N,).
            reward_std: Standard deviation of the reward over weight samples, where it is read. Shape (N,).
        """
        keep = uncertainty <= self.threshold
        if self.settings.reward_threshold is not None and reward_std is not None:
            keep &= reward_std <= self.settings.reward_threshold
        if self.settings.termination_threshold is not None:
            keep &= torch.minimum(p_terminated, 1.0 - p_terminated) <= self.settings.termination_threshold
        return keep

    def move_threshold(
        self, model: EnvironmentModel, real: RealMemory, weights: tuple[Tensor, ...] | None, generator: torch.Generator
    ) -> None:
        """Where the settings want it, set the threshold to a quantile of the uncertainty about real transitions."""
        quantile = self.settings.threshold_quantile
        if self.active and quantile is not None:
            known = real.sample(_CALIBRATION, generator)
            epistemic = self.score(decompose(model.predict(known.z, known.action, weights)).epistemic)
            self.threshold = float(epistemic.quantile(quantile))
