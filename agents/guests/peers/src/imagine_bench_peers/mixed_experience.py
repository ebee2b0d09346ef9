"""Real and imagined episodes as one Gymnasium environment, so that a library's algorithm trains on both unchanged."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from imagine_bench.agents.imagination.agent import ImaginingAgent
from imagine_bench.agents.imagination.vector_env import ImaginedEnv, ImaginedVectorEnv, Latents

from imagine_bench.interfaces import Frame


class MixedExperience(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Episodes of ``env`` seen as mean latents (Z,), and after each of them ``count`` ones of the world model.

    Real transitions train the world model of ``learner``, which neither acts nor learns values. Imagining begins after
    its ``imagination.start_episode`` real episodes, in states that were acted in, ``imagination.depth`` steps deep.
    Every info says whether a transition was ``imagined``. ``seed`` is that of the imagined world.
    """

    def __init__(self, env: gymnasium.Env[Frame, Any], learner: ImaginingAgent, *, count: int, seed: int) -> None:
        super().__init__(env)
        self.learner = learner
        self._count = count
        nowhere = np.zeros((1, learner.perception.latent_size), np.float32)  # until there is something to imagine from
        world = ImaginedVectorEnv(learner.imagination, nowhere, horizon=learner.settings.imagination.depth)
        world.reset(seed=seed)
        self._imagined = ImaginedEnv(world)
        self.observation_space = self._imagined.observation_space
        self._frame: Frame = np.zeros(0, np.uint8)
        self._episodes = self._left = 0  # real ones that ended; imagined ones before the next
        self._real = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Latents, dict[str, Any]]:
        """Begin a real episode, or an imagined one, for which seed and options mean nothing."""
        self._real = self._left == 0
        if not self._real:
            self._left -= 1
            return self._imagined.reset()
        self._frame, info = self.env.reset(seed=seed, options=options)
        return self._latents(self._frame), info

    def step(self, action: Any) -> tuple[Latents, float, bool, bool, dict[str, Any]]:
        """One macro-action, real or imagined; DivergedError if the world model diverges."""
        if not self._real:
            seen, reward, over, cut, info = self._imagined.step(action)
            self.learner.meters.add("imagination/acceptance_rate", float(info["accepted"]))
            return seen, reward, over, cut, {**info, "imagined": True}
        frame, earned, over, cut, info = self.env.step(action)
        sees = self.learner.perception.posterior
        self.learner.real.add(sees(self._frame), int(action), float(earned), sees(frame), over)
        self.learner.learn_model()
        self._frame = frame
        self._episodes += over or cut
        if (over or cut) and self._episodes >= self.learner.settings.imagination.start_episode:
            self._left = self._count
            self._remember()
        return self._latents(frame), float(earned), over, cut, {**info, "imagined": False}

    def _remember(self) -> None:
        """Imagine from all that was acted in by now, with the filter's threshold as it should be there."""
        learner = self.learner
        imagination = self.learner.imagination
        self._imagined.world.starts = learner.real.arrays()["mu"].astype(np.float32)
        weights = imagination.draw_weights(imagination.generators["dropout"])
        replay = imagination.generators["replay"]
        imagination.filter.move_threshold(imagination.model, learner.real, weights.dynamics, replay)

    def _latents(self, frame: Frame) -> Latents:
        return self.learner.perception.posterior(frame)[0].cpu().numpy()
