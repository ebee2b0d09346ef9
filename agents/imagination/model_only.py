"""Chapter 3's second controller: trained in the world model alone, as if that were the world (thesis 3.2.2).

A first controller explores the world like a DQN and is not tested. Before each test a new one is trained in the
learned model, for ``imagination.model_only_episodes`` episodes however many real ones there were. Imagined episodes
begin where real ones did and go on, one macro-action and one update at a time, until the model says that they end; no
real transition is ever learned from.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from imagine_bench.arrays import Arrays
from imagine_bench.interfaces import AgentState, Transition
from imagine_bench.seeding import SeedTree

from .. import snapshot
from ..dqn import Controller, epsilon
from ..encoders.perception import Perception
from ..meters import Meters
from ..replay import Batch, ImaginedMemory, RealMemory, StartMemory
from .agent import ImaginingAgent, build
from .rollouts import TERMINAL, Imagination
from .settings import Settings

_STARTS = 1_000
"""Starts of real episodes that are kept."""


class ModelOnlyTraining:
    """Trains a new controller in a world model, an imagined episode at a time; changes only a threshold that moves.

    Every training draws from generators of its own, named by the real step that it begins at, so it is the same whether
    earlier ones took place or not. ``seeds`` is this training's node of the seed tree.
    """

    def __init__(
        self, imagination: Imagination, n_actions: int, settings: Settings, seeds: SeedTree, device: torch.device
    ) -> None:
        self.imagination = imagination
        self._n_actions = n_actions
        self.settings = settings
        self._seeds = seeds
        self._device = device
        self.begin(0)

    def begin(self, real_step: int) -> None:
        """Start with a new controller and an empty memory; ``real_step`` names the world model's age."""
        seeds = self._seeds.child(real_step)
        device = self._device
        size = self.imagination.model.latent_size
        self.real_step = real_step
        self.episodes = 0
        self.steps = 0
        self._generator = torch.Generator(device).manual_seed(seeds.child("episodes").integer())
        weights = torch.Generator(device).manual_seed(seeds.child("controller").integer())
        self.controller = Controller(size, self._n_actions, self.settings.controller, weights)
        weighted = self.settings.imagination.confidence_scale is not None
        self._memory = ImaginedMemory(self.settings.memory.imagined, size, device, weighted=weighted)

    def episode(self, starts: StartMemory, real: RealMemory, meters: Meters) -> None:
        """Imagine one episode from a replayed start, learning at every step of it.

        The filter, where there is one, ends it before the first transition that it discards. ``real`` is read by a
        moving threshold only. DivergedError if the controller's loss is no longer finite.
        """
        imagination = self.imagination
        settings = self.settings.imagination
        generator = self._generator
        weights = imagination.draw_weights(generator)
        imagination.filter.move_threshold(imagination.model, real, weights.dynamics, generator)
        z = starts.sample(1, generator)
        predicted = 0
        kept = 0
        gathered = torch.zeros(1, device=z.device)
        while kept < settings.depth:
            chance = max(epsilon(self.steps, self.settings.controller), settings.exploration)
            action = imagination.act(self.controller, z, chance, generator)
            step = imagination.step(z, action, weights, generator)
            predicted += 1
            if not bool(imagination.keeps(step, gathered)):
                break
            terminated = step.p_terminated > TERMINAL
            weight = imagination.confidence(step, gathered)
            self._memory.add(Batch(z, action, step.reward, step.next_z, terminated.float(), weight=weight))
            gathered = imagination.gathered_with(step, gathered)
            for _ in range(self.settings.controller.updates_per_step):
                batch = self._memory.sample(self.settings.controller.batch_size, generator)
                meters.add("loss/bellman_imagined", self.controller.update(batch))
            self.steps += 1
            kept = kept + 1
            z = step.next_z
            if bool(terminated):
                break
        meters.add("imagination/acceptance_rate", kept, predicted)
        meters.add("imagination/mean_depth", kept)
        self.episodes += 1

    def values(self) -> dict[str, int]:
        """Counters, JSON-serialisable."""
        return {
            "real_step": self.real_step,
            "episodes": self.episodes,
            "steps": self.steps,
            "imagined": self._memory.added,
        }

    def arrays(self) -> Arrays:
        """Copies of weights, moments, target network, memory and generator."""
        return {
            **snapshot.prefixed("controller", snapshot.training_arrays(self.controller, self.controller.optimiser)),
            **snapshot.prefixed("memory", self._memory.arrays()),
            "generator": snapshot.generator_array(self._generator),
        }

    def load(self, arrays: Arrays, values: dict[str, int]) -> None:
        """Take up the results of :meth:`arrays` and :meth:`values`."""
        self.begin(values["real_step"])
        self.episodes = values["episodes"]
        self.steps = values["steps"]
        snapshot.load_training(self.controller, self.controller.optimiser, snapshot.below("controller", arrays))
        self._memory.load(snapshot.below("memory", arrays), values["imagined"])
        snapshot.load_generator(self._generator, arrays["generator"])


