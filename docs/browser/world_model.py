"""The world model that imagines in the browser: trained here, rounded to 16 bits, written for ``page/model.js``."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.world_models.latent import LatentModel, make_ensemble
from PIL import Image
from torch import Tensor, nn

from imagine_bench import registry
from imagine_bench.arrays import Floats32, Frame
from imagine_bench.interfaces import AgentContext
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders

TASK = "arrow_puzzle"
ENCODER = "arrow_puzzle-clean"
EPISODES = 1_000
SEED = 400
COLUMNS = 16
"""Frames side by side in the atlas of all macrostates."""


def untrained(seed: int) -> LatentModel:
    """Three networks that predict latents of the bundled encoder, with random weights."""
    spec = registry.task(TASK)
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=encoders.bundled()[ENCODER],
        seeds=SeedTree(seed).child("browser"),
    )
    return make_ensemble(context)


def trained(seed: int = SEED, episodes: int = EPISODES) -> LatentModel:
    """The same, once it has learned from random play."""
    spec = registry.task(TASK)
    found, _, _ = collect(
        spec, policy_of("random", spec, seed), episodes=episodes, seed=seed, execution="kinematic", appearance="clean"
    )
    model = untrained(seed)
    model.fit(found, SeedTree(seed).child("fit").generator())
    return model


@torch.no_grad()
def rounded(model: LatentModel) -> LatentModel:
    """The model with every weight as a 16-bit float holds it, in place."""
    for network in (model.encoder.network, model.imagination.model):
        for value in network.parameters():
            value.copy_(value.half().float())
    return model


def _linear(network: nn.Module) -> tuple[list[int], list[Tensor]]:
    """Sizes of a chain of dense layers, and its weights, each (in, out), and biases, in turn."""
    layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
    tensors = [each for layer in layers for each in (layer.weight.T, layer.bias)]
    return [layers[0].in_features, *(layer.out_features for layer in layers)], tensors


def _members(network: nn.Module, member: int) -> tuple[list[int], list[Tensor]]:
    """The same of one member of networks that are evaluated as one."""
    pairs = list(zip(network.weights, network.biases, strict=True))
    tensors = [each for weight, bias in pairs for each in (weight[member], bias[member, 0])]
    return list(network.sizes), tensors


def packed(model: LatentModel) -> bytes:
    """The file of the page: length of the header, JSON header, 16-bit floats."""
    network = model.encoder.network
    world = model.imagination.model
    settings = world.settings
    encoder, tensors = _linear(network.encoder)
    decoder, more = _linear(network.decoder)
    tensors += more
    members = []
    for member in range(settings.members):
        sizes, more = _members(world.dynamics, member)
        members.append(sizes)
        tensors += more
    heads = []
    for head in world.head.networks:
        sizes, more = _members(head, 0)
        heads.append(sizes)
        tensors += more
    header = {
        "encoder": encoder, "decoder": decoder, "members": members, "reward": heads[0], "termination": heads[1],
        "brightness": float(network.brightness), "contrast": float(network.contrast),
        "components": settings.components, "actions": world.n_actions,
        "predict_change": settings.predict_change, "reward_scale": settings.reward_scale,
        "episodes": EPISODES, "seed": SEED,
    }  # fmt: skip
    head_bytes = json.dumps(header).encode()
    head_bytes += b" " * (len(head_bytes) % 2)  # so that the floats begin at an even byte
    body = b"".join(tensor.detach().contiguous().numpy().astype("<f2").tobytes() for tensor in tensors)
    return struct.pack("<I", len(head_bytes)) + head_bytes + body


@torch.no_grad()
def expected(model: LatentModel, frame: Frame, action: int) -> dict[str, Floats32 | float]:
    """The model's own answer about one frame (64, 64, 3), by torch: the numbers that the page must give, too."""
    z = model.encoder.encode(frame[None])[0]
    world = model.imagination.model
    asked = torch.tensor([action])
    means = mdn.mean(world.predict(z, asked, None))[:, 0]  # [E, Z]
    after = means.mean(dim=0)
    reward, ends = world.predict_outcome(z, asked, after[None])
    return {
        "latents": z[0].numpy(),
        "next": after.numpy(),
        "disagreement": float(means.var(dim=0, correction=0).sum()),
        "reward": float(reward[0]),
        "ends": float(ends[0]),
        "image": model.encoder.decode(after[None])[0],
    }


def frames() -> Frame:
    """A clean frame of every macrostate of the puzzle, in the order of the rules. Shape (192, 64, 64, 3)."""
    spec = registry.task(TASK)
    return spec.render_macrostates(np.array(spec.rules.states), "clean", np.random.default_rng(SEED))


def write(folder: Path) -> None:
    """Train, and write ``model.bin`` and ``frames.png``."""
    (folder / "model.bin").write_bytes(packed(rounded(trained())))
    images = frames().reshape(-1, COLUMNS, 64, 64, 3)
    atlas = images.swapaxes(1, 2).reshape(-1, 64 * COLUMNS, 3)
    Image.fromarray(atlas).save(folder / "frames.png", optimize=True)
