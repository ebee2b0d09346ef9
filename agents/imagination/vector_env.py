"""A learned world model as a Gymnasium vector environment: any model-free algorithm can train in it (thesis 5.3).

Like DIAMOND's world-model environment (Alonso et al. 2024): ``reset`` and ``step`` of many imagined episodes at once.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from imagine_bench.arrays import Bools, Floats, Floats32, Frame, Info, Ints, State
from imagine_bench.errors import InvalidValueError, brief, require_integer
from imagine_bench.interfaces.model import UNCERTAINTIES

from .agent import ImaginingAgent
from .rollouts import LATENT_LIMIT, Imagination, ImaginedStep

Latents = Floats32
VERDICT = ("accepted", *UNCERTAINTIES)
"""The entries of an info about a transition."""


class ImaginedVectorEnv(VectorEnv[Latents, Ints, NDArray[np.generic]]):
    """N imagined episodes side by side; observations are latents (N, Z), float32, actions (N,) in [0, A).

    An episode starts at a latent of the pool, ends where the model says so (``terminated``), and is cut after
    ``horizon`` steps or by the filter (``truncated``). Of a transition that the filter discards nothing is shown: the
    observation stays where it was, the reward is 0 and ``accepted`` in the info False. To a learner that bootstraps at
    truncation nothing has happened; another can leave it out. Without a filter only latents that ran away are cut.

    A step's info holds, of the transition that it returned, ``accepted`` and the variances ``epistemic``, ``aleatoric``
    and ``modal``, in squared units of z, reduced as the filter does; all (N,). Ended episodes begin anew in the same
    step, with ``final_obs`` and ``final_info`` as in Gymnasium. Everything is drawn from :attr:`np_random`, weight
    samples anew at every step. The model is not copied: its later learning changes the imagination here.

    Args:
        imagination: The world model with its filter.
        starts: Where episodes begin, drawn uniformly: latents (P, Z) of real observations. It may be replaced later.
        num_envs: Episodes side by side, N.
        horizon: Most steps of an episode.

    Raises:
        InvalidValueError: No such number of episodes or steps, a pool that is empty or of another size of latents, or
            transitions that are to be weighed by confidence, for which an environment has no place.
    """

    def __init__(self, imagination: Imagination, starts: Latents, *, num_envs: int = 1, horizon: int = 10) -> None:
        imagination.require_no_confidence("An imagined environment")
        model = imagination.model
        if starts.ndim != 2 or len(starts) == 0 or starts.shape[1] != model.latent_size:
            raise InvalidValueError(
                f"The pool of starts has shape {starts.shape}; give at least one of shape (P, {model.latent_size})."
            )
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.imagination = imagination
        self.starts = starts
        self.num_envs = require_integer("num_envs", num_envs, 1)
        self.horizon = require_integer("horizon", horizon, 1)
        self._generator = torch.Generator(imagination.generators["rollouts"].device)
        self.single_observation_space = gymnasium.spaces.Box(-LATENT_LIMIT, LATENT_LIMIT, (model.latent_size,))
        self.single_action_space = gymnasium.spaces.Discrete(model.n_actions)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._z = np.empty((0, model.latent_size), np.float32)
        self._steps = np.zeros(num_envs, np.int64)
        self._gathered = torch.zeros(num_envs, device=self._generator.device)

    def reset(self, *, seed: int | None = None, options: dict[str, State] | None = None) -> tuple[Latents, Info]:
        """Begin N episodes; the first observations (N, Z), and no info.

        InvalidValueError for a seed that is no integer from 0 on, or for options, of which there are none.
        """
        if options:
            raise InvalidValueError(f"Reset options {brief(options)} are given; imagined episodes take none.")
        super().reset(seed=None if seed is None else require_integer("seed", seed, 0))
        self._z = self._draw_starts(self.num_envs)
        self._steps[:] = 0
        self._gathered.zero_()
        return self._z.copy(), {}

    def step(self, actions: Ints) -> tuple[Latents, Floats, Bools, Bools, Info]:
        """Imagine one transition of each episode: observations, rewards, terminated, truncated, info.

        InvalidValueError before :meth:`reset`, or for actions that are none; DivergedError if the model predicts NaN.
        """
        if len(self._z) == 0:
            raise InvalidValueError("No imagined episode has begun; call reset before step.")
        given = np.asarray(actions)
        if given.dtype.kind not in "iu" or not self.action_space.contains(given.astype(np.int64)):
            count = self.imagination.model.n_actions
            raise InvalidValueError(
                f"Actions {brief(actions)}: give one integer in [0, {count}) for each of {self.num_envs} episodes."
            )
        generator = self._generator
        imagination = self.imagination
        generator.manual_seed(int(self.np_random.integers(2**63)))
        z = torch.tensor(self._z, device=generator.device)
        action = torch.tensor(given.astype(np.int64), device=generator.device)
        step = imagination.step(z, action, imagination.draw_weights(generator), generator)
        accepted = imagination.keeps(step, self._gathered).cpu().numpy()
        self._gathered = imagination.gathered_with(step, self._gathered)
        reached = np.where(accepted[:, None], step.next_z.cpu().numpy(), self._z)  # [N, Z]
        reward = np.where(accepted, step.reward.cpu().numpy(), 0.0).astype(np.float64)
        self._steps += 1
        terminated = accepted & step.terminated.cpu().numpy()
        truncated = ~terminated & (~accepted | (self._steps >= self.horizon))
        ended = terminated | truncated
        info = self._info(step, accepted, reached, ended)
        reached[ended] = self._draw_starts(int(ended.sum()))
        self._steps[ended] = 0
        self._gathered[torch.from_numpy(ended)] = 0.0
        self._z = reached
        return self._z.copy(), reward, terminated, truncated, info

    def _info(self, step: ImaginedStep, accepted: Bools, reached: Latents, ended: Bools) -> Info:
        scores = self.imagination.uncertainties(step)
        values = {"accepted": accepted, **{name: scores[name].cpu().numpy() for name in UNCERTAINTIES}}
        info: Info = {}
        for index, over in enumerate(ended):
            own = {name: column[index].item() for name, column in values.items()}
            self._add_info(info, own, index)
            if over:
                self._add_info(info, {"final_obs": reached[index].copy(), "final_info": own}, index)
        return info

    def _draw_starts(self, count: int) -> Latents:
        return self.starts[self.np_random.integers(len(self.starts), size=count)]


class ImaginedEnv(gymnasium.Env[Latents, np.int64]):
    """One imagined episode after another, for learners that know no vectors: a world of one episode at a time."""

    def __init__(self, world: ImaginedVectorEnv) -> None:
        if world.num_envs != 1:
            raise InvalidValueError(f"This world has {world.num_envs} episodes side by side; give one of num_envs 1.")
        self.world = world
        self.observation_space = world.single_observation_space
        self.action_space = world.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, State] | None = None) -> tuple[Latents, Info]:
        """Begin an episode: latents (Z,)."""
        seen, info = self.world.reset(seed=seed, options=options)
        super().reset(seed=None if seed is None else int(seed))
        return seen[0], info

    def step(self, action: np.int64) -> tuple[Latents, float, bool, bool, Info]:
        """Imagine one transition; errors as of :meth:`ImaginedVectorEnv.step`."""
        seen, (reward,), (terminated,), (truncated,), info = self.world.step(np.array([action]))
        reached = info["final_obs"][0] if terminated or truncated else seen[0]
        own = {name: info[name][0].item() for name in VERDICT}
        return reached, float(reward), bool(terminated), bool(truncated), own


def imagined_env(
    agent: ImaginingAgent, *, frames: Frame | None = None, num_envs: int = 1, horizon: int = 10
) -> ImaginedVectorEnv:
    """The world that a trained agent has learned, with its filter.

    Episodes start at ``frames`` (P, 64, 64, 3) or, without, in all states that the agent remembers to have acted in, as
    means of their latents; otherwise as :class:`ImaginedVectorEnv`.
    """
    starts = agent.remembered_states() if frames is None else agent.perception.encoder.encode(frames)[0]
    return ImaginedVectorEnv(agent.imagination, starts.cpu().numpy(), num_envs=num_envs, horizon=horizon)
