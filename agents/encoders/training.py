"""Make an encoder: render frames, train the VAE or discover the factors, fit the evaluation-only probe, measure.

Every measurement is on fresh frames.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.appearance import appearance_name
from imagine_bench.errors import DivergedError
from imagine_bench.interfaces import Frame, TaskSpec, appearance_of_tests
from imagine_bench.preprocessing import preprocess
from imagine_bench.rules import states_of
from imagine_bench.seeding import SeedTree

from ..networks.weights import initialise
from .discrete_encoder import DiscreteEncoder, discover
from .encoder import PROBE_HIDDEN, Encoder, EncoderCard, empty_probe, empty_vae, image_shape
from .network import EncoderNetwork
from .perception import prepare_torch
from .probe import Latents, Probe, accuracy, train_probe
from .recipes import RECIPES, Recipe, recipe_named
from .unfinished import Kept, Unfinished
from .vae import MlpVae, Vae

Progress = Callable[[str, float], None]
"""Told the stage (``"frames"``, ``"training"``, ``"probe"``) and the fraction of it that is done."""

_CHUNK = 500  # frames rendered at once, to bound memory
_PART = 250  # images whose gradients are added up: 2000 at once leave the processor's caches
_CHECK_EVERY = 50  # steps between checks for NaN
_RISE = 0.02  # fraction of the steps over which the learning rate rises
_LIBRARIES = ("torch", "numpy", "mujoco")


@dataclass(frozen=True, kw_only=True)
class FrameSet:
    """Labelled frames: images (N, C, H, W), preprocessed, uint8 to quarter the memory; macrostates (N, M)."""

    images: Tensor
    macrostates: NDArray[np.int64]

    def batch(self, rows: Tensor) -> Tensor:
        """The images of ``rows`` (B,) in [0, 1]. Shape (B, C, H, W)."""
        return self.images[rows].float() / 255.0


def shown_states(spec: TaskSpec) -> NDArray[np.int64]:
    """Return everything that frames of a task may show: every macrostate, with -1 for hidden coordinates."""
    states = states_of(spec.rules)
    sight = spec.sight
    seen = [] if sight is None else [what for step in (0, 1) for s in states for _, what in sight.seen(s, step)]
    return np.array(list(dict.fromkeys((*states, *seen))), dtype=np.int64)


def classes_of(spec: TaskSpec) -> tuple[int, ...]:
    """How many values each coordinate shows; one more, the last, where it may be hidden. Length M."""
    hidden = [bool(lowest < 0) for lowest in shown_states(spec).min(axis=0)]
    return tuple(len(values) + also for values, also in zip(spec.macrostate_values, hidden, strict=True))


def draw_frames(spec: TaskSpec, appearance: str, n: int, rng: np.random.Generator) -> tuple[Frame, NDArray[np.int64]]:
    """Frames (n, 64, 64, 3) of macrostates drawn uniformly from all that frames show, and their classes (n, M)."""
    states = shown_states(spec)
    macrostates = states[rng.integers(len(states), size=n)]
    return spec.render_macrostates(macrostates, appearance, rng), macrostates % classes_of(spec)


def frame_set(spec: TaskSpec, appearance: str, n: int, rng: np.random.Generator, progress: Progress) -> FrameSet:
    """Render ``n`` labelled frames of uniformly drawn macrostates."""
    prepare = preprocess(spec.preprocessing)
    images: list[Tensor] = []
    labels: list[NDArray[np.int64]] = []
    for start in range(0, n, _CHUNK):
        frames, macrostates = draw_frames(spec, appearance, min(_CHUNK, n - start), rng)
        images.append(torch.from_numpy(np.rint(prepare(frames) * 255.0).astype(np.uint8)))
        labels.append(macrostates)
        progress("frames", min(start + _CHUNK, n) / n)
    return FrameSet(images=torch.cat(images), macrostates=np.concatenate(labels))


def beta_at(recipe: Recipe, step: int) -> float:
    """The KL weight of a gradient step: rises linearly from 0, then constant."""
    warmup = recipe.kl_warmup * recipe.steps
    return recipe.beta * min(1.0, step / warmup) if warmup else recipe.beta


def learning_rate_at(recipe: Recipe, step: int) -> float:
    """The learning rate of a gradient step."""
    if not recipe.cosine:
        return recipe.learning_rate
    done = step / recipe.steps
    return recipe.learning_rate * min(1.0, (done + 1e-3) / _RISE) * 0.5 * (1.0 + math.cos(math.pi * done))


def train_vae(
    vae: Vae,
    data: FrameSet,
    recipe: Recipe,
    generator: torch.Generator,
    progress: Progress,
    unfinished: Unfinished | None = None,
) -> float:
    """Minimise the beta-VAE loss with Adam, in place, and return the CPU seconds of it, earlier processes' included.

    The VAE stays on its device; what is drawn is drawn by ``generator``, on the CPU.

    Raises:
        DivergedError: The loss is not finite any more; the message names the step.
        ArtefactError: What is unfinished is damaged or another training.
    """
    optimiser = torch.optim.Adam(vae.parameters(), lr=recipe.learning_rate, fused=True)
    n = len(data.images)
    first = 0
    order = torch.empty(0, dtype=torch.int64)
    begun_s = time.process_time()
    device = next(vae.parameters()).device
    data = replace(data, images=data.images.to(device))
    at_once = _PART if device.type == "cpu" else recipe.batch
    if unfinished is not None and (kept := unfinished.load()) is not None:
        first = kept["step"]
        order = kept["order"]
        begun_s = begun_s - kept["cpu_s"]
        vae.load_state_dict(kept["vae"])
        optimiser.load_state_dict(kept["optimiser"])
        generator.set_state(kept["generator"])

    def so_far(step: int, order: Tensor) -> Kept:
        made = {"vae": vae.state_dict(), "optimiser": optimiser.state_dict(), "generator": generator.get_state()}
        return {"step": step, "order": order, "cpu_s": time.process_time() - begun_s, **made}

    for step in range(first, recipe.steps):
        while len(order) < recipe.batch:
            order = torch.cat([order, torch.randperm(n, generator=generator)])
        rows = order[: recipe.batch]
        order = order[recipe.batch :]
        noise = torch.randn((len(rows), vae.latent_size), generator=generator)
        optimiser.param_groups[0]["lr"] = learning_rate_at(recipe, step)
        optimiser.zero_grad()
        total = torch.zeros((), device=device)
        for part, its_noise in zip(rows.to(device).split(at_once), noise.to(device).split(at_once), strict=True):
            loss = vae.elbo(data.batch(part), its_noise, beta_at(recipe, step)).loss * (len(part) / len(rows))
            loss.backward()
            total += loss.detach()
        optimiser.step()
        if (step % _CHECK_EVERY == 0 or step == recipe.steps - 1) and not total.isfinite():
            raise DivergedError(f"The encoder's loss became {total.item()} at step {step} of {recipe.steps}.")
        if unfinished is not None:
            unfinished.save(partial(so_far, step + 1, order))
        progress("training", (step + 1) / recipe.steps)
    return time.process_time() - begun_s


def train_encoder(
    spec: TaskSpec,
    *,
    recipe: str | Recipe,
    appearance: str,
    seed: int,
    progress: Progress | None = None,
    unfinished: Path | None = None,
    device: str = "cpu",
) -> Encoder:
    """Make an encoder from nothing: the same arguments give the same weights, bit for bit, on one machine.

    A recipe is a name among the task's ``RECIPES``, or settings of one's own. ``seed`` is the root of the seed tree:
    training frames come from its ``encoder_training`` branch and held-out ones from its ``encoder_probe`` branch, of
    looks kept for tests where the appearance has such. ``unfinished`` is a file in which a VAE's training is kept once
    a minute and from which one that was killed goes on; when all is done it is removed. ``device`` is where a VAE's
    gradient steps are made; all else is the CPU's.

    Raises:
        UnknownNameError: An unknown recipe, appearance or device.
        SetupError: The machine has no such device.
        DivergedError: The loss became NaN or infinite.
        InvalidValueError: A recipe of codes found no factor with two values in so few or such like frames.
        ArtefactError: The unfinished training is damaged or another one.
    """
    recipe = recipe_named(recipe, spec.config_group) if isinstance(recipe, str) else recipe
    if recipe.kind == "codes":
        recipe = replace(recipe, frames=recipe.frames * max(image_shape(spec.preprocessing)[0], 3) // 3)
    appearance = appearance_name(appearance)
    progress = progress or (lambda stage, done: None)
    prepare_torch(device)
    seeds = SeedTree(seed)
    train_seeds, probe_seeds = (seeds.child(use, spec.id, appearance) for use in ("encoder_training", "encoder_probe"))
    clock = {"": time.process_time()}
    data = frame_set(spec, appearance, recipe.frames, train_seeds.generator(), progress)
    unseen = appearance_of_tests(appearance)
    held_out = frame_set(spec, unseen, recipe.held_out_frames, probe_seeds.generator(), progress)
    clock["frames"] = time.process_time()
    generator = torch.Generator().manual_seed(train_seeds.child("torch").integer())
    network: EncoderNetwork
    if recipe.kind == "codes":
        network = discover(data.batch(torch.arange(recipe.frames)), generator)
    else:
        what = f"{spec.id} {appearance} {seed} {recipe} {device}"
        kept = None if unfinished is None else Unfinished(unfinished, what)
        network, training_s = _trained_vae(recipe, spec.preprocessing, data, generator, progress, kept, device)
        earlier_s = clock["frames"] + training_s - time.process_time()
        clock |= {stage: at - earlier_s for stage, at in clock.items()}
    _round_to_half(network)
    clock["training"] = time.process_time()
    cardinalities = classes_of(spec)
    latents = latents_of(network, data)
    probe, linear = (empty_probe(network.latent_size, cardinalities, hidden) for hidden in (PROBE_HIDDEN, 0))
    for reader in (probe.to_empty(device="cpu"), linear.to_empty(device="cpu")):
        train_probe(reader, latents, data.macrostates, steps=recipe.probe_steps, generator=generator)
        _round_to_half(reader)
    clock["probe"] = time.process_time()
    progress("probe", 1.0)
    noise = torch.Generator().manual_seed(probe_seeds.child("torch").integer())
    measured = _measure(network, probe, linear, held_out, noise)
    sizes = network.code_sizes if isinstance(network, DiscreteEncoder) else ()
    measured |= {"latent_size": network.latent_size, "code_sizes": sizes, "cpu_s": _laps(clock)}
    return Encoder(network, probe, _card(spec, recipe, appearance, seed, device, **measured))


def _card(spec: TaskSpec, recipe: Recipe, appearance: str, seed: int, device: str, **measured: Any) -> EncoderCard:
    gpu = {"gpu": torch.cuda.get_device_name()} if device == "cuda" else {}
    return EncoderCard(
        task=spec.id,
        appearance=appearance,
        recipe=recipe,
        preprocessing=spec.preprocessing,
        macrostate_names=spec.macrostate_names,
        cardinalities=classes_of(spec),
        seed=seed,
        command=f"imagine-bench encoder --task {spec.id} --appearance {appearance} "
        f"--recipe {recipe.name} --seed {seed}{_changed(spec, recipe)}{' --device cuda' if gpu else ''}",
        data=f"{recipe.frames} training and {recipe.held_out_frames} held-out frames, kinematic, macrostates uniform",
        versions={name: version(name) for name in _LIBRARIES} | gpu,
        **measured,
    )


def _changed(spec: TaskSpec, recipe: Recipe) -> str:
    """The options of the command that changed a recipe's numbers, where they did."""
    named = RECIPES[spec.config_group].get(recipe.name, recipe)
    pairs = ((name, getattr(recipe, name)) for name in ("steps", "batch", "latents"))
    return "".join(f" --{name} {value}" for name, value in pairs if value != getattr(named, name))


