"""A DQN on latents (Mnih et al. 2015; thesis 5.2.2); the thesis has no target network, settings may ask for one."""

from __future__ import annotations

import copy
import math
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional

from imagine_bench.arrays import Floats32, Frame, Ints
from imagine_bench.errors import DivergedError
from imagine_bench.interfaces import AgentContext, AgentState, Observation, Transition
from imagine_bench.seeding import SeedTree

from . import snapshot
from .dqn_settings import HYPERPARAMETERS, MORE_UPDATES, ControllerSettings, DQNSettings, GreedySettings
from .encoders.perception import Perception, load_perception, prepare_torch
from .meters import Meters
from .networks.adam import Adam, TrainedModule
from .networks.mlp import ReluLayers, mlp
from .replay import Batch, RealMemory, Transitions
from .settings import Hyperparameters, flatten


def epsilon(step: int, settings: GreedySettings) -> float:
    """Exploration probability at real step ``step``: equation 3.3, from the maximum down to the minimum."""
    span = settings.epsilon_max - settings.epsilon_min
    return settings.epsilon_min + span * math.exp(-settings.epsilon_decay * step)


def td_target(reward: Tensor, terminated: Tensor, q_next: Tensor, discount: float) -> Tensor:
    """One-step targets ``r + gamma max_a Q(z', a)`` (B,) of rewards (B,), ends (B,) and next values (B, A).

    Termination stops bootstrapping; truncation does not, since ``terminated`` is 0 there.
    """
    return reward + discount * (1.0 - terminated) * q_next.amax(dim=-1)


def _mean_square(q: Tensor, target: Tensor, weight: Tensor | None) -> Tensor:
    if weight is None:
        return functional.mse_loss(q, target)
    return (weight * (q - target).square()).mean()