class ModelOnlyAgent(ImaginingAgent):
    """Explores with one controller, and is tested with another that was trained in the world model alone.

    ``filtered`` says whether imagined episodes end where the epistemic uncertainty is too large.
    """

    def __init__(
        self,
        perception: Perception,
        n_actions: int,
        settings: Settings,
        seeds: SeedTree,
        device: torch.device,
        *,
        filtered: bool,
    ) -> None:
        super().__init__(perception, n_actions, settings, seeds, device, filtered=filtered)
        self.training = ModelOnlyTraining(self.imagination, n_actions, settings, seeds.child("model_only"), device)
        self._starts = StartMemory(_STARTS, perception.latent_size, device)
        self._episode = -1

    @property
    def tested(self) -> Controller:
        """The controller that was trained in the model alone."""
        return self.training.controller

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Remember where episodes begin, and learn as the DQN and its world model do; DivergedError as there."""
        if episode != self._episode:
            self._starts.add(self.perception.posterior(transition.observation.frame))
            self._episode = episode
        super().observe(transition, episode=episode)

    def learn_more(self, z: Tensor, episode: int) -> None:
        """Make N_E model updates; only :meth:`train_in_model` imagines."""
        self.learn_model()
        self.meters.count("time/model_only_s")

    def reset_for_new_task(self) -> None:
        """Reset as every imagining agent does; the starts and the training in the model begin anew too."""
        super().reset_for_new_task()
        self._starts.clear()
        self._episode = -1
        self.training.begin(0)

    def train_in_model(self) -> bool:
        """Imagine one episode, learn from it, and return whether one was left; real steps make training begin anew.

        DivergedError if the controller's loss is no longer finite.
        """
        if self.steps == 0:
            return False  # nothing was learned and no start was seen
        if self.training.real_step != self.steps:
            self.training.begin(self.steps)
        if self.training.episodes >= self.settings.imagination.model_only_episodes:
            return False
        before = self.training.steps
        with self.meters.cpu_time("time/model_only_s"):
            self.training.episode(self._starts, self.real, self.meters)
        self.updates += (self.training.steps - before) * self.settings.controller.updates_per_step
        return True

    def diagnostics(self) -> dict[str, float]:
        """Return the diagnostics of an imagining agent, with the transitions of the training in the model."""
        return {**super().diagnostics(), "imagined_transitions": float(self.training.steps)}

    def state(self) -> AgentState:
        """Return a snapshot that includes the training in the model and the starts of episodes."""
        state = super().state()
        state.arrays.update(snapshot.prefixed("model_only", self.training.arrays()))
        state.arrays.update(snapshot.prefixed("starts", self._starts.arrays()))
        own = {"model_only": self.training.values(), "starts_added": self._starts.added, "episode": self._episode}
        state.values.update(own)
        return state

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        super().restore(state)
        self.training.load(snapshot.below("model_only", state.arrays), state.values["model_only"])
        self._starts.load(snapshot.below("starts", state.arrays), state.values["starts_added"])
        self._episode = state.values["episode"]


make = partial(build, ModelOnlyAgent, filtered=False)
"""The ``imagination_only`` agent."""
make_uncertainty = partial(build, ModelOnlyAgent, filtered=True)
"""The ``imagination_only_uncertainty`` agent: imagined episodes end where the model is uncertain."""
