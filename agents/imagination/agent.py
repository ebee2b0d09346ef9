"""The thesis' agents: a DQN fed by imagination, without and with the epistemic filter."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.capabilities import Follow, ImaginedRollout, SampledFutures, planned_actions
from imagine_bench.interfaces import AgentContext, Frame

from ..controller import Controller
from ..encoders.perception import load_perception, prepare_torch
from ..learner import Learner
from ..meters import Meters
from ..presets import settings_of
from .futures import sample_futures
from .rollouts import TERMINAL, Imagination, Imagined
from .uncertainty import decompose

_Kind = TypeVar("_Kind", bound="ImaginingLearner")


class ImaginingLearner(Learner):
    """A learner whose imagination can be looked at."""

    imagination: Imagination

    def reset_for_new_task(self) -> None:
        """Keep the network of the dynamics; see :class:`imagine_bench.capabilities.TransferLearner`.

        Reward, termination, controller, memories and the schedule of exploration begin anew.
        """
        self.imagination.reset_for_new_task()
        size, settings = self.perception.latent_size, self.settings.controller
        self.controller = Controller(size, self.n_actions, settings, self._replay)  # a generator that snapshots hold
        self.real.clear()
        self.meters = Meters()  # what was measured on an earlier task is no diagnosis of this one
        self.steps = 0

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        """Imagine up to ``depth`` transitions from ``frame``; see :class:`imagine_bench.capabilities.Imaginer`.

        Raises:
            InvalidValueError: No depth to imagine, or actions that are none.
        """
        planned = planned_actions(actions, depth, self.n_actions)
        start, _ = self.perception.posterior(frame)
        steps = list(self._unroll(start.unsqueeze(0), planned, depth, rng))
        return self._picture(start.unsqueeze(0), steps)

    def sample_futures(
        self,
        frames: Frame,
        actions: NDArray[np.int64],
        *,
        follow: Follow,
        samples: int,
        depth: int,
        rng: np.random.Generator,
    ) -> SampledFutures:
        """Imagine many futures of the same beginnings; see :class:`imagine_bench.capabilities.FutureSampler`."""
        encoder = self.perception.encoder
        return sample_futures(
            self.imagination, encoder, frames, actions, follow=follow, samples=samples, depth=depth, rng=rng
        )

    def predict_map(self, frames: Frame, actions: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
        """The likeliest results of actions; see :class:`imagine_bench.capabilities.MapPredictor`."""
        z = torch.stack([self.perception.posterior(frame)[0] for frame in frames])  # [N, Z]
        weights = self.imagination.draw_weights(torch.Generator(z.device).manual_seed(int(rng.integers(2**63))))
        likeliest = self.imagination.likeliest(z, torch.as_tensor(actions, device=z.device), weights)
        return self.perception.encoder.read_macrostate(likeliest)

    def replayed(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """What the real memory holds; see :class:`imagine_bench.capabilities.ReplayReader`."""
        rows = self.real.arrays()
        return self.perception.encoder.read_macrostate(torch.as_tensor(rows["mu"])), rows["action"].astype(np.int64)

    def _unroll(
        self, z: Tensor, planned: list[int] | None, depth: int, rng: np.random.Generator
    ) -> Iterator[tuple[Tensor, Tensor, Imagined]]:
        """Values before, action and result of each imagined step, one rollout."""
        generator = torch.Generator(z.device).manual_seed(int(rng.integers(2**63)))
        weights = self.imagination.draw_weights(generator)
        for index in range(depth if planned is None else len(planned)):
            values = self.tested.values(z)  # [1, A]
            action = values.argmax(dim=-1) if planned is None else torch.tensor([planned[index]], device=z.device)
            step = self.imagination.step(z, action, weights, generator)
            yield values, action, step
            if planned is None and float(step.p_terminated) > TERMINAL:
                return
            z = step.next_z

    def _picture(self, start: Tensor, steps: list[tuple[Tensor, Tensor, Imagined]]) -> ImaginedRollout:
        values, actions, imagined = zip(*steps, strict=True)
        encoder, imagination = self.perception.encoder, self.imagination
        latents = torch.cat([step.next_z for step in imagined])  # [D, Z]
        kept = torch.cat([imagination.keeps(step) for step in imagined]).cpu().numpy()  # [D]

        doubts = [decompose(step.samples) for step in imagined]

        def reduced(cause: str) -> NDArray[np.float32]:
            return torch.cat([imagination.score(getattr(doubt, cause)) for doubt in doubts]).cpu().numpy()

        return ImaginedRollout(
            actions=torch.cat(actions).cpu().numpy(),
            frames=encoder.decode(latents),
            start_frame=encoder.decode(start)[0],
            rewards=torch.cat([step.reward for step in imagined]).cpu().numpy(),
            p_terminated=torch.cat([step.p_terminated for step in imagined]).cpu().numpy(),
            q_values=torch.cat(values).cpu().numpy(),
            epistemic=reduced("epistemic"),
            aleatoric=reduced("aleatoric"),
            modal=reduced("modal"),
            accepted=np.logical_and.accumulate(kept),
            macrostates=encoder.read_macrostate(latents),
        )


def build(kind: type[_Kind], context: AgentContext, *, filtered: bool) -> _Kind:
    """An imagining learner of a kind, with or without the filter."""
    settings = settings_of(context)
    device, perception = prepare_torch(context.device), load_perception(context)
    imagination = Imagination(
        perception.latent_size,
        context.n_actions,
        settings,
        filtered=filtered,
        seeds=context.seeds.child("imagination"),
        device=device,
    )
    return kind(perception, context.n_actions, settings, context.seeds, device, imagination)


def make(context: AgentContext) -> ImaginingLearner:
    """The ``imagination`` agent: algorithm 1 without the filter."""
    return build(ImaginingLearner, context, filtered=False)


def make_uncertainty(context: AgentContext) -> ImaginingLearner:
    """The ``imagination_uncertainty`` agent: algorithm 1 with the filter."""
    return build(ImaginingLearner, context, filtered=True)
