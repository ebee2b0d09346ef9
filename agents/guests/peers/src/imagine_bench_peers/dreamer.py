"""DreamerV3 (Hafner et al. 2023) of sheeprl: its networks, losses, replay and player, an episode at a time.

It sees the environment's frames and nothing else, or the latents that an encoder makes of them. The library's own
loop counts macro-actions; here its parts are called one real transition at a time, in the order of that loop, so that
the bench counts episodes, tests greedily and takes a run up again to the bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from hydra import compose, initialize_config_module
from imagine_bench.agents import snapshot
from imagine_bench.agents.encoders.perception import Perception, load_perception, prepare_torch
from imagine_bench.agents.meters import Meters
from imagine_bench.agents.settings import flatten
from lightning.fabric import Fabric
from numpy.typing import NDArray
from omegaconf import OmegaConf
from sheeprl.algos.dreamer_v3 import dreamer_v3 as library
from sheeprl.algos.dreamer_v3.agent import build_agent
from sheeprl.algos.dreamer_v3.utils import Moments, prepare_obs
from sheeprl.utils.utils import dotdict
from torch import Tensor, nn
from torch.distributions import Distribution

from imagine_bench.interfaces import AgentContext, AgentState, Frame, Observation, Transition

from .dreamer_settings import HYPERPARAMETERS, DreamerSettings
from .global_rng_scope import GlobalRngScope

_PIXELS = "rgb"
_LATENTS = "latents"
_CHANNELS_FIRST = (2, 0, 1)
_LOSSES = {f"Loss/{name}_loss": f"loss/{name}" for name in ("world_model", "observation", "reward", "policy", "value")}


class Dreamer:
    """One DreamerV3 learner, for one run.

    Args:
        settings: Sizes, rates and counts.
        n_actions: Number of macro-actions A.
        seed: Of the library's draws, which come from torch's global generator: it is lent to it, call by call.
        device: ``"cpu"`` or ``"cuda"``.
        perception: Whose latents it sees, or None: pixels.
    """

    def __init__(
        self, settings: DreamerSettings, n_actions: int, seed: int, device: str, perception: Perception | None = None
    ) -> None:
        self.settings = settings
        self.n_actions = n_actions
        self._perception = perception
        self.config = _config(settings, pixels=perception is None)
        self._fabric = Fabric(accelerator="cuda" if device == "cuda" else "cpu", devices=1)
        self._blank = self._shown(np.zeros((64, 64, 3), np.uint8))
        self._random = GlobalRngScope(seed, device)
        self._test_random = GlobalRngScope(0, device)
        self._rng = np.random.default_rng([seed, 1])
        with self._drawing():
            shown = spaces.Dict({name: spaces.Box(-np.inf, np.inf, array.shape) for name, array in self._blank.items()})
            *learners, self.player = build_agent(self._fabric, (n_actions,), False, self.config, shown)
        self._world, self._actor, self.critic, self.target = learners
        self._optimisers = self._new_optimisers()
        moments = self.config.algo.actor.moments
        self._moments = Moments(moments.decay, moments.max, moments.percentile.low, moments.percentile.high)
        self._memory = SequenceReplay(settings.buffer_size)
        self.meters = Meters()
        self.steps = self.updates = 0
        self._arrived = (0.0, False, False)  # reward and ends of the transition before, of this episode
        self._owed = 0.0  # updates
        self.begin_episode()

    def _new_optimisers(self) -> list[Any]:
        settings = self.settings
        modules = self._world, self._actor, self.critic
        rates = settings.model_learning_rate, settings.actor_learning_rate, settings.critic_learning_rate
        return [
            self._fabric.setup_optimizers(torch.optim.Adam(module.parameters(), lr=rate, eps=eps, fused=True))
            for module, rate, eps in zip(modules, rates, (1e-8, 1e-5, 1e-5), strict=True)
        ]

    def __getstate__(self) -> dict[str, Any]:
        """The attributes of a copy or a pickle, with the optimisers' states in place of the library's wrappers.

        The library wraps each optimiser in a class of its own, which no pickle finds.
        """
        return {**vars(self), "_optimisers": [optimiser.state_dict() for optimiser in self._optimisers]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._optimisers = self._new_optimisers()
        for optimiser, kept in zip(self._optimisers, state["_optimisers"], strict=True):
            optimiser.load_state_dict(kept)

    def begin_episode(self) -> None:
        """Forget the earlier frames: the next frame is an episode's first."""
        self.player.init_states()
        self._first = True
        self._acted = False
        self._test_random.reset(0)

    @torch.no_grad()
    def act(self, observation: Observation, *, explore: bool) -> int:
        """Draw from the policy while exploring, after macro-actions by chance; else take its likeliest macro-action.

        The recurrent state takes in the frame. A test's latents are drawn from a generator of their own.
        """
        with self._drawing(test=not explore):
            shown = {name: array[None] for name, array in self._shown(observation.frame).items()}
            seen = prepare_obs(self._fabric, shown, cnn_keys=[_PIXELS])
            chosen = self.player.get_actions(seen, greedy=not explore)
        self._acted = explore
        if not explore or self.steps >= self.settings.learning_starts:
            return int(chosen[0].argmax())
        action = int(self._rng.integers(self.n_actions))
        self._take(action)
        return action

    def _take(self, action: int) -> None:
        """Let the recurrent state take in a macro-action that the policy did not choose."""
        self.player.actions = nn.functional.one_hot(torch.tensor([[action]]), self.n_actions).to(self.player.actions)

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Remember the transition, and update the networks as often as the replay ratio says.

        Acting and updates draw from the same generators, so a transition that was only shown takes the draws of an
        act, too: it then teaches as much as one of its own.
        """
        if not self._acted:
            self.act(transition.observation, explore=True)
            self._take(transition.action)
        self._acted = False
        action = np.eye(self.n_actions, dtype=np.float32)[transition.action]
        self._remember(transition.observation.frame, action)
        self._arrived = (transition.reward, transition.terminated, transition.truncated)
        self._first = False
        self.steps += 1
        if transition.terminated or transition.truncated:
            self._remember(transition.next_observation.frame, np.zeros_like(action))
            self._arrived = (0.0, False, False)
            self.begin_episode()
        if self.steps >= self.settings.learning_starts:
            self._owed += self.settings.replay_ratio
            with self.meters.cpu_time("time/updates_s"), self._drawing():
                while self._owed >= 1.0:
                    self.update()
                    self._owed -= 1.0
        self.meters.count("time/updates_s")

    def _remember(self, frame: Frame, action: NDArray[np.float32]) -> None:
        reward, terminated, truncated = self._arrived
        scalars = {"rewards": reward, "terminated": terminated, "truncated": truncated, "is_first": self._first}
        row = {name: np.array([value], dtype=np.float32) for name, value in scalars.items()}
        self._memory.add({**self._shown(frame), "actions": action, **row})

    def _shown(self, frame: Frame) -> dict[str, NDArray[Any]]:
        """The library's view of a frame (64, 64, 3): the frame with its channels first, or its latents (Z,)."""
        if self._perception is None:
            return {_PIXELS: frame.transpose(_CHANNELS_FIRST)}
        return {_LATENTS: self._perception.posterior(frame)[0].cpu().numpy()}

    def update(self) -> None:
        """One gradient step of world model, actor and critic."""
        settings = self.settings
        drawn = self._memory.sample(settings.batch_size, settings.sequence_length, self._rng)
        batch = {name: torch.tensor(array, device=self._fabric.device).float() for name, array in drawn.items()}
        rate = 1.0 if self.updates == 0 else self.config.algo.critic.tau
        with torch.no_grad():
            for fast, slow in zip(self.critic.parameters(), self.target.parameters(), strict=True):
                slow.lerp_(fast, rate)
        library.train(
            self._fabric, self._world, self._actor, self.critic, self.target, *self._optimisers, batch,
            _Losses(self.meters), self.config, False, (self.n_actions,), self._moments,
        )  # fmt: skip
        self.updates += 1

    @contextmanager
    def _drawing(self, *, test: bool = False) -> Iterator[None]:
        """The library draws from a test's generator, or from this learner's own.

        Distributions are not validated, as where the library runs by itself.
        """
        validated = Distribution._validate_args
        Distribution.set_default_validate_args(False)
        try:
            with (self._test_random if test else self._random).active():
                yield
        finally:
            Distribution.set_default_validate_args(validated)

    def diagnostics(self) -> dict[str, float]:
        """Mean losses and CPU seconds of updates a macro-action since the last call, and the counters now."""
        return {**self.meters.read(), "real_transitions": float(self.steps), "gradient_updates": float(self.updates)}

    def state(self) -> AgentState:
        """A snapshot between two episodes: weights, moments, replay, generators, counters."""
        arrays = {"generator": self._random.state.numpy().copy()}
        for name, module, optimiser in self._trained():
            arrays |= snapshot.prefixed(name, snapshot.training_arrays(module, optimiser))
        for name, module in (("target", self.target), ("returns", self._moments)):
            arrays |= snapshot.prefixed(name, {k: v.cpu().numpy().copy() for k, v in module.state_dict().items()})
        arrays |= snapshot.prefixed("replay", self._memory.arrays(self._blank, self.n_actions))
        values = {
            "steps": self.steps, "updates": self.updates, "owed": self._owed, "meters": self.meters.state(),
            "exploration": self._rng.bit_generator.state, "settings": snapshot.jsonable(flatten(self.settings)),
        }  # fmt: skip
        return AgentState(arrays=arrays, values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        snapshot.require_fit(state, self.state())
        arrays = state.arrays
        values = state.values
        for name, module, optimiser in self._trained():
            snapshot.load_training(module, optimiser, snapshot.below(name, arrays))
        for name, module in (("target", self.target), ("returns", self._moments)):
            module.load_state_dict({k: torch.tensor(v) for k, v in snapshot.below(name, arrays).items()})
        self._random.state = torch.tensor(arrays["generator"])
        self._memory.load(snapshot.below("replay", arrays))
        self._rng.bit_generator.state = values["exploration"]
        self.meters.restore(values["meters"])
        self.steps = values["steps"]
        self.updates = values["updates"]
        self._owed = values["owed"]
        self.begin_episode()

    def _trained(self) -> Iterator[tuple[str, nn.Module, Any]]:
        modules = self._world, self._actor, self.critic
        yield from zip(("world", "actor", "critic"), modules, self._optimisers, strict=True)


class _Losses:
    """Takes the library's measurements, of which the losses are kept."""

    disabled = False

    def __init__(self, meters: Meters) -> None:
        self._meters = meters

    def update(self, name: str, value: Tensor) -> None:
        if name in _LOSSES:
            self._meters.add(_LOSSES[name], float(value))


class SequenceReplay:
    """The latest rows of experience, one behind the other through the ends of episodes, drawn as sequences.

    Args:
        capacity: Rows kept.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._rows = list[dict[str, NDArray[Any]]]()

    def add(self, row: dict[str, NDArray[Any]]) -> None:
        """Remember a row; the oldest is forgotten where there are too many."""
        self._rows.append(row)
        del self._rows[: -self._capacity]

    def sample(self, count: int, length: int, rng: np.random.Generator) -> dict[str, NDArray[Any]]:
        """Sequences (L, count, ...) of ``length`` rows, or as many as there are, each begun anywhere."""
        length = min(length, len(self._rows))
        rows = np.arange(length)[:, None] + rng.integers(len(self._rows) - length + 1, size=count)
        return {
            name: np.array([[self._rows[each][name] for each in time] for time in rows.tolist()])
            for name in self._rows[0]
        }

    def arrays(self, shown: dict[str, NDArray[Any]], n_actions: int) -> dict[str, NDArray[Any]]:
        """All rows, by name, also where there are none: rows like ``shown``, ``n_actions`` macro-actions."""
        row = {**shown, "actions": np.zeros(n_actions, np.float32)}
        row |= {name: np.zeros(1, np.float32) for name in ("rewards", "terminated", "truncated", "is_first")}
        return {name: np.array([each[name] for each in self._rows] or array[None][:0]) for name, array in row.items()}

    def load(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Take up the result of :meth:`arrays`."""
        names = sorted(arrays)
        self._rows = [dict(zip(names, row, strict=True)) for row in zip(*(arrays[name] for name in names), strict=True)]


def _config(settings: DreamerSettings, *, pixels: bool) -> Any:
    """The library's configuration of its smallest model, with our settings in it."""
    model = settings.model
    values = {
        "world_model.encoder.cnn_channels_multiplier": model.channels,
        "world_model.recurrent_model.recurrent_state_size": model.recurrent,
        "world_model.transition_model.hidden_size": model.units,
        "world_model.representation_model.hidden_size": model.units,
        "world_model.discrete_size": model.classes, "world_model.stochastic_size": model.categoricals,
        "dense_units": model.units, "mlp_layers": model.layers, "horizon": settings.horizon,
        "gamma": settings.discount, "lmbda": settings.return_decay, "actor.ent_coef": settings.entropy,
        "per_rank_batch_size": settings.batch_size, "per_rank_sequence_length": settings.sequence_length,
        **{f"cnn_keys.{part}": [_PIXELS] if pixels else [] for part in ("encoder", "decoder")},
        **{f"mlp_keys.{part}": [] if pixels else [_LATENTS] for part in ("encoder", "decoder")},
    }  # fmt: skip
    chosen = ["exp=dreamer_v3", "algo=dreamer_v3_XS", "env=gym", "env.id=any", "env.num_envs=1", "run_name=any"]
    with initialize_config_module("sheeprl.configs", version_base="1.3"):
        config = compose("config", overrides=[*chosen, *(f"algo.{name}={value}" for name, value in values.items())])
    return dotdict(OmegaConf.to_container(config, resolve=True))


def make(context: AgentContext) -> Dreamer:
    """The ``dreamer_v3`` agents: on pixels, or on latents where there is an encoder."""
    prepare_torch(context.device)
    settings = HYPERPARAMETERS.of(context)
    perception = None if context.encoder is None else load_perception(context)
    return Dreamer(settings, context.n_actions, context.seeds.child("library").integer(), context.device, perception)
