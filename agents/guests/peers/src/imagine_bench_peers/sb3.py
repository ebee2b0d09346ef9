"""Agents of Stable-Baselines3 (Raffin et al. 2021) through Gymnasium, trained by the library's own loop.

They see the environment's frames, or other observations of the protocol, or an encoder's latents of frames.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from functools import partial
from typing import Any

import gymnasium
from imagine_bench.agents.encoders.latent_observation import LatentObservation
from imagine_bench.agents.encoders.perception import load_perception, prepare_torch
from imagine_bench.agents.imagination.agent import ImaginingAgent, build
from imagine_bench.agents.settings import Hyperparameters

from imagine_bench.errors import ArtefactError, SetupError
from imagine_bench.interfaces import AgentContext, AgentState, Observation, Transition
from imagine_bench.interfaces.capabilities import OnEpisode

from .mixed_experience import MixedExperience
from .novelty import NoveltyBonus
from .sb3_settings import CURIOUS, HYPERPARAMETERS, IMAGINING, PIXELS, QUANTILES, PPOSettings

_SEEDS = 2**31
"""The library takes seeds below this; numpy's global generator, which it draws from, would take twice as many."""


class LibraryAgent:
    """One learner of the library, for one run; it sees latents where the context names an encoder, else pixels.

    Args:
        context: Of the run. Its seed is that of torch's and numpy's global generators, which the library draws from.
        algorithm: The library's class, such as ``"stable_baselines3:DQN"``.
        hyperparameters: Its settings, those that the agent's entry names.

    Raises:
        SetupError: The library is not installed.
    """

    def __init__(
        self, context: AgentContext, algorithm: str, hyperparameters: Hyperparameters[Any] = HYPERPARAMETERS
    ) -> None:
        prepare_torch(context.device)
        self._algorithm = _load(algorithm)
        importlib.import_module("torch._dynamo")  # else the first optimiser imports it, in the time of training
        self._device = context.device
        self.settings = hyperparameters.of(context)
        self._keywords = self.settings.ppo if algorithm.endswith(":PPO") else self.settings.sb3
        self._seed = context.seeds.child("library").integer() % _SEEDS
        self._encoder = None if context.encoder is None else load_perception(context).encoder
        self._model: Any = None

    def train(self, env: gymnasium.Env[Any, Any], *, episodes: int, horizon: int, on_episode: OnEpisode) -> None:
        """Train in the library's own loop; see :class:`imagine_bench.interfaces.capabilities.ExternalTrainer`."""
        from .training_loop import learn  # noqa: PLC0415 - needs the library

        keywords = dataclasses.asdict(self._keywords)
        explores = keywords.pop("exploration_steps", 0)
        steps = max(episodes * self._steps_an_episode(horizon), explores)  # on_episode ends training before
        if "n_quantiles" in keywords:
            keywords["policy_kwargs"] = {"n_quantiles": keywords.pop("n_quantiles")}
        if explores:
            keywords["exploration_fraction"] = explores / steps  # exploration depends on the step alone
        scale = self.settings.reward_scale
        scaled = gymnasium.wrappers.TransformReward(self._experience(env), lambda reward: scale * float(reward))
        world = self._with_bonus(scaled)
        named = isinstance(world.observation_space, gymnasium.spaces.Dict)
        policy = "MultiInputPolicy" if named else "CnnPolicy" if self._encoder is None else "MlpPolicy"
        self._model = self._algorithm(policy, world, seed=self._seed, device=self._device, **keywords)
        learn(self._model, steps, on_episode)

    def _experience(self, env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
        """The environment in which the library trains."""
        return env if self._encoder is None else LatentObservation(env, self._encoder)

    def _with_bonus(self, env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
        """The environment with rewards that the agent pays itself, if it does."""
        return env

    def _steps_an_episode(self, horizon: int) -> int:
        """The most steps that it makes for one real episode."""
        return horizon

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The library's greedy action; ArtefactError before training."""
        if self._model is None:
            raise ArtefactError("This agent has no policy before its training loop has run; train it first.")
        frame = observation.frame.copy()  # torch wants arrays that it may write into
        seen: Any = frame if self._encoder is None else self._encoder.latents(frame)
        if observation.more:
            more = {name: part.copy() for name, part in observation.more.items()}
            seen = {**more, **({"frame": frame} if frame.size else {})}
        return int(self._model.predict(seen, deterministic=not explore)[0])

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Learn nothing: the library learns in its own loop."""

    def diagnostics(self) -> dict[str, float]:
        """The measurements that the library logged last, and its exploration probability."""
        logged = {} if self._model is None else dict(self._model.logger.name_to_value)
        values = {
            "loss/bellman": logged.get("train/loss"),
            "epsilon": getattr(self._model, "exploration_rate", None),
            "gradient_updates": logged.get("train/n_updates"),
        }
        if isinstance(self._keywords, PPOSettings) and values["gradient_updates"]:  # it counts epochs of batches
            values["gradient_updates"] *= math.ceil(self._keywords.n_steps / self._keywords.batch_size)
        return {name: float(value) for name, value in values.items() if value is not None}

    def state(self) -> AgentState:
        """The policy's weights: enough to look at, not to train on from."""
        if self._model is None:
            return AgentState(arrays={}, values={})
        weights = {name: value.cpu().numpy().copy() for name, value in self._model.policy.state_dict().items()}
        return AgentState(arrays=weights, values={})

    def restore(self, state: AgentState) -> None:
        """Raise ArtefactError: the library cannot go on from here bit for bit."""
        raise ArtefactError("An agent of Stable-Baselines3 cannot be taken up again; run its bench anew.")


class CuriousLibraryAgent(LibraryAgent):
    """A learner of the library that also earns a bonus for latents that were seldom seen."""

    def __init__(self, context: AgentContext, algorithm: str) -> None:
        super().__init__(context, algorithm, CURIOUS)
        self._novelty_seeds = context.seeds.child("novelty")

    def _with_bonus(self, env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
        return NoveltyBonus(env, self.settings.novelty, self._novelty_seeds)


class ImaginingLibraryAgent(LibraryAgent):
    """A learner of the library that trains on real and imagined episodes alike, the latter through the filter."""

    def __init__(self, context: AgentContext, algorithm: str) -> None:
        super().__init__(context, algorithm, IMAGINING)
        self._world_seed = context.seeds.child("imagined").integer()
        self._learner = build(ImaginingAgent, context, filtered=True, hyperparameters=IMAGINING)

    def _experience(self, env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
        return MixedExperience(env, self._learner, count=self.settings.mix.imagined_episodes, seed=self._world_seed)

    def _steps_an_episode(self, horizon: int) -> int:
        return horizon + self.settings.mix.imagined_episodes * self.settings.imagination.depth

    def diagnostics(self) -> dict[str, float]:
        """As without a world model, with that model's losses and how much the filter kept."""
        found = {**super().diagnostics(), **self._learner.meters.read()}
        updates = found.get("gradient_updates", 0.0) + self._learner.updates
        return {**found, "gradient_updates": updates, "real_transitions": float(self._learner.real.added)}


def _load(target: str) -> Any:
    module, _, name = target.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except ImportError as error:
        raise SetupError(
            f"This agent needs the library {module}, which is not installed ({error}). Install it with "
            "pip install 'imagine-bench[peers]'."
        ) from error


make_dqn = partial(LibraryAgent, algorithm="stable_baselines3:DQN", hyperparameters=PIXELS)
"""The ``sb3_dqn`` agent: DQN (Mnih et al. 2015)."""
make_qrdqn = partial(LibraryAgent, algorithm="sb3_contrib:QRDQN", hyperparameters=QUANTILES)
"""The ``sb3_qrdqn`` agent: QR-DQN (Dabney et al. 2018)."""
make_dqn_latents = partial(LibraryAgent, algorithm="stable_baselines3:DQN")
"""The ``sb3_dqn_latents`` agent."""
make_ppo = partial(LibraryAgent, algorithm="stable_baselines3:PPO")
"""The ``sb3_ppo_latents`` agent: PPO (Schulman et al. 2017)."""
make_curious_ppo = partial(CuriousLibraryAgent, algorithm="stable_baselines3:PPO")
"""The ``sb3_ppo_rnd_latents`` agent: the same with random network distillation (Burda et al. 2018)."""
make_imagining_dqn = partial(ImaginingLibraryAgent, algorithm="stable_baselines3:DQN")
"""The ``sb3_dqn_imagined`` agent."""
make_imagining_ppo = partial(ImaginingLibraryAgent, algorithm="stable_baselines3:PPO")
"""The ``sb3_ppo_imagined`` agent."""
