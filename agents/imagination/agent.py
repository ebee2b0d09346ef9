"""The thesis' agents: a DQN fed by imagination, without and with the epistemic filter."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.arrays import Floats32, Frame, Ints
from imagine_bench.interfaces import AgentContext, AgentState, Observation
from imagine_bench.interfaces.capabilities import ExpectedOutcomes, ImaginedRollout, planned_actions
from imagine_bench.interfaces.model import UNCERTAINTIES
from imagine_bench.seeding import SeedTree

from .. import snapshot
from ..dqn import DQN, epsilon
from ..encoders.perception import Perception, load_perception, prepare_torch
from ..meters import Meters
from ..networks.precision import settle
from ..replay import Batch, Transitions
from ..settings import Hyperparameters
from .filter import weight_samples
from .rollouts import Imagination, RolloutStep
from .settings import HYPERPARAMETERS, Settings

_PREDICTIONS = 20_000  # mixtures predicted at once, over weight samples and rows, to bound memory
_BRANCHES = 8  # imagined samples that an expected outcome is averaged over
_Kind = TypeVar("_Kind", bound="ImaginingAgent")


class ImaginingAgent(DQN):
    """Algorithm 1: a DQN that also learns a world model, and learns from the transitions that the model imagines.

    ``filtered`` says whether transitions of too large an epistemic uncertainty are discarded.
    """

    settings: Settings
    imagination_kind = Imagination

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
        super().__init__(perception, n_actions, settings, seeds, device)
        size = perception.latent_size
        node = seeds.child("imagination")
        self.imagination = self.imagination_kind(
            size, n_actions, settings, filtered=filtered, seeds=node, device=device
        )

    def learn_more(self, z: Tensor, episode: int) -> None:
        """Make N_E model updates; from ``start_episode``, imagine from ``z`` (Z,) and make N_I updates on the result.

        After the last episode that imagines, these updates are made on real transitions.
        """
        self.learn_model()
        settings = self.settings.imagination
        if settings.end_episode is not None and episode >= settings.end_episode:
            self.learn_values(self.real, settings.updates_per_step)
        elif episode >= settings.start_episode:
            self._imagine(z)
            self.learn_values(self.imagination.memory, settings.updates_per_step)
        self.meters.count("time/imagination_s")

    def learn_model(self) -> None:
        """Make N_E updates of the world model on real transitions."""
        model = self.imagination.model
        draws = self.imagination.generators
        with self.meters.cpu_time("time/model_s"):
            for batch in self.draw_model_batches(draws["replay"]):
                losses = model.update(batch, draws["dropout"])
                for name, value in losses._asdict().items():
                    self.meters.add(f"loss/{name}", value)
                self.updates += 1
        self.meters.count("time/model_s")

    def draw_model_batches(self, generator: torch.Generator) -> Iterable[Batch]:
        """Draw the real transitions of all N_E updates of the world model at once, which is quicker than one by one."""
        settings = self.settings.model
        rows = settings.updates_per_step * settings.batch_size
        sampled = self.real.sample(rows, generator, spread=settings.spread, balance=settings.balance)
        return sampled.split(settings.batch_size)

    def draw_batch(self, memory: Transitions) -> Batch:
        """Draw as the DQN does; curiosity adds the model's ignorance of each real transition to its reward."""
        batch = super().draw_batch(memory)
        weight = self.settings.imagination.curiosity
        if weight == 0.0 or memory is not self.real:
            return batch
        paid = weight * self.imagination.ignorance(batch.z, batch.action, self.imagination.generators["dropout"])
        self.meters.add("imagination/intrinsic_reward", float(paid.mean()))
        return replace(batch, reward=batch.reward + paid)

    def remembered_states(self) -> Tensor:
        """The states that it remembers to have acted in, as means of their latents. Shape (N, Z)."""
        return torch.from_numpy(self.real.arrays()["mu"].astype(np.float32))

    def _imagine(self, z: Tensor) -> None:
        with self.meters.cpu_time("time/imagination_s"):
            chance = epsilon(self.steps, self.settings.controller)
            counts = self.imagination.rollouts(self.controller, z, self.real, chance)
        self.meters.add("imagination/acceptance_rate", counts.accepted, counts.predicted)
        self.meters.add("imagination/mean_depth", counts.accepted, counts.rollouts)

    def diagnostics(self) -> dict[str, float]:
        """Return the DQN's diagnostics and the number of transitions imagined so far."""
        return {**super().diagnostics(), "imagined_transitions": float(self.imagination.memory.added)}

    def parts(self) -> dict[str, snapshot.Part]:
        """The parts whose arrays a snapshot holds: world model and imagined memory, too."""
        own = {f"imagination/{name}": part for name, part in self.imagination.parts().items()}
        return {**super().parts(), **own}

    def state(self) -> AgentState:
        """Return a snapshot that includes the world model and the imagined memory."""
        state = super().state()
        own = self.imagination
        state.arrays["imagination/threshold"] = np.array(own.filter.threshold)
        state.values.update(filtered=own.filter.active, imagined_added=own.memory.added)
        return state

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        super().restore(state)
        self.imagination.memory.added = state.values["imagined_added"]
        self.imagination.filter.threshold = float(state.arrays["imagination/threshold"])

    def reset_for_new_task(self) -> None:
        """Keep the network of the dynamics; see :class:`.capabilities.TransferLearner`.

        Reward, termination, controller, memories and the schedule of exploration begin anew.
        """
        self.imagination.reset_for_new_task()
        self.controller = self.new_controller(self._replay)  # a generator that snapshots hold
        self.real.clear()
        self.meters = Meters()  # a measurement on an earlier task is no diagnosis of this one
        self.steps = self.updates = 0

    def novelty(self, observation: Observation, rng: np.random.Generator) -> Floats32 | None:
        """Return the curiosity reward of every macro-action; see :class:`.capabilities.NoveltyReader`.

        A single network has no disagreement to measure, so the result is None there.
        """
        if weight_samples(self.settings) * self.settings.model.members == 1:
            return None
        z = self.perceive(observation.frame).expand(self.n_actions, -1)
        generator = torch.Generator(z.device).manual_seed(int(rng.integers(2**63)))
        return self.imagination.ignorance(z, torch.arange(self.n_actions, device=z.device), generator).cpu().numpy()

    def imagine(self, frame: Frame, *, actions: Ints | None, depth: int, rng: np.random.Generator) -> ImaginedRollout:
        """Imagine up to ``depth`` transitions from ``frame``; see :class:`.capabilities.Imaginer`.

        InvalidValueError if there is no depth to imagine, or actions are none.
        """
        planned = planned_actions(actions, depth, self.n_actions)
        imagination = self.imagination
        encoder = self.perception.encoder
        start = self.perceive(frame).unsqueeze(0)  # [1, Z]
        generator = torch.Generator(start.device).manual_seed(int(rng.integers(2**63)))
        values: list[Tensor] = []

        def act(z: Tensor) -> Tensor:
            values.append(self.tested.values(z))  # [1, A]
            if planned is None:
                return values[-1].argmax(dim=-1)
            return torch.tensor([planned[len(values) - 1]], device=z.device)

        steps: list[RolloutStep] = []
        longest = depth if planned is None else len(planned)
        for each in imagination.unroll(start, act, imagination.draw_weights(generator), generator, longest, cut=False):
            steps.append(each)
            if planned is None and each.step.terminated:
                break
        imagined = [each.step for each in steps]
        latents = torch.cat([step.next_z for step in imagined])  # [D, Z]
        scores = [imagination.uncertainties(step) for step in imagined]
        return ImaginedRollout(
            actions=_joined([each.action for each in steps]),
            frames=encoder.decode(latents),
            start_frame=encoder.decode(start)[0],
            rewards=_joined([step.reward for step in imagined]),
            p_terminated=_joined([step.p_terminated for step in imagined]),
            q_values=_joined(values),
            accepted=np.logical_and.accumulate(_joined([each.kept for each in steps])),
            macrostates=encoder.read_macrostate(latents),
            **{name: _joined([score[name] for score in scores]) for name in UNCERTAINTIES},
        )

    def predict_outcomes(self, frames: Frame, rng: np.random.Generator) -> ExpectedOutcomes:
        """Average over :data:`_BRANCHES` imagined samples; see :class:`.capabilities.OutcomePredictor`."""
        imagination = self.imagination
        z = self.perception.encoder.encode(frames)[0]
        shape = (len(frames), self.n_actions, _BRANCHES)
        generator = torch.Generator(z.device).manual_seed(int(rng.integers(2**63)))
        action = torch.arange(self.n_actions, device=z.device).repeat_interleave(_BRANCHES).repeat(len(frames))
        z = z.repeat_interleave(self.n_actions * _BRANCHES, dim=0)
        weights = imagination.draw_weights(generator)
        samples = imagination.model.members * (1 if weights.dynamics is None else imagination.settings.weight_samples)
        size = max(1, _PREDICTIONS // samples)  # pieces fit the memory
        parts = zip(z.split(size), action.split(size), strict=True)
        steps = [imagination.step(*part, weights, generator) for part in parts]
        read = self.perception.encoder.read_macrostate(torch.cat([step.next_z for step in steps]))
        ended = _joined([step.terminated for step in steps])
        reward = _joined([step.reward.double() for step in steps])
        return ExpectedOutcomes(
            macrostates=read.reshape(*shape, -1),
            p_continues=(~ended).astype(np.float64).reshape(shape) / _BRANCHES,
            reward=reward.reshape(shape).mean(axis=2),
        )


def build(
    kind: type[_Kind],
    context: AgentContext,
    *,
    filtered: bool,
    hyperparameters: Hyperparameters[Any] = HYPERPARAMETERS,
) -> _Kind:
    """Make an imagining agent of a class, with or without the filter; its device decides an ``auto`` precision."""
    settings = hyperparameters.of(context)
    precision = settle(settings.model.precision, context.device)
    settings = replace(settings, model=replace(settings.model, precision=precision))
    device = prepare_torch(context.device)
    perception = load_perception(context)
    return kind(perception, context.n_actions, settings, context.seeds, device, filtered=filtered)


make = partial(build, ImaginingAgent, filtered=False)
"""The ``imagination`` agent: algorithm 1 without the filter."""
make_uncertainty = partial(build, ImaginingAgent, filtered=True)
"""The ``imagination_uncertainty`` agent: algorithm 1 with the filter."""


def _joined(parts: list[Tensor]) -> NDArray[Any]:
    """One array of the rows of several tensors."""
    return torch.cat(parts).cpu().numpy()
