"""LeWM (Maes et al. 2026) of torch-world: a world model of pixels in latents, and plans toward frames that paid most.

It learns no reward. A goal is a frame at which a transition earned the most that any did; plans lead to the nearest.
Macro-actions are few, so all sequences are priced where the paper samples some (cross-entropy method).
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import torch
from imagine_bench.agents import snapshot
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.meters import Meters
from imagine_bench.agents.networks.allocator import release_freed_memory
from imagine_bench.agents.settings import flatten
from numpy.typing import NDArray
from torch import Tensor, nn
from torch_world.losses import SIGReg
from torch_world.models import LeWM
from torch_world.nn import CLSEncoder
from torch_world.utils import recompute_batchnorm

from imagine_bench.interfaces import AgentContext, AgentState, Frame, Observation, Transition

from .global_rng_scope import GlobalRngScope
from .lewm_settings import HYPERPARAMETERS, LeWMSettings

_RELEASED_EVERY = 50
"""Updates after which freed memory goes back to the system.

An update takes and frees some 200 MB. Frames that are kept lie between freed blocks, so the C library asks for more and
more: a run reached 20 GB.
"""
_ROW = {"frame": ((64, 64, 3), np.uint8), "action": ((), np.int64), "next_frame": ((64, 64, 3), np.uint8)}


class LeWMPlanner:
    """One LeWM learner, for one run.

    Args:
        settings: Sizes, rates and counts.
        n_actions: Number of macro-actions A.
        seed: Of all draws.
        device: ``"cpu"`` or ``"cuda"``.
    """

    def __init__(self, settings: LeWMSettings, n_actions: int, seed: int, device: str) -> None:
        self.settings = settings
        self.n_actions = n_actions
        self._device = device
        self._random = GlobalRngScope(seed, device)
        self._rng = np.random.default_rng([seed, 1])
        with self._random.active():
            self.network = _network(settings, n_actions).to(device).eval()
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=True
        )
        sequences = torch.tensor(list(product(range(n_actions), repeat=settings.horizon)))  # [S, H]
        self._first = sequences[:, 0].tolist()
        self._sequences = nn.functional.one_hot(sequences, n_actions).float().to(device)  # [S, H, A]
        self.rows: dict[str, list[Any]] = {name: [] for name in _ROW}
        self.goals: list[Frame] = []
        self.goal_latents: Tensor | None = None  # latents of the goals (G, D), until these or the model change
        self._most = -np.inf  # earned by a transition
        self.meters = Meters()
        self.steps = self.updates = 0
        self._owed = 0.0  # updates
        self._acted = False

    def begin_episode(self) -> None:
        """Nothing is remembered within an episode."""

    def act(self, observation: Observation, *, explore: bool) -> int:
        """The first macro-action of the best plan; while exploring and where there is no goal yet, often a random one.

        Without a goal a test takes macro-action 0.
        """
        settings = self.settings
        self._acted = explore
        if explore:
            left = max(0.0, 1.0 - self.steps / settings.exploration_steps)
            epsilon = settings.exploration_final_eps + left * (1.0 - settings.exploration_final_eps)
            if not self.goals or self.updates == 0 or self._rng.random() < epsilon:
                return int(self._rng.integers(self.n_actions))
        return self._planned(observation.frame) if self.goals else 0

    @torch.no_grad()
    def _planned(self, frame: Frame) -> int:
        """The first macro-action of the sequence that stays nearest to a goal, from its step of arrival as if at rest.

        That is the library's objective of a path, whose mean distance counts, of an episode that arrives at any step.
        """
        if self.goal_latents is None:
            self.goal_latents = self.network.encode(self._pixels(self.goals))[:, 0]
        start = self.network.encode(self._pixels([frame]))
        path = self.network.rollout(start.expand(len(self._sequences), -1, -1), self._sequences)[:, 1:]  # [S, H, D]
        apart = torch.cdist(path.flatten(0, 1), self.goal_latents).square().unflatten(0, path.shape[:2])  # [S, H, G]
        rest = torch.arange(path.shape[1] - 1, -1, -1, device=apart.device)[:, None]  # [H, 1]
        return self._first[int((apart.cumsum(dim=1) + rest * apart).flatten(1).amin(dim=1).argmin())]

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Remember the transition, and update the networks as often as the replay ratio says.

        Acting and updates draw from the same generator, so a transition that was only shown takes the draws of an act,
        too: it then teaches as much as one of its own.
        """
        if not self._acted:
            self.act(transition.observation, explore=True)
        self._acted = False
        frame = transition.observation.frame
        following = transition.next_observation.frame
        for name, value in zip(_ROW, (frame, transition.action, following), strict=True):
            self.rows[name].append(value)
            del self.rows[name][: -self.settings.buffer_size]
        if transition.reward > self._most:
            self._most = transition.reward
            self.goals = []
        if transition.reward == self._most:
            self.goals = [*self.goals, following][-self.settings.goals :]
            self.goal_latents = None
        self.steps += 1
        if self.steps >= self.settings.learning_starts:
            self._owed += self.settings.replay_ratio
            with self.meters.cpu_time("time/updates_s"):
                for _ in range(int(self._owed)):
                    self._update()
            self._owed %= 1.0
        self.meters.count("time/updates_s")

    def _update(self) -> None:
        rows = self._rng.integers(len(self.rows["action"]), size=self.settings.batch_size).tolist()
        frames, actions, following = ([kept[row] for row in rows] for kept in self.rows.values())
        pixels = torch.cat([self._pixels(frames), self._pixels(following)], dim=1)  # [B, 2, 3, 64, 64]
        taken = nn.functional.one_hot(torch.tensor(actions, device=self._device), self.n_actions).float()
        batch = pixels, taken.unsqueeze(1)
        with self._random.active():
            losses = self.network.train()(*batch)
            self._optimiser.zero_grad()
            losses["loss"].backward()
            self._optimiser.step()
            with torch.no_grad():
                recompute_batchnorm(self.network.eval(), [batch], lambda each: self.network(*each))
        for name in ("pred_loss", "sigreg_loss"):
            self.meters.add(f"loss/{name.removesuffix('_loss')}", losses[name].item())
        self.updates = self.updates + 1
        self.goal_latents = None
        if self.updates % _RELEASED_EVERY == 0:
            release_freed_memory()

    def _pixels(self, frames: list[Frame]) -> Tensor:
        """The model's input for N frames. Shape (N, 1, 3, 64, 64), in [0, 1]."""
        return torch.tensor(np.array(frames), device=self._device).movedim(-1, 1).unsqueeze(1).float() / 255.0

    def diagnostics(self) -> dict[str, float]:
        """Mean losses and CPU seconds of updates a macro-action since the last call, and the counters now."""
        return {**self.meters.read(), "real_transitions": float(self.steps), "gradient_updates": float(self.updates)}

    def state(self) -> AgentState:
        """A snapshot between two episodes: weights, statistics, replay, goals, generator, counters."""
        arrays = snapshot.prefixed("model", snapshot.training_arrays(self.network, self._optimiser))
        arrays |= {f"buffer/{name}": value.cpu().numpy().copy() for name, value in self.network.named_buffers()}
        frames: dict[str, NDArray[Any]] = {
            f"replay/{name}": np.array(self.rows[name], dtype).reshape(-1, *shape)
            for name, (shape, dtype) in _ROW.items()
        }
        frames["generator"] = self._random.state.numpy().copy()
        frames["replay/goals"] = np.array(self.goals, np.uint8).reshape(-1, 64, 64, 3)
        values = {
            "steps": self.steps, "updates": self.updates, "owed": self._owed, "meters": self.meters.state(),
            "most": None if self._most == -np.inf else self._most, "exploration": self._rng.bit_generator.state,
            "settings": snapshot.jsonable(flatten(self.settings)),
        }  # fmt: skip
        return AgentState(arrays=arrays | frames, values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot; ArtefactError if it does not fit this agent, and then nothing was changed."""
        snapshot.require_fit(state, self.state())
        arrays = state.arrays
        values = state.values
        snapshot.load_training(self.network, self._optimiser, snapshot.below("model", arrays))
        for name, value in self.network.named_buffers():
            value.copy_(torch.tensor(arrays[f"buffer/{name}"]))
        self.rows = {name: list(arrays[f"replay/{name}"]) for name in _ROW}
        self.goals = list(arrays["replay/goals"])
        self.goal_latents = None
        self._most = -np.inf if values["most"] is None else values["most"]
        self._random.state = torch.tensor(arrays["generator"])
        self._rng.bit_generator.state = values["exploration"]
        self.meters.restore(values["meters"])
        self.steps = values["steps"]
        self.updates = values["updates"]
        self._owed = values["owed"]


def _network(settings: LeWMSettings, n_actions: int) -> LeWM:
    """The library's model with new weights; a frame shows all there is to know, so its history is 1."""
    model = settings.model
    encoder = CLSEncoder(
        64, model.patch, embed_dim=model.embedding, depth=model.encoder_depth, num_heads=model.encoder_heads
    )
    return LeWM(
        encoder, n_actions, embed_dim=model.embedding, history=1, depth=model.predictor_depth,
        num_heads=model.predictor_heads, mlp_dim=model.units, proj_dim=model.units, dropout=model.dropout,
        lamb=settings.regularisation, sigreg=SIGReg(model.slices),
    )  # fmt: skip


def make(context: AgentContext) -> LeWMPlanner:
    """The ``lewm`` agent."""
    prepare_torch(context.device)
    settings = HYPERPARAMETERS.of(context)
    return LeWMPlanner(settings, context.n_actions, context.seeds.child("library").integer(), context.device)
