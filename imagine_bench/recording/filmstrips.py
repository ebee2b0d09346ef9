"""Filmstrips of imagined rollouts: beside reality, or several of one start below one another (thesis' figure 3.4)."""

from __future__ import annotations

import functools
import io
import textwrap
from collections.abc import Sequence
from importlib import resources

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from imagine_bench.interfaces import Macrostate, Rules, TaskSpec
from imagine_bench.rules import states_of
from imagine_bench.store.results import ComparedRollout

_CELL = 128  # pixels: a 64-pixel frame at 2x, nearest, so that no pixel is made up
_GAP = 12
_SHEET_GAP = 14
_MARGIN = 12
_LABELS = 108  # width of the column that names the rows
HEADER_PX = 62
_FOOTER = 92
_ROW = _CELL + _GAP
_BOTTOM = HEADER_PX + 2 * _ROW
_SHEET_HEADER = 36
_SHEET_LINE = 14
_LINE = 20  # characters
INK = (28, 30, 34)
FAINT = (120, 124, 130)
PAPER = (255, 255, 255)
RIGHT = (0, 114, 178)  # Okabe-Ito blue and vermilion: color-blind safe
WRONG = (213, 94, 0)
_CUT = (204, 30, 90)


def filmstrip(
    compared: ComparedRollout, action_names: tuple[str, ...], *, columns: int | None = None
) -> NDArray[np.uint8]:
    """Draw one imagined rollout below reality, one column a macro-action.

    Each column names the macro-action and shows the real frame, the decoded imagined one, and the predicted reward,
    P(end) and epistemic uncertainty, with the true reward in brackets. A vertical line marks where the uncertainty
    filter cuts; what it discards is paler. The border of an imagined frame is blue where its macrostate is what
    the rules say and orange where it is not; the text below says the same. Where nothing real is to
    compare with (a plan that was not carried out that far), the upper row stays empty. There is room for ``columns``
    macro-actions, None for all. The image has shape (height, width, 3), uint8.
    """
    depth = len(compared.rollout.actions)
    room = depth if columns is None else columns
    canvas = Image.new("RGB", (_LABELS + (room + 1) * _ROW, _BOTTOM + _FOOTER), PAPER)
    draw = ImageDraw.Draw(canvas)
    for y, text in ((HEADER_PX + 54, "real"), (HEADER_PX + _ROW + 54, "imagined")):
        draw.text((8, y), text, font=font(15, bold=True), fill=INK)
    draw.multiline_text((8, _BOTTOM + 19), "predicted\n(true)", font=font(12), fill=FAINT, spacing=4)
    _paste(canvas, compared.start_frame, (left_px(0), HEADER_PX))
    _paste(canvas, rgb(compared.rollout.start_frame), (left_px(0), HEADER_PX + _ROW))
    draw.text((left_px(0), HEADER_PX - 20), "start", font=font(13, bold=True), fill=INK)
    for index in range(min(depth, room)):
        _column(canvas, draw, compared, index, action_names)
    cut = first_cut(compared)
    if cut is not None and cut < room:
        _mark_cut(draw, left_px(cut + 1) - _GAP // 2 - 1)
    return np.asarray(canvas)


def sampled_filmstrips(sampled_rollouts: tuple[ComparedRollout, ...], spec: TaskSpec) -> NDArray[np.uint8]:
    """Draw imagined rollouts of one start below one another, a column a macro-action; only the start is real.

    Below each imagined frame stands what a probe says has changed: in blue where the rules make it possible, in
    orange where not, in black where frames hide or delay a part, so that single steps cannot be judged. The image has
    shape (height, width, 3), uint8.
    """
    depth = max(len(each.rollout.actions) for each in sampled_rollouts)
    texts = [_what_changes(each, step, spec) for each in sampled_rollouts for step in range(len(each.rollout.actions))]
    height = _SHEET_HEADER + _CELL + 12 + _SHEET_LINE * max(len(lines) for lines in texts) + _SHEET_GAP  # of a row
    width = 2 * _MARGIN + (depth + 1) * (_CELL + _SHEET_GAP)
    canvas = Image.new("RGB", (width, 2 * _MARGIN + len(sampled_rollouts) * height), PAPER)
    draw = ImageDraw.Draw(canvas)
    for row, compared in enumerate(sampled_rollouts):
        top = _MARGIN + row * height + _SHEET_HEADER
        if row == 0:
            _paste(canvas, compared.start_frame, (_MARGIN, top))
            draw.text((_MARGIN, top - 18), "the real start", font=font(12, bold=True), fill=INK)
        else:
            draw.text((_MARGIN, top + 40), "the same start,\nimagined again", font=font(12), fill=FAINT)
        for step in range(len(compared.rollout.actions)):
            _sampled_cell(canvas, draw, compared, step, top, spec)
    return np.asarray(canvas)


def transition_sheet(
    titles: Sequence[str],
    rows: Sequence[tuple[str, Sequence[NDArray[np.uint8]], Sequence[bool] | None]],
) -> NDArray[np.uint8]:
    """Draw single transitions side by side (thesis' figure 5.9): a title each, below it an image of each named row.

    Images are square, RGB bytes. A row that is judged has a border around each image, blue where it is right and
    orange where not, and says it below. The image has shape (height, width, 3), uint8.
    """
    height = _CELL + _SHEET_GAP + _SHEET_LINE
    size = (_LABELS + len(titles) * _ROW + _GAP, HEADER_PX + len(rows) * height)
    canvas = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(canvas)
    for column, title in enumerate(titles):
        lines = "\n".join(textwrap.wrap(title, width=18)[:3])
        draw.multiline_text((left_px(column), 8), lines, font=font(12, bold=True), fill=INK, spacing=3)
    for row, (name, images, verdicts) in enumerate(rows):
        top = HEADER_PX + row * height
        label = "\n".join(textwrap.wrap(name, width=13))
        draw.multiline_text((4, top + 40), label, font=font(11, bold=True), fill=INK, spacing=4)
        for column, image in enumerate(images):
            left = left_px(column)
            _paste(canvas, image, (left, top))
            if verdicts is not None:
                color, words = (RIGHT, "as the rules say") if verdicts[column] else (WRONG, "not what happens")
                draw.rectangle([left - 3, top - 3, left + _CELL + 2, top + _CELL + 2], outline=color, width=3)
                draw.text((left, top + _CELL + 4), words, font=font(12, bold=True), fill=color)
    return np.asarray(canvas)


def png(image: NDArray[np.uint8]) -> bytes:
    """Encode an image (height, width, 3), uint8, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def rgb(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """An image in [0, 1], gray (H, W) or RGB (H, W, 3), as RGB bytes (H, W, 3)."""
    pixels = (np.clip(image, 0.0, 1.0) * 255.0).round().astype(np.uint8)
    return pixels if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2)


def first_cut(compared: ComparedRollout) -> int | None:
    """Index of the first macro-action that the uncertainty filter discards, or None where it keeps all."""
    rejected = np.flatnonzero(~compared.rollout.accepted)
    return int(rejected[0]) if rejected.size else None


def changes(before: Macrostate, now: Macrostate, spec: TaskSpec) -> str:
    """What is different, in the task's own words."""
    named = zip(spec.macrostate_names, spec.value_names(now), before, now, strict=True)
    return ", ".join(f"{name} {value}" for name, value, was, after in named if was != after) or "nothing changes"


def is_possible(rules: Rules, before: Macrostate, action: int, now: Macrostate) -> bool:
    """Whether the rules allow ``now`` after ``action`` in ``before``."""
    state = tuple(before.tolist())
    reached = tuple(now.tolist())
    known = state in states_of(rules) and not rules.is_terminal(state)
    return known and any(outcome.macrostate == reached for outcome in rules.outcomes(state, action))


@functools.lru_cache
def font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which travels with matplotlib."""
    file = resources.files("matplotlib") / f"mpl-data/fonts/ttf/DejaVuSans{'-Bold' if bold else ''}.ttf"
    return ImageFont.truetype(io.BytesIO(file.read_bytes()), size)


def _column(
    canvas: Image.Image, draw: ImageDraw.ImageDraw, compared: ComparedRollout, index: int, names: tuple[str, ...]
) -> None:
    rollout = compared.rollout
    left = left_px(index + 1)
    kept = bool(rollout.accepted[index])
    happened = index < len(compared.real_frames)
    over = 0 < index <= len(compared.real_frames) and bool(compared.real_terminated[index - 1])
    right = happened and np.array_equal(rollout.macrostates[index], compared.real_macrostates[index])
    ink = INK if kept else FAINT
    verdict = RIGHT if right else WRONG
    words = ""
    lines = textwrap.wrap(f"{index + 1}. {names[int(rollout.actions[index])]}", width=18)[:3]
    draw.multiline_text((left, 8), "\n".join(lines), font=font(12, bold=True), fill=ink, spacing=3)
    if happened:
        _paste(canvas, compared.real_frames[index], (left, HEADER_PX), pale=over)
    if over:
        width = draw.textlength("episode over", font=font(13, bold=True))
        corner = (left + (_CELL - width) / 2, HEADER_PX + _CELL / 2 - 8)
        draw.text(corner, "episode over", font=font(13, bold=True), fill=INK)
    _paste(canvas, rgb(rollout.frames[index]), (left, HEADER_PX + _ROW), pale=not kept)
    if happened and not over:
        words = "as the rules say" if right else "not what happens"
        top = HEADER_PX + _ROW
        draw.rectangle([left - 3, top - 3, left + _CELL + 2, top + _CELL + 2], outline=verdict, width=3)
    truth = f" ({_signed(compared.real_rewards[index])})" if happened else ""
    draw.text((left, _BOTTOM), words, font=font(12, bold=True), fill=verdict)
    reward = f"reward {_signed(rollout.rewards[index])}{truth}"
    p_end = f"P(end) {rollout.p_terminated[index]:.2f}"
    for line, text in enumerate((reward, p_end, f"epistemic {rollout.epistemic[index]:.2g}"), start=1):
        draw.text((left, _BOTTOM + line * 19), text, font=font(12), fill=ink)


def _mark_cut(draw: ImageDraw.ImageDraw, x: int) -> None:
    draw.line([(x, 4), (x, _BOTTOM + _FOOTER - 20)], fill=_CUT, width=3)
    text = "filter cuts here"
    length = int(draw.textlength(text, font=font(11, bold=True)))
    draw.text((max(2, x - length // 2), _BOTTOM + _FOOTER - 16), text, font=font(11, bold=True), fill=_CUT)


def _sampled_cell(
    canvas: Image.Image, draw: ImageDraw.ImageDraw, compared: ComparedRollout, step: int, top: int, spec: TaskSpec
) -> None:
    rollout = compared.rollout
    left = _MARGIN + (step + 1) * (_CELL + _SHEET_GAP)
    action = int(rollout.actions[step])
    now = rollout.macrostates[step]
    before = _before(compared, step)
    title = textwrap.wrap(spec.action_names[action], width=_LINE)[:2]
    draw.multiline_text((left, top - _SHEET_HEADER), "\n".join(title), font=font(11, bold=True), fill=INK, spacing=2)
    _paste(canvas, rgb(rollout.frames[step]), (left, top))
    lines = _what_changes(compared, step, spec)
    color = INK
    if spec.sight is None:
        color = RIGHT if is_possible(spec.rules, before, action, now) else WRONG
    draw.multiline_text((left, top + _CELL + 3), "\n".join(lines), font=font(11), fill=color, spacing=2)


def _before(compared: ComparedRollout, step: int) -> Macrostate:
    return compared.start_macrostate if step == 0 else compared.rollout.macrostates[step - 1]


def _what_changes(compared: ComparedRollout, step: int, spec: TaskSpec) -> list[str]:
    """The lines below one imagined image."""
    end = "; the end" if compared.rollout.p_terminated[step] > 0.5 else ""
    return textwrap.wrap(changes(_before(compared, step), compared.rollout.macrostates[step], spec) + end, width=_LINE)


def _paste(canvas: Image.Image, pixels: NDArray[np.uint8], corner: tuple[int, int], *, pale: bool = False) -> None:
    image = Image.fromarray(pixels).resize((_CELL, _CELL), Image.Resampling.NEAREST)
    if pale:
        image = Image.blend(image, Image.new("RGB", image.size, PAPER), 0.65)
    canvas.paste(image, corner)


def left_px(column: int) -> int:
    """Where a column begins; column 0 is the start."""
    return _LABELS + column * _ROW


def _signed(value: float) -> str:
    return f"{value:+.1f}".replace("-", "\u2212")
