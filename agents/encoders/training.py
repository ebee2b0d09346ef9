"""Make an encoder: render frames, train the VAE or discover the factors, fit the evaluation-only probe, measure.

Every measurement is on fresh frames. An encoder that another package offers is not trained; its scale is measured when
it is first used, and it is kept with its probe in an ordinary encoder's file, which names the offer.
"""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from imagine_bench.appearance import appearance_name
from imagine_bench.arrays import Floats32, Frame, Ints
from imagine_bench.errors import ArtefactError, DivergedError
from imagine_bench.interfaces import TaskSpec, appearance_of_tests
from imagine_bench.preprocessing import preprocess
from imagine_bench.rules import states_of
from imagine_bench.seeding import SeedTree

from ..networks.mlp import initialise
from .discrete_encoder import discover
from .encoder import Encoder, EncoderCard, write_whole
from .network import EncoderNetwork, OfferedNetwork, image_shape, read_whole
from .perception import prepare_torch
from .probe import Latents, Probe, accuracy, train_probe
from .recipes import RECIPES, Recipe
from .vae import Vae, build_vae

Progress = Callable[[str, float], None]
"""Told the stage (``"frames"``, ``"training"``, ``"probe"``) and the fraction of it that is done."""

_CHUNK = 500  # frames rendered at once, to bound memory
_PART = 250  # images whose gradients are added up: 2000 at once leave the processor's caches
_CHECK_EVERY = 50  # steps between checks for NaN
_RISE = 0.02  # fraction of the steps over which the learning rate rises
_LIBRARIES = ("torch", "numpy", "mujoco")
SAVE_EVERY_S = 60.0
"""Seconds between two states of a training that are kept."""
OFFERED = Recipe(name="offered", architecture="offered", frames=4000, held_out_frames=1000, probe_steps=2000)
"""Frames that scale and probe of another package's encoder are made of, and the probe's steps."""


class FrameSet(NamedTuple):
    """Labelled frames: images (N, C, H, W), preprocessed, uint8 to quarter the memory; macrostates (N, M)."""

    images: Tensor
    macrostates: Ints

    def batch(self, rows: Tensor) -> Tensor:
        """The images of ``rows`` (B,) in [0, 1]. Shape (B, C, H, W)."""
        return self.images[rows].float() / 255.0


def shown_states(spec: TaskSpec) -> Ints:
    """Return everything that frames of a task may show: every macrostate, with -1 for hidden coordinates."""
    states = states_of(spec.rules)
    sight = spec.sight
    seen = [] if sight is None else [what for step in (0, 1) for s in states for _, what in sight.seen(s, step)]
    return np.array(list(dict.fromkeys((*states, *seen))), dtype=np.int64)


def classes_of(spec: TaskSpec) -> tuple[int, ...]:
    """How many values each coordinate shows; one more, the last, where it may be hidden. Length M."""
    hidden = [bool(lowest < 0) for lowest in shown_states(spec).min(axis=0)]
    return tuple(len(values) + also for values, also in zip(spec.macrostate_values, hidden, strict=True))


def draw_frames(spec: TaskSpec, appearance: str, n: int, rng: np.random.Generator) -> tuple[Frame, Ints]:
    """Frames (n, 64, 64, 3) of macrostates drawn uniformly from all that frames show, and their classes (n, M)."""
    states = shown_states(spec)
    macrostates = states[rng.integers(len(states), size=n)]
    return spec.render_macrostates(macrostates, appearance, rng), macrostates % classes_of(spec)


def frame_set(
    spec: TaskSpec,
    appearance: str,
    n: int,
    rng: np.random.Generator,
    progress: Progress,
    prepare: Callable[[Frame], Floats32] | None = None,
) -> FrameSet:
    """Render ``n`` labelled frames of uniformly drawn macrostates, preprocessed as the task declares or else."""
    prepare = prepare or preprocess(spec.preprocessing)
    images: list[Tensor] = []
    labels: list[Ints] = []
    for start in range(0, n, _CHUNK):
        frames, macrostates = draw_frames(spec, appearance, min(_CHUNK, n - start), rng)
        images.append(torch.from_numpy(np.rint(prepare(frames) * 255.0).astype(np.uint8)))
        labels.append(macrostates)
        progress("frames", min(start + _CHUNK, n) / n)
    return FrameSet(torch.cat(images), np.concatenate(labels))


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


