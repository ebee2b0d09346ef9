"""The command ``imagine-bench encoder``: make an encoder and say how it compares to the one that is bundled."""

from __future__ import annotations

from pathlib import Path

import torch
from tqdm import tqdm

from imagine_bench.errors import require_known
from imagine_bench.interfaces import APPEARANCES, TaskSpec, bundled_name
from imagine_bench.seeding import SeedTree

from .encoder import Encoder, EncoderCard, bundled_encoder, refuse_existing
from .figure import COLUMNS, sample_sheet
from .recipes import Recipe, recipe_named
from .training import draw_frames, train_encoder


def retrain(spec: TaskSpec, *, recipe: str | Recipe, appearance: str, seed: int, out: Path) -> str:
    """Make an encoder and leave artefact, card and figure in ``out``.

    Args:
        spec: The task.
        recipe: A name among the task's ``RECIPES``, or settings of one's own.
        appearance: Appearance level of the frames.
        seed: Root of the seed tree.
        out: Folder for ``<encoder>-<appearance>.safetensors`` (``-codes`` after it where the recipe gives codes),
            ``.json`` and ``.png``; made if missing.

    Returns:
        A few lines for a person: where it is, and how it compares to the bundled encoder.

    Raises:
        UnknownNameError: An unknown recipe or appearance.
        ArtefactError: One of the three files exists; nothing was trained or written.
        DivergedError: The loss became NaN or infinite.
        InvalidValueError: A recipe of codes found no factor with two values in so few or such like frames.
    """
    recipe = recipe_named(recipe, spec.settings) if isinstance(recipe, str) else recipe
    name = bundled_name(spec.encoder, require_known("appearance", appearance, APPEARANCES), recipe.kind)
    path = out / f"{name}.safetensors"
    refuse_existing(path, path.with_suffix(".json"), path.with_suffix(".png"))
    with tqdm(total=1.0, bar_format="{desc:10}{percentage:3.0f}% |{bar}| {elapsed}<{remaining}") as bar:
        encoder = train_encoder(
            spec, recipe=recipe, appearance=appearance, seed=seed, progress=lambda *at: _show(bar, *at)
        )
    seeds = SeedTree(seed).child("encoder_probe", spec.id, appearance, "picture")
    frames, macrostates = draw_frames(spec, appearance, COLUMNS, seeds.generator())
    noise = torch.Generator().manual_seed(seeds.child("torch").integer())
    sheet = sample_sheet(encoder, spec, frames, macrostates, noise)
    encoder.save(path)
    sheet.save(path.with_suffix(".png"))
    bundled = bundled_encoder(name)
    if not bundled.is_file() or bundled.resolve() == path.resolve():
        return f"Wrote {path}.\n{compare(encoder.card, None)}"
    return f"Wrote {path}.\n{compare(encoder.card, Encoder.load(bundled).card)}"


def compare(new: EncoderCard, bundled: EncoderCard | None) -> str:
    """A small table of two cards, or of one where nothing is bundled."""
    columns = {"new": new} if bundled is None else {"new": new, "bundled": bundled}
    lines = [f"{'':34}" + "".join(f"{name:>12}" for name in columns)]
    for label, texts in _rows(list(columns.values())).items():
        lines.append(f"{label:34}" + "".join(f"{text:>12}" for text in texts))
    return "\n".join(lines)


def _rows(cards: list[EncoderCard]) -> dict[str, list[str]]:
    return {
        "recipe": [card.recipe.name for card in cards],
        "seed": [str(card.seed) for card in cards],
        "latents": [str(card.latent_size) for card in cards],
        "macrostate read right": [f"{card.probe['mlp']:.2%}" for card in cards],
        "  from sampled latents": [f"{card.probe['mlp_sampled']:.2%}" for card in cards],
        "  by a linear reader": [f"{card.probe['linear']:.2%}" for card in cards],
        "held-out frames": [str(card.recipe.held_out_frames) for card in cards],
        "KL from the prior, nats": [f"{card.kl_nats:.1f}" for card in cards],
        "CPU s, frames included": [f"{card.cpu_s['total']:.0f}" for card in cards],
    }


def _show(bar: tqdm, stage: str, done: float) -> None:
    if bar.desc != f"{stage}: ":
        bar.set_description(stage, refresh=False)
        bar.reset()
    bar.update(done - bar.n)
