"""The command ``imagine-bench encoder``: make an encoder and say how it compares to the one that is bundled."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from imagine_bench.appearance import appearance_name
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import TaskSpec, appearance_of_tests, bundled_name
from imagine_bench.seeding import SeedTree

from .encoder import Encoder, EncoderCard, bundled_encoder, refuse_existing
from .figure import COLUMNS, sample_sheet
from .recipes import Recipe, recipe_named
from .training import draw_frames, train_encoder


def retrain(
    spec: TaskSpec,
    *,
    recipe: str | Recipe,
    appearance: str,
    seed: int,
    out: Path,
    steps: int | None = None,
    batch: int | None = None,
    latents: int | None = None,
    device: str = "cpu",
) -> str:
    """Make an encoder, leave artefact, card and figure in ``out``, and say how it compares to the bundled one.

    The files are ``<encoder>-<appearance>.safetensors`` (``-codes`` after it where the recipe gives codes), ``.json``
    and ``.png``. A recipe is a name among the task's ``RECIPES``, or settings of one's own; ``steps``, ``batch`` and
    ``latents`` replace its numbers of gradient steps, of images a step and of latents; the steps are made on
    ``device``. A training that was killed goes on from ``.<name>.unfinished.pt`` in ``out``.

    Raises:
        UnknownNameError: An unknown recipe, appearance or device.
        SetupError: The machine has no such device.
        ArtefactError: One of the three files exists; nothing was trained or written.
        DivergedError: The loss became NaN or infinite.
        InvalidValueError: A recipe of codes was given one of those numbers, or found no factor with two values in so
            few or such like frames.
    """
    recipe = recipe_named(recipe, spec.config_group) if isinstance(recipe, str) else recipe
    numbers = {"steps": steps, "batch": batch, "latents": latents}
    given: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
    elsewhere = {} if device == "cpu" else {"device": device}
    if recipe.kind == "codes" and given | elsewhere:
        options = " ".join(f"--{name} {value}" for name, value in (given | elsewhere).items())
        raise InvalidValueError(f"Recipe {recipe.name} finds its codes without gradient steps; leave out {options}.")
    recipe = replace(recipe, **given)
    appearance = appearance_name(appearance)
    name = bundled_name(spec.encoder, appearance, recipe.kind)
    path = out / f"{name}.safetensors"
    refuse_existing(path)
    unfinished = path.with_name(f".{name}.unfinished.pt")
    with tqdm(total=1.0, bar_format="{desc:10}{percentage:3.0f}% |{bar}| {elapsed}<{remaining}", disable=None) as bar:
        show = partial(_show, bar)
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
    sheet = sample_sheet(encoder, spec, frames, macrostates, noise)
    picture = io.BytesIO()
    sheet.save(picture, format="png")
    encoder.save(path, picture.getvalue())
    unfinished.unlink(missing_ok=True)
    bundled = bundled_encoder(name)
    other = bundled.is_file() and bundled.resolve() != path.resolve()
    return f"Wrote {path}.\n{compare(encoder.card, Encoder.load(bundled).card if other else None)}"


def compare(new: EncoderCard, bundled: EncoderCard | None) -> str:
    """A small table of two cards, or of one where nothing is bundled."""
    columns = {"new": new} if bundled is None else {"new": new, "bundled": bundled}
    lines = [f"{'':34}" + "".join(f"{name:>12}" for name in columns)]
    for label, text in _ROWS.items():
        lines.append(f"{label:34}" + "".join(f"{text(card):>12}" for card in columns.values()))
    return "\n".join(lines)


_ROWS: dict[str, Callable[[EncoderCard], str]] = {
    "recipe": lambda card: card.recipe.name,
    "seed": lambda card: str(card.seed),
    "latents": lambda card: str(card.latent_size),
    "macrostate read right": lambda card: f"{card.probe['mlp']:.2%}",
    "  from sampled latents": lambda card: f"{card.probe['mlp_sampled']:.2%}",
    "  by a linear reader": lambda card: f"{card.probe['linear']:.2%}",
    "held-out frames": lambda card: str(card.recipe.held_out_frames),
    "KL from the prior, nats": lambda card: f"{card.kl_nats:.1f}",
    "CPU s, frames included": lambda card: f"{card.cpu_s['total']:.0f}",
}


def _show(bar: tqdm, stage: str, done: float) -> None:
    if bar.disable:
        return
    if bar.desc != f"{stage}: ":
        bar.set_description(stage, refresh=False)
        bar.reset()
    bar.update(done - bar.n)
