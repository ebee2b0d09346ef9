"""Chapter 3's second controller: the world model is learned on the side, and who is tested has never met the world.

A first controller explores the world like a DQN and is not tested. Before each test a fresh one is trained in the
learned model alone, for ``imagination.rehearsal_episodes`` episodes however many real ones there were.
"""

from __future__ import annotations

import torch

from imagine_bench.interfaces import AgentContext, AgentState, Transition
from imagine_bench.seeding import SeedTree

from .. import snapshot
from ..controller import Controller
from ..encoders.perception import Perception
from ..replay import StartMemory
from ..settings import Settings
from .agent import ImaginingLearner, build
from .rehearsal import Rehearsal
from .rollouts import Imagination


class ImaginationOnly(ImaginingLearner):
    """Explores with one controller, rehearses with another, and is tested with that one.

    Args:
        perception: Frames to posteriors of latents.
        n_actions: A.
        settings: All hyperparameters.
        seeds: This agent's node of the seed tree.
        device: Where networks and memories lie.
        imagination: The world model that is rehearsed in, and its filter.
    """

    def __init__(
        self,
        perception: Perception,
        n_actions: int,
        settings: Settings,
        seeds: SeedTree,
        device: torch.device,
        imagination: Imagination,
    ) -> None:
        super().__init__(perception, n_actions, settings, seeds, device, imagination)
        self.rehearsal = Rehearsal(imagination, n_actions, settings, seeds.child("rehearsal"), device)
        self._starts = StartMemory(settings.memory.starts, perception.latent_size, device)
        self._episode = -1

    @property
    def tested(self) -> Controller:
        """The controller that was trained in imagination alone."""
        return self.rehearsal.controller

    def _practises_in(self, episode: int) -> bool:
        return False

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Remember where episodes begin, and learn as the DQN and its world model do.

        Raises:
            DivergedError: A loss is no longer finite.
        """
        if episode != self._episode:
            self._starts.add(self.perception.posterior(transition.observation.frame))
            self._episode = episode
        super().observe(transition, episode=episode)
        self.meters.count("time/rehearsal_s")

    def reset_for_new_task(self) -> None:
        """As every imagining learner; starts and rehearsal begin anew too."""
        super().reset_for_new_task()
        self._starts.clear()
        self._episode = -1
        self.rehearsal.begin(0)

    def train_in_model(self) -> bool:
        """One imagined episode; see :class:`imagine_bench.capabilities.ModelOnlyTrainer`. Real steps call for a new rehearsal.

        Raises:
            DivergedError: The controller's loss is no longer finite.
        """
        if self.steps == 0:
            return False  # nothing was learned and no start was seen
        if self.rehearsal.real_step != self.steps:
            self.rehearsal.begin(self.steps)
        if self.rehearsal.episodes >= self.settings.imagination.rehearsal_episodes:
            return False
        with self.meters.cpu_time("time/rehearsal_s"):
            self.rehearsal.episode(self._starts, self.real, self.meters)
        return True

    def diagnostics(self) -> dict[str, float]:
        """As every learner, where what is imagined is rehearsed; ``time/rehearsal_s`` too is spread over real steps."""
        base = super().diagnostics()
        base.pop("time/imagination_s", None)  # rehearsals are all that it imagines
        return {**base, "imagined_transitions": float(self.rehearsal.steps)}

    def state(self) -> AgentState:
        """A snapshot, rehearsal and starts included."""
        base = super().state()
        arrays = {
            **snapshot.prefixed("rehearsal", self.rehearsal.arrays()),
            **snapshot.prefixed("starts", self._starts.arrays()),
        }
        values = {"rehearsal": self.rehearsal.values(), "starts_added": self._starts.added, "episode": self._episode}
        return AgentState(arrays={**base.arrays, **arrays}, values={**base.values, **values})

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot.

        Raises:
            ArtefactError: It does not fit this agent; nothing was changed.
        """
        super().restore(state)
        self.rehearsal.load(snapshot.below("rehearsal", state.arrays), state.values["rehearsal"])
        self._starts.load(snapshot.below("starts", state.arrays), state.values["starts_added"])
        self._episode = state.values["episode"]


def make(context: AgentContext) -> ImaginationOnly:
    """The ``imagination_only`` agent."""
    return build(ImaginationOnly, context, filtered=False)


def make_uncertainty(context: AgentContext) -> ImaginationOnly:
    """The ``imagination_only_uncertainty`` agent: imagined episodes end where the model is unsure."""
    return build(ImaginationOnly, context, filtered=True)