class Controller(TrainedModule):
    """Action values of latents: a network, a slowly updated target network, and Adam.

    The generator draws the initial weights of the dense network that it has where none is given; its device is the
    controller's.
    """

    def __init__(
        self,
        latent_size: int,
        n_actions: int,
        settings: ControllerSettings,
        generator: torch.Generator,
        network: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.n_actions = n_actions
        self.settings = settings
        self.network = self.target = network or mlp((latent_size, *settings.hidden, n_actions), generator)
        if settings.target_rate < 1.0:
            self.target = copy.deepcopy(self.network).requires_grad_(False)
        self._fast: list[Tensor] = [*self.network.parameters()]
        self._slow: list[Tensor] = [*self.target.parameters()]
        self.optimiser = Adam([(self.network.parameters(), 0.0)], settings.learning_rate)

    @torch.no_grad()
    def values(self, z: Tensor) -> Tensor:
        """Action values of latents (N, Z). Shape (N, A)."""
        return self.network(z)

    def loss(self, batch: Batch) -> Tensor:
        """Mean squared Bellman error, weighted where the batch has weights; no gradient flows through the targets."""
        return _mean_square(*self._sides(batch), batch.weight)

    @torch.no_grad()
    def errors(self, batch: Batch) -> Tensor:
        """Bellman errors ``Q(z, a)`` less target. Shape (B,)."""
        q, target = self._sides(batch)
        return q - target

    def _sides(self, batch: Batch) -> tuple[Tensor, Tensor]:
        return self.network(batch.z).gather(1, batch.action.unsqueeze(1)).squeeze(1), self._targets(batch)

    @torch.no_grad()
    def _targets(self, batch: Batch) -> Tensor:
        return td_target(batch.reward, batch.terminated, self.target(batch.next_z), self.settings.discount)

    def update(self, batch: Batch) -> float:
        """One step of Adam; the loss before it. DivergedError, and weights as they were, if that is not finite."""
        value = self._differentiate(batch)
        if not math.isfinite(value):
            raise DivergedError(f"The controller's loss is {value}. Lower controller.learning_rate.")
        self.optimiser.step()
        if self.target is not self.network:
            self._follow()
        return value

    def _differentiate(self, batch: Batch) -> float:
        """Set the gradients of the loss, and return it; of a dense network without autograd, which is slower there."""
        network = self.network
        if not isinstance(network, ReluLayers):
            loss = self.loss(batch)
            self.optimiser.zero_grad()
            loss.backward()
            return loss.item()
        values = network.outputs(batch.z)
        action = batch.action.unsqueeze(1)
        q = values[-1].gather(1, action).squeeze(1)
        target = self._targets(batch)
        slopes = 2.0 / len(q) * (q - target)
        if batch.weight is not None:
            slopes = batch.weight * slopes
        network.backpropagate(values, torch.zeros_like(values[-1]).scatter_(1, action, slopes.unsqueeze(1)))
        return _mean_square(q, target, batch.weight).item()

    @torch.no_grad()
    def _follow(self) -> None:
        """Move the target network toward the network."""
        torch._foreach_lerp_(self._slow, self._fast, self.settings.target_rate)


class DQN:
    """Acts epsilon-greedily on mean latents, learns from replay; each consumer of randomness has its own generator.

    ``seeds`` is this agent's node of the seed tree, ``device`` where networks and memories lie.
    """

    def __init__(
        self, perception: Perception, n_actions: int, settings: DQNSettings, seeds: SeedTree, device: torch.device
    ) -> None:
        self.perception = perception
        self.n_actions = n_actions
        self.settings = settings
        self.rng = seeds.child("exploration").generator()
        self._replay = torch.Generator(device).manual_seed(seeds.child("replay").integer())
        weights = torch.Generator(device).manual_seed(seeds.child("controller").integer())
        self.controller = self.new_controller(weights)
        self.real = self.new_memory(device)
        self.meters = Meters()
        self.steps = self.updates = 0

    def new_controller(self, generator: torch.Generator) -> Controller:
        """Return an untrained controller."""
        return Controller(self.perception.latent_size, self.n_actions, self.settings.controller, generator)

    def new_memory(self, device: torch.device) -> RealMemory:
        """Return an empty replay memory."""
        settings = self.settings.memory
        return RealMemory(settings.real, self.perception.latent_size, device, prioritised=settings.priority > 0.0)

    @property
    def tested(self) -> Controller:
        """The controller used in tests. A DQN has only one."""
        return self.controller

    def q_values(self, observation: Observation) -> Floats32:
        """Values of every macro-action at the mean latents. Shape (A,)."""
        return self._values(self.tested, observation)

    def read_frames(self, frames: Frame) -> Ints:
        """Read macrostates with the encoder's probe; see :class:`imagine_bench.interfaces.capabilities.FrameReader`."""
        encoder = self.perception.encoder
        return encoder.read_macrostate(encoder.encode(frames)[0])

    def _values(self, controller: Controller, observation: Observation) -> Floats32:
        return controller.values(self.perceive(observation.frame).unsqueeze(0))[0].cpu().numpy()

    def perceive(self, frame: Frame) -> Tensor:
        """The state that the controller reads: here the mean latents of the frame. Shape (Z,)."""
        return self.perception.posterior(frame)[0]

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Act epsilon-greedily on the mean latents; greedily, and changing nothing, without ``explore``."""
        if explore and self.rng.random() < epsilon(self.steps, self.settings.controller):
            return int(self.rng.integers(self.n_actions))
        return int(self._values(self.controller if explore else self.tested, observation).argmax())

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Store the transition, and learn from replayed ones N_R times; DivergedError if a loss is not finite."""
        state = self.store(transition)
        self.learn_values(self.real, self.settings.controller.updates_per_step)
        self.learn_more(state, episode)
        self.meters.count("time/controller_s")
        self.steps += 1

    def store(self, transition: Transition) -> Tensor:
        """Add a real transition to the memory; returns the state that it began in. Shape (Z,)."""
        now = self.perception.posterior(transition.observation.frame)
        then = self.perception.posterior(transition.next_observation.frame)
        self.real.add(now, transition.action, transition.reward, then, transition.terminated)
        return now[0]

    def learn_more(self, z: Tensor, episode: int) -> None:
        """Learn more after the updates on real transitions, given the state (Z,) before; a DQN does nothing here."""

    def learn_values(self, memory: Transitions, updates: int) -> None:
        """Update the controller on batches of a memory, if that holds anything yet."""
        with self.meters.cpu_time("time/controller_s"):
            for _ in range(updates if len(memory) else 0):
                batch = self.draw_batch(memory)
                self.meters.add("loss/bellman", self.controller.update(batch))
                if batch.rows is not None:
                    self.real.prioritise(batch.rows, self.controller.errors(batch))
                self.updates += 1

    def draw_batch(self, memory: Transitions) -> Batch:
        """Draw transitions of a memory with the rewards that the controller learns from."""
        count = self.settings.controller.batch_size
        settings = self.settings.memory
        if settings.priority > 0.0 and isinstance(memory, RealMemory):
            exponent = settings.priority
            correction = settings.priority_correction
            return memory.sample_prioritised(count, self._replay, exponent=exponent, correction=correction)
        return memory.sample(count, self._replay)

    def diagnostics(self) -> dict[str, float]:
        """Means since the last call (``time/*`` in CPU seconds a real step), and the counters now."""
        counters = {"real_transitions": float(self.real.added), "gradient_updates": float(self.updates)}
        return {**self.meters.read(), "epsilon": epsilon(self.steps, self.settings.controller), **counters}

    def parts(self) -> dict[str, snapshot.Part]:
        """The parts whose arrays a snapshot holds, by name."""
        return {"controller": self.controller, "real": self.real, "generator/replay": self._replay}

    def state(self) -> AgentState:
        """A snapshot: weights, moments, memories, generators, counters, measurements."""
        values = {
            "steps": self.steps,
            "updates": self.updates,
            "real_added": self.real.added,
            "exploration": self.rng.bit_generator.state,
            "meters": self.meters.state(),
            "settings": snapshot.jsonable(flatten(self.settings)),
        }
        return AgentState(arrays=snapshot.arrays_of(self.parts()), values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        snapshot.require_fit(state, self.state())
        snapshot.load_parts(self.parts(), state.arrays)
        values = state.values
        self.real.added = values["real_added"]
        self.meters.restore(values["meters"])
        self.rng.bit_generator.state = values["exploration"]
        self.steps = values["steps"]
        self.updates = values["updates"]


def build(hyperparameters: Hyperparameters[DQNSettings], context: AgentContext) -> DQN:
    """A DQN with its settings from one of the tables of :mod:`.dqn_settings`."""
    settings = hyperparameters.of(context)
    device = prepare_torch(context.device)
    return DQN(load_perception(context), context.n_actions, settings, context.seeds, device)


make = partial(build, HYPERPARAMETERS)
"""The ``dqn`` agent."""
make_more_updates = partial(build, MORE_UPDATES)
"""The control ``dqn_more_updates``; see :data:`.dqn_settings.MORE_UPDATES`."""
