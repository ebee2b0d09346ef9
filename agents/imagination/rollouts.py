"""Imagination: the world model runs in closed loop; the filter keeps certain transitions (thesis 5.2.2).

From one real state, ``I_B`` rollouts of depth ``I_D`` run side by side. One call draws T weight samples of the
dynamics; every prediction averages over them, and their disagreement is the epistemic variance that the filter reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from imagine_bench.errors import DivergedError, InvalidValueError
from imagine_bench.interfaces.model import UNCERTAINTIES
from imagine_bench.seeding import SeedTree

from ..dqn import Controller
from ..networks.mlp import Masks
from ..replay import Batch, ImaginedMemory, RealMemory
from ..snapshot import Part
from . import mixture as mdn
from .filter import EpistemicFilter
from .mixture import Mixture
from .settings import Settings
from .uncertainty import decompose
from .world_model import EnvironmentModel

TERMINAL = 0.5
"""Predicted probability above which a rollout ends."""
LATENT_LIMIT = 1e6
"""Largest absolute latent that is kept. An encoder's latents are of order 1; a larger one has run away.

Adam keeps the square of a gradient, in which a latent occurs with its fourth power; a larger limit could overflow."""


class Weights(NamedTuple):
    """Weight samples that all steps of a call share: masks of the dynamics (E, T, H), None where nothing is dropped.

    Those of the reward network are (1, T, H), None where the filter does not read it.
    """

    dynamics: Masks | None
    reward: Masks | None


@dataclass(frozen=True, slots=True)
class ImaginedStep:
    """One imagined step of N rollouts, with predicted ``reward`` and probability of the end there, (N,) each."""

    next_z: Tensor  #: shape (N, Z), within +-1e6; where that is reached, the closed loop has run away
    reward: Tensor
    p_terminated: Tensor
    samples: Mixture  #: the predictions of each weight sample of each member, with leading axes (E T, N)
    #: Standard deviation of the reward over its network's weight samples, in units of reward; None where the filter
    #: does not read it. Shape (N,).
    reward_std: Tensor | None

    @property
    def terminated(self) -> Tensor:
        """Which rollouts end here. Shape (N,), bool."""
        return self.p_terminated > TERMINAL


class RolloutStep(NamedTuple):
    """One step of N rollouts that are unrolled together."""

    z: Tensor  #: where it began. Shape (N, Z).
    action: Tensor  #: shape (N,)
    step: ImaginedStep
    kept: Tensor  #: which are kept. Shape (N,), bool.
    gathered: Tensor  #: uncertainty of each rollout before it, in squared units of z. Shape (N,).


class Counts(NamedTuple):
    """How much one call imagined: rollouts begun, transitions predicted, transitions kept."""

    rollouts: int
    predicted: int
    accepted: int


class Imagination:
    """A world model, the memory of its imagined transitions, and the filter between the two.

    ``filtered`` says whether the filter is active. ``seeds`` is this imagination's node of the seed tree, ``device``
    where networks and memory lie.

    Raises:
        InvalidValueError: A filter is asked for, but no weight sample would differ from another.
    """

    def __init__(
        self,
        latent_size: int,
        n_actions: int,
        settings: Settings,
        *,
        filtered: bool,
        seeds: SeedTree,
        device: torch.device,
    ) -> None:
        self._all_settings = settings
        self.settings = settings.imagination
        self.filter = EpistemicFilter(settings, active=filtered)
        self.generators = {
            name: torch.Generator(device).manual_seed(seeds.child(name).integer())
            for name in ("weights", "replay", "dropout", "rollouts")
        }
        self.model = self.new_model(latent_size, n_actions, settings)
        weighted = self.settings.confidence_scale is not None
        self.memory = ImaginedMemory(settings.memory.imagined, latent_size, device, weighted=weighted)

    def new_model(self, state_size: int, n_actions: int, settings: Settings) -> EnvironmentModel:
        """Return an untrained world model of states of ``state_size`` numbers."""
        return EnvironmentModel(state_size, n_actions, settings.model, self.generators["weights"])

    def reset_for_new_task(self) -> None:
        """Keep the dynamics network; everything else begins anew, the optimiser's moments included."""
        known = self.model
        self.model = self.new_model(known.latent_size, known.n_actions, self._all_settings)
        self.model.keep_dynamics_of(known)
        self.memory.clear()
        self.filter.reset()

    def draw_weights(self, generator: torch.Generator) -> Weights:
        """Draw T weight samples of the networks that the filter compares."""
        count = self.settings.weight_samples
        dynamics = self.model.draw_weights(count, generator)
        return Weights(dynamics, self.model.draw_reward_weights(count, generator) if self.filter.reads_reward else None)

    def step(self, z: Tensor, action: Tensor, weights: Weights, generator: torch.Generator) -> ImaginedStep:
        """Imagine the result of ``action`` (N,) in ``z`` (N, Z): sample z' from the networks that the settings choose.

        Raises DivergedError if a prediction is NaN.
        """
        model = self.model
        samples = model.predict(z, action, weights.dynamics)  # [E T, N, ...]
        predicted = self._predicted(samples, z, action, weights, generator)
        _require_numbers(predicted.log_weights)
        next_z = mdn.sample(predicted, self.settings.temperature, generator).clamp(-LATENT_LIMIT, LATENT_LIMIT)
        _require_numbers(next_z)
        next_z = self.state_after(z, action, next_z)
        reward, p_terminated = model.predict_outcome(z, action, next_z)
        reward_std = None if weights.reward is None else model.reward_std(z, action, next_z, weights.reward)
        return ImaginedStep(next_z, reward, p_terminated, samples, reward_std)

    def state_after(self, z: Tensor, action: Tensor, predicted: Tensor) -> Tensor:
        """The states that follow N states ``z`` after actions (N,), given the predictions of them: all there is."""
        del z, action
        return predicted

    def ignorance(self, z: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Return the epistemic variance of the next states of actions (N,) in z (N, Z), reduced and at most 1: (N,).

        Curiosity pays this for exploring, so noise and the choice among several outcomes are no part of it (thesis 6).
        """
        weights = self.model.draw_weights(self.settings.weight_samples, generator)
        return self.filter.score(decompose(self.model.predict(z, action, weights)).epistemic).clamp(max=1.0)

    def _predicted(
        self, samples: Mixture, z: Tensor, action: Tensor, weights: Weights, generator: torch.Generator
    ) -> Mixture:
        """Return the mixtures (N, E K) that z' is sampled from, given those of the weight samples (E T, N)."""
        members = self.model.members
        if self.settings.predicts_with == "network" and weights.dynamics is not None:
            samples = self.model.predict(z, action, None)
        elif self.settings.predicts_with == "sample":
            rows = torch.arange(len(z), device=z.device)
            count = len(samples.means) // members
            chosen = torch.randint(count, (len(z),), generator=generator, device=z.device)
            samples = samples.map(lambda values: values.unflatten(0, (members, count))[:, chosen, rows])
        return mdn.average(samples, members)

    def uncertainty(self, step: ImaginedStep) -> Tensor:
        """Epistemic variance of N imagined steps, reduced to one number each, in squared units of z. Shape (N,)."""
        return self.filter.score(decompose(step.samples).epistemic)

    def uncertainties(self, step: ImaginedStep) -> dict[str, Tensor]:
        """The variances of N imagined steps by cause, reduced alike. Each of shape (N,)."""
        parts = decompose(step.samples)
        return {name: self.filter.score(getattr(parts, name)) for name in UNCERTAINTIES}

    def keeps(self, step: ImaginedStep, gathered: Tensor | float = 0.0) -> Tensor:
        """Return whether the filter keeps each transition; without a filter only runaway ones are dropped. (N,), bool.

        ``gathered`` is the uncertainty of each rollout before this step, where it counts, in squared units of z. A
        variance that is sampled in full and fed back can grow without bound, within some five imagined steps.
        """
        bounded = step.next_z.abs().amax(dim=-1) < LATENT_LIMIT
        if not self.filter.active:
            return bounded
        return bounded & self.filter.passes(gathered + self.uncertainty(step), step.p_terminated, step.reward_std)

    def confidence(self, step: ImaginedStep, gathered: Tensor) -> Tensor | None:
        """The weight of each of N transitions in updates, in (0, 1]; None where all count alike. Shape (N,)."""
        scale = self.settings.confidence_scale
        if scale is None:
            return None
        return 1.0 / (1.0 + (gathered + self.uncertainty(step)) / scale)

    def learnable(self, each: RolloutStep) -> Batch:
        """The transitions of a step that are kept, as a controller learns from them."""
        step = each.step
        weight = self.confidence(step, each.gathered)
        ended = step.terminated.float()
        return Batch(each.z, each.action, step.reward, step.next_z, ended, weight=weight).where(each.kept)

    def gathered_with(self, step: ImaginedStep, gathered: Tensor) -> Tensor:
        """The uncertainty of each rollout up to and with this step, where steps accumulate; else as before: (N,)."""
        return gathered + self.uncertainty(step) if self.settings.accumulates else gathered

    def require_no_confidence(self, reader: str) -> None:
        """Raise InvalidValueError if transitions are to be weighed by confidence, which ``reader`` cannot do."""
        if self.settings.confidence_scale is not None:
            raise InvalidValueError(
                f"{reader} cannot weigh transitions by their confidence; leave imagination.confidence_scale out."
            )

    def admits(self, z: Tensor, action: Tensor, step: ImaginedStep, gathered: Tensor | float) -> Tensor:
        """Which of N transitions a rollout keeps and goes on from: those of :meth:`keeps`. Shape (N,), bool."""
        del z, action
        return self.keeps(step, gathered)

    def unroll(
        self,
        z: Tensor,
        act: Callable[[Tensor], Tensor],
        weights: Weights,
        generator: torch.Generator,
        depth: int,
        *,
        cut: bool = True,
    ) -> Iterator[RolloutStep]:
        """Imagine rollouts side by side, at most ``depth`` steps of them.

        Args:
            z: Where they begin. Shape (N, Z).
            act: Chooses the actions (N,) of states (N, Z).
            weights: Weight samples of all steps.
            generator: Draws the outcomes.
            depth: Most steps.
            cut: Whether a rollout ends where the model says that the episode does, or with its first transition that
                :meth:`admits` discards; else all go on to the end, and :meth:`keeps` says which are kept.
        """
        gathered = torch.zeros(len(z), device=z.device)
        for _ in range(depth):
            action = act(z)
            step = self.step(z, action, weights, generator)
            kept = self.admits(z, action, step, gathered) if cut else self.keeps(step, gathered)
            yield RolloutStep(z, action, step, kept, gathered)
            gathered = self.gathered_with(step, gathered)
            z = step.next_z
            if cut:
                going_on = kept & ~step.terminated
                z = z[going_on]
                gathered = gathered[going_on]
            if len(z) == 0:
                return

    def rollouts(self, controller: Controller, current: Tensor, real: RealMemory, epsilon: float) -> Counts:
        """Imagine ``I_B`` rollouts and store those that the filter keeps.

        Args:
            controller: Chooses the actions, epsilon-greedily.
            current: The state the robot just acted in. Shape (Z,).
            real: The real transitions so far.
            epsilon: Probability of a random action; that of the settings counts where it is larger.
        """
        settings = self.settings
        generator = self.generators["rollouts"]
        sampled = self.filter.active or settings.confidence_scale is not None or settings.predicts_with != "network"
        weights = self.draw_weights(self.generators["dropout"]) if sampled else Weights(None, None)
        self.filter.move_threshold(self.model, real, weights.dynamics, self.generators["replay"])
        chance = max(epsilon, settings.exploration)
        predicted = 0
        accepted = 0

        def act(z: Tensor) -> Tensor:
            return self.act(controller, z, chance, generator)

        for each in self.unroll(self._starts(current, real), act, weights, generator, settings.depth):
            predicted += len(each.z)
            accepted += int(each.kept.sum())
            self.memory.add(self.learnable(each))
        return Counts(settings.breadth, predicted, accepted)

    def _starts(self, current: Tensor, real: RealMemory) -> Tensor:
        """Where this step's rollouts begin. Shape (I_B, Z)."""
        if self.settings.start_states == "current":
            return current.expand(self.settings.breadth, -1)
        return real.sample(self.settings.breadth, self.generators["replay"]).z

    @staticmethod
    def act(controller: Controller, z: Tensor, epsilon: float, generator: torch.Generator) -> Tensor:
        """Epsilon-greedy actions of states (N, Z). Shape (N,)."""
        greedy = controller.values(z).argmax(dim=-1)
        random = torch.randint(controller.n_actions, greedy.shape, generator=generator, device=generator.device)
        explores = torch.rand(greedy.shape, generator=generator, device=generator.device) < epsilon
        return torch.where(explores, random, greedy)

    def parts(self) -> dict[str, Part]:
        """The parts whose arrays snapshots hold, by name; the filter's threshold is not among it."""
        generators = {f"generator/{name}": generator for name, generator in self.generators.items()}
        return {"model": self.model, "memory": self.memory, **generators}


def _require_numbers(imagined: Tensor) -> None:
    if bool(imagined.isnan().any()):
        raise DivergedError("The imagination of the world model is no longer a number. Lower model.learning_rate.")