def _laps(clock: dict[str, float]) -> dict[str, float]:
    """Seconds of each stage and in total, from the times at which stages ended."""
    laps = {stage: end - start for start, (stage, end) in zip(clock.values(), list(clock.items())[1:], strict=False)}
    return {stage: round(seconds, 1) for stage, seconds in {**laps, "total": sum(laps.values())}.items()}


def _trained_vae(
    recipe: Recipe,
    preprocessing: str,
    data: FrameSet,
    generator: torch.Generator,
    progress: Progress,
    unfinished: Unfinished | None,
    device: str,
) -> tuple[Vae, float]:
    vae = empty_vae(recipe, preprocessing).to_empty(device="cpu")
    initialise(vae, generator)
    if isinstance(vae, MlpVae):
        vae.fit_appearance(data.batch(torch.arange(min(_CHUNK, recipe.frames))))
    cpu_s = train_vae(vae.to(device), data, recipe, generator, progress, unfinished)
    return vae.cpu(), cpu_s


@torch.no_grad()
def _round_to_half(network: torch.nn.Module) -> None:
    """Round the weights to the float16 that the artefact stores, so that the measured encoder is the loaded one."""
    for value in network.state_dict().values():
        value.copy_(value.half())


@torch.no_grad()
def latents_of(network: EncoderNetwork, data: FrameSet) -> Latents:
    """The latents of every frame."""
    chunks = [network.posterior(data.batch(rows)) for rows in torch.split(torch.arange(len(data.images)), _CHUNK)]
    mu, log_variance = (torch.cat(column) for column in zip(*chunks, strict=True))
    return Latents(mu, (0.5 * log_variance).exp())


def _measure(
    network: EncoderNetwork, probe: Probe, linear: Probe, held_out: FrameSet, generator: torch.Generator
) -> dict[str, Any]:
    """Measure an encoder on frames that no training saw, for its card."""
    latents = latents_of(network, held_out)
    right = held_out.macrostates
    kl = network.information(latents.mu, 2.0 * latents.sigma.log())
    read = {"linear": accuracy(linear, latents.mu, right), "mlp": accuracy(probe, latents.mu, right)}
    read["mlp_sampled"] = accuracy(probe, latents.sample(generator), right)
    reconstruction = _squared_error(network, held_out, latents)
    return {"kl_nats": round(kl.mean().item(), 3), "reconstruction": reconstruction, "probe": read}


@torch.no_grad()
def _squared_error(network: EncoderNetwork, data: FrameSet, latents: Latents) -> float:
    """Squared error of the mean latents' images, mean a pixel."""
    total = 0.0
    for rows in torch.split(torch.arange(len(data.images)), _CHUNK):
        images = data.batch(rows)
        total += (network.mean(latents.mu[rows]) - network.target(images)).square().sum().item()
    return total / network.target(data.batch(torch.arange(1))).numel() / len(data.images)
