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

from imagine_bench.interfaces import AgentState, Transition
from imagine_bench.seeding import SeedTree

from .. import snapshot
from ..dqn import Controller, epsilon
from ..encoders.perception import Perception
from ..replay import ImaginedMemory, StartMemory
from .agent import ImaginingAgent, build
from .settings import Settings

_STARTS = 1_000
"""Starts of real episodes that are kept."""


class ModelOnlyAgent(ImaginingAgent):
    """Explores with one controller, and is tested with another that is trained in the world model alone.

    ``filtered`` says whether imagined episodes end where the epistemic uncertainty is too large. Every training draws
    from generators of its own, named by the real step that it begins at, so it is the same whether earlier ones took
    place or not; it changes nothing but itself and a threshold that moves.
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
        self._seeds = seeds.child("model_only")
        self._device = device
        self.starts = StartMemory(_STARTS, perception.latent_size, device)
        self._episode = -1
        self.begin_training(0)

    @property
    def tested(self) -> Controller:
        """The controller that was trained in the model alone."""
        return self.trained

    def begin_training(self, real_step: int) -> None:
        """Start with a new controller and an empty memory; ``real_step`` names the world model's age."""
        seeds = self._seeds.child(real_step)
        generators = {
            name: torch.Generator(self._device).manual_seed(seeds.child(name).integer())
            for name in ("episodes", "controller")
        }
        self.real_step = real_step
        self.imagined_episodes = 0
        self.imagined_steps = 0
        self._draws = generators["episodes"]
        self.trained = self.new_controller(generators["controller"])
        weighted = self.settings.imagination.confidence_scale is not None
        size = self.perception.latent_size
        self.imagined = ImaginedMemory(self.settings.memory.imagined, size, self._device, weighted=weighted)

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Remember where episodes begin, and learn as the DQN and its world model do; DivergedError as there."""
        if episode != self._episode:
            self.starts.add(self.perception.posterior(transition.observation.frame))
            self._episode = episode
        super().observe(transition, episode=episode)

    def learn_more(self, z: Tensor, episode: int) -> None:
        """Make N_E model updates; only :meth:`train_in_model` imagines."""
        self.learn_model()
        self.meters.count("time/model_only_s")

    def reset_for_new_task(self) -> None:
        """Reset as every imagining agent does; the starts and the training in the model begin anew too."""
        super().reset_for_new_task()
        self.starts.clear()
        self._episode = -1
        self.begin_training(0)

    def train_in_model(self) -> bool:
        """Imagine one episode, learn from it, and return whether one was left; real steps make training begin anew.

        DivergedError if the controller's loss is no longer finite.
        """
        if self.steps == 0:
            return False  # nothing was learned and no start was seen
        if self.real_step != self.steps:
            self.begin_training(self.steps)
        if self.imagined_episodes >= self.settings.imagination.model_only_episodes:
            return False
        with self.meters.cpu_time("time/model_only_s"):
            self._imagine_episode()
        return True

    def _imagine_episode(self) -> None:
        """Imagine one episode from a replayed start, learning at every step of it.

        The filter, where there is one, ends it before the first transition that it discards.
        """
        imagination = self.imagination
        settings = self.settings.imagination
        controller = self.settings.controller
        draws = self._draws
        weights = imagination.draw_weights(draws)
        imagination.filter.move_threshold(imagination.model, self.real, weights.dynamics, draws)
        predicted = 0
        kept = 0

        def act(z: Tensor) -> Tensor:
            chance = max(epsilon(self.imagined_steps, controller), settings.exploration)
            return imagination.act(self.trained, z, chance, draws)

        for each in imagination.unroll(self.starts.sample(1, draws), act, weights, draws, settings.depth):
            predicted += 1
            if not each.kept:
                break
            kept += 1
            self.imagined.add(imagination.learnable(each))
            for _ in range(controller.updates_per_step):
                batch = self.imagined.sample(controller.batch_size, draws)
                self.meters.add("loss/bellman_imagined", self.trained.update(batch))
                self.updates += 1
            self.imagined_steps += 1
        self.meters.add("imagination/acceptance_rate", kept, predicted)
        self.meters.add("imagination/mean_depth", kept)
        self.imagined_episodes += 1

    def diagnostics(self) -> dict[str, float]:
        """Return the diagnostics of an imagining agent, with the transitions of the training in the model."""
        return {**super().diagnostics(), "imagined_transitions": float(self.imagined_steps)}

    def parts(self) -> dict[str, snapshot.Part]:
        """The parts whose arrays a snapshot holds: the training in the model and the starts of episodes, too."""
        return {
            **super().parts(),
            "model_only/controller": self.trained,
            "model_only/memory": self.imagined,
            "model_only/generator": self._draws,
            "starts": self.starts,
        }

    def state(self) -> AgentState:
        """Return a snapshot that includes the training in the model and the starts of episodes."""
        state = super().state()
        training = {
            "real_step": self.real_step,
            "episodes": self.imagined_episodes,
            "steps": self.imagined_steps,
            "imagined": self.imagined.added,
        }
        state.values.update(model_only=training, starts_added=self.starts.added, episode=self._episode)
        return state

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        super().restore(state)
        training = state.values["model_only"]
        self.real_step = training["real_step"]
        self.imagined_episodes = training["episodes"]
        self.imagined_steps = training["steps"]
        self.imagined.added = training["imagined"]
        self.starts.added = state.values["starts_added"]
        self._episode = state.values["episode"]


make = partial(build, ModelOnlyAgent, filtered=False)
"""The ``imagination_only`` agent."""
make_uncertainty = partial(build, ModelOnlyAgent, filtered=True)
"""The ``imagination_only_uncertainty`` agent: imagined episodes end where the model is uncertain."""
