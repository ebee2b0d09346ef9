"""Algorithm 1 of the thesis: learn from what happened, then from what was imagined."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import torch
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentState, Observation, Transition
from imagine_bench.seeding import SeedTree

from . import snapshot
from .controller import Controller, epsilon
from .encoders.perception import Perception
from .imagination.rollouts import Imagination
from .meters import Meters
from .presets import flatten
from .replay import ImaginedMemory, RealMemory
from .settings import Settings

_TIMES = ("time/controller_s", "time/model_s", "time/imagination_s")
"""What a real step costs in CPU seconds; all but the first belong to imagination."""


class Learner:
    """A DQN on latents and, where it has one, an imagination that feeds it.

    Two learners of one seed act alike until one of them first learns from imagination: every consumer of randomness
    has a generator of its own.

    Args:
        perception: Frames to posteriors of latents.
        n_actions: A.
        settings: All hyperparameters.
        seeds: This agent's node of the seed tree.
        device: Where networks and memories lie.
        imagination: The world model, its filter and its memory; None for the plain DQN.
    """

    def __init__(
        self,
        perception: Perception,
        n_actions: int,
        settings: Settings,
        seeds: SeedTree,
        device: torch.device,
        imagination: Imagination | None = None,
    ) -> None:
        self.perception, self.n_actions, self.settings = perception, n_actions, settings
        self.imagination = imagination
        self.rng = seeds.child("exploration").generator()
        self._replay = torch.Generator(device).manual_seed(seeds.child("replay").integer())
        weights = torch.Generator(device).manual_seed(seeds.child("controller").integer())
        self.controller = Controller(perception.latent_size, n_actions, settings.controller, weights)
        self.real = RealMemory(settings.memory.real, perception.latent_size, device)
        self.meters = Meters()
        self.steps = 0

    @property
    def epsilon(self) -> float:
        """Probability that the next exploring action is random."""
        return epsilon(self.steps, self.settings.controller)

    @property
    def tested(self) -> Controller:
        """The controller that acts greedily: here the one that explores too."""
        return self.controller

    def q_values(self, observation: Observation) -> NDArray[np.float32]:
        """Values of every macro-action at the mean latents. Shape (A,)."""
        return self._values(self.tested, observation)

    def _values(self, controller: Controller, observation: Observation) -> NDArray[np.float32]:
        mu, _ = self.perception.posterior(observation.frame)
        values: NDArray[np.float32] = controller.values(mu.unsqueeze(0))[0].cpu().numpy()
        return values

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Act epsilon-greedily on the mean latents; greedily, and changing nothing, without ``explore``."""
        if explore and self.rng.random() < self.epsilon:
            return int(self.rng.integers(self.n_actions))
        return int(self._values(self.controller if explore else self.tested, observation).argmax())

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Algorithm 1 after the action: store, N_E model updates, N_R updates on real batches; imagine, N_I updates.

        Raises:
            DivergedError: A loss is no longer finite.
        """
        now = self.perception.posterior(transition.observation.frame)
        then = self.perception.posterior(transition.next_observation.frame)
        self.real.add(now, transition.action, transition.reward, then, transition.terminated)
        if self.imagination is not None:
            self._learn_model(self.imagination)
        self._learn_values(self.real, self.settings.controller.updates_per_step)
        if self.imagination is not None and self._practises_in(episode):
            self._practise(self.imagination, now[0], episode)
        self.meters.count(*_TIMES[: 1 if self.imagination is None else None])
        self.steps += 1

    def _practises_in(self, episode: int) -> bool:
        """Whether the controller learns from imagination in real episode ``episode``."""
        return episode >= self.settings.imagination.start_episode

    def _practise(self, imagination: Imagination, z: torch.Tensor, episode: int) -> None:
        """N_I updates on what is imagined now; after the last episode that imagines, on what really happened."""
        settings = self.settings.imagination
        ended = settings.end_episode is not None and episode >= settings.end_episode
        if not ended:
            self._imagine(imagination, z)
        self._learn_values(self.real if ended else imagination.memory, settings.updates_per_step)

    def _learn_model(self, imagination: Imagination) -> None:
        with self.meters.cpu_time("time/model_s"):
            for losses in imagination.learn(self.real):
                for name, value in asdict(losses).items():
                    self.meters.add(f"loss/{name}", value)

    def _learn_values(self, memory: RealMemory | ImaginedMemory, updates: int) -> None:
        with self.meters.cpu_time("time/controller_s"):
            for _ in range(updates if len(memory) else 0):  # the filter may have kept nothing yet
                batch = memory.sample(self.settings.controller.batch_size, self._replay)
                self.meters.add("loss/bellman", self.controller.update(batch))

    def _imagine(self, imagination: Imagination, z: torch.Tensor) -> None:
        with self.meters.cpu_time("time/imagination_s"):
            counts = imagination.rollouts(self.controller, z, self.real, self.epsilon)
        self.meters.add("imagination/acceptance_rate", counts.accepted, counts.predicted)
        self.meters.add("imagination/mean_depth", counts.accepted, counts.rollouts)

    def diagnostics(self) -> dict[str, float]:
        """Means since the last call (``time/*`` in CPU seconds a real step), and the counters now."""
        imagined = {} if self.imagination is None else {"imagined_transitions": float(self.imagination.memory.added)}
        return {**self.meters.read(), "epsilon": self.epsilon, "real_transitions": float(self.real.added), **imagined}

    def state(self) -> AgentState:
        """A snapshot: weights, moments, memories, generators, counters, measurements."""
        arrays = {
            **snapshot.prefixed("controller", self.controller.arrays()),
            **snapshot.prefixed("real", self.real.arrays()),
            "generator/replay": snapshot.generator_array(self._replay),
        }
        values = {
            "steps": self.steps,
            "real_added": self.real.added,
            "exploration": self.rng.bit_generator.state,
            "meters": self.meters.state(),
            "settings": snapshot.jsonable(flatten(self.settings)),
            "filtered": None if self.imagination is None else self.imagination.filtered,
        }
        if self.imagination is not None:
            arrays.update(snapshot.prefixed("imagination", self.imagination.arrays()))
            values["imagined_added"] = self.imagination.memory.added
        return AgentState(arrays=arrays, values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot.

        Raises:
            ArtefactError: It does not fit this agent; nothing was changed.
        """
        snapshot.require_fit(state, self.state())
        arrays, values = state.arrays, state.values
        self.controller.load(snapshot.below("controller", arrays))
        snapshot.load_generator(self._replay, arrays["generator/replay"])
        self.real.load(snapshot.below("real", arrays), values["real_added"])
        self.meters.restore(values["meters"])
        self.rng.bit_generator.state, self.steps = values["exploration"], values["steps"]
        if self.imagination is not None:
            self.imagination.load(snapshot.below("imagination", arrays), values["imagined_added"])
