"""The baseline: a DQN on latents that learns from real transitions alone."""

from __future__ import annotations

from imagine_bench.interfaces import AgentContext

from .encoders.perception import load_perception, prepare_torch
from .learner import Learner
from .presets import settings_of


def make(context: AgentContext) -> Learner:
    """The ``dqn`` agent."""
    settings = settings_of(context)
    device = prepare_torch(context.device)
    return Learner(load_perception(context), context.n_actions, settings, context.seeds, device)
