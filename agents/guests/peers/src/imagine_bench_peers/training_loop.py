"""The training loop of Stable-Baselines3, with a callback that counts episodes and ends training."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from imagine_bench.interfaces.capabilities import OnEpisode


class _EpisodeCounter(BaseCallback):
    """Tells ``on_episode`` of each finished real episode; training ends when it returns False."""

    def __init__(self, on_episode: OnEpisode) -> None:
        super().__init__()
        self._on_episode = on_episode
        self._length = 0

    def _on_step(self) -> bool:
        (done,), (info,) = self.locals["dones"], self.locals["infos"]
        if info.get("imagined"):
            return True
        self._length += 1
        if not done:
            return True
        length = self._length
        self._length = 0
        return self._on_episode(bool(info["is_success"]), length)


def learn(model: Any, steps: int, on_episode: OnEpisode) -> None:
    """Train for at most ``steps`` macro-actions, imagined ones too, until ``on_episode`` says that it is enough."""
    model.set_logger(Logger(folder=None, output_formats=[]))  # its own leaves a folder a run among temporary files
    model.learn(steps, callback=_EpisodeCounter(on_episode), log_interval=None)
