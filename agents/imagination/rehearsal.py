"""A controller that never meets the world: it is trained in imagination as if that were the world (thesis 3.2.2).

Imagined episodes begin where real ones did and go on, one macro-action and one update at a time, until the model says
that they end; no real transition is ever learned from.
"""

from __future__ import annotations

import torch

from imagine_bench.seeding import SeedTree

from .. import snapshot
from ..controller import Controller, epsilon
from ..meters import Meters
from ..replay import Batch, ImaginedMemory, RealMemory, StartMemory
from ..settings import Settings
from .rollouts import TERMINAL, Imagination


class Rehearsal:
    """Trains a fresh controller on a world model, an imagined episode at a time.

    Every rehearsal draws from generators of its own, named by the real step that it begins at, so it is the same
    whether earlier ones took place or not.

    Args:
        imagination: The world model that stands for the world, and its filter; only a threshold that moves is changed.
        n_actions: A.
        settings: All hyperparameters of the learner.
        seeds: This rehearsal's node of the seed tree.
        device: Where networks and memory lie.
    """

    def __init__(
        self, imagination: Imagination, n_actions: int, settings: Settings, seeds: SeedTree, device: torch.device
    ) -> None:
        self._imagination, self._n_actions, self._settings = imagination, n_actions, settings
        self._seeds, self._device = seeds, device
        self.begin(0)

    def begin(self, real_step: int) -> None:
        """Forget everything and start with a fresh controller, for what was learned up to ``real_step``."""
        seeds, device, size = self._seeds.child(real_step), self._device, self._imagination.model.latent_size
        self.real_step, self.episodes, self.steps = real_step, 0, 0
        self._generator = torch.Generator(device).manual_seed(seeds.child("practice").integer())
        weights = torch.Generator(device).manual_seed(seeds.child("controller").integer())
        self.controller = Controller(size, self._n_actions, self._settings.controller, weights)
        self._memory = ImaginedMemory(self._settings.memory.imagined, size, device)

    def episode(self, starts: StartMemory, real: RealMemory, meters: Meters) -> None:
        """Imagine one episode from a replayed start, learning at every step of it.

        The filter, where there is one, ends it before the first transition that it discards.

        Args:
            starts: Where real episodes began.
            real: Read by a moving threshold only, not learned from.
            meters: Told the losses, and how much was kept.

        Raises:
            DivergedError: The controller's loss is no longer finite.
        """
        imagination, settings, generator = self._imagination, self._settings.imagination, self._generator
        weights = imagination.draw_weights(generator)
        imagination.move_threshold(real, weights, generator)
        z, predicted, kept = starts.sample(1, generator), 0, 0
        while kept < settings.depth:
            chance = max(epsilon(self.steps, self._settings.controller), settings.exploration)
            action = imagination.act(self.controller, z, chance, generator)
            step = imagination.step(z, action, weights, generator)
            predicted += 1
            if not bool(imagination.keeps(step)):
                break
            terminated = step.p_terminated > TERMINAL
            self._memory.add(Batch(z, action, step.reward, step.next_z, terminated.float()))
            self._learn(meters)
            kept, z = kept + 1, step.next_z
            if bool(terminated):
                break
        meters.add("imagination/acceptance_rate", kept, predicted)
        meters.add("imagination/mean_depth", kept)
        self.episodes += 1

    def _learn(self, meters: Meters) -> None:
        for _ in range(self._settings.controller.updates_per_step):
            batch = self._memory.sample(self._settings.controller.batch_size, self._generator)
            meters.add("loss/bellman_imagined", self.controller.update(batch))
        self.steps += 1

    def values(self) -> dict[str, int]:
        """Counters, JSON-serialisable."""
        counters = {"real_step": self.real_step, "episodes": self.episodes, "steps": self.steps}
        return {**counters, "imagined": self._memory.added}

    def arrays(self) -> snapshot.Arrays:
        """Copies of weights, moments, target network, memory and generator."""
        return {
            **snapshot.prefixed("controller", self.controller.arrays()),
            **snapshot.prefixed("memory", self._memory.arrays()),
            "generator": snapshot.generator_array(self._generator),
        }

    def load(self, arrays: snapshot.Arrays, values: dict[str, int]) -> None:
        """Take up the results of :meth:`arrays` and :meth:`values`."""
        self.begin(values["real_step"])
        self.episodes, self.steps = values["episodes"], values["steps"]
        self.controller.load(snapshot.below("controller", arrays))
        self._memory.load(snapshot.below("memory", arrays), values["imagined"])
        snapshot.load_generator(self._generator, arrays["generator"])
