"""Real and imagined episodes as one Gymnasium environment, so that a library's algorithm trains on both unchanged."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from imagine_bench.interfaces import Frame

from ..imagination.agent import ImaginingAgent
from ..imagination.rollouts import LATENT_LIMIT
from ..imagination.vector_env import ImaginedEnv, Latents, imagined_env


class MixedExperience(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Episodes of ``env`` seen as mean latents (Z,), and after each of them ``count`` ones of the world model.

    Real transitions train the world model of ``learner``, which neither acts nor learns values. Imagining begins after
    its ``imagination.start_episode`` real episodes, in states that were acted in, ``imagination.depth`` steps deep.
    Every info says whether a transition was ``imagined``. ``seed`` is that of the imagined world.
    """

    def __init__(self, env: gymnasium.Env[Frame, Any], learner: ImaginingAgent, *, count: int, seed: int) -> None:
        super().__init__(env)
        self.learner, self._count, self._seed = learner, count, seed
        self.observation_space = gymnasium.spaces.Box(-LATENT_LIMIT, LATENT_LIMIT, (learner.perception.latent_size,))
        self._imagined: ImaginedEnv | None = None  # none before there is anything to imagine from
        self._frame: Frame = np.zeros(0, np.uint8)
        self._episodes = self._left = 0  # real ones that ended; imagined ones before the next
        self._real = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Latents, dict[str, Any]]:
        """Begin a real episode, or an imagined one, for which seed and options mean nothing."""
        if self._left > 0 and self._imagined is not None:
            self._left, self._real = self._left - 1, False
            return self._imagined.reset()
        self._real = True
        self._frame, info = self.env.reset(seed=seed, options=options)
        return self._latents(self._frame), info

    def step(self, action: Any) -> tuple[Latents, float, bool, bool, dict[str, Any]]:
        """One macro-action, real or imagined; DivergedError if the world model diverges."""
        if not self._real and self._imagined is not None:
            seen, reward, over, cut, info = self._imagined.step(action)
            self.learner.meters.add("imagination/acceptance_rate", float(info["accepted"]))
            return seen, reward, over, cut, {**info, "imagined": True}
        frame, earned, over, cut, info = self.env.step(action)
        sees = self.learner.perception.posterior
        self.learner.real.add(sees(self._frame), int(action), float(earned), sees(frame), over)
        self.learner.learn_model()
        self._frame = frame
        if over or cut:
            self._episodes += 1
            if self._episodes >= self.learner.settings.imagination.start_episode:
                self._prepare()
        return self._latents(frame), float(earned), over, cut, {**info, "imagined": False}

    def _prepare(self) -> None:
        """Let imagined episodes follow, from all that is remembered by now."""
        learner, imagination = self.learner, self.learner.imagination
        if self._imagined is None:
            self._imagined = ImaginedEnv(imagined_env(learner, horizon=learner.settings.imagination.depth))
            self._imagined.reset(seed=self._seed)
        self._imagined.world.starts, self._left = learner.real.arrays()["mu"].astype(np.float32), self._count
        weights, replay = imagination.draw_weights(imagination.generators["dropout"]), imagination.generators["replay"]
        imagination.filter.move_threshold(imagination.model, learner.real, weights.dynamics, replay)

    def _latents(self, frame: Frame) -> Latents:
        return self.learner.perception.posterior(frame)[0].cpu().numpy()
