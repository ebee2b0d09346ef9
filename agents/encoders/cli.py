"""The command ``imagine-bench encoder``: make an encoder and say how it compares to the one that is bundled."""

from __future__ import annotations

import io
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from imagine_bench.appearance import appearance_name
from imagine_bench.arrays import Arrays, Frame, Ints
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import TaskSpec, appearance_of_tests, bundled_name
from imagine_bench.preprocessing import preprocess
from imagine_bench.seeding import SeedTree

from .encoder import Encoder, EncoderCard, bundled_encoder, refuse_existing, view
from .probe import Latents
from .recipes import Recipe, recipe_named
from .training import draw_frames, train_encoder

_LINE_EVERY_S = 15.0  # where nobody watches a terminal
COLUMNS = 8
"""Frames in the figure."""


def retrain(
    spec: TaskSpec,
    *,
    recipe: str | Recipe,
    appearance: str,
    seed: int,
    out: Path,
    device: str = "cpu",
    **numbers: int | None,
) -> str:
    """Make an encoder, leave artefact, card and figure in ``out``, and say how it compares to the bundled one.

    The files are ``<encoder>-<appearance>.safetensors`` (``-codes`` after it where the recipe gives codes), ``.json``
    and ``.png``. A recipe is a name among the task's ``RECIPES``, or settings of one's own; the numbers ``steps``,
    ``batch`` and ``latents`` replace its gradient steps, images a step and latents; the steps are made on ``device``.
    A training that was killed goes on from ``.<name>.unfinished.pt`` in ``out``.

    Raises:
        UnknownNameError: An unknown recipe, appearance or device.
        SetupError: The machine has no such device.
        ArtefactError: One of the three files exists; nothing was trained or written.
        DivergedError: The loss became NaN or infinite.
        InvalidValueError: A recipe of codes was given one of those numbers, or found no factor with two values in so
            few or such like frames.
    """
    recipe = recipe_named(recipe, spec.config_group) if isinstance(recipe, str) else recipe
    given: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
    choices = given if device == "cpu" else {**given, "device": device}
    if recipe.kind == "codes" and choices:
        options = " ".join(f"--{name} {value}" for name, value in choices.items())
        raise InvalidValueError(f"Recipe {recipe.name} finds its codes without gradient steps; leave out {options}.")
    recipe = replace(recipe, **given)
    appearance = appearance_name(appearance)
    name = bundled_name(spec.encoder, appearance, recipe.kind)
    path = out / f"{name}.safetensors"
    refuse_existing(path)
    unfinished = path.with_name(f".{name}.unfinished.pt")
    with tqdm(total=1.0, bar_format="{desc:10}{percentage:3.0f}% |{bar}| {elapsed}<{remaining}", disable=None) as bar:
        shown_s = time.monotonic()

        def show(stage: str, done: float) -> None:
            nonlocal shown_s
            bar.desc = stage
            bar.n = done
            bar.refresh()
            if bar.disable and time.monotonic() - shown_s > _LINE_EVERY_S:
                shown_s = time.monotonic()
                print(f"{name}: {stage} {done:.0%}", file=sys.stderr, flush=True)

        encoder = train_encoder(
            spec,
            recipe=recipe,
            appearance=appearance,
            seed=seed,
            progress=show,
            unfinished=unfinished,
            device=device,
        )
    seeds = SeedTree(seed).child("encoder_probe", spec.id, appearance, "picture")
    frames, macrostates = draw_frames(spec, appearance_of_tests(appearance), COLUMNS, seeds.generator())
    noise = torch.Generator().manual_seed(seeds.child("torch").integer())
    picture = io.BytesIO()
    sample_sheet(encoder, spec, frames, macrostates, noise).savefig(picture, format="png")
    encoder.save(path, picture.getvalue())
    with suppress(OSError):  # the encoder is whole
        unfinished.unlink(missing_ok=True)
    bundled = bundled_encoder(name)
    other = bundled.is_file() and bundled.resolve() != path.resolve()
    return f"Wrote {path}.\n{compare(encoder.card, Encoder.load(bundled).card if other else None)}"


def compare(new: EncoderCard, bundled: EncoderCard | None) -> str:
    """A line each of two cards, or of one where nothing is bundled."""
    text = f"new:     {summary(new)}"
    return text if bundled is None else f"{text}\nbundled: {summary(bundled)}"


def summary(card: EncoderCard) -> str:
    """The reading of held-out frames through an encoder, by the stored probe, from sampled latents and by a linear
    reader.
    """
    read = ", ".join(f"{name} {share:.2%}" for name, share in card.probe.items())
    cost = f"{card.kl_nats:.1f} nats from the prior, {card.cpu_s['total']:.0f} CPU s"
    return (
        f"recipe {card.recipe.name}, seed {card.seed}, {card.latent_size} latents; of {card.recipe.held_out_frames} "
        f"held-out frames read right: {read}; {cost}."
    )


def sample_sheet(
    encoder: Encoder, spec: TaskSpec, frames: Frame, macrostates: Ints, generator: torch.Generator
) -> Figure:
    """A figure of the information that an encoder keeps, one column a frame: camera, network input, decoded mean and
    decoded sample.

    Below each column of ``frames`` (N, 64, 64, 3) stands the probe's reading, red where it is not ``macrostates``
    (N, M).
    """
    latents = Latents(*encoder.encode(frames))
    preprocessing = encoder.card.preprocessing
    rows: Arrays = {
        "camera": frames,
        "encoder's view": view(preprocess(preprocessing)(frames), preprocessing),
        "decoded mean": encoder.decode(latents.mu),
        "decoded sample": encoder.decode(latents.sample(generator)),
    }
    figure = Figure(figsize=(2.0 * len(frames), 2.5 * len(rows)), layout="constrained")
    figure.suptitle(f"{encoder.card.task}, appearance {encoder.card.appearance}, recipe {encoder.card.recipe.name}")
    axes = figure.subplots(len(rows), len(frames), squeeze=False)
    for line, (label, images) in zip(axes, rows.items(), strict=True):
        line[0].set_ylabel(label)
        for place, image in zip(line, images, strict=True):
            place.imshow(image, cmap="gray", vmin=0.0, vmax=1.0)
            place.set(xticks=(), yticks=())
    for place, right, read in zip(axes[-1], macrostates, encoder.read_macrostate(latents.mu), strict=True):
        words = "\n".join(spec.value_names(read))
        place.set_xlabel(words, color="black" if (right == read).all() else "red")
    return figure