class Unfinished:
    """Keeps a training in a file, so that one that was killed goes on with the same bits.

    The file is three times as large as the weights; ``what`` names the training uniquely.
    """

    def __init__(self, path: Path, what: str) -> None:
        self._path = path
        self._what = what
        self._saved_s = time.monotonic()

    def load(self) -> dict[str, Any] | None:
        """Return the kept state, or None. Raises ArtefactError if the file is damaged or of another training."""
        if not self._path.exists():
            return None
        try:
            what, kept = torch.load(self._path, weights_only=True)
        except Exception as error:  # a damaged file can be wrong in any way
            raise ArtefactError(f"{self._path} is damaged; remove it to begin anew.") from error
        if what != self._what:
            raise ArtefactError(f"{self._path} is of another training; remove it or choose another folder.")
        return kept

    def due(self) -> bool:
        """Whether the last state was kept more than a minute ago."""
        return time.monotonic() - self._saved_s >= SAVE_EVERY_S

    def save(self, kept: dict[str, Any]) -> None:
        """Write numbers, tensors and states of optimisers atomically."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()
        torch.save((self._what, kept), content)  # to a full disk torch itself would end in an error of its own
        write_whole(self._path, content.getvalue())
        self._saved_s = time.monotonic()


def train_vae(
    vae: Vae,
    data: FrameSet,
    recipe: Recipe,
    generator: torch.Generator,
    progress: Progress,
    unfinished: Unfinished | None = None,
) -> float:
    """Minimise the beta-VAE loss with Adam, in place, and return the CPU seconds that earlier processes spent on it.

    The VAE stays on its device; random numbers are drawn by ``generator``, on the CPU.

    Raises:
        DivergedError: The loss is not finite any more; the message names the step.
        ArtefactError: The unfinished training is damaged or another one.
    """
    optimiser = torch.optim.Adam(vae.parameters(), lr=recipe.learning_rate, fused=True)
    kept: dict[str, Any] = {"step": 0, "order": torch.empty(0, dtype=torch.int64), "cpu_s": 0.0}
    found = None if unfinished is None else unfinished.load()
    if found is not None:
        kept = found
        vae.load_state_dict(kept["vae"])
        optimiser.load_state_dict(kept["optimiser"])
        generator.set_state(kept["generator"])
    order = kept["order"]
    begun_s = time.process_time() - kept["cpu_s"]
    device = next(vae.parameters()).device
    data = data._replace(images=data.images.to(device))
    at_once = _PART if device.type == "cpu" else recipe.batch
    for step in range(kept["step"], recipe.steps):
        while len(order) < recipe.batch:
            order = torch.cat([order, torch.randperm(len(data.images), generator=generator)])
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
        if unfinished is not None and unfinished.due():
            learned = {"vae": vae.state_dict(), "optimiser": optimiser.state_dict(), "generator": generator.get_state()}
            counted = {"step": step + 1, "order": order, "cpu_s": time.process_time() - begun_s}
            unfinished.save({**learned, **counted})
        progress("training", (step + 1) / recipe.steps)
    return kept["cpu_s"]


def train_encoder(
    spec: TaskSpec,
    *,
    recipe: Recipe,
    appearance: str,
    seed: int,
    progress: Progress = lambda stage, done: None,
    unfinished: Path | None = None,
    device: str = "cpu",
    offer: str = "",
) -> Encoder:
    """Make an encoder from nothing: the same arguments give the same weights, bit for bit, on one machine.

    ``seed`` is the root of the seed tree: training frames come from its ``encoder_training`` branch and held-out ones
    from its ``encoder_probe`` branch, of looks kept for tests where the appearance has such. ``unfinished`` is a file
    in which a VAE's training is kept once a minute and from which one that was killed goes on; when all is done it is
    removed. ``device`` is where a VAE's gradient steps are made; all else is the CPU's. ``offer`` is the
    ``"module:attr"`` of another package's offer, in the recipe :data:`OFFERED`.

    Raises:
        UnknownNameError: An unknown appearance or device.
        SetupError: The machine has no such device.
        DivergedError: The loss became NaN or infinite.
        InvalidValueError: A recipe of codes found no factor with two values in so few or such like frames, or the
            offered object gives no latents.
        ArtefactError: The unfinished training is damaged or another one.
    """
    if recipe.kind == "codes":
        recipe = replace(recipe, frames=recipe.frames * max(image_shape(spec.preprocessing)[0], 3) // 3)
    appearance = appearance_name(appearance)
    prepare_torch(device)
    seeds = SeedTree(seed)
    train_seeds = seeds.child("encoder_training", spec.id, appearance)
    probe_seeds = seeds.child("encoder_probe", spec.id, appearance)
    prepare = read_whole if offer else None
    begun_s = time.process_time()
    data = frame_set(spec, appearance, recipe.frames, train_seeds.generator(), progress, prepare)
    unseen = appearance_of_tests(appearance)
    held_out = frame_set(spec, unseen, recipe.held_out_frames, probe_seeds.generator(), progress, prepare)
    generator = torch.Generator().manual_seed(train_seeds.child("torch").integer())
    network: EncoderNetwork
    if offer:
        network = _fitted_offer(offer, data)
    elif recipe.kind == "codes":
        network = discover(data.batch(torch.arange(recipe.frames)), generator)
    else:
        what = f"{spec.id} {appearance} {seed} {recipe} {device}"
        kept = None if unfinished is None else Unfinished(unfinished, what)
        network = vae = build_vae(recipe, spec.preprocessing)
        initialise(vae, generator)
        vae.fit_appearance(data.batch(torch.arange(min(_CHUNK, recipe.frames))))
        begun_s -= train_vae(vae.to(device), data, recipe, generator, progress, kept)
    _round_to_half(network.cpu())
    latents = latents_of(network, data)
    probe = Probe(network.latent_size, classes_of(spec))
    linear = Probe(network.latent_size, classes_of(spec), hidden=0)
    for reader in (probe, linear):
        train_probe(reader, latents, data.macrostates, steps=recipe.probe_steps, generator=generator)
        _round_to_half(reader)
    progress("probe", 1.0)
    measured = _measured(network, probe, linear, held_out, probe_seeds.child("torch").integer())
    measured["cpu_s"] = {"total": round(time.process_time() - begun_s, 1)}
    return Encoder(network, probe, _card(spec, recipe, appearance, seed, device, offer=offer, **measured))


def _card(
    spec: TaskSpec, recipe: Recipe, appearance: str, seed: int, device: str, *, offer: str, **measured: Any
) -> EncoderCard:
    """The card of an encoder; its command names the options that changed a recipe's numbers."""
    gpu = {"gpu": torch.cuda.get_device_name()} if device == "cuda" else {}
    command = f"imagine-bench encoder --task {spec.id} --appearance {appearance} --recipe {recipe.name} --seed {seed}"
    named = RECIPES[spec.config_group].get(recipe.name, recipe)
    for name in ("steps", "batch", "latents"):
        if getattr(recipe, name) != getattr(named, name):
            command += f" --{name} {getattr(recipe, name)}"
    if gpu:
        command += " --device cuda"
    if offer:
        command = f"imagine-bench bench --task {spec.id} --appearance {appearance} --encoder {recipe.name}"
    training = f"those of {offer}, {recipe.frames}" if offer else f"{recipe.frames} training"
    return EncoderCard(
        task=spec.id,
        appearance=appearance,
        recipe=recipe,
        preprocessing=spec.preprocessing,
        macrostate_names=spec.macrostate_names,
        cardinalities=classes_of(spec),
        seed=seed,
        command=command,
        data=f"{training} and {recipe.held_out_frames} held-out frames, kinematic, macrostates uniform",
        versions={name: version(name) for name in _LIBRARIES} | gpu,
        offer=offer,
        **measured,
    )


