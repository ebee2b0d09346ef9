"""The control ``dqn_swaps``: a DQN that also learns from real transitions with parts of others (CoDA).

Counterfactual data augmentation (Pitis, Creager & Garg 2020): factors of a code that an action does not touch are taken
from another transition, on both sides. These are the factors that the action was never seen to change. The reward and
end of the new transition are those that were seen of its next code; where none or several were, the real transition
stays. Its assumptions: touched factors change alike whatever the others are, and the outcome is decided by the next
code. Its control is the same DQN without swaps, ``dqn_codes``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from imagine_bench.agents import snapshot
from imagine_bench.agents.dqn import DQN
from imagine_bench.agents.encoders.perception import Perception, load_perception, prepare_torch
from imagine_bench.agents.replay import Batch, Transitions
from imagine_bench_factored.factors import Code
from torch import Tensor
from torch.nn import functional

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, AgentState, Transition
from imagine_bench.seeding import SeedTree

from .settings import SWAPPING, SwappingSettings

UNSURE = (0.0, -1.0)
"""Of a next code that had several outcomes."""


class SwappingDQN(DQN):
    """A DQN on codes of P factors, a share of whose batches has parts of other transitions."""

    settings: SwappingSettings

    def __init__(
        self, perception: Perception, n_actions: int, settings: SwappingSettings, seeds: SeedTree, device: torch.device
    ) -> None:
        super().__init__(perception, n_actions, settings, seeds, device)
        self._sizes = perception.encoder.card.code_sizes
        self.touched = torch.zeros(n_actions, len(self._sizes), dtype=torch.bool, device=device)
        self.outcomes: dict[Code, tuple[float, float]] = {}  #: reward and end by next code

    def store(self, transition: Transition) -> Tensor:
        """As of the DQN; and which factors the action changed, and its outcomes."""
        z = super().store(transition)
        then = self._codes(self.perception.posterior(transition.next_observation.frame)[0].unsqueeze(0))[0]
        self.touched[transition.action] |= self._codes(z.unsqueeze(0))[0] != then
        code = tuple(then.tolist())
        outcome = (transition.reward, float(transition.terminated))
        self.outcomes[code] = outcome if self.outcomes.get(code, outcome) == outcome else UNSURE
        return z

    def draw_batch(self, memory: Transitions) -> Batch:
        """Real transitions, the first of them with parts of others."""
        batch = super().draw_batch(memory)
        return self.swapped(batch, memory.sample(round(self.settings.swaps.share * len(batch.z)), self._replay).z)

    def swapped(self, batch: Batch, others: Tensor) -> Batch:
        """The batch, with untouched factors of its first N rows from ``others`` (N, Z), where the outcome is known."""
        count = len(others)
        before, after, theirs = map(self._codes, (batch.z[:count], batch.next_z[:count], others))
        touched = self.touched[batch.action[:count]]  # [N, P]
        before = torch.where(touched, before, theirs)
        after = torch.where(touched, after, theirs)
        outcomes = [self.outcomes.get(tuple(code), UNSURE) for code in after.tolist()]
        reward, ended = torch.tensor(outcomes, dtype=batch.reward.dtype, device=batch.z.device).reshape(-1, 2).T
        known = ended >= 0.0
        z = batch.z.clone()
        next_z = batch.next_z.clone()
        rewards = batch.reward.clone()
        ends = batch.terminated.clone()
        z[:count][known], next_z[:count][known] = self._latents(before[known]), self._latents(after[known])
        rewards[:count][known], ends[:count][known] = reward[known], ended[known]
        self.meters.add("swaps/known", float(known.sum()), count)
        return replace(batch, z=z, next_z=next_z, reward=rewards, terminated=ends)

    def _codes(self, latents: Tensor) -> Tensor:
        """Values of the factors of one-hot latents (N, Z). Shape (N, P)."""
        return torch.stack([part.argmax(dim=1) for part in latents.split(self._sizes, dim=1)], dim=1)

    def _latents(self, codes: Tensor) -> Tensor:
        """One-hot latents (N, Z) of codes (N, P)."""
        hot = [functional.one_hot(value, size) for value, size in zip(codes.T, self._sizes, strict=True)]
        return torch.cat(hot, dim=1).float()

    def state(self) -> AgentState:
        """A snapshot, with the knowledge of factors and outcomes."""
        state = super().state()
        factors = len(self._sizes)
        known = {
            "touched": self.touched.cpu().numpy().copy(),
            "code": np.array(list(self.outcomes), dtype=np.int64).reshape(-1, factors),
            "outcome": np.array(list(self.outcomes.values()), dtype=np.float64).reshape(-1, 2),
        }
        state.arrays.update(snapshot.prefixed("table", known))
        return state

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        super().restore(state)
        known = snapshot.below("table", state.arrays)
        self.touched = torch.tensor(known["touched"], device=self.touched.device)
        pairs = zip(known["code"].tolist(), known["outcome"].tolist(), strict=True)
        self.outcomes = {tuple(code): (reward, ended) for code, (reward, ended) in pairs}


def make(context: AgentContext) -> SwappingDQN:
    """The ``dqn_swaps`` agent; InvalidValueError if the context's encoder gives no codes."""
    settings = SWAPPING.of(context)
    device = prepare_torch(context.device)
    perception = load_perception(context)
    if not perception.encoder.card.code_sizes:
        raise InvalidValueError(
            "This agent swaps factors of codes, and the encoder gives continuous latents; give one made with "
            "`imagine-bench encoder --recipe codes`."
        )
    return SwappingDQN(perception, context.n_actions, settings, context.seeds, device)
