"""Another reading of the thesis' max-norm: the weights of a whole layer have a norm of at most 3, not those of a unit.

"The norm of the weights in each layer" (thesis 5.2.2) can mean either. The suite reads it per unit, as Keras does. This
world model is ``mdn_thesis`` with the other reading.
"""

from __future__ import annotations

import torch
from imagine_bench.agents.encoders.perception import load_perception, prepare_torch
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import HYPERPARAMETERS, Settings
from imagine_bench.agents.imagination.world_model import EnvironmentModel
from imagine_bench.agents.world_models.latent import LatentModel
from torch import Tensor

from imagine_bench.interfaces import AgentContext


@torch.no_grad()
def limit_layer_norm(weights: Tensor, limit: float) -> None:
    """Scale each member's weight matrix of a layer, shape (E, in, out), to a Frobenius norm of at most ``limit``."""
    norms = weights.square().sum(dim=(1, 2), keepdim=True).sqrt()
    weights.mul_((limit / norms.clamp_min(1e-12)).clamp_max(1.0))


class WholeLayerModel(EnvironmentModel):
    """The thesis' environment model, whose layers are limited as a whole."""

    def limit_norms(self, limit: float) -> None:
        """Scale the weights of each layer of each network down to a norm of at most ``limit``."""
        for network in self.networks:
            for weights in network.weights:
                limit_layer_norm(weights, limit)


class WholeLayerImagination(Imagination):
    """Imagination with such a model."""

    def new_model(self, state_size: int, n_actions: int, settings: Settings) -> EnvironmentModel:
        """A world model that has learned nothing, of states of so many numbers."""
        return WholeLayerModel(state_size, n_actions, settings.model, self.generators["weights"])


class WholeLayerLatentModel(LatentModel):
    """Encoder, such a model and decoder as a world model."""

    imagination_kind = WholeLayerImagination


def make(context: AgentContext) -> WholeLayerLatentModel:
    """At the settings that the thesis prints, as ``mdn_thesis``."""
    settings = HYPERPARAMETERS.resolve("published", context.overrides, context.config_group)
    prepare_torch(context.device)
    return WholeLayerLatentModel(load_perception(context).encoder, settings, context)
