"""Picture strips of imagined rollouts: what the real environment shows above, what the agent imagined below."""

from __future__ import annotations

import functools
import io
import textwrap
from importlib import resources

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from imagine_bench.store.results import ComparedRollout

_CELL = 128  # pixels: a 64-pixel frame at 2x, nearest, so that no pixel is hallucinated
_GAP = 12
_LABELS = 108  # width of the column that names the rows
_HEADER, _FOOTER = 62, 92
_ROW = _CELL + _GAP
INK, FAINT, PAPER = (28, 30, 34), (120, 124, 130), (255, 255, 255)
RIGHT, WRONG, _CUT = (0, 114, 178), (213, 94, 0), (204, 30, 90)  # Okabe-Ito blue and vermilion: color-blind safe


def rollout_strip(
    compared: ComparedRollout, action_names: tuple[str, ...], *, columns: int | None = None
) -> NDArray[np.uint8]:
    """Draw one imagined rollout beside reality, one column a macro-action.

    Each column names the macro-action and shows the real frame, the decoded imagined one, and the predicted reward,
    P(end) and epistemic uncertainty, with the true reward in brackets. A vertical line marks where the uncertainty
    filter cut; what it threw away is paler. The frame around an imagined picture is blue where its macrostate is what
    the rules say and orange where it is not; the words below say the same. Where nothing real is to
    compare with (a plan that was not carried out that far), the upper row stays empty.

    Args:
        compared: The rollout of depth D and its real counterpart, of depth D or less.
        action_names: Names of the task's macro-actions.
        columns: Macro-actions to make room for; None for exactly D. Deeper rollouts are shown up to there.

    Returns:
        The picture. Shape (height, width, 3), uint8.
    """
    depth = len(compared.rollout.actions)
    room = depth if columns is None else columns
    width = _LABELS + (room + 1) * _ROW
    canvas = Image.new("RGB", (width, _HEADER + 2 * _ROW + _FOOTER), PAPER)
    draw = ImageDraw.Draw(canvas)
    _row_labels(draw)
    _picture(canvas, compared.start_frame, column=0, row=0)
    _picture(canvas, rgb(compared.rollout.start_frame), column=0, row=1)
    draw.text((_left(0), _HEADER - 20), "start", font=font(13, bold=True), fill=INK)
    for index in range(min(depth, room)):
        _column(canvas, draw, compared, index, action_names)
    _cut_mark(draw, compared, room)
    return np.asarray(canvas)


def png(picture: NDArray[np.uint8]) -> bytes:
    """Encode a picture (height, width, 3), uint8, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG")
    return buffer.getvalue()


def rgb(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A picture in [0, 1], gray (H, W) or RGB (H, W, 3), as RGB bytes (H, W, 3)."""
    pixels = (np.clip(picture, 0.0, 1.0) * 255.0).round().astype(np.uint8)
    return pixels if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2)


def first_cut(compared: ComparedRollout) -> int | None:
    """Index of the first macro-action that the uncertainty filter throws away, or None where it keeps all."""
    rejected = np.flatnonzero(~compared.rollout.accepted)
    return int(rejected[0]) if rejected.size else None


def _column(
    canvas: Image.Image, draw: ImageDraw.ImageDraw, compared: ComparedRollout, index: int, names: tuple[str, ...]
) -> None:
    rollout, column = compared.rollout, index + 1
    kept, happened = bool(rollout.accepted[index]), index < len(compared.real_frames)
    over = 0 < index <= len(compared.real_frames) and bool(compared.real_terminated[index - 1])
    right = happened and np.array_equal(rollout.macrostates[index], compared.real_macrostates[index])
    judged = happened and not over
    ink = INK if kept else FAINT
    lines = textwrap.wrap(f"{index + 1}. {names[int(rollout.actions[index])]}", width=18)[:3]
    draw.multiline_text((_left(column), 8), "\n".join(lines), font=font(12, bold=True), fill=ink, spacing=3)
    if happened:
        _picture(canvas, compared.real_frames[index], column=column, row=0, pale=over)
    if over:
        _overlay_text(draw, column, "episode over")
    _picture(canvas, rgb(rollout.frames[index]), column=column, row=1, pale=not kept)
    if judged:
        _frame(draw, column, RIGHT if right else WRONG)
    truth = f" ({_signed(compared.real_rewards[index])})" if happened else ""
    facts = [
        ("as the rules say" if right else "not what happens") if judged else "",
        f"reward {_signed(rollout.rewards[index])}{truth}",
        f"P(end) {rollout.p_terminated[index]:.2f}",
        f"epistemic {rollout.epistemic[index]:.2g}",
    ]
    for line, text in enumerate(facts):
        color = (RIGHT if right else WRONG) if line == 0 else ink
        draw.text((_left(column), _HEADER + 2 * _ROW + line * 19), text, font=font(12, bold=line == 0), fill=color)


def _cut_mark(draw: ImageDraw.ImageDraw, compared: ComparedRollout, room: int) -> None:
    cut = first_cut(compared)
    if cut is None or cut >= room:
        return
    x = _left(cut + 1) - _GAP // 2 - 1
    draw.line([(x, 4), (x, _HEADER + 2 * _ROW + _FOOTER - 20)], fill=_CUT, width=3)
    text = "filter cuts here"
    length = int(draw.textlength(text, font=font(11, bold=True)))
    bottom = _HEADER + 2 * _ROW + _FOOTER - 16
    draw.text((max(2, x - length // 2), bottom), text, font=font(11, bold=True), fill=_CUT)


def _row_labels(draw: ImageDraw.ImageDraw) -> None:
    bottom = _HEADER + 2 * _ROW
    for y, text in ((_HEADER + 54, "real"), (_HEADER + _ROW + 54, "imagined")):
        draw.text((8, y), text, font=font(15, bold=True), fill=INK)
    draw.multiline_text((8, bottom + 19), "predicted\n(true)", font=font(12), fill=FAINT, spacing=4)


def _overlay_text(draw: ImageDraw.ImageDraw, column: int, text: str) -> None:
    length = draw.textlength(text, font=font(13, bold=True))
    x, y = _left(column) + (_CELL - length) / 2, _HEADER + _CELL / 2 - 8
    draw.text((x, y), text, font=font(13, bold=True), fill=INK)


def _frame(draw: ImageDraw.ImageDraw, column: int, color: tuple[int, int, int]) -> None:
    x, y = _left(column), _HEADER + _ROW
    draw.rectangle([x - 3, y - 3, x + _CELL + 2, y + _CELL + 2], outline=color, width=3)


def _picture(canvas: Image.Image, pixels: NDArray[np.uint8], *, column: int, row: int, pale: bool = False) -> None:
    image = Image.fromarray(pixels).resize((_CELL, _CELL), Image.Resampling.NEAREST)
    if pale:
        image = Image.blend(image, Image.new("RGB", image.size, PAPER), 0.65)
    canvas.paste(image, (_left(column), _HEADER + row * _ROW))


def _left(column: int) -> int:
    return _LABELS + column * _ROW


def _signed(value: float) -> str:
    return f"{value:+.1f}".replace("-", "\u2212")


@functools.lru_cache
def font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which travels with matplotlib."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    data = resources.files("matplotlib").joinpath("mpl-data", "fonts", "ttf", name).read_bytes()
    return ImageFont.truetype(io.BytesIO(data), size)
