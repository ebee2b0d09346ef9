"""The thesis' VAE on patched images, on a CPU: it starts from the weights of the VAE of plain images.

python patched_vae.py encoders/patched_vae.safetensors --steps 1200

The same command goes on after an interruption. It computes in float32, since the result in bfloat16 depends on the
processor: on one that has instructions for bfloat16 a classifier read 31 % of new frames, and 69 % after float32.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import torch
from imagine_bench.agents.encoders import training
from imagine_bench.agents.encoders.encoder import Encoder, EncoderCard
from imagine_bench.agents.encoders.probe import Probe, accuracy, train_probe
from imagine_bench.agents.encoders.recipes import Recipe, recipe_named
from imagine_bench.agents.encoders.training import FrameSet, Unfinished
from imagine_bench.agents.encoders.vae import Vae, build_vae
from imagine_bench.agents.networks.mlp import initialise
from torch import Tensor

from imagine_bench import registry
from imagine_bench.appearance import appearance_name
from imagine_bench.interfaces import TaskSpec, appearance_of_tests
from imagine_bench.seeding import SeedTree
from imagine_bench.store.files import sha256

START = Path("docs/results/arrow_puzzle-thesis-vae/arrow_puzzle-clean.safetensors")
FRAMES = 24_000
HELD_OUT_FRAMES = 2000
PROBE_STEPS = 2000
SEED = 1000  # of the frames
TORCH_SEED = 1030  # of the order of the frames and of the noise
FIRST = (199, 100, 5e-4)  # steps, frames a step and learning rate of a first trial, which the rest goes on from
BATCH = 50
LEARNING_RATE = 7e-4  # at the second phase's begin; it falls to 0 along a half cosine
RISE = 50  # steps over which the first learning rate rises


def frames_of(spec: TaskSpec, appearance: str, n: int, branch: str) -> FrameSet:
    seeds = SeedTree(SEED).child(branch, spec.id, appearance_name("patched"))
    return training.frame_set(spec, appearance, n, seeds.generator(), lambda stage, done: None)


def schedule(step: int, steps: int) -> tuple[int, float]:
    """Frames and learning rate of a step, where ``steps`` follow the first trial."""
    trial, batch, rate = FIRST
    if step < trial:
        return batch, rate * min(1.0, (step + 1) / RISE)
    return BATCH, LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * (step - trial) / steps))


def loss_of(vae: Vae, images: Tensor, noise: Tensor, beta: float) -> Tensor:
    """As Vae.elbo, with frames in the memory order that makes them cheap on a CPU."""
    target = vae.target(images).contiguous(memory_format=torch.channels_last)
    mu, log_variance = vae.posterior(target)
    generated = vae.generate(mu + (0.5 * log_variance).exp() * noise)
    return vae.log_loss(generated, target).mean() + beta * vae.information(mu, log_variance)


def train(vae: Vae, data: FrameSet, recipe: Recipe, steps: int, generator: torch.Generator, kept: Unfinished) -> float:
    """Train in place, go on from the state kept if there is one, and return the CPU seconds spent."""
    optimiser = torch.optim.Adam(vae.parameters(), lr=LEARNING_RATE, fused=True)
    order = torch.empty(0, dtype=torch.int64)
    step, seen, spent = 0, 0, 0.0
    state = kept.load()
    if state is not None:
        vae.load_state_dict(state["vae"])
        optimiser.load_state_dict(state["opt"])
        generator.set_state(state["g"])
        order, step, seen, spent = state["order"], state["step"], state["frames"], state["spent"]
    begun_s = time.process_time() - spent
    while step < FIRST[0] + steps:
        batch, rate = schedule(step, steps)
        if len(order) < batch:
            order = torch.randperm(len(data.images), generator=generator)
        rows, order = order[:batch], order[batch:]
        optimiser.param_groups[0]["lr"] = rate
        optimiser.zero_grad()
        noise = torch.randn(batch, vae.latent_size, generator=generator)
        loss = loss_of(vae, data.batch(rows), noise, recipe.beta)
        loss.backward()
        optimiser.step()
        step += 1
        seen += batch
        if kept.due() or step == FIRST[0] + steps:
            spent = time.process_time() - begun_s
            learned = {"vae": vae.state_dict(), "opt": optimiser.state_dict(), "g": generator.get_state()}
            kept.save({**learned, "order": order, "step": step, "frames": seen, "spent": spent})
            print(f"step {step}, {seen:,} frames, {spent:.0f} CPU s, loss {loss.item():.1f}", flush=True)
    return spent


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--start", type=Path, default=START)
    parser.add_argument("--steps", type=int, default=1200)
    options = parser.parse_args(arguments)
    training.prepare_torch("cpu")
    spec = registry.task("arrow_puzzle")
    thesis = recipe_named("thesis", spec.config_group)
    recipe = replace(thesis, frames=FRAMES, held_out_frames=HELD_OUT_FRAMES, probe_steps=PROBE_STEPS)
    recipe = replace(recipe, steps=FIRST[0] + options.steps, batch=BATCH, learning_rate=LEARNING_RATE)
    data = frames_of(spec, appearance_name("patched"), recipe.frames, "encoder_training")
    held_out = frames_of(spec, appearance_of_tests(appearance_name("patched")), recipe.held_out_frames, "encoder_probe")
    generator = torch.Generator().manual_seed(TORCH_SEED)
    vae = build_vae(recipe, spec.preprocessing)
    initialise(vae, generator)
    vae.load_state_dict(Encoder.load(options.start).network.state_dict())
    vae = vae.to(memory_format=torch.channels_last)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    kept = options.out.with_suffix(".unfinished")
    what = f"patched VAE from {sha256(options.start)}, {recipe}"
    spent_s = train(vae, data, recipe, options.steps, generator, Unfinished(kept, what))
    encoder = measured(vae, spec, recipe, data, held_out, start=options.start, spent_s=spent_s)
    encoder.save(options.out)
    kept.unlink(missing_ok=True)
    print(f"{options.out}: {100 * encoder.card.probe['mlp']:.1f} % of {recipe.held_out_frames:,} new frames are read")


@torch.no_grad()
def rounded(network: torch.nn.Module) -> None:
    """Round the weights to the float16 that the file stores."""
    for value in network.state_dict().values():
        value.copy_(value.half())


def measured(
    vae: Vae, spec: TaskSpec, recipe: Recipe, data: FrameSet, held_out: FrameSet, *, start: Path, spent_s: float
) -> Encoder:
    """The encoder with its probe, fitted on training frames, and its card, measured on frames of other fragments."""
    vae = vae.to(memory_format=torch.contiguous_format)
    rounded(vae)
    latents = training.latents_of(vae, data)
    new = training.latents_of(vae, held_out)
    readers = {}
    for name, hidden in (("linear", 0), ("mlp", 256)):
        probe = Probe(vae.latent_size, training.classes_of(spec), hidden=hidden)
        generator = torch.Generator().manual_seed(TORCH_SEED)
        train_probe(probe, latents, data.macrostates, steps=recipe.probe_steps, generator=generator)
        rounded(probe)
        readers[name] = probe
    read = {name: accuracy(probe, new.mu, held_out.macrostates) for name, probe in readers.items()}
    sampled = new.sample(torch.Generator().manual_seed(TORCH_SEED))
    card = EncoderCard(
        task=spec.id,
        appearance=appearance_name("patched"),
        recipe=recipe,
        preprocessing=spec.preprocessing,
        latent_size=vae.latent_size,
        macrostate_names=spec.macrostate_names,
        cardinalities=training.classes_of(spec),
        seed=SEED,
        command=f"python docs/examples/patched_vae.py OUT --start {start} --steps {recipe.steps - FIRST[0]}",
        data=f"{recipe.frames} training and {recipe.held_out_frames} held-out frames; start: weights of {start.name}",
        versions={name: version(name) for name in ("torch", "numpy", "mujoco")},
        cpu_s={"total": round(spent_s, 1)},
        kl_nats=round(vae.information(new.mu, 2.0 * new.sigma.log()).item(), 3),
        reconstruction=error(vae, held_out, new.mu),
        probe={**read, "mlp_sampled": accuracy(readers["mlp"], sampled, held_out.macrostates)},
    )
    return Encoder(vae, readers["mlp"], card)


@torch.no_grad()
def error(vae: Vae, data: FrameSet, mu: Tensor) -> float:
    """Squared error of the decoded frames, mean a pixel."""
    parts = torch.arange(len(mu)).split(500)
    squared = [(vae.mean(mu[rows]) - vae.target(data.batch(rows))).square().mean(dim=(1, 2, 3)) for rows in parts]
    return torch.cat(squared).mean().item()


if __name__ == "__main__":
    main()