@torch.no_grad()
def _round_to_half(network: torch.nn.Module) -> None:
    """Round the weights to the float16 that the artefact stores, so that the measured encoder is the loaded one."""
    for value in network.state_dict().values():
        value.copy_(value.half())


@torch.no_grad()
def latents_of(network: EncoderNetwork, data: FrameSet) -> Latents:
    """The latents of every frame."""
    chunks = [network.posterior(data.batch(rows)) for rows in torch.arange(len(data.images)).split(_CHUNK)]
    mu, log_variance = (torch.cat(column) for column in zip(*chunks, strict=True))
    return Latents(mu, (0.5 * log_variance).exp())


@torch.no_grad()
def _measured(network: EncoderNetwork, probe: Probe, linear: Probe, held_out: FrameSet, seed: int) -> dict[str, Any]:
    """The entries of a card about an encoder on frames that no training saw."""
    latents = latents_of(network, held_out)
    sampled = latents.sample(torch.Generator().manual_seed(seed))
    right = held_out.macrostates
    squared = 0.0
    pixels = 0
    for rows in torch.arange(len(right)).split(_CHUNK):
        target = network.target(held_out.batch(rows))
        squared += (network.mean(latents.mu[rows]) - target).square().sum().item()
        pixels += target.numel()
    return {
        "latent_size": network.latent_size,
        "code_sizes": network.code_sizes,
        "kl_nats": round(network.information(latents.mu, 2.0 * latents.sigma.log()).item(), 3),
        "reconstruction": squared / pixels,
        "probe": {
            "linear": accuracy(linear, latents.mu, right),
            "mlp": accuracy(probe, latents.mu, right),
            "mlp_sampled": accuracy(probe, sampled, right),
        },
    }


def fit_offered(spec: TaskSpec, *, name: str, offer: str, appearance: str, path: Path) -> None:
    """Measure the scale of another package's offer, train the probe and write the artefact.

    Raises:
        InvalidValueError: The offered object gives no latents.
        ArtefactError: The file exists.
    """
    train_encoder(spec, recipe=replace(OFFERED, name=name), appearance=appearance, seed=0, offer=offer).save(path)


def _fitted_offer(offer: str, data: FrameSet) -> OfferedNetwork:
    """The offer of another package; latents that are no codes are brought to mean 0 and standard deviation 1."""
    network = OfferedNetwork(offer)
    if not network.code_sizes:
        mu = latents_of(network, data).mu
        network.centre.copy_(mu.mean(dim=0))
        network.scale.copy_(mu.std(dim=0).clamp_min(1e-3))
    return network
