"""One figure of what an encoder keeps: real views, their reconstructions, and what the probe reads from them."""

from __future__ import annotations

import textwrap

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from imagine_bench.arrays import Arrays, Images
from imagine_bench.interfaces import Frame, TaskSpec
from imagine_bench.preprocessing import preprocess

from .encoder import Encoder, view
from .probe import Latents

COLUMNS = 8
_CELL = 192  # pixels, edge of an image
_GAP = 8  # pixels
_HEADING = 80  # pixels
_LABEL = 150  # pixels, left of the rows
_CAPTION = 60  # pixels, below the rows
_CAPTION_LETTERS = 26  # in a line of it
_INK = (20, 20, 20)
_MUTED = (110, 110, 110)
_WRONG = (190, 20, 20)
_PAPER = (255, 255, 255)


def sample_sheet(
    encoder: Encoder, spec: TaskSpec, frames: Frame, macrostates: NDArray[np.int64], generator: torch.Generator
) -> Image.Image:
    """A sheet with one column a frame: camera, network input, reconstruction from mean and from sampled latents.

    At most :data:`COLUMNS` ``frames`` (N, 64, 64, 3) are shown; ``macrostates`` (N, M) are the truth, to mark
    misreadings.
    """
    frames = frames[:COLUMNS]
    macrostates = macrostates[:COLUMNS]
    latents = Latents(*encoder.encode(frames))
    rows: Arrays = {
        "camera": frames,
        "encoder's view": view(preprocess(encoder.card.preprocessing)(frames), encoder.card.preprocessing),
        "decoded mean": encoder.decode(latents.mu),
        "decoded sample": encoder.decode(latents.sample(generator)),
    }
    read = encoder.read_macrostate(latents.mu)
    cell = _CELL + _GAP
    sheet = Image.new("RGB", (_LABEL + cell * len(frames), _HEADING + cell * len(rows) + _CAPTION), _PAPER)
    draw = ImageDraw.Draw(sheet)
    _write_heading(draw, encoder)
    for row, (label, images) in enumerate(rows.items()):
        top = _HEADING + row * cell
        draw.text((_GAP, top + cell / 2), label, fill=_MUTED, font=ImageFont.load_default(16))
        for column, image in enumerate(images):
            sheet.paste(_enlarged(image), (_LABEL + column * cell, top))
    for column, (right, found) in enumerate(zip(macrostates, read, strict=True)):
        values = [value.replace("_", " ") for value in spec.value_names(found)]
        words = " · ".join(value.split()[-1] for value in values)
        names = "\n".join(textwrap.wrap(words, width=_CAPTION_LETTERS))
        color = _INK if (right == found).all() else _WRONG
        draw.text(
            (_LABEL + column * cell, _HEADING + cell * len(rows)), names, fill=color, font=ImageFont.load_default(14)
        )
    return sheet


def _write_heading(draw: ImageDraw.ImageDraw, encoder: Encoder) -> None:
    card = encoder.card
    title = f"{card.task}, appearance {card.appearance}, recipe {card.recipe.name}: {card.latent_size} latents"
    numbers = (
        f"whole macrostate read right on {card.recipe.held_out_frames} fresh frames: {card.probe['mlp']:.2%} "
        f"(sampled latents {card.probe['mlp_sampled']:.2%}, linear reader {card.probe['linear']:.2%}) · "
        f"KL {card.kl_nats:.1f} nats · {card.cpu_s['total']:.0f} CPU s."
    )
    reading = f"Below each column what the probe reads ({' · '.join(card.macrostate_names)}), red where it is wrong."
    draw.text((_GAP, _GAP), title, fill=_INK, font=ImageFont.load_default(20))
    draw.text((_GAP, _GAP + 27), numbers, fill=_MUTED, font=ImageFont.load_default(14))
    draw.text((_GAP, _GAP + 46), reading, fill=_MUTED, font=ImageFont.load_default(14))


def _enlarged(pixels: Images) -> Image.Image:
    if pixels.dtype != np.uint8:
        pixels = np.rint(pixels * 255.0).astype(np.uint8)
    return Image.fromarray(pixels).convert("RGB").resize((_CELL, _CELL), Image.Resampling.NEAREST)
