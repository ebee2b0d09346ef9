"""Initial weights from a passed generator: torch's own constructors draw from the global one."""

from __future__ import annotations

import math

import torch
from torch import nn


def initialise(network: nn.Module, generator: torch.Generator) -> None:
    """Draw every linear and convolutional weight and bias from U(-1/sqrt(fan_in), 1/sqrt(fan_in)), torch's default law.

    Other modules are left alone. The generator must be on the network's device.
    """
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
                bound = 1.0 / math.sqrt(module.weight[0].numel())
                module.weight.uniform_(-bound, bound, generator=generator)
                if module.bias is not None:
                    module.bias.uniform_(-bound, bound, generator=generator)
